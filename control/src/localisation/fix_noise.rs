//! Estimates the noise of position fixes that state none.
//!
//! Two consecutive fixes differ by the robot's motion, which gyro and wheels measure well over so
//! short a time, and by the noise of both: `d = (z_k − z_{k−1}) − Δ`, of variance 2R per axis. R is
//! the running mean of `d²/2`, started with the configured noise. R does not contain errors that
//! change slowly, such as a receiver's drift. An outlier counts as at most four standard
//! deviations.

use super::FixNoise;
use crate::geometry::{Pose, wrap_angle_rad};

/// Weight of the configured noise, as a number of fixes.
const CONFIGURED_FIXES: f64 = 5.0;
/// Maximum weight of the running mean, as a number of fixes.
const MEMORY_FIXES: f64 = 50.0;
/// Maximum difference that counts, in standard deviations, so that one outlier is not taken as
/// noise.
const DIFFERENCE_MAX: f64 = 4.0;
/// Maximum time between two fixes that are compared, seconds.
const APART_MAX_S: f64 = 1.0;
/// Bounds of the estimated position noise per axis, metres.
const POSITION_RANGE_M: std::ops::RangeInclusive<f64> = 1.0e-3..=0.2;
/// Bounds of the estimated heading noise, radians.
const HEADING_RANGE_RAD: std::ops::RangeInclusive<f64> = 1.0e-3..=0.1;

/// Pose of a fix, and pose of the filter at the same time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct PosePair {
    pub(super) fix: Pose,
    pub(super) filter: Pose,
}

/// Last fix that was used, with the pose of the filter after it, and its age.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Anchor {
    poses: PosePair,
    age_s: f64,
}

/// Running mean of the noise variances.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct FixNoiseEstimate {
    anchor: Option<Anchor>,
    /// Weight of the running mean, as a number of fixes.
    fixes: f64,
    /// Variances: position per axis, metres squared, and heading, radians squared.
    position_m2: f64,
    heading_rad2: f64,
}

impl FixNoiseEstimate {
    /// Starts with the configured noise.
    pub(super) fn new(configured: FixNoise) -> Self {
        Self {
            anchor: None,
            fixes: CONFIGURED_FIXES,
            position_m2: configured.position_m.powi(2),
            heading_rad2: configured.heading_rad.powi(2),
        }
    }

    /// Returns the estimated standard deviations of a fix.
    pub(super) fn noise(&self) -> FixNoise {
        FixNoise {
            position_m: self.position_m2.sqrt(),
            heading_rad: self.heading_rad2.sqrt(),
        }
    }

    /// Adds to the age of the last fix.
    pub(super) fn advance(&mut self, dt_s: f64) {
        if let Some(anchor) = &mut self.anchor {
            anchor.age_s += dt_s;
        }
    }

    /// Discards the last fix, because the motion since is unknown.
    pub(super) fn discard_last_fix(&mut self) {
        self.anchor = None;
    }

    /// Updates the variances with the difference of a fix from the previous one. The pose of the
    /// filter in `now` is the one that it predicts from the previous fix.
    pub(super) fn compare(&mut self, now: PosePair) {
        let Some(anchor) = self.anchor.filter(|anchor| anchor.age_s <= APART_MAX_S) else {
            return;
        };
        let before = anchor.poses;
        let apart = |of: fn(Pose) -> f64| {
            (of(now.fix) - of(before.fix)) - (of(now.filter) - of(before.filter))
        };
        let (x_m, y_m) = (apart(|pose| pose.x_m), apart(|pose| pose.y_m));
        let turned_rad = wrap_angle_rad(apart(|pose| pose.heading_rad));
        // A difference of two values has twice the variance of one.
        let position_m2 = 0.25 * (x_m * x_m + y_m * y_m);
        let heading_rad2 = 0.5 * turned_rad * turned_rad;
        self.fixes = (self.fixes + 1.0).min(MEMORY_FIXES);
        let most = DIFFERENCE_MAX * DIFFERENCE_MAX;
        let take = |mean: &mut f64, found: f64, range: std::ops::RangeInclusive<f64>| {
            *mean += (found.min(most * *mean) - *mean) / self.fixes;
            *mean = mean.clamp(range.start().powi(2), range.end().powi(2));
        };
        take(&mut self.position_m2, position_m2, POSITION_RANGE_M);
        take(&mut self.heading_rad2, heading_rad2, HEADING_RANGE_RAD);
    }

    /// Records a fix that was used, and the pose of the filter after it.
    pub(super) fn anchor(&mut self, poses: PosePair) {
        self.anchor = Some(Anchor { poses, age_s: 0.0 });
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::super::{FixOutcome, Localisation, LocalisationNoise, PositionFix};
    use super::*;
    use crate::estimation::SensorSample;
    use crate::measured::WheelSpeeds;
    use crate::robot::RobotModel;

    /// Period of the loop at 100 Hz.
    const LOOP_S: f64 = 0.01;

    /// Simulation of a robot on a circle of 2 m with noisy fixes, one per a number of ticks.
    struct Drive {
        filter: Localisation,
        random: ChaCha8Rng,
        truth: Pose,
    }

    impl Drive {
        fn new(seed: u64) -> Self {
            Self {
                filter: Localisation::new(RobotModel::yi2007(), LocalisationNoise::default()),
                random: ChaCha8Rng::seed_from_u64(seed),
                truth: Pose::default(),
            }
        }

        fn normal(&mut self, std_dev: f64) -> f64 {
            let radius = (-2.0 * (1.0 - self.random.random::<f64>()).ln()).sqrt();
            std_dev * radius * (std::f64::consts::TAU * self.random.random::<f64>()).cos()
        }

        /// Drives on and returns the number of fixes that were refused.
        fn run(
            &mut self,
            seconds: u32,
            ticks_per_fix: u32,
            noise: FixNoise,
            wild_share: f64,
        ) -> u32 {
            let (speed_m_s, turn_rad_s) = (0.6, 0.3);
            let rims = speed_m_s / RobotModel::yi2007().wheel_radius_m();
            let wheels = WheelSpeeds {
                left_rad_s: rims,
                right_rad_s: rims,
            };
            let mut refused = 0;
            for tick in 0..100 * seconds {
                let middle_rad = self.truth.heading_rad + 0.5 * LOOP_S * turn_rad_s;
                self.truth.x_m += LOOP_S * speed_m_s * middle_rad.cos();
                self.truth.y_m += LOOP_S * speed_m_s * middle_rad.sin();
                self.truth.heading_rad += LOOP_S * turn_rad_s;
                let sample = SensorSample {
                    wheel_speeds: wheels,
                    gyro_rad_s: turn_rad_s + self.normal(0.003),
                    ..SensorSample::default()
                };
                self.filter.predict(&sample, LOOP_S);
                if tick % ticks_per_fix != 0 {
                    continue;
                }
                let wild_m = if self.random.random_bool(wild_share) {
                    1.0
                } else {
                    0.0
                };
                let fix = PositionFix {
                    pose: Pose {
                        x_m: self.truth.x_m + self.normal(noise.position_m) + wild_m,
                        y_m: self.truth.y_m + self.normal(noise.position_m),
                        heading_rad: wrap_angle_rad(
                            self.truth.heading_rad + self.normal(noise.heading_rad),
                        ),
                    },
                    age_s: 0.0,
                    noise: None,
                };
                refused += u32::from(self.filter.correct(&fix) == FixOutcome::Outlier);
            }
            refused
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]

        #[test]
        fn the_noise_of_fixes_is_found_while_driving(
            position_m in 0.002..0.08_f64, heading_rad in 0.002..0.04_f64,
            ticks_per_fix in 2..20_u32, seed in 0..1000_u64,
        ) {
            let noise = FixNoise { position_m, heading_rad };
            let mut drive = Drive::new(seed);
            drive.run(30, ticks_per_fix, noise, 0.0);
            let found = drive.filter.fix_noise.noise();
            // The wheels' error between two fixes counts as noise too.
            let position = found.position_m / position_m.hypot(1.0e-3);
            let heading = found.heading_rad / heading_rad;
            prop_assert!((0.7..1.4).contains(&position), "position {position}");
            prop_assert!((0.7..1.4).contains(&heading), "heading {heading}");
        }
    }

    #[test]
    fn fixes_that_are_noisier_than_configured_are_not_refused_for_long() {
        let noise = FixNoise {
            position_m: 0.1,
            heading_rad: 0.05,
        };
        let mut drive = Drive::new(7);
        drive.run(10, 10, noise, 0.0);
        let refused = drive.run(60, 10, noise, 0.0);
        assert!(refused <= 6, "{refused} of 600 refused");
        assert_eq!(drive.filter.restarts(), 0);
    }

    #[test]
    fn single_wild_fixes_are_refused_and_hardly_count_as_noise() {
        let noise = FixNoise {
            position_m: 0.01,
            heading_rad: 0.005,
        };
        let mut drive = Drive::new(11);
        let refused = drive.run(120, 10, noise, 0.01);
        assert!((5..=30).contains(&refused), "{refused} of 1200 refused");
        let found = drive.filter.fix_noise.noise();
        assert!(found.position_m < 0.02, "{found:?}");
    }

    #[test]
    fn a_fix_that_states_its_noise_tells_nothing_of_those_that_do_not() {
        let mut filter = Localisation::new(RobotModel::yi2007(), LocalisationNoise::default());
        let before = filter.fix_noise.noise();
        for tick in 0..100_u8 {
            filter.predict(&SensorSample::default(), LOOP_S);
            filter.correct(&PositionFix {
                pose: Pose {
                    x_m: if tick % 2 == 0 { 0.3 } else { -0.3 },
                    ..Pose::default()
                },
                age_s: 0.0,
                noise: Some(FixNoise {
                    position_m: 0.3,
                    heading_rad: 0.1,
                }),
            });
        }
        assert_eq!(filter.fix_noise.noise(), before);
    }
}
