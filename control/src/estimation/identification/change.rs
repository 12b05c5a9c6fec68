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
use super::parameters::{PARAMETERS, Robot, Values, index};
use super::simulation::Simulation;
use crate::robot::RobotModel;

/// Differences of ln K of the other grounds.
const OFFSETS: [f64; 2] = [-1.0, 1.0];
/// Threshold h of the CUSUM and its drift k: squares of standard deviations.
const THRESHOLD: f64 = 100.0;
const DRIFT: f64 = 2.0;
/// Limit of one channel's squared standardised residual.
const SQUARE_MAX: f64 = 25.0;
/// Number of comparisons after the start of motion that are ignored: one second.
const ROLLS_FOR: u32 = 20;
/// Number of compared channels: all but the body speed.
pub(super) const COMPARED: usize = CHANNELS - 1;

/// A measurement of one channel, with the output of the best hypothesis and the standard deviation
/// of their difference, in the channel's unit.
#[derive(Debug, Clone, Copy)]
pub(super) struct Explained {
    pub(super) measured: f64,
    pub(super) output: f64,
    pub(super) std_dev: f64,
}

impl Explained {
    /// Returns the limited squared residual of an output.
    fn square(&self, output: f64) -> f64 {
        let residual = (self.measured - output) / self.std_dev;
        (residual * residual).min(SQUARE_MAX)
    }
}

/// The robot on another ground.
#[derive(Debug, Clone, PartialEq)]
struct OtherGround {
    robot: Robot<f64>,
    model: Simulation<f64>,
    evidence: f64,
}

/// State of the detector. It detects nothing before [`ChangeMonitor::follow`].
#[derive(Debug, Clone, PartialEq, Default)]
pub(super) struct ChangeMonitor {
    others: Option<[OtherGround; OFFSETS.len()]>,
    /// Number of comparisons since the robot began to roll.
    rolling: u32,
}

impl ChangeMonitor {
    /// Takes the parameters of the best hypothesis, in the units of [`index`]. The first call begins
    /// with the robots in the motion `state`.
    pub(super) fn follow(&mut self, values: &Values, model: &RobotModel, state: State<f64>) {
        let robot = |offset: f64| {
            let mut values: [f64; PARAMETERS] = (*values).into();
            values[index::STIFFNESS] += offset;
            Robot::new(&values, model)
        };
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

    /// Adds one comparison of the means since the last call; `ratio` multiplies the outputs of the
    /// other grounds. While the robot does not roll there is no evidence.
    ///
    /// Returns whether the ground has changed; after an alarm the detector is reset.
    pub(super) fn compare(
        &mut self,
        explained: &[Option<Explained>; COMPARED],
        ratio: f64,
        is_rolling: bool,
    ) -> bool {
        self.rolling = if is_rolling {
            self.rolling.saturating_add(1)
        } else {
            0
        };
        let mut has_changed = false;
        for other in self.others.iter_mut().flatten() {
            let outputs = other.model.take_mean(ratio);
            if self.rolling <= ROLLS_FOR {
                other.evidence = 0.0;
                continue;
            }
            let gains = explained.iter().zip(outputs).map(|(explained, output)| {
                explained.map_or(0.0, |explained| {
                    explained.square(explained.output) - explained.square(output)
                })
            });
            let gain: f64 = gains.sum();
            if gain.is_finite() {
                other.evidence = (other.evidence + gain - DRIFT).max(0.0);
            }
            has_changed |= other.evidence > THRESHOLD;
        }
        if has_changed {
            *self = Self::default();
        }
        has_changed
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::super::parameters;
    use super::*;
    use crate::estimation::{EstimatorPrior, SensorNoise};

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
    }

    impl Drive {
        fn new(seed: u64) -> Self {
            let model = RobotModel::yi2007();
            let (mut values, _) =
                parameters::prior(&EstimatorPrior::default(), &SensorNoise::default());
            values[index::STIFFNESS] = 3.0_f64.ln();
            let state = State::rolling(0.0, 0.0);
            let mut monitor = ChangeMonitor::default();
            monitor.follow(&values, &model, state);
            Self {
                model,
                values,
                robot: Simulation::new(state),
                believed: Simulation::new(state),
                monitor,
                random: ChaCha8Rng::seed_from_u64(seed),
                time_s: 0.0,
            }
        }

        /// Drives one comparison on ground of a stiffness, with `scaled` torques. Returns whether the
        /// monitor raises an alarm.
        fn compare(&mut self, stiffness: f64, scaled: f64, is_rolling: bool) -> bool {
            let mut values: [f64; PARAMETERS] = self.values.into();
            let believed = Robot::new(&values, &self.model);
            values[index::STIFFNESS] = stiffness.ln();
            let robot = Robot::new(&values, &self.model);
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
                    time_s: SAMPLE_S,
                };
                self.robot.advance(&robot, &input, share);
                self.believed.advance(&believed, &input, share);
                self.monitor.advance(&input, share);
            }
            let truth = self.robot.take_mean(1.0);
            let outputs = self.believed.take_mean(1.0);
            let explained = std::array::from_fn(|channel| {
                let of_12 = (0..12).map(|_| self.random.random::<f64>() - 0.5);
                let factor = if channel > 2 { scaled } else { 1.0 };
                Some(Explained {
                    measured: factor * truth[channel] + STD_DEVS[channel] * of_12.sum::<f64>(),
                    output: outputs[channel],
                    std_dev: STD_DEVS[channel],
                })
            });
            self.monitor.compare(&explained, 1.0, is_rolling)
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
            assert!(!(0..200).any(|_| drive.compare(3.0, 1.0, true)));
            let delay = (0..400).position(|_| drive.compare(stiffness, 1.0, true));
            let is_in_time = delay.is_some_and(|delay| delay < most);
            assert!(is_in_time, "{stiffness}: {delay:?}");
        }
    }

    #[test]
    fn noise_and_wrong_torques_on_the_same_ground_raise_no_alarm() {
        for (seed, scaled) in (0..).zip([1.0, 0.85, 1.15]) {
            let mut drive = Drive::new(seed);
            let alarm = (0..12_000).position(|_| drive.compare(3.0, scaled, true));
            assert_eq!(alarm, None, "torques × {scaled}");
        }
    }

    #[test]
    fn a_robot_that_sets_off_or_stands_raises_no_alarm() {
        let mut drive = Drive::new(1);
        let alarm = (0..1_000).position(|count| drive.compare(1.0, 1.0, count % 25 >= 6));
        assert_eq!(alarm, None);
    }
}
