//! A figure-8 through waypoints, which the tests of the lab drive too.

use std::f64::consts::TAU;

use tread_control::geometry::Point;
use tread_control::trajectory::{Trajectory, Waypoint, WaypointsSpec};

/// A figure-8 of 8 m by 4 m about the origin at 0.6 m/s.
pub(crate) fn figure_8() -> Trajectory {
    let points = (0..=24)
        .map(|index| {
            let angle_rad = f64::from(index) / 24.0 * TAU;
            Waypoint::from(Point {
                x_m: 4.0 * angle_rad.sin(),
                y_m: 2.0 * (2.0 * angle_rad).sin(),
            })
        })
        .collect();
    Trajectory::Waypoints(WaypointsSpec {
        points,
        speed_m_s: 0.6,
    })
}
