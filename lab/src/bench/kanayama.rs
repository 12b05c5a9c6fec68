//! Kanayama's tracker: with usual gains, and tuned with integral action.

use tread_control::geometry::{Twist, wrap_angle_rad};
use tread_control::measured::{Measured, WheelSpeeds};
use tread_control::reference::ReferenceSample;
use tread_control::robot::RobotModel;
use tread_control::tracking::desaturated;

/// Bound of the integral of the cross-track error, metre seconds.
const INTEGRAL_MAX_M_S: f64 = 0.1;

/// Track width that converts a twist to wheel speeds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Track {
    /// Distance between the wheels, as for a differential drive.
    Raw,
    /// Effective track width of a skid-steered base.
    Effective,
}

/// Gains of the tracker.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct KanayamaGains {
    /// Track width in use.
    pub track: Track,
    /// `k_x`, per second.
    pub along_1_s: f64,
    /// `k_y`, per metre squared.
    pub cross_1_m2: f64,
    /// `k_θ`, per metre.
    pub heading_1_m: f64,
    /// `k_I` on the cross-track error, per metre squared and second.
    pub integral_1_m2_s: f64,
}

impl KanayamaGains {
    /// Returns usual gains, without integral action.
    pub fn usual() -> Self {
        Self {
            track: Track::Effective,
            along_1_s: 1.0,
            cross_1_m2: 4.0,
            heading_1_m: 3.0,
            integral_1_m2_s: 0.0,
        }
    }

    /// Returns tuned gains with integral action, the strongest peer.
    pub fn tuned() -> Self {
        Self {
            along_1_s: 3.0,
            cross_1_m2: 16.0,
            heading_1_m: 6.0,
            integral_1_m2_s: 4.0,
            ..Self::usual()
        }
    }
}

/// Kanayama's tracker with its state.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Kanayama {
    model: RobotModel,
    gains: KanayamaGains,
    integral_m_s: f64,
}

impl Kanayama {
    /// Creates a tracker with zero integral.
    pub fn new(model: RobotModel, gains: KanayamaGains) -> Self {
        Self {
            model,
            gains,
            integral_m_s: 0.0,
        }
    }

    /// Computes the wheel speeds of one tick of `dt_s` seconds.
    pub fn step(
        &mut self,
        reference: &ReferenceSample,
        measured: &Measured,
        dt_s: f64,
    ) -> WheelSpeeds {
        let gains = &self.gains;
        let forward = measured.pose.body_from_site(reference.pose.point());
        let heading_rad = wrap_angle_rad(reference.pose.heading_rad - measured.pose.heading_rad);
        self.integral_m_s =
            (self.integral_m_s + forward.y_m * dt_s).clamp(-INTEGRAL_MAX_M_S, INTEGRAL_MAX_M_S);
        let mut twist = Twist {
            linear_m_s: reference.speed_m_s * heading_rad.cos() + gains.along_1_s * forward.x_m,
            angular_rad_s: reference.turn_rad_s
                + reference.speed_m_s
                    * (gains.cross_1_m2 * forward.y_m
                        + gains.heading_1_m * heading_rad.sin()
                        + gains.integral_1_m2_s * self.integral_m_s),
        };
        if gains.track == Track::Raw {
            twist.angular_rad_s /= self.model.effective_track_ratio();
        }
        desaturated(&self.model, twist).0
    }
}
