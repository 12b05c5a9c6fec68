//! Sums of measurements per cell, ground, robot, configuration and hour of measuring.

use tread_api::site::Cell;
use tread_api::terrain::TerrainRef;

use crate::friction::{Horizons, Sums};

/// Key of one sum.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct SumKey {
    /// Key of the robot.
    pub robot_pk: i64,
    /// Time of the measurement's end, hours since 1970.
    pub epoch_h: i64,
    /// The cell.
    pub cell: Cell,
    /// The terrain; `None` outside of all terrains.
    pub terrain: Option<TerrainRef>,
    /// Revision of the grid of the cell.
    pub grid_revision: u32,
    /// Key of the site.
    pub site_pk: i64,
    /// Key of the configuration.
    pub configuration_pk: i64,
}

/// A stored sum of one robot, configuration and hour in one cell.
#[derive(Debug, Clone, PartialEq)]
pub struct SumRow {
    /// Its key.
    pub key: SumKey,
    /// The sums.
    pub sums: Sums,
}

/// An hour of a robot under which sums are stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StoredHour {
    /// Key of the robot.
    pub robot_pk: i64,
    /// Hours since 1970.
    pub epoch_h: i64,
    /// Horizons of the robot's site.
    pub horizons: Horizons,
}
