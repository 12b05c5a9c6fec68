//! Pose estimation: an extended Kalman filter that fuses position fixes, gyro and wheel speeds.
//!
//! **State** `(x, y, φ, δ_v, v_l, b)`: position in the site frame, m; heading, rad; true minus
//! odometric forward speed, m/s; lateral speed, m/s (a skid-steered base slides in turns); gyro
//! bias, rad/s. **Inputs**: odometric forward speed `v_o` and measured turn rate `ω_m`.
//!
//! **Process model**, at the loop's rate `1/dt`:
//!
//! ```text
//! ẋ = (v_o + δ_v) cos φ − v_l sin φ      white noise of the gyro on φ, σ_ω dt a step
//! ẏ = (v_o + δ_v) sin φ + v_l cos φ      δ_v, v_l: first-order Gauss–Markov, time constant
//! φ̇ = ω_m − b                                      `speed_memory_s`, less driven at low speed
//! ḃ = 0 + random walk                    `gyro_offset_walk`
//! ```
//!
//! **Measurement model**: a fix is `(x, y, φ) + noise` at an earlier time. It is propagated over
//! its age with the measured motion since then (`past_motion.rs`), so it also depends on the errors
//! of that motion: on `δ_v`, `v_l` and b times the age, and on their change within it, which adds to its
//! noise. Its covariance is the stated one, or else estimated from the
//! differences of consecutive fixes (`fix_noise.rs`), starting with the configured one. A χ² gate
//! on the Mahalanobis distance refuses outliers and counts them; after [`REFUSED_MAX`] in a row the
//! robot has been moved, and the filter restarts from the fix. The covariance update is
//! Joseph's form. See Bar-Shalom, Li and Kirubarajan, *Estimation with Applications to Tracking and
//! Navigation*, 2001, chapters 5 and 10.

mod fix_noise;
mod past_motion;
#[cfg(test)]
mod tests;

use nalgebra::{Matrix3, Matrix6, Vector3, Vector6};

use crate::estimation::SensorSample;
use crate::geometry::{Pose, Twist, wrap_angle_rad};
use crate::measured::GYRO_OFFSET_WALK;
use crate::robot::RobotModel;
use fix_noise::{FixNoiseEstimate, PosePair};
use past_motion::{PastMotion, Propagated, Step, Unmeasured};

/// Number of consecutive refused fixes after which the filter restarts.
pub const REFUSED_MAX: u32 = 20;
/// Squared Mahalanobis distance beyond which a fix is refused (χ² with three degrees of freedom;
/// one in 10⁶ correct fixes exceeds it).
const VALIDATION_GATE: f64 = 30.7;
/// Standard deviation of the path's curvature while no measurements arrive, 1/m.
const GAP_CURVATURE_PER_M: f64 = 1.0;
/// Maximum time of prediction in one call, seconds.
const STEP_MAX_S: f64 = 0.5;
/// Maximum age of a fix that is used, seconds.
const FIX_AGE_MAX_S: f64 = 1.0;
/// Magnitude of speeds and turn rates from which a sample is refused, metres or radians per second.
const RATE_MAX: f64 = 100.0;

/// Measured pose.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PositionFix {
    /// Pose in the site frame.
    pub pose: Pose,
    /// Time since its measurement, seconds; accepted from 0 to 1.
    pub age_s: f64,
    /// Noise of the fix; None to estimate it from the fixes.
    pub noise: Option<FixNoise>,
}

/// Standard deviations of a fix, each finite and above zero.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FixNoise {
    /// Position, per axis, metres.
    pub position_m: f64,
    /// Heading, radians.
    pub heading_rad: f64,
}

impl FixNoise {
    fn is_possible(self) -> bool {
        let is_possible = |std_dev: f64| std_dev.is_finite() && std_dev > 0.0;
        is_possible(self.position_m) && is_possible(self.heading_rad)
    }
}

/// Noise of the sensors that localisation uses, as standard deviations.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct LocalisationNoise {
    /// Position noise of a fix that states none, per axis, metres; the start value of its estimate.
    pub position_m: f64,
    /// Heading noise of a fix that states none, radians; the start value of its estimate.
    pub heading_rad: f64,
    /// White noise of the gyro at the loop's rate, radians per second.
    pub gyro_rad_s: f64,
    /// Random walk of the gyro's bias, radians per second per square root of a second.
    pub gyro_offset_walk: f64,
    /// True minus odometric forward speed, metres per second.
    pub speed_m_s: f64,
    /// Lateral speed, metres per second.
    pub sideways_m_s: f64,
    /// Correlation time of both speeds, seconds.
    pub speed_memory_s: f64,
}

impl Default for LocalisationNoise {
    fn default() -> Self {
        Self {
            position_m: 0.01,
            heading_rad: 0.005,
            gyro_rad_s: 0.003,
            gyro_offset_walk: GYRO_OFFSET_WALK,
            speed_m_s: 0.02,
            sideways_m_s: 0.03,
            speed_memory_s: 1.0,
        }
    }
}

/// Result of processing a fix.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FixOutcome {
    /// It was the first fix; the filter starts from it.
    Started,
    /// It was fused into the estimate.
    Fused,
    /// It was refused: not finite, too old, from the future, or with invalid noise.
    Invalid,
    /// It was refused: too far from the prediction.
    Outlier,
    /// It was the last of too many outliers in a row; the filter restarted from it.
    Restarted,
}

/// Extended Kalman filter of one robot's pose.
#[derive(Debug, Clone, PartialEq)]
pub struct Localisation {
    model: RobotModel,
    noise: LocalisationNoise,
    fix_noise: FixNoiseEstimate,
    state: Vector6<f64>,
    covariance: Matrix6<f64>,
    turn_rad_s: f64,
    forward_m_s: f64,
    past: PastMotion,
    started: bool,
    fix_age_s: f64,
    refused_in_a_row: u32,
    outliers: u64,
    invalid: u64,
    restarts: u64,
}

impl Localisation {
    /// Creates a filter without a pose.
    pub fn new(model: RobotModel, noise: LocalisationNoise) -> Self {
        Self {
            model,
            noise,
            fix_noise: FixNoiseEstimate::new(FixNoise {
                position_m: noise.position_m,
                heading_rad: noise.heading_rad,
            }),
            state: Vector6::zeros(),
            covariance: Matrix6::zeros(),
            turn_rad_s: 0.0,
            forward_m_s: 0.0,
            past: PastMotion::new(),
            started: false,
            fix_age_s: f64::INFINITY,
            refused_in_a_row: 0,
            outliers: 0,
            invalid: 0,
            restarts: 0,
        }
    }

    /// Returns the pose in the site frame; None before the first fix.
    pub fn pose(&self) -> Option<Pose> {
        self.started.then(|| Pose {
            x_m: self.state[0],
            y_m: self.state[1],
            heading_rad: wrap_angle_rad(self.state[2]),
        })
    }

    /// Returns forward speed and turn rate in the body frame, corrected by the estimated errors.
    pub fn twist(&self) -> Twist {
        Twist {
            linear_m_s: self.forward_m_s + self.state[3],
            angular_rad_s: self.turn_rad_s,
        }
    }

    /// Returns the standard deviation of the position on the worse axis, metres; infinite before
    /// the first fix.
    pub fn position_std_dev_m(&self) -> f64 {
        if self.started {
            self.covariance[(0, 0)]
                .max(self.covariance[(1, 1)])
                .max(0.0)
                .sqrt()
        } else {
            f64::INFINITY
        }
    }

    /// Returns the age of the last fix that was used, seconds; infinite before the first.
    pub fn fix_age_s(&self) -> f64 {
        self.fix_age_s
    }

    /// Returns the number of fixes refused as outliers.
    pub fn outliers(&self) -> u64 {
        self.outliers
    }

    /// Returns the number of samples and fixes refused as not finite, too large or too old.
    pub fn invalid(&self) -> u64 {
        self.invalid
    }

    /// Returns the number of restarts.
    pub fn restarts(&self) -> u64 {
        self.restarts
    }

    /// Predicts the state over `dt_s` seconds, at most 0.5, with the rates of gyro and wheels; call
    /// [`Self::widen_without_measurements`] first after a longer gap. An invalid rate is counted,
    /// and the last valid one is used; an invalid `dt_s` is counted, and nothing else changes.
    pub fn predict(&mut self, sample: &SensorSample, dt_s: f64) {
        if !(dt_s.is_finite() && dt_s > 0.0) {
            self.invalid += 1;
            return;
        }
        self.fix_age_s += dt_s;
        self.fix_noise.advance(dt_s);
        let (gyro_rad_s, wheels) = (sample.gyro_rad_s, sample.wheel_speeds);
        let wheel_m_s =
            0.5 * self.model.wheel_radius_m() * (wheels.left_rad_s + wheels.right_rad_s);
        // After a refused sample the last rates apply; the covariance grows.
        if gyro_rad_s.is_finite() && gyro_rad_s.abs() < RATE_MAX {
            self.turn_rad_s = gyro_rad_s - self.state[5];
        } else {
            self.invalid += 1;
        }
        if wheel_m_s.is_finite() && wheel_m_s.abs() < RATE_MAX {
            self.forward_m_s = wheel_m_s;
        } else {
            self.invalid += 1;
        }
        let dt_s = dt_s.min(STEP_MAX_S);
        self.past.add(&Step {
            time_s: dt_s,
            turn_rad: self.turn_rad_s * dt_s,
            forward_m: self.forward_m_s * dt_s,
        });
        if !self.started {
            return;
        }
        let middle_rad = self.state[2] + 0.5 * dt_s * self.turn_rad_s;
        let (sin, cos) = middle_rad.sin_cos();
        let (forward_m_s, left_m_s) = (self.forward_m_s + self.state[3], self.state[4]);
        self.state[0] += dt_s * (forward_m_s * cos - left_m_s * sin);
        self.state[1] += dt_s * (forward_m_s * sin + left_m_s * cos);
        self.state[2] += dt_s * self.turn_rad_s;
        let fade = (-dt_s / self.noise.speed_memory_s.max(dt_s)).exp();
        self.state[3] *= fade;
        self.state[4] *= fade;
        let mut motion = Matrix6::identity();
        motion[(0, 2)] = -dt_s * (forward_m_s * sin + left_m_s * cos);
        motion[(1, 2)] = dt_s * (forward_m_s * cos - left_m_s * sin);
        motion[(0, 3)] = dt_s * cos;
        motion[(0, 4)] = -dt_s * sin;
        motion[(1, 3)] = dt_s * sin;
        motion[(1, 4)] = dt_s * cos;
        motion[(2, 5)] = -dt_s;
        motion[(3, 3)] = fade;
        motion[(4, 4)] = fade;
        let renewed = (1.0 - fade * fade) * self.noise_share().powi(2);
        self.covariance = motion * self.covariance * motion.transpose();
        self.covariance[(2, 2)] += (self.noise.gyro_rad_s * dt_s).powi(2);
        self.covariance[(3, 3)] += renewed * self.noise.speed_m_s.powi(2);
        self.covariance[(4, 4)] += renewed * self.noise.sideways_m_s.powi(2);
        self.covariance[(5, 5)] += dt_s * self.noise.gyro_offset_walk.powi(2);
    }

    /// Enlarges the covariance after `gap_s` seconds without measurements: the robot may have
    /// stopped, or continued at its last speeds on any curve. Must be called before the prediction
    /// that ends the gap, which replaces these speeds.
    pub fn widen_without_measurements(&mut self, gap_s: f64) {
        if !self.started || !gap_s.is_finite() || gap_s <= 0.0 {
            return;
        }
        let (forward_m_s, left_m_s) = (self.forward_m_s + self.state[3], self.state[4]);
        let distance_m = forward_m_s.hypot(left_m_s) * gap_s;
        let turn_rad = (self.turn_rad_s * gap_s).hypot(GAP_CURVATURE_PER_M * distance_m);
        let turn_rad = turn_rad.min(std::f64::consts::PI);
        self.fix_noise.discard_last_fix();
        for (index, std_dev) in [distance_m, distance_m, turn_rad].into_iter().enumerate() {
            self.covariance[(index, index)] += std_dev * std_dev;
        }
    }

    /// Fuses a position fix, unless it is invalid or an outlier. Restarts from the last of
    /// [`REFUSED_MAX`] outliers in a row.
    pub fn correct(&mut self, fix: &PositionFix) -> FixOutcome {
        let is_in_time = (0.0..=FIX_AGE_MAX_S).contains(&fix.age_s);
        let is_possible = fix.noise.is_none_or(FixNoise::is_possible);
        if !(fix.pose.is_finite() && is_in_time && is_possible) {
            self.invalid += 1;
            return FixOutcome::Invalid;
        }
        let Propagated { pose, observe } = self.propagated(fix);
        if let Some(filter) = self.pose().filter(|_| fix.noise.is_none()) {
            self.fix_noise.compare(PosePair { fix: pose, filter });
        }
        let fix_noise = fix.noise.unwrap_or_else(|| self.fix_noise.noise());
        if !self.started {
            self.start(pose, fix.age_s, fix_noise);
            return FixOutcome::Started;
        }
        let innovation = Vector3::new(
            pose.x_m - self.state[0],
            pose.y_m - self.state[1],
            wrap_angle_rad(pose.heading_rad - self.state[2]),
        );
        let position = fix_noise.position_m.powi(2) + self.drift_m2(fix.age_s);
        let noise = Matrix3::from_diagonal(&Vector3::new(
            position,
            position,
            fix_noise.heading_rad.powi(2),
        ));
        let innovation_variance: Matrix3<f64> =
            observe * self.covariance * observe.transpose() + noise;
        let Some(inverse) = innovation_variance.try_inverse() else {
            self.invalid += 1;
            return FixOutcome::Invalid;
        };
        if (innovation.transpose() * inverse * innovation)[(0, 0)] > VALIDATION_GATE {
            self.outliers += 1;
            self.refused_in_a_row += 1;
            if self.refused_in_a_row < REFUSED_MAX {
                return FixOutcome::Outlier;
            }
            self.restarts += 1;
            self.start(pose, fix.age_s, fix_noise);
            return FixOutcome::Restarted;
        }
        let gain = self.covariance * observe.transpose() * inverse;
        self.state += gain * innovation;
        // Joseph's form keeps the covariance symmetric and positive.
        let keep = Matrix6::identity() - gain * observe;
        self.covariance =
            keep * self.covariance * keep.transpose() + gain * noise * gain.transpose();
        self.refused_in_a_row = 0;
        self.fix_age_s = fix.age_s;
        self.anchor(pose);
        FixOutcome::Fused
    }

    fn anchor(&mut self, fix: Pose) {
        if let Some(filter) = self.pose() {
            self.fix_noise.anchor(PosePair { fix, filter });
        }
    }

    /// Propagates the fix over its age with the measured motion.
    fn propagated(&self, fix: &PositionFix) -> Propagated {
        let unmeasured = Unmeasured {
            forward_m_s: self.state[3],
            left_m_s: self.state[4],
        };
        let rates = Step {
            time_s: 1.0,
            turn_rad: self.turn_rad_s,
            forward_m: self.forward_m_s,
        };
        self.past.propagate(fix.pose, fix.age_s, unmeasured, &rates)
    }

    /// Returns the share of the noise that drives the unmeasured speeds, 0 to 1: stopped wheels do not slide,
    /// so it grows with the speed.
    fn noise_share(&self) -> f64 {
        let moving = (self.forward_m_s.abs() + 0.2 * self.turn_rad_s.abs()).min(0.5) / 0.5;
        0.05 + 0.95 * moving
    }

    /// Returns the variance of the way since a fix by changes of the unmeasured speeds within its age a, in
    /// square metres: with the density q of the noise that drives them, `q a³/3` on each axis.
    fn drift_m2(&self, age_s: f64) -> f64 {
        let noise = &self.noise;
        let std_dev_m_s = noise.speed_m_s.max(noise.sideways_m_s) * self.noise_share();
        let square = std_dev_m_s * std_dev_m_s;
        2.0 * square / noise.speed_memory_s.max(age_s) * age_s.powi(3) / 3.0
    }

    fn start(&mut self, pose: Pose, age_s: f64, fix_noise: FixNoise) {
        self.state = Vector6::new(
            pose.x_m,
            pose.y_m,
            pose.heading_rad,
            0.0,
            0.0,
            self.state[5],
        );
        let noise = &self.noise;
        self.covariance = Matrix6::from_diagonal(&Vector6::new(
            fix_noise.position_m.powi(2),
            fix_noise.position_m.powi(2),
            fix_noise.heading_rad.powi(2),
            noise.speed_m_s.powi(2),
            noise.sideways_m_s.powi(2),
            0.01_f64.powi(2),
        ));
        self.started = true;
        self.refused_in_a_row = 0;
        self.fix_age_s = age_s;
        self.anchor(pose);
    }
}
