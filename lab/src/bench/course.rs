//! Reference motions of the comparison: a plan, or a figure-8 as a function of time.

use tread_control::geometry::{Point, Pose};
use tread_control::plan::Plan;
use tread_control::reference::ReferenceSample;

/// Corner points of a closed path, metres: about 33 m long, with bends to the left and to the
/// right.
pub const CLOSED_PATH_M: [(f64, f64); 12] = [
    (0.0, 0.0),
    (3.0, -0.5),
    (6.0, 0.5),
    (7.0, 3.0),
    (5.0, 4.5),
    (3.0, 3.5),
    (1.0, 4.5),
    (-1.0, 6.5),
    (-4.0, 6.0),
    (-5.0, 3.5),
    (-3.5, 1.5),
    (-1.5, 1.2),
];

/// Number of Newton steps to the nearest point.
const NEWTON_STEPS: usize = 6;
/// Lower bound of the speed in a Newton step, metres per second.
const SPEED_FLOOR_M_S: f64 = 0.05;
/// Maximum move of the nearest point in one Newton step, seconds.
const MOVE_MAX_S: f64 = 0.5;

/// Figure-8 `(A sin wt, B sin 2wt)`, already in motion at t = 0.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Figure8 {
    /// A, metres.
    pub half_length_m: f64,
    /// B, metres.
    pub half_width_m: f64,
    /// w, radians per second.
    pub rate_rad_s: f64,
    /// Number of laps.
    pub laps: f64,
}

impl Figure8 {
    /// Returns `(4 sin 0.15t, 2 sin 0.3t)` m with three laps; the second half of the time is
    /// scored.
    pub fn usual() -> Self {
        Self {
            half_length_m: 4.0,
            half_width_m: 2.0,
            rate_rad_s: 0.15,
            laps: 3.0,
        }
    }

    /// Returns the time of one lap, seconds.
    pub fn lap_s(&self) -> f64 {
        std::f64::consts::TAU / self.rate_rad_s
    }

    fn sample(&self, time_s: f64) -> ReferenceSample {
        let rate = self.rate_rad_s;
        let (sin_1, cos_1) = (rate * time_s).sin_cos();
        let (sin_2, cos_2) = (2.0 * rate * time_s).sin_cos();
        let (x, y) = (self.half_length_m, self.half_width_m);
        let (dx, dy) = (x * rate * cos_1, 2.0 * y * rate * cos_2);
        let (ddx, ddy) = (-x * rate * rate * sin_1, -4.0 * y * rate * rate * sin_2);
        let (jerk_x, jerk_y) = (-rate * rate * dx, -4.0 * rate * rate * dy);
        let speed_m_s = dx.hypot(dy);
        let acceleration_m_s2 = (dx * ddx + dy * ddy) / speed_m_s;
        let turn_rad_s = (dx * ddy - dy * ddx) / (speed_m_s * speed_m_s);
        ReferenceSample {
            pose: Pose {
                x_m: x * sin_1,
                y_m: y * sin_2,
                heading_rad: dy.atan2(dx),
            },
            speed_m_s,
            acceleration_m_s2,
            turn_rad_s,
            turn_acceleration_rad_s2: (dx * jerk_y - dy * jerk_x) / (speed_m_s * speed_m_s)
                - 2.0 * turn_rad_s * acceleration_m_s2 / speed_m_s,
            curvature_1_m: turn_rad_s / speed_m_s,
            arc_m: 0.0,
        }
    }
}

/// Point of a course nearest to a robot.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ClosestPoint {
    /// Time of this point on the course, seconds.
    pub time_s: f64,
    /// Distance of the robot to the left of the course, metres.
    pub cross_track_m: f64,
}

/// Reference motion that the laws follow.
#[derive(Debug, Clone, PartialEq)]
pub enum Course {
    /// A plan from zero speed to zero speed; the reference does not wait for the robot.
    Plan(Plan),
    /// A figure-8 as a function of time.
    Figure8(Figure8),
}

impl Course {
    /// Returns the duration, seconds.
    pub fn duration_s(&self) -> f64 {
        match self {
            Self::Plan(plan) => plan.duration_s(),
            Self::Figure8(shape) => shape.laps * shape.lap_s(),
        }
    }

    /// Returns the reference at a time, seconds.
    pub fn sample(&self, time_s: f64) -> ReferenceSample {
        match self {
            Self::Plan(plan) => ReferenceSample::from(&plan.sample(time_s)),
            Self::Figure8(shape) => shape.sample(time_s),
        }
    }

    /// Returns the point nearest to a robot, searched from `guess_s` over a bounded distance.
    pub fn nearest(&self, point: Point, guess_s: f64) -> ClosestPoint {
        let mut time_s = guess_s;
        for _ in 0..NEWTON_STEPS {
            let sample = self.sample(time_s);
            let forward = sample.pose.body_from_site(point);
            // Inside a bend the nearest point moves faster than the robot by this factor's inverse.
            let bend = (1.0 - sample.curvature_1_m * forward.y_m).max(0.2);
            let step_s = forward.x_m / (bend * sample.speed_m_s.max(SPEED_FLOOR_M_S));
            time_s = (time_s + step_s.clamp(-MOVE_MAX_S, MOVE_MAX_S)).clamp(0.0, self.duration_s());
        }
        ClosestPoint {
            time_s,
            cross_track_m: self.sample(time_s).pose.body_from_site(point).y_m,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn derivatives_of_the_figure_8_are_its_differences() {
        let shape = Figure8::usual();
        for step in 0_u8..200 {
            let time_s = 0.37 * f64::from(step);
            let (before, now, after) = (
                shape.sample(time_s - 1.0e-4),
                shape.sample(time_s),
                shape.sample(time_s + 1.0e-4),
            );
            let slope = |late: f64, early: f64| (late - early) / 2.0e-4;
            let moved_m = before.pose.point().distance_m(after.pose.point());
            assert!((slope(moved_m, 0.0) - now.speed_m_s).abs() < 1.0e-6);
            let acceleration = slope(after.speed_m_s, before.speed_m_s);
            assert!((acceleration - now.acceleration_m_s2).abs() < 1.0e-6);
            let turn = slope(after.turn_rad_s, before.turn_rad_s);
            assert!((turn - now.turn_acceleration_rad_s2).abs() < 1.0e-6);
        }
    }

    #[test]
    fn the_nearest_point_is_found_beside_the_course() {
        let course = Course::Figure8(Figure8::usual());
        for step in 0_u8..100 {
            let time_s = 0.8 * f64::from(step) + 0.1;
            let pose = course.sample(time_s).pose;
            let (sin, cos) = pose.heading_rad.sin_cos();
            let point = Point {
                x_m: pose.x_m - 0.1 * sin,
                y_m: pose.y_m + 0.1 * cos,
            };
            let found = course.nearest(point, time_s + 0.15);
            assert!(
                (found.time_s - time_s).abs() < 1.0e-3,
                "{time_s}: {found:?}"
            );
            assert!((found.cross_track_m - 0.1).abs() < 1.0e-6);
        }
    }
}
