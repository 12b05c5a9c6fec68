//! Reasons why a trajectory is refused, with the place and the value at fault.

use tread_api::ids::RobotId;
use tread_api::trajectory::{Place, Trajectory};
use tread_control::excitation::ExcitationError;
use tread_control::plan::{PlanError, PlanValue};

use crate::app::AppError;
use crate::app::trajectory_value::TrajectoryValue;

/// Reason why a trajectory cannot be driven, for people and for programs.
#[derive(Debug)]
pub(in crate::app) struct Refused {
    detail: String,
    reason: Reason,
}

#[derive(Debug)]
enum Reason {
    /// The robot cannot drive it; with the path of the value at fault and the place, if there are
    /// any.
    Impossible {
        field: Option<Box<str>>,
        place: Option<Place>,
    },
    /// It turns too sharply at a waypoint, or on the approach to a circle.
    TooSharp(Option<Place>),
    /// It leaves the geofence.
    CrossesGeofence(Place),
}

impl Refused {
    /// Refuses every trajectory of a robot that cannot be planned for.
    pub(super) fn always(detail: String) -> Self {
        let reason = Reason::Impossible {
            field: None,
            place: None,
        };
        Self { detail, reason }
    }

    /// Refuses a trajectory that cannot be planned.
    pub(super) fn unplanned(error: PlanError, trajectory: &Trajectory) -> Self {
        let place = place_of(error, trajectory);
        let reason = if let PlanError::TooTight { .. } = error {
            Reason::TooSharp(place)
        } else {
            let value = value_of(error, trajectory);
            Reason::Impossible {
                field: value.map(|value| value.path(trajectory).into()),
                place,
            }
        };
        let detail = error.to_string();
        Self { detail, reason }
    }

    /// Refuses a trajectory that leaves the geofence.
    pub(super) fn outside(detail: String, place: Place) -> Self {
        let reason = Reason::CrossesGeofence(place);
        Self { detail, reason }
    }

    /// Names no value: the trajectory is not in the body of the request.
    pub(in crate::app) fn without_field(mut self) -> Self {
        if let Reason::Impossible { field, .. } = &mut self.reason {
            *field = None;
        }
        self
    }

    /// Returns the error for a robot.
    pub(in crate::app) fn of(self, robot: RobotId) -> AppError {
        let Self { detail, reason } = self;
        match reason {
            Reason::Impossible { field, place } => AppError::Impossible {
                robot,
                detail,
                field,
                place,
            },
            Reason::TooSharp(place) => AppError::TurnTooSharp {
                robot,
                detail,
                place,
            },
            Reason::CrossesGeofence(place) => AppError::CrossesGeofence {
                robot,
                detail,
                place,
            },
        }
    }
}

/// Returns the place at which a trajectory cannot be planned.
fn place_of(error: PlanError, trajectory: &Trajectory) -> Option<Place> {
    let waypoint = match error {
        PlanError::TooTight { waypoint: None }
        | PlanError::Radius(_)
        | PlanError::Turns(_)
        | PlanError::TooFewWaypoints(_)
        | PlanError::TooManyWaypoints(_)
        | PlanError::TooLong(_)
        | PlanError::Excitation(_) => return None,
        PlanError::DuplicateWaypoint { waypoint } => Some(waypoint),
        PlanError::NotFinite { waypoint, .. }
        | PlanError::SpeedNotPositive { waypoint, .. }
        | PlanError::SpeedAboveLimit { waypoint, .. }
        | PlanError::TooTight { waypoint } => waypoint,
    };
    match trajectory {
        Trajectory::Circle(circle) => Some(Place {
            arc_m: None,
            waypoint: None,
            point: circle.center,
        }),
        Trajectory::Waypoints(waypoints) => waypoints.points.get(waypoint?).map(|point| Place {
            arc_m: None,
            waypoint,
            point: point.position(),
        }),
    }
}

/// Returns the value because of which a trajectory cannot be planned, if it is a single one.
fn value_of(error: PlanError, trajectory: &Trajectory) -> Option<TrajectoryValue> {
    match error {
        PlanError::Radius(_) => Some(TrajectoryValue::Radius),
        PlanError::Turns(_) => Some(TrajectoryValue::Turns),
        PlanError::TooFewWaypoints(_) | PlanError::TooManyWaypoints(_) => {
            Some(TrajectoryValue::Points)
        }
        PlanError::DuplicateWaypoint { waypoint } => Some(TrajectoryValue::Point(waypoint)),
        PlanError::SpeedNotPositive {
            waypoint,
            speed_m_s,
        }
        | PlanError::SpeedAboveLimit {
            waypoint,
            speed_m_s,
            ..
        } => Some(speed_of(waypoint, speed_m_s, trajectory)),
        PlanError::NotFinite {
            what,
            waypoint,
            value,
        } => match what {
            PlanValue::Center => Some(TrajectoryValue::Center),
            PlanValue::Position => waypoint.map(TrajectoryValue::Point),
            PlanValue::Heading => waypoint.map(TrajectoryValue::PointHeading),
            PlanValue::Speed => Some(speed_of(waypoint, value, trajectory)),
            PlanValue::TractionLimit | PlanValue::StartPose => None,
        },
        PlanError::Excitation(ExcitationError::Depth(_)) => Some(TrajectoryValue::ExcitationDepth),
        PlanError::Excitation(ExcitationError::Period(_)) => {
            Some(TrajectoryValue::ExcitationPeriod)
        }
        PlanError::TooTight { .. } | PlanError::TooLong(_) => None,
    }
}

/// Returns the value that requests a speed. Without a waypoint it is the speed of the approach or
/// of the trajectory; the planner checks that of the approach first.
fn speed_of(waypoint: Option<usize>, speed_m_s: f64, trajectory: &Trajectory) -> TrajectoryValue {
    match waypoint {
        Some(waypoint) => TrajectoryValue::PointSpeed(waypoint),
        None if trajectory.options().approach_speed_m_s == Some(speed_m_s) => {
            TrajectoryValue::ApproachSpeed
        }
        None => TrajectoryValue::Speed,
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn waypoints() -> Trajectory {
        let points =
            json!([{"x_m": 0.0, "y_m": 0.0}, {"x_m": 4.0, "y_m": 0.0}, {"x_m": 4.0, "y_m": 4.0}]);
        let options = json!({"approach_speed_m_s": 0.7});
        serde_json::from_value(
            json!({"waypoints": {"points": points, "speed_m_s": 0.5, "options": options}}),
        )
        .unwrap()
    }

    fn circle() -> Trajectory {
        serde_json::from_value(json!({"circle": {"center": {"x_m": 1.0, "y_m": 2.0},
            "radius_m": 3.0, "speed_m_s": 0.5}}))
        .unwrap()
    }

    fn field(error: PlanError, trajectory: &Trajectory) -> Option<String> {
        let refused = Refused::unplanned(error, trajectory).of("rover-1".parse().unwrap());
        refused.field().map(str::to_owned)
    }

    #[test]
    fn a_turn_that_is_too_sharp_names_its_waypoint_and_none_on_the_approach_to_a_circle() {
        for (trajectory, waypoint) in [(waypoints(), Some(1)), (circle(), None)] {
            let error = PlanError::TooTight { waypoint };
            let refused = Refused::unplanned(error, &trajectory).of("rover-1".parse().unwrap());
            assert!(
                matches!(refused, AppError::TurnTooSharp { .. }),
                "{refused}"
            );
            let place = refused.place();
            assert_eq!(place.and_then(|place| place.waypoint), waypoint);
            assert_eq!(place.is_some(), waypoint.is_some());
        }
    }

    #[test]
    fn each_value_that_cannot_be_planned_has_its_path() {
        let above = |waypoint, speed_m_s| PlanError::SpeedAboveLimit {
            waypoint,
            speed_m_s,
            limit_m_s: 0.4,
        };
        let unusable = |what, waypoint| PlanError::NotFinite {
            what,
            waypoint,
            value: f64::NAN,
        };
        for (error, path) in [
            (PlanError::Radius(0.01), "circle.radius_m"),
            (PlanError::Turns(0.0), "circle.turns"),
            (above(None, 0.5), "circle.speed_m_s"),
            (unusable(PlanValue::Center, None), "circle.center"),
            (unusable(PlanValue::Speed, None), "circle.speed_m_s"),
        ] {
            let path = format!("trajectory.{path}");
            assert_eq!(field(error, &circle()), Some(path));
        }
        for (error, path) in [
            (above(None, 0.5), "speed_m_s"),
            (above(None, 0.7), "options.approach_speed_m_s"),
            (above(Some(2), 0.7), "points[2].speed_m_s"),
            (PlanError::DuplicateWaypoint { waypoint: 1 }, "points[1]"),
            (unusable(PlanValue::Position, Some(1)), "points[1]"),
            (
                unusable(PlanValue::Heading, Some(1)),
                "points[1].heading_rad",
            ),
            (
                PlanError::Excitation(ExcitationError::Depth(2.0)),
                "options.excitation.depth_ratio",
            ),
        ] {
            let path = format!("trajectory.waypoints.{path}");
            assert_eq!(field(error, &waypoints()), Some(path));
        }
        assert_eq!(field(PlanError::TooLong(1e6), &circle()), None);
        let start = unusable(PlanValue::StartPose, None);
        assert_eq!(field(start, &circle()), None);
    }
}
