//! Errors of planning a trajectory.

use std::fmt;

use thiserror::Error;

use super::{LENGTH_MAX_M, WAYPOINTS_MAX};
use crate::excitation::ExcitationError;
use crate::path::RADIUS_MIN_M;

/// Value that a plan is made from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PlanValue {
    /// Traction limit of the ground.
    TractionLimit,
    /// Pose from which the robot starts.
    StartPose,
    /// Centre of a circle.
    Center,
    /// Position of a waypoint.
    Position,
    /// Heading of a waypoint.
    Heading,
    /// Speed of a trajectory, of a waypoint or of the approach.
    Speed,
}

impl fmt::Display for PlanValue {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(match self {
            Self::TractionLimit => "the traction limit",
            Self::StartPose => "the start pose",
            Self::Center => "the centre",
            Self::Position => "the position",
            Self::Heading => "the heading",
            Self::Speed => "the speed",
        })
    }
}

/// Reason why a trajectory cannot be planned. Indices count from zero.
#[derive(Debug, Clone, Copy, PartialEq, Error)]
pub enum PlanError {
    /// A value is NaN, infinite, or a coordinate beyond [`super::COORDINATE_MAX_M`]; also a
    /// traction limit not above zero.
    #[error("{what}{} is not a usable number: {value}", at(*waypoint))]
    NotFinite {
        /// The value.
        what: PlanValue,
        /// Index of the waypoint; `None` for a value of a circle, of the start or of an option.
        waypoint: Option<usize>,
        /// Rejected value.
        value: f64,
    },
    /// The circle's radius is NaN, below [`RADIUS_MIN_M`] or above [`super::COORDINATE_MAX_M`],
    /// metres.
    #[error("the radius must be at least {RADIUS_MIN_M} m, not {0} m")]
    Radius(f64),
    /// The number of turns is not finite or not above zero.
    #[error("the number of turns must be above zero, not {0}")]
    Turns(f64),
    /// Fewer than two waypoints; the value is their number.
    #[error("a path needs at least two waypoints, not {0}")]
    TooFewWaypoints(usize),
    /// More than [`WAYPOINTS_MAX`] waypoints; the value is their number.
    #[error("a path may have at most {WAYPOINTS_MAX} waypoints, not {0}")]
    TooManyWaypoints(usize),
    /// Two consecutive waypoints are closer than [`super::WAYPOINT_SPACING_MIN_M`].
    #[error("waypoint {waypoint} is at the same place as the one before")]
    DuplicateWaypoint {
        /// Index of the second of the two.
        waypoint: usize,
    },
    /// A speed is zero or negative.
    #[error("the speed{} must be above zero, not {speed_m_s} m/s", at(*waypoint))]
    SpeedNotPositive {
        /// Index of the waypoint; `None` for the speed of a circle, a path or the approach.
        waypoint: Option<usize>,
        /// Requested speed, metres per second.
        speed_m_s: f64,
    },
    /// A speed is above the robot's limit.
    #[error(
        "the speed{} is {speed_m_s} m/s, above the robot's limit of {limit_m_s} m/s",
        at(*waypoint)
    )]
    SpeedAboveLimit {
        /// Index of the waypoint; `None` for the speed of a circle, a path or the approach.
        waypoint: Option<usize>,
        /// Requested speed, metres per second.
        speed_m_s: f64,
        /// Smaller of the linear speed limit and 85 % of the wheels' speed limit, metres per
        /// second.
        limit_m_s: f64,
    },
    /// The path would turn tighter than [`RADIUS_MIN_M`].
    #[error("the path turns too sharply {}", near(*waypoint))]
    TooTight {
        /// Index of the waypoint at the start of the sharp turn; `None` on the approach to a
        /// circle.
        waypoint: Option<usize>,
    },
    /// The path is longer than [`LENGTH_MAX_M`]; the value is its length, metres.
    #[error("the path is {0} m long, above the limit of {LENGTH_MAX_M} m")]
    TooLong(f64),
    /// Depth or period of the excitation is out of its range.
    #[error("the excitation cannot be driven")]
    Excitation(#[from] ExcitationError),
}

fn at(waypoint: Option<usize>) -> String {
    waypoint.map_or_else(String::new, |waypoint| format!(" at waypoint {waypoint}"))
}

fn near(waypoint: Option<usize>) -> String {
    waypoint.map_or_else(
        || "on the approach to the circle".to_owned(),
        |waypoint| format!("near waypoint {waypoint}"),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_name_the_waypoint_where_there_is_one() {
        let speed = |waypoint| PlanError::SpeedNotPositive {
            waypoint,
            speed_m_s: -1.0,
        };
        let tight = |waypoint| PlanError::TooTight { waypoint };
        for (error, text) in [
            (speed(None), "the speed must be above zero, not -1 m/s"),
            (
                speed(Some(2)),
                "the speed at waypoint 2 must be above zero, not -1 m/s",
            ),
            (
                tight(None),
                "the path turns too sharply on the approach to the circle",
            ),
            (tight(Some(1)), "the path turns too sharply near waypoint 1"),
        ] {
            assert_eq!(error.to_string(), text);
        }
    }
}
