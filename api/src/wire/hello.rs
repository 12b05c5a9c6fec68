//! A robot introduces itself; the server answers with the site.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};

use super::reply::{Acknowledgement, Command};
use crate::ids::{BootId, RobotId};
use crate::keys::Verb;
use crate::robot::{Capabilities, RobotModel};
use crate::safety::Geofence;
use crate::site::Grid;
use crate::terrain::TerrainShape;

/// What a robot says on every new connection.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Hello {
    /// Who speaks; the same as in the key.
    pub robot: RobotId,
    /// This run of the agent.
    pub boot: BootId,
    /// Version of the agent.
    #[serde(deserialize_with = "crate::text::bounded::<_, {crate::robot::VERSION_TEXT_MAX}>")]
    pub agent_version: String,
    /// Model and tyres.
    pub model: RobotModel,
    /// The robot's wall clock.
    pub robot_time: Timestamp,
    /// What the base and its agent can do; nothing beyond driving missions when absent.
    #[serde(default)]
    pub capabilities: Capabilities,
}

/// The server's answer.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Welcome {
    /// The site as the robot must know it.
    pub site: SiteDefinition,
    /// The server's wall clock.
    pub server_time: Timestamp,
}

/// What a robot must know of its site to name cells and terrains.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SiteDefinition {
    /// The grid.
    pub grid: Grid,
    /// Counts changes of the terrains; a robot reports the one it holds.
    pub terrain_revision: u64,
    /// All terrains.
    pub terrains: Vec<TerrainShape>,
    /// Where robots may be. An older server has none, an older robot ignores it.
    #[serde(default)]
    pub geofence: Geofence,
}

/// `cmd/site`: take this definition.
impl Command for SiteDefinition {
    const VERB: Verb = Verb::Site;
    type Reply = Acknowledgement;
}
