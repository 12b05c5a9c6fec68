//! Measures how far positions lie from the straight, uniform motion between two others.

use tread_control::geometry::Point;

use super::{LINE_TOLERANCE_M, MOTION_TOLERANCE_M, PathPosition};

/// Straight line between two positions, passed at uniform speed.
#[derive(Debug, Clone, Copy)]
pub(super) struct Stretch {
    pub(super) from: PathPosition,
    pub(super) to: PathPosition,
}

impl Stretch {
    /// Returns the distance of a point from the line, metres.
    pub(super) fn distance_m(self, point: Point) -> f64 {
        let (from, to) = (self.from.at, self.to.at);
        let (along_x, along_y) = (to.x_m - from.x_m, to.y_m - from.y_m);
        let length_squared_m2 = along_x * along_x + along_y * along_y;
        if length_squared_m2 <= 0.0 {
            return point.distance_m(from);
        }
        let share = ((point.x_m - from.x_m) * along_x + (point.y_m - from.y_m) * along_y)
            / length_squared_m2;
        let share = share.clamp(0.0, 1.0);
        point.distance_m(Point {
            x_m: from.x_m + share * along_x,
            y_m: from.y_m + share * along_y,
        })
    }

    /// Returns the error of dropping a position between the two, as a multiple of the tolerance: the
    /// larger of its distance from the line over [`LINE_TOLERANCE_M`] and of its distance from
    /// uniform motion over [`MOTION_TOLERANCE_M`]. Above 1 the position must be kept.
    pub(super) fn shortfall(self, passed: PathPosition) -> f64 {
        let Self { from, to } = self;
        let off_line = self.distance_m(passed.at) / LINE_TOLERANCE_M;
        let lasted_s = to.time_s - from.time_s;
        let share = if lasted_s > 0.0 {
            (passed.time_s - from.time_s) / lasted_s
        } else {
            0.0
        };
        let evenly = Point {
            x_m: from.at.x_m + share * (to.at.x_m - from.at.x_m),
            y_m: from.at.y_m + share * (to.at.y_m - from.at.y_m),
        };
        off_line.max(passed.at.distance_m(evenly) / MOTION_TOLERANCE_M)
    }
}
