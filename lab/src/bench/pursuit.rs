//! Regulated pure pursuit by Nav2's published rules, an independent implementation.
//!
//! Look-ahead `v·t` within bounds; curvature `2y/d²` to the point there; speed reduced by the
//! path's curvature below a radius, with a minimum; turn on the spot when the path leaves to the
//! side. Nav2's defaults, but the course's own speed in place of `desired_linear_vel`.

use crate::bench::course::Course;
use tread_control::geometry::Twist;
use tread_control::measured::{Measured, WheelSpeeds};
use tread_control::robot::RobotModel;
use tread_control::tracking::desaturated;

/// Turn rate on the spot, radians per second.
const ROTATE_RAD_S: f64 = 1.8;
/// Bearing of the look-ahead point above which it turns on the spot, radians.
const ROTATE_FROM_RAD: f64 = 0.785;
/// Time step of the search for the look-ahead point, seconds.
const SEARCH_S: f64 = 0.02;
/// Maximum number of steps of that search.
const SEARCH_MAX: u32 = 500;

/// Parameters with their names in Nav2.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PursuitConfig {
    /// `lookahead_time`, seconds.
    pub lookahead_time_s: f64,
    /// `min_lookahead_dist`, metres.
    pub lookahead_min_m: f64,
    /// `max_lookahead_dist`, metres.
    pub lookahead_max_m: f64,
    /// `regulated_linear_scaling_min_radius`, metres.
    pub scaling_radius_m: f64,
    /// `regulated_linear_scaling_min_speed`, metres per second.
    pub scaling_speed_min_m_s: f64,
}

impl Default for PursuitConfig {
    fn default() -> Self {
        Self {
            lookahead_time_s: 1.5,
            lookahead_min_m: 0.3,
            lookahead_max_m: 0.9,
            scaling_radius_m: 0.9,
            scaling_speed_min_m_s: 0.25,
        }
    }
}

/// Pure pursuit with its state; it follows the path, not the time of the reference.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pursuit {
    model: RobotModel,
    config: PursuitConfig,
    nearest_s: f64,
}

impl Pursuit {
    /// Creates a tracker at the start of a course.
    pub fn new(model: RobotModel, config: PursuitConfig) -> Self {
        Self {
            model,
            config,
            nearest_s: 0.0,
        }
    }

    /// Computes the wheel speeds of one tick.
    pub fn step(&mut self, course: &Course, measured: &Measured) -> WheelSpeeds {
        let config = &self.config;
        let nearest = course.nearest(measured.pose.point(), self.nearest_s);
        self.nearest_s = nearest.time_s.max(self.nearest_s);
        let wanted_m_s = course
            .sample(self.nearest_s)
            .speed_m_s
            .max(config.scaling_speed_min_m_s);
        let reach_m = (measured.twist.linear_m_s.abs() * config.lookahead_time_s)
            .clamp(config.lookahead_min_m, config.lookahead_max_m);
        let mut carrot = measured
            .pose
            .body_from_site(course.sample(self.nearest_s).pose.point());
        let mut time_s = self.nearest_s;
        for _ in 0..SEARCH_MAX {
            if carrot.x_m.hypot(carrot.y_m) >= reach_m || time_s >= course.duration_s() {
                break;
            }
            time_s += SEARCH_S;
            carrot = measured
                .pose
                .body_from_site(course.sample(time_s).pose.point());
        }
        let distance_m = carrot.x_m.hypot(carrot.y_m).max(1.0e-3);
        let bearing_rad = carrot.y_m.atan2(carrot.x_m);
        let twist = if bearing_rad.abs() > ROTATE_FROM_RAD {
            Twist {
                linear_m_s: 0.0,
                angular_rad_s: ROTATE_RAD_S.copysign(bearing_rad),
            }
        } else {
            let curvature_1_m = 2.0 * carrot.y_m / (distance_m * distance_m);
            let share = (curvature_1_m.abs() * config.scaling_radius_m)
                .max(1.0)
                .recip();
            let linear_m_s = (wanted_m_s * share).max(config.scaling_speed_min_m_s);
            Twist {
                linear_m_s,
                angular_rad_s: linear_m_s * curvature_1_m,
            }
        };
        desaturated(&self.model, twist).0
    }
}
