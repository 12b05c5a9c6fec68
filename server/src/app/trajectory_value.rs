//! Values of a trajectory, and their paths in the body of a request.

use tread_api::trajectory::{Trajectory, Waypoint};

/// Value of a trajectory that a request gives.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum TrajectoryValue {
    /// Centre of a circle.
    Center,
    /// Radius of a circle.
    Radius,
    /// Number of turns of a circle.
    Turns,
    /// All points of a path.
    Points,
    /// Point of a path, by its index.
    Point(usize),
    /// Heading of a point, by its index.
    PointHeading(usize),
    /// Speed of a point, by its index.
    PointSpeed(usize),
    /// Speed of the trajectory, of a circle perhaps given by its period.
    Speed,
    /// Speed of the approach.
    ApproachSpeed,
    /// Depth of the excitation.
    ExcitationDepth,
    /// Period of the excitation.
    ExcitationPeriod,
}

impl TrajectoryValue {
    /// Returns the value that requests the maximum speed, that of the approach included, and this
    /// speed in metres per second.
    pub(super) fn of_speed_max(trajectory: &Trajectory) -> (Self, f64) {
        let own_m_s = match trajectory {
            Trajectory::Circle(circle) => circle.speed_m_s(),
            Trajectory::Waypoints(waypoints) => waypoints.speed_m_s,
        };
        let points: &[Waypoint] = match trajectory {
            Trajectory::Circle(_) => &[],
            Trajectory::Waypoints(waypoints) => &waypoints.points,
        };
        let of_points = points
            .iter()
            .enumerate()
            .filter_map(|(index, point)| Some((Self::PointSpeed(index), point.speed_m_s?)));
        let approach_m_s = trajectory.options().approach_speed_m_s;
        let of_approach = approach_m_s.map(|speed_m_s| (Self::ApproachSpeed, speed_m_s));
        let faster = |fastest: (Self, f64), other: (Self, f64)| {
            if other.1 > fastest.1 { other } else { fastest }
        };
        of_points
            .chain(of_approach)
            .fold((Self::Speed, own_m_s), faster)
    }

    /// Returns the path of the value in a request's body, such as `trajectory.circle.radius_m`.
    pub(super) fn path(self, trajectory: &Trajectory) -> String {
        let (kind, speed) = match trajectory {
            Trajectory::Circle(circle) if circle.speed_m_s.is_none() => ("circle", "period_s"),
            Trajectory::Circle(_) => ("circle", "speed_m_s"),
            Trajectory::Waypoints(_) => ("waypoints", "speed_m_s"),
        };
        let of_point = |index: usize| format!("points[{index}]");
        let value = match self {
            Self::Center => "center".to_owned(),
            Self::Radius => "radius_m".to_owned(),
            Self::Turns => "turns".to_owned(),
            Self::Points => "points".to_owned(),
            Self::Point(index) => of_point(index),
            Self::PointHeading(index) => format!("{}.heading_rad", of_point(index)),
            Self::PointSpeed(index) => format!("{}.speed_m_s", of_point(index)),
            Self::Speed => speed.to_owned(),
            Self::ApproachSpeed => "options.approach_speed_m_s".to_owned(),
            Self::ExcitationDepth => "options.excitation.depth_ratio".to_owned(),
            Self::ExcitationPeriod => "options.excitation.period_s".to_owned(),
        };
        format!("trajectory.{kind}.{value}")
    }
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;

    fn trajectory(body: Value) -> Trajectory {
        serde_json::from_value(body).unwrap()
    }

    fn circle(speed: &str) -> Trajectory {
        trajectory(
            json!({"circle": {"center": {"x_m": 0.0, "y_m": 0.0}, "radius_m": 1.0,
            speed: 4.0, "options": {"approach_speed_m_s": 0.5}}}),
        )
    }

    fn fastest(trajectory: &Trajectory) -> String {
        TrajectoryValue::of_speed_max(trajectory).0.path(trajectory)
    }

    #[test]
    fn the_speed_of_a_circle_is_named_as_it_is_given() {
        assert_eq!(fastest(&circle("speed_m_s")), "trajectory.circle.speed_m_s");
        assert_eq!(fastest(&circle("period_s")), "trajectory.circle.period_s");
    }

    #[test]
    fn the_maximum_speed_is_that_of_the_fastest_point_or_of_the_approach() {
        let path = |point_m_s: f64, approach_m_s: f64| {
            trajectory(json!({"waypoints": {"speed_m_s": 0.5, "points": [
                {"x_m": 0.0, "y_m": 0.0, "speed_m_s": 0.1},
                {"x_m": 1.0, "y_m": 0.0, "speed_m_s": point_m_s}, {"x_m": 2.0, "y_m": 0.0}],
                "options": {"approach_speed_m_s": approach_m_s}}}))
        };
        for (point_m_s, approach_m_s, value) in [
            (0.4, 0.3, "speed_m_s"),
            (0.8, 0.3, "points[1].speed_m_s"),
            (0.8, 0.9, "options.approach_speed_m_s"),
        ] {
            let named = fastest(&path(point_m_s, approach_m_s));
            assert_eq!(named, format!("trajectory.waypoints.{value}"));
        }
    }
}
