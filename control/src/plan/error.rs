//! Why a trajectory cannot be driven.

use thiserror::Error;

use super::{LENGTH_MAX_M, WAYPOINTS_MAX};
use crate::excitation::ExcitationError;
use crate::path::RADIUS_MIN_M;

/// Why a trajectory cannot be driven; places count from zero.
#[derive(Debug, Clone, Copy, PartialEq, Error)]
pub enum PlanError {
    /// A figure is NaN, infinite or too large.
    #[error("{what} at {place} is not a usable number: {value}")]
    NotFinite {
        /// Which figure.
        what: &'static str,
        /// Index of the waypoint, 0 for a circle or the start.
        place: usize,
        /// What it held.
        value: f64,
    },
    /// A radius that is zero, negative or tighter than [`RADIUS_MIN_M`].
    #[error("the radius must be at least {RADIUS_MIN_M} m, not {0} m")]
    Radius(f64),
    /// No turn, or a negative one.
    #[error("the number of turns must be above zero, not {0}")]
    Turns(f64),
    /// Fewer than two waypoints.
    #[error("a path needs at least two waypoints, not {0}")]
    TooFewWaypoints(usize),
    /// More than [`WAYPOINTS_MAX`] waypoints.
    #[error("a path may have at most {WAYPOINTS_MAX} waypoints, not {0}")]
    TooManyWaypoints(usize),
    /// A waypoint at the same place as the one before.
    #[error("waypoint {place} is at the same place as the one before")]
    DuplicateWaypoint {
        /// Index of the second of the two.
        place: usize,
    },
    /// A speed that is zero or negative.
    #[error("the speed at {place} must be above zero, not {speed_m_s} m/s")]
    SpeedNotPositive {
        /// Index of the waypoint, 0 for a circle or a path's own speed.
        place: usize,
        /// What was asked for.
        speed_m_s: f64,
    },
    /// A speed above what the robot can drive.
    #[error("the speed at {place} is {speed_m_s} m/s, above the robot's limit of {limit_m_s} m/s")]
    SpeedAboveLimit {
        /// Index of the waypoint, 0 for a circle or a path's own speed.
        place: usize,
        /// What was asked for.
        speed_m_s: f64,
        /// The robot's limit.
        limit_m_s: f64,
    },
    /// The path would turn tighter than [`RADIUS_MIN_M`].
    #[error("the path turns too sharply near waypoint {place}")]
    TooTight {
        /// Index of the waypoint at the start of the sharp piece; 0 on the approach to a circle.
        place: usize,
    },
    /// The path is longer than [`LENGTH_MAX_M`].
    #[error("the path is {0} m long, above the limit of {LENGTH_MAX_M} m")]
    TooLong(f64),
    /// The excitation that was asked for is out of its range.
    #[error("the excitation cannot be driven")]
    Excitation(#[from] ExcitationError),
}
