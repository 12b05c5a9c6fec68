//! What the law returns: its command, errors and adapted values.

use crate::geometry::{Twist, wrap_angle_rad};
use crate::measured::{Measured, WheelSpeeds};
use crate::reference::ReferenceSample;

/// Tracking errors: reference minus robot, in the frame of the reference.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct TrackingErrors {
    /// Along-track error `e_x`, metres; positive if the reference is ahead of the robot.
    pub along_track_m: f64,
    /// Cross-track error `e_y`, metres; positive if the reference is to the left of the robot.
    pub cross_track_m: f64,
    /// Reference heading minus robot heading, radians, in (−π, π].
    pub heading_rad: f64,
}

impl TrackingErrors {
    /// Computes the errors in the frame of the reference.
    pub fn between(reference: &ReferenceSample, measured: &Measured) -> Self {
        let robot = reference.pose.body_from_site(measured.pose.point());
        Self {
            along_track_m: -robot.x_m,
            cross_track_m: -robot.y_m,
            heading_rad: wrap_angle_rad(reference.pose.heading_rad - measured.pose.heading_rad),
        }
    }

    /// Returns the distance between robot and reference, metres.
    pub fn distance_m(&self) -> f64 {
        self.along_track_m.hypot(self.cross_track_m)
    }
}

/// Output of the law in one tick.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct TrackerOutput {
    /// Wheel speeds to command, within all limits.
    pub wheel_speeds: WheelSpeeds,
    /// Twist of these wheel speeds by the low-speed kinematics.
    pub twist: Twist,
    /// Errors in the frame of the reference.
    pub errors: TrackingErrors,
    /// Adapted θ̂; not a measurement of θ.
    pub theta_loop: f64,
    /// Adapted χ̂: fraction, 0 to 1, of the modelled friction loss beyond the peak.
    pub beyond_loop: f64,
    /// Adapted d̂: sideslip of a robot across the slope, as a vector along the site's axes `[x, y]`
    /// that points downhill, radians.
    pub slope_loop_rad: [f64; 2],
    /// Adapted rotation centre `x̂_c` ahead of the middle of the wheels, metres.
    pub center_loop_m: f64,
    /// Confidence in the known θ, 0 to 1; 0 without one.
    pub confidence: f64,
    /// Whether the wheel speed limit cut the command.
    pub saturated: bool,
}
