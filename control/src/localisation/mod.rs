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
//! its age with the present twist. Its covariance is the stated one, or else estimated from the
//! differences of consecutive fixes (`fix_noise.rs`), starting with the configured one. A χ² gate
//! on the Mahalanobis distance refuses outliers and counts them; after [`REFUSED_MAX`] in a row the
//! robot has been moved, and the filter restarts from the fix. The covariance update is
//! Joseph's form. See Bar-Shalom, Li and Kirubarajan, *Estimation with Applications to Tracking and
//! Navigation*, 2001, chapters 5 and 10.

mod fix_noise;

use nalgebra::{Matrix3, Matrix3x6, Matrix6, Vector3, Vector6};

use crate::estimation::SensorSample;
use crate::geometry::{Pose, Twist, wrap_angle_rad};
use crate::robot::RobotModel;
use fix_noise::{FixNoiseEstimate, PosePair};

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
            gyro_offset_walk: 2.0e-4,
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
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Localisation {
    model: RobotModel,
    noise: LocalisationNoise,
    fix_noise: FixNoiseEstimate,
    state: Vector6<f64>,
    covariance: Matrix6<f64>,
    turn_rad_s: f64,
    forward_m_s: f64,
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
        if !self.started {
            return;
        }
        let dt_s = dt_s.min(STEP_MAX_S);
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
        // Stopped wheels do not slide: the noise driving both speeds grows with the speed.
        let moving = (self.forward_m_s.abs() + 0.2 * self.turn_rad_s.abs()).min(0.5) / 0.5;
        let renewed = (1.0 - fade * fade) * (0.05 + 0.95 * moving).powi(2);
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
        let pose = self.propagated(fix);
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
        let observe = Matrix3x6::identity();
        let position = fix_noise.position_m.powi(2);
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

    /// Propagates the fix over its age with the present motion.
    fn propagated(&self, fix: &PositionFix) -> Pose {
        let turn_rad = self.turn_rad_s * fix.age_s;
        let (sin, cos) = (fix.pose.heading_rad + 0.5 * turn_rad).sin_cos();
        let forward_m = (self.forward_m_s + self.state[3]) * fix.age_s;
        let left_m = self.state[4] * fix.age_s;
        Pose {
            x_m: fix.pose.x_m + forward_m * cos - left_m * sin,
            y_m: fix.pose.y_m + forward_m * sin + left_m * cos,
            heading_rad: fix.pose.heading_rad + turn_rad,
        }
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

#[cfg(test)]
mod tests {
    use super::*;

    fn filter() -> Localisation {
        Localisation::new(RobotModel::yi2007(), LocalisationNoise::default())
    }

    fn fix(x_m: f64, y_m: f64) -> PositionFix {
        PositionFix {
            pose: Pose {
                x_m,
                y_m,
                heading_rad: 0.0,
            },
            age_s: 0.0,
            noise: None,
        }
    }

    fn straight(speed_rad_s: f64) -> SensorSample {
        SensorSample {
            wheel_speeds: crate::measured::WheelSpeeds {
                left_rad_s: speed_rad_s,
                right_rad_s: speed_rad_s,
            },
            ..SensorSample::default()
        }
    }

    #[test]
    fn nothing_is_known_before_the_first_fix() {
        let mut filter = filter();
        filter.predict(&SensorSample::default(), 0.01);
        assert!(filter.pose().is_none() && filter.fix_age_s().is_infinite());
        assert_eq!(filter.correct(&fix(1.0, 2.0)), FixOutcome::Started);
        assert!((filter.pose().unwrap().x_m - 1.0).abs() < 1.0e-12);
    }

    #[test]
    fn a_fix_that_cannot_be_true_is_refused_until_it_insists() {
        let mut filter = filter();
        filter.correct(&fix(0.0, 0.0));
        for _ in 1..REFUSED_MAX {
            filter.predict(&SensorSample::default(), 0.05);
            assert_eq!(filter.correct(&fix(50.0, 0.0)), FixOutcome::Outlier);
            assert!(filter.pose().unwrap().x_m.abs() < 0.01);
        }
        filter.predict(&SensorSample::default(), 0.05);
        assert_eq!(filter.correct(&fix(50.0, 0.0)), FixOutcome::Restarted);
        assert!((filter.pose().unwrap().x_m - 50.0).abs() < 1.0e-9);
    }

    #[test]
    fn after_a_silence_a_fix_is_believed_as_far_as_the_robot_can_have_come() {
        let speed_m_s = 0.5;
        let speed_rad_s = speed_m_s / RobotModel::yi2007().wheel_radius_m();
        let driven = |is_silence_known: bool, speed_rad_s: f64, jump_m: f64| {
            let mut filter = filter();
            filter.correct(&fix(0.0, 0.0));
            for _ in 0..20 {
                filter.predict(&straight(speed_rad_s), 0.05);
                let x_m = filter.pose().unwrap().x_m;
                filter.correct(&fix(x_m, 0.0));
            }
            let x_m = filter.pose().unwrap().x_m;
            if is_silence_known {
                filter.widen_without_measurements(1.5);
            }
            filter.predict(&straight(0.0), 0.2);
            filter.correct(&fix(x_m + jump_m, 0.0))
        };
        assert_eq!(driven(true, speed_rad_s, 0.3), FixOutcome::Fused);
        assert_eq!(driven(false, speed_rad_s, 0.3), FixOutcome::Outlier);
        assert_eq!(driven(true, speed_rad_s, 50.0), FixOutcome::Outlier);
        assert_eq!(driven(true, 0.0, 0.3), FixOutcome::Outlier);
    }

    #[test]
    fn a_fix_weighs_by_its_own_standard_deviation() {
        let moved_by = |position_m: f64| {
            let mut filter = filter();
            filter.correct(&fix(0.0, 0.0));
            filter.predict(&SensorSample::default(), 0.05);
            let mut fix = fix(0.02, 0.0);
            fix.noise = Some(FixNoise {
                position_m,
                heading_rad: 0.01,
            });
            let outcome = filter.correct(&fix);
            (outcome, filter.pose().unwrap().x_m)
        };
        let (_, by_good) = moved_by(0.005);
        let (_, by_poor) = moved_by(0.1);
        assert!(by_good > 0.015 && by_poor < 0.001, "{by_good} {by_poor}");
        assert_eq!(moved_by(f64::NAN).0, FixOutcome::Invalid);
        assert_eq!(moved_by(0.0).0, FixOutcome::Invalid);
    }

    #[test]
    fn samples_that_are_no_numbers_are_counted_and_do_no_harm() {
        let mut filter = filter();
        filter.correct(&fix(0.0, 0.0));
        let mut sample = straight(f64::INFINITY);
        sample.gyro_rad_s = f64::NAN;
        filter.predict(&sample, 0.01);
        assert_eq!(filter.correct(&fix(f64::NAN, 0.0)), FixOutcome::Invalid);
        assert_eq!(filter.invalid(), 3);
        assert!(filter.pose().unwrap().is_finite());
        assert!((filter.fix_age_s() - 0.01).abs() < 1.0e-12);
    }
}
