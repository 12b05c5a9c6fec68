//! Estimates the forward speed from accelerometer, wheels and body speed; its innovations are rows
//! of the regression.
//!
//! A scalar Kalman filter estimates the speed v. Its innovations are white and linear in the
//! parameters (Friedland's two-stage filter), so each innovation is one row. Averaged over short
//! steps, with `s = (1/u_L + 1/u_R)/2` and `d = 1/u_L − 1/u_R` (combined slip, linear range):
//!
//! ```text
//! (1 + Wφ̇d/4)/s = v + θ (a/g)/s + δ_c/s + δ_d (u_R − u_L)/4        wheels
//! v_body        = v                                                body speed
//! 0             = v                                                standing wheels
//! v̇             = a − b_a − θ v²φ̇²/g                               accelerometer, and sideslip
//! ```
//! Below the speed at which slip is defined the line of the wheels is not used.

use crate::robot::{GRAVITY_M_S2, RobotModel};

use super::contacts::{CurvatureInput, MeanSlip, StiffnessLoss, TyreCurve};
use super::curved::{
    CurvatureAtSlip, Curvatures, SLIP_MIN, SlipBySide, Turn, stiffness_difference,
};
use super::rows::{Regressors, Row, index};
use super::types::Curvature;
use super::window::IntervalDeviation;
use super::{SensorNoise, SensorSample, signed_rims};

/// Duration of a step, over which samples are averaged, seconds.
pub(super) const STEP_S: f64 = 0.05;
/// Initial and maximum variance of the speed, metres squared per second squared.
const UNKNOWN_M2_S2: f64 = 1.0;
/// Rim speed below which a wheel counts as stopped, metres per second.
const STANDING_M_S: f64 = 3.0e-3;
/// Standard deviation of a stopped robot's speed, metres per second.
const STANDING_NOISE_M_S: f64 = 1.0e-3;
/// Turn rate below which a robot counts as driving straight, radians per second.
const TURNING_MIN_RAD_S: f64 = 1.0e-3;
/// Turn rate above which a robot with stopped wheels counts as moving, radians per second: it
/// slides or is carried. Offsets of gyros are far smaller.
const STANDING_RAD_S: f64 = 0.05;
/// Number of consecutive steps with stopped wheels after which the body counts as stopped.
const STANDING_STEPS: u32 = 3;

/// Variation of slip in a row that has none: one interval without deviation.
const STILL: IntervalDeviation = IntervalDeviation {
    slip_difference: 0.0,
    turn_rad_s: 0.0,
    longitudinal_mu: 0.0,
    weight: 1.0,
};

/// Sums over the samples of one step.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct Step {
    duration_s: f64,
    samples: f64,
    usable: f64,
    rim_m_s: f64,
    /// Sums of the rim speeds `[left, right]`.
    sides_m_s: [f64; 2],
    wheels_m_s: f64,
    harmonic_m_s: f64,
    force_m_s: f64,
    rim_difference_m_s: f64,
    forward_m_s2: f64,
    /// Sum of acceleration times the time since the start of the step.
    forward_late_m_s: f64,
    gyro_rad_s: f64,
    /// Sum of the rim speed of the slower side.
    slower_m_s: f64,
    body_m_s: f64,
    body_samples: f64,
    /// Sum of the times of the body speeds since the start of the step.
    body_time_s: f64,
}

/// Limits of slip for a step to be used, and values with which rows are computed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct SlipBound {
    /// Upper bound of θ.
    pub(super) theta_most: f64,
    /// Largest slip at which the model of the tyres is valid.
    pub(super) slip_max: f64,
    /// θ for the weights of rows.
    pub(super) theta: f64,
    /// Estimated `δ_d`.
    pub(super) radius_difference: f64,
    /// Curvature of the tyres at this θ.
    pub(super) curvature: Curvature,
}

/// Parameters with which the sideslip in a turn is computed.
#[derive(Debug, Clone, Copy)]
struct SideslipParameters {
    /// Estimated or assumed θ.
    theta: f64,
    /// Increase of the sideslip by curvature, per θκ and θκ², relative to that of linear tyres.
    curvature_ratio: [f64; 2],
}

/// Measurement of the forward speed, linear in the parameters.
#[derive(Debug, Clone, Copy)]
struct SpeedMeasurement {
    /// Coefficients of the parameters in the measurement.
    regressors: Regressors,
    /// Measured speed, metres per second.
    speed_m_s: f64,
    /// Variance of the measured speed.
    variance: f64,
    /// Variance of the noise of the force, the regressor of θ, (m/s)².
    force_noise: f64,
}

/// Kalman filter of the forward speed, with its sensitivity to the parameters.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct LongitudinalFilter {
    step: Step,
    speed_m_s: f64,
    variance: f64,
    sensitivity: Regressors,
    /// Part of the last step's change of speed that is added in the next step.
    last_share_m_s: f64,
    last_duration_s: f64,
    last_gyro_rad_s: f64,
    last_forward_m_s2: f64,
    standing: u32,
    started: bool,
}

/// Rows of one step: wheels; body speed, or zero speed of a stopped robot; gyro of a stopped robot.
pub(super) type Rows = [Option<Row>; 3];

impl LongitudinalFilter {
    /// Creates a filter that starts at the rim speed of the first step.
    pub(super) fn new() -> Self {
        Self {
            step: Step::default(),
            speed_m_s: 0.0,
            variance: UNKNOWN_M2_S2,
            sensitivity: Regressors::zeros(),
            last_share_m_s: 0.0,
            last_duration_s: 0.0,
            last_gyro_rad_s: 0.0,
            last_forward_m_s2: 0.0,
            standing: 0,
            started: false,
        }
    }

    /// Adds a sample, `dt_s` seconds after the one before. Returns the rows of the step that it
    /// completes; None within a step, and for a sample without acceleration, which is not used.
    pub(super) fn add(
        &mut self,
        sample: &SensorSample,
        dt_s: f64,
        model: &RobotModel,
        noise: &SensorNoise,
        bound: &SlipBound,
    ) -> Option<Rows> {
        let acceleration = sample.acceleration?;
        let step = &mut self.step;
        let radius_m = model.wheel_radius_m();
        let wheels = sample.wheel_speeds;
        step.rim_m_s += 0.5 * radius_m * (wheels.left_rad_s + wheels.right_rad_s);
        step.sides_m_s[0] += radius_m * wheels.left_rad_s;
        step.sides_m_s[1] += radius_m * wheels.right_rad_s;
        step.samples += 1.0;
        if let Some(rims) = signed_rims(sample, model) {
            let inverse = 0.5 * (rims.left_m_s.recip() + rims.right_m_s.recip());
            let gap = rims.left_m_s.recip() - rims.right_m_s.recip();
            let turn_m_s = model.track_width_m() * sample.gyro_rad_s;
            step.usable += 1.0;
            step.wheels_m_s += rims.sign * (1.0 + 0.25 * turn_m_s * gap) / inverse;
            step.harmonic_m_s += rims.sign / inverse;
            step.force_m_s += acceleration.forward_m_s2 / GRAVITY_M_S2 / inverse;
            step.rim_difference_m_s +=
                radius_m * (sample.wheel_speeds.right_rad_s - sample.wheel_speeds.left_rad_s);
            step.slower_m_s += rims.left_m_s.min(rims.right_m_s);
        }
        step.forward_m_s2 += acceleration.forward_m_s2;
        step.forward_late_m_s += acceleration.forward_m_s2 * (step.duration_s + 0.5 * dt_s);
        step.gyro_rad_s += sample.gyro_rad_s;
        step.duration_s += dt_s;
        if let Some(body_m_s) = sample.body_speed_m_s {
            step.body_m_s += body_m_s;
            step.body_samples += 1.0;
            step.body_time_s += step.duration_s;
        }
        (step.duration_s >= STEP_S - 1.0e-6).then(|| self.finish(model, noise, bound))
    }

    fn finish(&mut self, model: &RobotModel, noise: &SensorNoise, bound: &SlipBound) -> Rows {
        let step = std::mem::take(&mut self.step);
        let count = step.samples;
        let forward_m_s2 = step.forward_m_s2 / count;
        let gyro_rad_s = step.gyro_rad_s / count;
        let sideslip = SideslipParameters {
            theta: bound.theta,
            curvature_ratio: sideslip_curvature(&step, gyro_rad_s, model, bound),
        };
        self.predict(&step, gyro_rad_s, noise, sideslip);
        let mut rows: Rows = [None; 3];
        let gained_m_s2 =
            forward_m_s2 - std::mem::replace(&mut self.last_forward_m_s2, forward_m_s2);
        // When turning on the spot, the mean of the rim speeds is zero, so check both sides.
        let [left_m_s, right_m_s] = step.sides_m_s.map(|sum| (sum / count).abs());
        let is_standing =
            left_m_s.max(right_m_s) < STANDING_M_S && gyro_rad_s.abs() < STANDING_RAD_S;
        self.standing = if is_standing { self.standing + 1 } else { 0 };
        if step.usable >= count {
            rows[0] = self.wheels(&step, gained_m_s2, model, noise, bound);
        }
        if self.standing >= STANDING_STEPS {
            rows[1] = Some(self.observe(SpeedMeasurement {
                regressors: Regressors::zeros(),
                speed_m_s: 0.0,
                variance: STANDING_NOISE_M_S.powi(2),
                force_noise: 0.0,
            }));
            let mut regressors = Regressors::zeros();
            regressors[index::GYRO_OFFSET] = 1.0;
            rows[2] = Some(Row {
                regressors,
                response: gyro_rad_s,
                innovation_variance: noise.gyro_rad_s.powi(2) / count,
                ..Row::default()
            });
        } else if step.body_samples > 0.0 {
            // Correct for the time between the middle of the step and the samples.
            let late_s = step.body_time_s / step.body_samples - 0.5 * step.duration_s;
            let mut regressors = Regressors::zeros();
            regressors[index::LONGITUDINAL_OFFSET] = -late_s;
            rows[1] = Some(self.observe(SpeedMeasurement {
                regressors,
                speed_m_s: step.body_m_s / step.body_samples - forward_m_s2 * late_s,
                variance: noise.body_speed_m_s.powi(2) / step.body_samples,
                force_noise: 0.0,
            }));
        }
        rows
    }

    /// Propagates the speed from the mean of the last step to that of this one, by the acceleration
    /// with a triangular weight that rises over the last step and falls over this one.
    fn predict(
        &mut self,
        step: &Step,
        gyro_rad_s: f64,
        noise: &SensorNoise,
        sideslip: SideslipParameters,
    ) {
        let forward_m_s2 = step.forward_m_s2 / step.samples;
        let late_m_s = step.forward_late_m_s / step.samples;
        let early_m_s = forward_m_s2 * step.duration_s - late_m_s;
        let span_s = 0.5 * (self.last_duration_s + step.duration_s);
        let gained_m_s = self.last_share_m_s + early_m_s;
        self.last_share_m_s = late_m_s;
        self.last_duration_s = step.duration_s;
        let last_gyro_rad_s = std::mem::replace(&mut self.last_gyro_rad_s, gyro_rad_s);
        if !self.started {
            self.started = true;
            self.speed_m_s = step.rim_m_s / step.samples;
            return;
        }
        self.speed_m_s += gained_m_s;
        self.sensitivity[index::LONGITUDINAL_OFFSET] -= span_s;
        self.sensitivity[index::LONGITUDINAL_SCALE] += gained_m_s;
        // Values between the middles of two steps. Sideslip is proportional to the lateral
        // acceleration, which is less than vφ̇ while the sideslip grows.
        let turn_rad_s = 0.5 * (gyro_rad_s + last_gyro_rad_s);
        let turn_rad_s2 = (gyro_rad_s - last_gyro_rad_s) / span_s;
        let forward_m_s2 = gained_m_s / span_s;
        let drift_s = sideslip.theta * self.speed_m_s / GRAVITY_M_S2;
        let lateral_m_s2 = self.speed_m_s * turn_rad_s
            - drift_s * (self.speed_m_s * turn_rad_s2 + 2.0 * forward_m_s2 * turn_rad_s);
        let sideslip_m_s = span_s * self.speed_m_s * turn_rad_s * lateral_m_s2 / GRAVITY_M_S2;
        self.sensitivity[index::THETA] -= sideslip_m_s;
        self.sensitivity[index::CURVATURE] -= sideslip_m_s * sideslip.curvature_ratio[0];
        self.sensitivity[index::CURVATURE_SQUARE] -= sideslip_m_s * sideslip.curvature_ratio[1];
        self.variance = (self.variance
            + (span_s * noise.accelerometer_m_s2).powi(2) / step.samples)
            .min(UNKNOWN_M2_S2);
    }

    /// Updates the filter by the wheel speeds of a step, in which the acceleration is greater by
    /// `gained_m_s2` than in the last step, and returns the innovation as a row; None if a wheel may
    /// slip beyond the valid range.
    fn wheels(
        &mut self,
        step: &Step,
        gained_m_s2: f64,
        model: &RobotModel,
        noise: &SensorNoise,
        bound: &SlipBound,
    ) -> Option<Row> {
        let count = step.samples;
        let forward_m_s2 = step.forward_m_s2 / count;
        let gyro_rad_s = step.gyro_rad_s / count;
        let slower_m_s = step.slower_m_s / count;
        let rim_difference_m_s = step.rim_difference_m_s / count;
        let turn_m_s = model.track_width_m() * gyro_rad_s;
        let lateral = 0.5 * model.wheelbase_m() * gyro_rad_s.abs() / slower_m_s;
        let turning = 0.5 * (rim_difference_m_s - turn_m_s).abs() / slower_m_s;
        let driving = bound.theta_most * forward_m_s2.abs() / GRAVITY_M_S2;
        if lateral.hypot(turning + driving) > bound.slip_max {
            return None;
        }
        let harmonic_m_s = step.harmonic_m_s / count;
        let force_m_s = step.force_m_s / count;
        let mut regressors = Regressors::zeros();
        regressors[index::THETA] = force_m_s;
        regressors[index::RADIUS_OFFSET] = harmonic_m_s;
        regressors[index::RADIUS_DIFFERENCE] = 0.25 * rim_difference_m_s;
        let rate_1_s = gained_m_s2 / step.duration_s / GRAVITY_M_S2;
        regressors[index::RELAXATION] = rate_1_s;
        let turn = Turn {
            rim_m_s: harmonic_m_s.abs(),
            rim_difference_m_s,
            yaw_rate_rad_s: gyro_rad_s,
            radius_difference: bound.radius_difference * harmonic_m_s.signum(),
        };
        let longitudinal_mu = forward_m_s2 / GRAVITY_M_S2 * harmonic_m_s.signum();
        let input = CurvatureInput {
            turn: &turn,
            variation: &[STILL],
            mu: MeanSlip {
                forward: longitudinal_mu,
                lateral: harmonic_m_s.abs() * gyro_rad_s / GRAVITY_M_S2,
            },
            theta: bound.theta,
            force_m_s,
            uneven_m_s: |loss: &StiffnessLoss| harmonic_m_s * loss.forward,
        };
        let (curvature_regressors, mut curvature_ratio) = input.regressors(model, bound.curvature);
        curvature_regressors.write_to(&mut regressors);
        // Noise of the mean acceleration over the step; its offset is a regressor.
        let acceleration_noise =
            (harmonic_m_s * noise.accelerometer_m_s2 / GRAVITY_M_S2).powi(2) / count;
        let rim_noise = 0.5 * (noise.wheel_speed_rad_s * model.wheel_radius_m()).powi(2) / count;
        regressors[index::LONGITUDINAL_OFFSET] = -bound.theta * harmonic_m_s.abs() / GRAVITY_M_S2;
        let mut row = self.observe(SpeedMeasurement {
            regressors,
            speed_m_s: step.wheels_m_s / count,
            variance: rim_noise + bound.theta.powi(2) * acceleration_noise,
            force_noise: acceleration_noise,
        });
        // The force, with its noise, also makes the slips of the sides unequal.
        let sides = SlipBySide::of(&turn, bound.theta * longitudinal_mu, model);
        let unequal_by_force =
            0.25 * sides.slip_difference * sides.slip_difference / sides.mean.max(SLIP_MIN);
        let curvatures = Curvatures::of(bound.curvature);
        let more = curvatures.split(curvatures.nodes().map(|curvature| {
            let at = CurvatureAtSlip {
                curvature,
                slip: sides.mean,
            };
            unequal_by_force * stiffness_difference(at)
        }));
        curvature_ratio[0] += more[0];
        curvature_ratio[1] += more[1];
        row.curvature_ratio = curvature_ratio;
        row.rate_noise =
            2.0 * (noise.accelerometer_m_s2 / GRAVITY_M_S2 / step.duration_s).powi(2) / count;
        Some(row)
    }

    /// Updates the filter by one measurement of the speed. Returns its innovation as a row, linear
    /// in the parameters.
    fn observe(&mut self, measurement: SpeedMeasurement) -> Row {
        let SpeedMeasurement {
            regressors,
            speed_m_s,
            variance,
            force_noise,
        } = measurement;
        let innovation_variance = self.variance + variance;
        let gain = self.variance / innovation_variance;
        let row = regressors + self.sensitivity;
        let innovation_m_s = speed_m_s - self.speed_m_s;
        self.speed_m_s += gain * innovation_m_s;
        self.sensitivity -= row * gain;
        self.variance *= 1.0 - gain;
        Row {
            regressors: row,
            response: innovation_m_s,
            innovation_variance,
            // An error of this row persists in the following innovations and decays.
            force_noise: force_noise * 2.0 / (2.0 - gain),
            ..Row::default()
        }
    }
}

/// Returns the increase of the sideslip by curvature in a step, per θκ and θκ², relative to that of
/// linear tyres; zero when driving straight.
fn sideslip_curvature(
    step: &Step,
    gyro_rad_s: f64,
    model: &RobotModel,
    bound: &SlipBound,
) -> [f64; 2] {
    let theta = bound.theta;
    let rim_m_s = step.harmonic_m_s.abs() / step.samples;
    if step.usable < step.samples || gyro_rad_s.abs() < TURNING_MIN_RAD_S {
        return [0.0; 2];
    }
    let turn = Turn {
        rim_m_s,
        rim_difference_m_s: step.rim_difference_m_s / step.samples,
        yaw_rate_rad_s: gyro_rad_s,
        radius_difference: 0.0,
    };
    let lateral = theta * rim_m_s * gyro_rad_s / GRAVITY_M_S2;
    let curvatures = Curvatures::of(bound.curvature);
    curvatures.split(curvatures.nodes().map(|curvature| {
        let loss = StiffnessLoss::of(
            &turn,
            &[STILL],
            MeanSlip {
                forward: 0.0,
                lateral,
            },
            TyreCurve { theta, curvature },
            model,
        );
        (loss.mean + loss.lateral / lateral) / loss.left
    }))
}
