//! Detects a change of the ground under a robot that is being identified.
//!
//! Beside the best hypothesis the same robot is simulated on softer and on stiffer ground. The
//! evidence for each of them is a CUSUM (Page 1954) of how much better it explains the
//! measurements: `S ← max(0, S + Σ ρ(r/σ) − Σ ρ(r'/σ) − k) > h`, with the residuals r of the
//! hypothesis and r' of the other ground, over all channels of a comparison, and ρ the square up to
//! a limit. That is a likelihood ratio over a grid of K (Basseville and Nikiforov, Detection of
//! Abrupt Changes, 1993, ch. 2). An error of the model or a sensor makes both residuals large, and
//! their difference small.

use super::model::{CHANNELS, Input, State};
use super::parameters::{MODELLED, Values, index};
use super::physical::Robot;
use super::simulation::{DELAYED, Simulation, delays_s};
use crate::robot::RobotModel;

/// Differences of ln K of the other grounds.
const OFFSETS: [f64; 3] = [-1.0, 1.0, -2.3];
/// Threshold h of the CUSUM, without and with measured torque, and its drift k: squares of standard
/// deviations. Without torque the robot's parameters are less certain, and residuals by errors of
/// the model last longer.
const THRESHOLDS: [f64; 2] = [220.0, 125.0];
const DRIFT: f64 = 2.0;
/// Limit of one channel's squared standardised residual.
const SQUARE_MAX: f64 = 25.0;
/// Limit of what one comparison adds: a jerk in all channels is no change of the ground.
const GAIN_MAX: f64 = 25.0;
/// Number of comparisons that are ignored after standstill: one second.
const IGNORED_AFTER_STANDSTILL: u32 = 20;
/// Number of comparisons that are ignored after one side was slow.
const IGNORED_AFTER_SLOW_SIDE: u32 = 12;
/// Maximum number of comparisons with a slow side after which evidence is kept: two seconds.
const SLOW_MAX: u32 = 40;
/// Number of compared channels: all but the body speed.
pub(super) const COMPARED: usize = CHANNELS - 1;
/// Index of the first channel of the torques, which are the last ones.
const TORQUES_FROM: usize = 3;

/// A measurement of one channel, with the output of the best hypothesis and the standard deviation
/// of their difference, in the channel's unit.
#[derive(Debug, Clone, Copy)]
pub(super) struct ChannelComparison {
    pub(super) measured: f64,
    pub(super) output: f64,
    pub(super) std_dev: f64,
}

impl ChannelComparison {
    /// Returns the limited squared residual of an output.
    fn square(&self, output: f64) -> f64 {
        let residual = (self.measured - output) / self.std_dev;
        (residual * residual).min(SQUARE_MAX)
    }
}

/// The robot simulated on another ground, with the CUSUM of the evidence for that ground.
#[derive(Debug, Clone, PartialEq)]
struct OtherGround {
    robot: Robot<f64>,
    model: Simulation<f64>,
    evidence: f64,
}

/// Motion of a robot in one comparison.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Motion {
    /// Both sides roll.
    Rolling,
    /// One side is too slow for a comparison, as the inner one in a tight bend.
    Slow,
    /// The robot stands.
    Standing,
}

/// State of the detector. It detects nothing before [`ChangeMonitor::set_best`].
#[derive(Debug, Clone, PartialEq)]
pub(super) struct ChangeMonitor {
    others: Option<[OtherGround; OFFSETS.len()]>,
    /// Number of comparisons that are still ignored.
    ignored: u32,
    /// Number of comparisons in a row in which the robot did not roll.
    slow: u32,
    /// Whether torques were compared.
    has_torque: bool,
    /// Delays of turn rate and accelerations relative to the wheel speeds, seconds.
    delays_s: [f64; DELAYED],
}

impl Default for ChangeMonitor {
    fn default() -> Self {
        Self {
            others: None,
            ignored: IGNORED_AFTER_STANDSTILL,
            slow: 0,
            has_torque: false,
            delays_s: [0.0; DELAYED],
        }
    }
}

impl ChangeMonitor {
    /// Sets the parameters of the best hypothesis, in the units of [`index`]. The first call starts
    /// the robots on the other grounds in the motion `state`.
    pub(super) fn set_best(&mut self, values: &Values, model: &RobotModel, state: State<f64>) {
        let robot = |offset: f64| {
            let mut values = *values;
            values[index::STIFFNESS] += offset;
            robot_of(&values, model)
        };
        self.delays_s = delays_s(values);
        if let Some(others) = &mut self.others {
            for (other, offset) in others.iter_mut().zip(OFFSETS) {
                other.robot = robot(offset);
            }
        } else {
            self.others = Some(OFFSETS.map(|offset| OtherGround {
                robot: robot(offset),
                model: Simulation::new(state),
                evidence: 0.0,
            }));
        }
    }

    /// Advances the robots on other grounds by one sample, whose outputs have the weight `share`.
    pub(super) fn advance(&mut self, input: &Input, share: f64) {
        for other in self.others.iter_mut().flatten() {
            other.model.advance(&other.robot, input, share);
        }
    }

    /// Records the motion during a comparison. Returns whether the comparison counts. Evidence is
    /// kept while one side is slow for a short time, and is dropped at standstill.
    fn record(&mut self, motion: Motion) -> bool {
        if motion == Motion::Rolling {
            if std::mem::take(&mut self.slow) > 0 {
                self.ignored = self.ignored.max(IGNORED_AFTER_SLOW_SIDE);
            }
            let is_ignored = self.ignored > 0;
            self.ignored = self.ignored.saturating_sub(1);
            return !is_ignored;
        }
        self.slow = self.slow.saturating_add(1);
        if motion == Motion::Standing || self.slow > SLOW_MAX {
            self.ignored = IGNORED_AFTER_STANDSTILL;
            for other in self.others.iter_mut().flatten() {
                other.evidence = 0.0;
            }
        }
        false
    }

    /// Adds one comparison of the means over `compared_s` seconds, since the last call. While the
    /// robot does not roll there is no evidence.
    ///
    /// Returns whether the ground has changed; after an alarm the detector is reset.
    pub(super) fn compare(
        &mut self,
        compared: &[Option<ChannelComparison>; COMPARED],
        compared_s: f64,
        motion: Motion,
    ) -> bool {
        let counts = self.record(motion);
        self.has_torque |= compared[TORQUES_FROM..].iter().any(Option::is_some);
        let threshold = THRESHOLDS[usize::from(self.has_torque)];
        let mut has_changed = false;
        for other in self.others.iter_mut().flatten() {
            let outputs = other.model.take_outputs(compared_s);
            let outputs = outputs.measured(self.delays_s);
            if !counts {
                continue;
            }
            let gains = compared.iter().zip(outputs).map(|(compared, output)| {
                compared.map_or(0.0, |compared| {
                    compared.square(compared.output) - compared.square(output)
                })
            });
            let gain: f64 = gains.sum();
            if gain.is_finite() {
                other.evidence = (other.evidence + gain.min(GAIN_MAX) - DRIFT).max(0.0);
            }
            has_changed |= other.evidence > threshold;
        }
        if has_changed {
            *self = Self::default();
        }
        has_changed
    }
}

/// Returns the robot of these parameters, in the units of [`index`].
fn robot_of(values: &Values, model: &RobotModel) -> Robot<f64> {
    Robot::new(
        &std::array::from_fn::<_, MODELLED, _>(|place| values[place]),
        model,
    )
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::super::{COMPARED_S, parameters};
    use super::*;
    use crate::estimation::{EstimatorPrior, SensorNoise};
    use crate::geometry::Twist;

    const SAMPLE_S: f64 = 0.01;
    const SAMPLES: u32 = 5;
    /// Standard deviations of the channels.
    const STD_DEVS: [f64; COMPARED] = [0.008, 0.08, 0.08, 0.15, 0.15];

    /// A robot in turns, one that is believed to be it, and the monitor of that belief.
    struct Drive {
        model: RobotModel,
        values: Values,
        robot: Simulation<f64>,
        believed: Simulation<f64>,
        monitor: ChangeMonitor,
        random: ChaCha8Rng,
        time_s: f64,
        has_torque: bool,
    }

    impl Drive {
        fn new(seed: u64) -> Self {
            let model = RobotModel::yi2007();
            let mut values =
                parameters::prior(&EstimatorPrior::default(), &SensorNoise::default()).mean;
            values[index::STIFFNESS] = 3.0_f64.ln();
            let state = State::rolling(Twist::default());
            let mut monitor = ChangeMonitor::default();
            monitor.set_best(&values, &model, state);
            Self {
                model,
                values,
                robot: Simulation::new(state),
                believed: Simulation::new(state),
                monitor,
                random: ChaCha8Rng::seed_from_u64(seed),
                time_s: 0.0,
                has_torque: true,
            }
        }

        /// Drives one comparison on ground of a stiffness, with `scaled` torques. Returns whether
        /// the monitor raises an alarm.
        fn compare(&mut self, stiffness: f64, scaled: f64, motion: Motion) -> bool {
            let mut values = self.values;
            let believed = robot_of(&values, &self.model);
            values[index::STIFFNESS] = stiffness.ln();
            let robot = robot_of(&values, &self.model);
            let share = f64::from(SAMPLES).recip();
            for _ in 0..SAMPLES {
                self.time_s += SAMPLE_S;
                let speed = |phase: f64| 6.0 + 2.5 * (0.9 * self.time_s + phase).sin();
                let rise = |phase: f64| 2.5 * 0.9 * (0.9 * self.time_s + phase).cos();
                let input = Input {
                    wheels_rad_s: [speed(0.0), speed(2.0)],
                    wheels_rad_s2: [rise(0.0), rise(2.0)],
                    heading_rad: 0.0,
                    acceleration_m_s2: [0.0; 2],
                    is_specific_force: false,
                    time_s: SAMPLE_S,
                };
                self.robot.advance(&robot, &input, share);
                self.believed.advance(&believed, &input, share);
                self.monitor.advance(&input, share);
            }
            let truth = self.robot.take_outputs(COMPARED_S).means;
            let outputs = self.believed.take_outputs(COMPARED_S).means;
            let compared = std::array::from_fn(|channel| {
                let of_12 = (0..12).map(|_| self.random.random::<f64>() - 0.5);
                let factor = if channel > 2 { scaled } else { 1.0 };
                (channel < TORQUES_FROM || self.has_torque).then_some(ChannelComparison {
                    measured: factor * truth[channel] + STD_DEVS[channel] * of_12.sum::<f64>(),
                    output: outputs[channel],
                    std_dev: STD_DEVS[channel],
                })
            });
            self.monitor.compare(&compared, COMPARED_S, motion)
        }
    }

    #[test]
    fn softer_and_stiffer_ground_is_detected_the_sooner_the_more_it_differs() {
        let grounds = [
            (0.7, 30),
            (1.0, 30),
            (1.5, 300),
            (6.0, 300),
            (9.0, 100),
            (12.0, 100),
        ];
        for (seed, (stiffness, most)) in (0..).zip(grounds) {
            let mut drive = Drive::new(seed);
            assert!(!(0..200).any(|_| drive.compare(3.0, 1.0, Motion::Rolling)));
            let delay = (0..400).position(|_| drive.compare(stiffness, 1.0, Motion::Rolling));
            let is_in_time = delay.is_some_and(|delay| delay < most);
            assert!(is_in_time, "{stiffness}: {delay:?}");
        }
    }

    #[test]
    fn ground_that_becomes_very_slippery_is_detected_without_torque() {
        for seed in 0..4 {
            let mut drive = Drive::new(seed);
            drive.has_torque = false;
            assert!(!(0..200).any(|_| drive.compare(3.0, 1.0, Motion::Rolling)));
            let delay = (0..400).position(|_| drive.compare(0.2, 1.0, Motion::Rolling));
            assert!(delay.is_some_and(|delay| delay < 60), "{seed}: {delay:?}");
        }
    }

    #[test]
    fn noise_and_wrong_torques_on_the_same_ground_raise_no_alarm() {
        for (seed, scaled) in (0..).zip([1.0, 0.85, 1.15]) {
            let mut drive = Drive::new(seed);
            let alarm = (0..12_000).position(|_| drive.compare(3.0, scaled, Motion::Rolling));
            assert_eq!(alarm, None, "torques × {scaled}");
        }
    }

    #[test]
    fn a_robot_that_sets_off_or_stands_raises_no_alarm() {
        let mut drive = Drive::new(1);
        let motion = |count: u32| match count % 25 {
            0..6 => Motion::Standing,
            _ => Motion::Rolling,
        };
        let alarm = (0..1_000).position(|count| drive.compare(1.0, 1.0, motion(count)));
        assert_eq!(alarm, None);
    }

    #[test]
    fn an_inner_side_that_is_slow_in_every_bend_delays_an_alarm_only() {
        // Evidence of the parts in which both sides roll adds up.
        let mut drive = Drive::new(2);
        let motion = |count: u32| match count % 40 {
            0..15 => Motion::Slow,
            _ => Motion::Rolling,
        };
        let has_alarm = (0..200).any(|count| drive.compare(3.0, 1.0, motion(count)));
        assert!(!has_alarm, "the ground is the same");
        let alarm = (0..400).position(|count| drive.compare(1.2, 1.0, motion(count)));
        assert!(alarm.is_some(), "softer ground was not detected");
    }

    #[test]
    fn a_jerk_in_all_channels_raises_no_alarm() {
        let mut drive = Drive::new(3);
        let mut has_alarm = false;
        for count in 0..600 {
            // As if the ground were softer for three comparisons in every five seconds.
            let stiffness = if count % 100 < 3 { 0.4 } else { 3.0 };
            has_alarm |= drive.compare(stiffness, 1.0, Motion::Rolling);
        }
        assert!(!has_alarm);
    }
}
