//! Predicts the accuracy of the θ that a plan will measure, before the robot moves.
//!
//! The estimator runs on the noise-free samples of an undisturbed robot that follows the plan on
//! ground of an assumed θ. Its standard deviation is the prediction.

use serde::{Deserialize, Serialize};

use super::{Estimator, RIM_SPEED_MIN_M_S, SensorNoise, SensorSample};
use crate::measured::{BodyAcceleration, WheelSpeeds, WheelTorques};
use crate::plan::Plan;
use crate::robot::{GRAVITY_M_S2, RobotModel};

/// Sampling period of the simulated samples, seconds.
const SAMPLE_S: f64 = 0.005;
/// Number of samples per measured body speed.
const SAMPLES_PER_BODY_SPEED: u32 = 20;
/// Maximum evaluated duration of a plan, seconds; a longer plan is at least as accurate.
const EVALUATED_MAX_S: f64 = 300.0;

/// Predicted accuracy of θ.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ExpectedAccuracy {
    /// Relative standard deviation of θ at the end of the plan; `None` if the plan does not excite
    /// θ enough for a measurement.
    pub relative_std_dev: Option<f64>,
    /// Driving time until the first measurement, seconds; `None` without a measurement.
    pub first_after_s: Option<f64>,
}

/// Predicts the accuracy of θ after driving `plan` on ground of slip compliance `theta`.
///
/// `has_torque` states whether the base measures wheel torques. If `theta` is not positive and
/// finite, both values of the result are `None`. At most the first 300 s of the plan are evaluated.
pub fn expected_accuracy(
    plan: &Plan,
    model: &RobotModel,
    noise: SensorNoise,
    theta: f64,
    has_torque: bool,
) -> ExpectedAccuracy {
    let mut expected = ExpectedAccuracy {
        relative_std_dev: None,
        first_after_s: None,
    };
    if !(theta.is_finite() && theta > 0.0) {
        return expected;
    }
    let mut estimator = Estimator::new(*model, noise);
    let end_s = plan.duration_s().min(EVALUATED_MAX_S);
    let (mut time_s, mut count) = (0.0, 0_u32);
    while time_s < end_s {
        let at = plan.sample(time_s);
        let motion = Motion {
            speed_m_s: at.speed_m_s,
            acceleration_m_s2: at.acceleration_m_s2,
            turn_rad_s: at.path.curvature_1_m * at.speed_m_s,
            turn_acceleration_rad_s2: at.path.curvature_1_m * at.acceleration_m_s2
                + at.path.curvature_slope_1_m2 * at.speed_m_s * at.speed_m_s,
        };
        let mut sample = undisturbed(&motion, model, theta, has_torque);
        if count.is_multiple_of(SAMPLES_PER_BODY_SPEED) {
            sample.body_speed_m_s = Some(at.speed_m_s);
        }
        estimator.update(&sample, SAMPLE_S);
        time_s += SAMPLE_S;
        count = count.wrapping_add(1);
        if expected.first_after_s.is_none() && estimator.estimate().theta.is_some() {
            expected.first_after_s = Some(time_s);
        }
    }
    expected.relative_std_dev = estimator
        .estimate()
        .theta
        .map(|found| found.std_dev / found.theta);
    expected
}

/// Motion of the body along a plan.
struct Motion {
    speed_m_s: f64,
    acceleration_m_s2: f64,
    turn_rad_s: f64,
    turn_acceleration_rad_s2: f64,
}

/// Returns the noise-free sample of a robot with this motion, in the linear range of slip.
fn undisturbed(motion: &Motion, model: &RobotModel, theta: f64, has_torque: bool) -> SensorSample {
    let track_m = model.track_width_m();
    let wheelbase_m = model.wheelbase_m();
    let turn_rad_s = motion.turn_rad_s;
    // Force and moment balance give the sides' forces over their load: half of the sum and half of
    // the difference.
    let mean_mu = motion.acceleration_m_s2 / GRAVITY_M_S2;
    let inertia_s2 = 4.0 * model.yaw_inertia_kg_m2() / (model.mass_kg() * GRAVITY_M_S2 * track_m);
    let rims = |lateral_mu: f64| {
        // λ = θμ with λ = (u − v_side)/u.
        let side = |mu: f64, side_m_s: f64| side_m_s / (1.0 - (theta * mu).min(0.5));
        let half_m_s = 0.5 * track_m * turn_rad_s;
        (
            side(mean_mu - lateral_mu, motion.speed_m_s - half_m_s),
            side(mean_mu + lateral_mu, motion.speed_m_s + half_m_s),
        )
    };
    // The moment of the lateral forces depends on the rim speeds and vice versa: two iterations
    // suffice.
    let mut half_mu = 0.5 * inertia_s2 * motion.turn_acceleration_rad_s2;
    let (mut left_m_s, mut right_m_s) = rims(half_mu);
    for _ in 0..2 {
        let seconds_per_m = |rim_m_s: f64| rim_m_s.abs().max(RIM_SPEED_MIN_M_S).recip();
        let inverse = 0.5 * (seconds_per_m(left_m_s) + seconds_per_m(right_m_s));
        half_mu = 0.5 * inertia_s2 * motion.turn_acceleration_rad_s2
            + 0.5 * wheelbase_m * wheelbase_m / track_m * turn_rad_s * inverse / theta;
        (left_m_s, right_m_s) = rims(half_mu);
    }
    let radius_m = model.wheel_radius_m();
    let torque_n_m = radius_m * model.side_load_n();
    SensorSample {
        wheel_speeds: WheelSpeeds {
            left_rad_s: left_m_s / radius_m,
            right_rad_s: right_m_s / radius_m,
        },
        gyro_rad_s: turn_rad_s,
        acceleration: Some(BodyAcceleration {
            forward_m_s2: motion.acceleration_m_s2,
            left_m_s2: motion.speed_m_s * turn_rad_s,
        }),
        is_specific_force: false,
        body_speed_m_s: None,
        wheel_torques: has_torque.then_some(WheelTorques {
            left_n_m: torque_n_m * (mean_mu - half_mu),
            right_n_m: torque_n_m * (mean_mu + half_mu),
        }),
    }
}
