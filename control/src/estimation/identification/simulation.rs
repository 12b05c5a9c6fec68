//! The model's state of motion and its outputs since the last comparison.

use super::COMPARED_S;
use super::dual::Real;
use super::model::{CHANNELS, Input, Output, State};
use super::parameters::{MODELLED, Number, Values, index};
use super::physical::Robot;

/// Number of channels that can be late: turn rate, acceleration forward and left.
pub(super) const DELAYED: usize = 3;

/// Returns the delays of these channels relative to the wheel speeds, seconds.
pub(super) fn delays_s(values: &Values) -> [f64; DELAYED] {
    let gyro_s = values[index::GYRO_DELAY];
    let accelerometer_s = gyro_s + values[index::ACCELEROMETER_DELAY];
    [gyro_s, accelerometer_s, accelerometer_s]
}

/// A simulated robot that follows the measured wheel speeds.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Simulation<T> {
    pub(super) state: State<T>,
    /// Weighted sum of outputs since the last comparison.
    mean: Output<T>,
    /// Outputs of the last sample.
    newest: Option<Output<T>>,
    /// Outputs of the sample before, and the time from then to the last one, seconds.
    previous: Option<(Delayed<T>, f64)>,
    /// End of the last comparison.
    compared: Option<End<T>>,
}

/// Outputs of the channels that can be late: turn rate, acceleration forward and left.
type Delayed<T> = [T; DELAYED];

/// Outputs at the end of a comparison, half a sample after the mean of its last one, and their rates of
/// change there, per second.
#[derive(Debug, Clone, Copy, PartialEq)]
struct End<T> {
    outputs: Delayed<T>,
    rates: Delayed<T>,
}

fn delayed<T: Copy>(output: &Output<T>) -> Delayed<T> {
    let [forward, left] = output.acceleration_m_s2;
    [output.turn_rad_s, forward, left]
}

/// Outputs since the last comparison.
#[derive(Debug, Clone, Copy)]
pub(super) struct Outputs<T> {
    /// Means, in the order of the channels without the body speed.
    pub(super) means: [T; CHANNELS - 1],
    /// Mean first and second derivatives in time of the first channels, which can be late, per second and
    /// per second squared.
    pub(super) rates: Delayed<T>,
    pub(super) second_rates: Delayed<T>,
}

impl<T: Real> Outputs<T> {
    /// Returns a channel's mean as a sensor with a delay of `delay_s` would measure it, to second
    /// order: slip delays the motion by `θ v/g`, and only the second order tells one from the other.
    fn late(&self, channel: usize, delay_s: f64) -> T {
        self.means[channel] - self.rates[channel] * delay_s
            + self.second_rates[channel] * (0.5 * delay_s * delay_s)
    }

    /// Returns the derivative of [`Self::late`] by the delay, per second.
    fn late_by_delay(&self, channel: usize, delay_s: f64) -> T {
        self.second_rates[channel] * delay_s - self.rates[channel]
    }
}

impl Outputs<f64> {
    /// Returns the means as late sensors give them.
    pub(super) fn measured(&self, delays_s: [f64; DELAYED]) -> [f64; CHANNELS - 1] {
        let mut means = self.means;
        for (channel, delay_s) in delays_s.into_iter().enumerate() {
            means[channel] = self.late(channel, delay_s);
        }
        means
    }
}

impl Outputs<Number> {
    /// Returns the means as late sensors give them, with their slopes.
    pub(super) fn measured(&self, delays_s: [f64; DELAYED]) -> [Predicted; CHANNELS - 1] {
        let mut predicted = self.means.map(|mean| Predicted::of(&mean));
        for (channel, delay_s) in delays_s.into_iter().enumerate() {
            predicted[channel] = Predicted::of(&self.late(channel, delay_s));
            let by_delay = self.late_by_delay(channel, delay_s).value;
            predicted[channel].slopes[index::GYRO_DELAY] = by_delay;
            if channel > 0 {
                predicted[channel].slopes[index::ACCELEROMETER_DELAY] = by_delay;
            }
        }
        predicted
    }
}

/// Output of one channel, with its slopes with respect to all parameters.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Predicted {
    pub(super) value: f64,
    pub(super) slopes: Values,
}

impl Predicted {
    /// Converts an output that has no delay.
    pub(super) fn of(output: &Number) -> Self {
        let mut slopes = Values::zeros();
        slopes.as_mut_slice()[..MODELLED].copy_from_slice(&output.derivatives);
        Self {
            value: output.value,
            slopes,
        }
    }
}

impl<T: Real> Simulation<T> {
    /// Creates a robot that moves as in `state`.
    pub(super) fn new(state: State<T>) -> Self {
        Self {
            state,
            mean: Output::zero(),
            newest: None,
            previous: None,
            compared: None,
        }
    }

    /// Advances the robot by one sample and adds its outputs with the weight `share`.
    pub(super) fn advance(&mut self, robot: &Robot<T>, input: &Input, share: f64) {
        self.previous = self
            .newest
            .as_ref()
            .map(|output| (delayed(output), input.time_s));
        let output = self.newest.insert(robot.advance(&mut self.state, input));
        let add = |mean: &mut T, value: T| *mean = *mean + value * share;
        add(&mut self.mean.turn_rad_s, output.turn_rad_s);
        for axis in 0..2 {
            add(
                &mut self.mean.acceleration_m_s2[axis],
                output.acceleration_m_s2[axis],
            );
            add(&mut self.mean.torques_n_m[axis], output.torques_n_m[axis]);
        }
    }

    /// Returns the forward speed at the last sample's end, metres per second; None before the first
    /// sample.
    pub(super) fn forward_m_s(&self) -> Option<&T> {
        self.newest.as_ref().map(|output| &output.forward_m_s)
    }

    /// Returns the outputs since the last call, `compared_s` seconds ago, and begins anew. They
    /// were weighted by [`COMPARED_S`].
    pub(super) fn take_outputs(&mut self, compared_s: f64) -> Outputs<T> {
        let rate = |now: &Delayed<T>, before: &Delayed<T>, time_s: f64| {
            std::array::from_fn(|place| (now[place] - before[place]) * time_s.recip())
        };
        let end = self.newest.as_ref().zip(self.previous.as_ref());
        let end = end.map(|(newest, (previous, time_s))| {
            let mean = delayed(newest);
            let rates: Delayed<T> = rate(&mean, previous, *time_s);
            End {
                outputs: std::array::from_fn(|place| mean[place] + rates[place] * (0.5 * time_s)),
                rates,
            }
        });
        let before = std::mem::replace(&mut self.compared, end);
        let (rates, second_rates) = match (&self.compared, &before) {
            (Some(end), Some(before)) => (
                rate(&end.outputs, &before.outputs, compared_s),
                rate(&end.rates, &before.rates, compared_s),
            ),
            _ => ([T::constant(0.0); DELAYED], [T::constant(0.0); DELAYED]),
        };
        let mean = std::mem::replace(&mut self.mean, Output::zero());
        let [forward, left] = mean.acceleration_m_s2;
        let [torque_left, torque_right] = mean.torques_n_m;
        let means = [mean.turn_rad_s, forward, left, torque_left, torque_right];
        Outputs {
            means: means.map(|mean| mean * (COMPARED_S / compared_s)),
            rates,
            second_rates,
        }
    }
}

impl Simulation<Number> {
    /// Returns the state of motion, without derivatives.
    pub(super) fn motion(&self) -> State<f64> {
        let state = &self.state;
        State {
            speed_m_s: state.speed_m_s.map(|speed| speed.value),
            turn_rad_s: state.turn_rad_s.value,
            deflections: state
                .deflections
                .map(|deflection| deflection.map(|part| part.value)),
        }
    }

    /// Moves the state, to first order, to that of the parameters after `step`.
    pub(super) fn shift(&mut self, step: &Values) {
        let shift = |number: &mut Number| {
            let slopes = number.derivatives.iter().zip(step.iter());
            number.value += slopes.map(|(slope, step)| slope * step).sum::<f64>();
        };
        self.state.speed_m_s.iter_mut().for_each(shift);
        shift(&mut self.state.turn_rad_s);
        self.state.deflections.iter_mut().flatten().for_each(shift);
    }
}

/// Output of one channel, and that of the model with noise added to the wheel speeds.
#[derive(Debug, Clone, Copy)]
pub(super) struct ChannelOutput {
    pub(super) output: Predicted,
    pub(super) perturbed: Option<Predicted>,
}

impl ChannelOutput {
    /// Returns the output without slopes.
    pub(super) fn value(&self) -> f64 {
        self.output.value
    }

    /// Returns its slope with respect to one parameter.
    pub(super) fn slope(&self, place: usize) -> f64 {
        self.output.slopes[place]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimation::identification::parameters;
    use crate::estimation::{EstimatorPrior, SensorNoise};
    use crate::geometry::Twist;
    use crate::robot::RobotModel;

    const SAMPLE_S: f64 = 0.005;
    const SAMPLES_PER_COMPARISON: usize = 10;

    /// Wheel speeds that change as fast as those of a robot that is tracked.
    fn wheels_rad_s(time_s: f64) -> [f64; 2] {
        let half = (2.0 * time_s).sin() + 0.5 * (15.0 * time_s).sin();
        [6.0 - half, 6.0 + half + 0.3 * (20.0 * time_s).sin()]
    }

    #[test]
    fn late_sensors_measure_the_outputs_of_before() {
        let prior = parameters::prior(&EstimatorPrior::default(), &SensorNoise::default());
        let values = std::array::from_fn(|place| prior.mean[place]);
        let robot = Robot::<f64>::new(&values, &RobotModel::yi2007());
        let twist = Twist {
            linear_m_s: 0.4,
            angular_rad_s: 0.0,
        };
        let mut simulation = Simulation::new(State::rolling(twist));
        let mut all: Vec<Delayed<f64>> = Vec::new();
        let mut squares = [[0.0; 2]; 2];
        for comparison in 0..200 {
            for _ in 0..SAMPLES_PER_COMPARISON {
                let wheels = wheels_rad_s(f64::from(u32::try_from(all.len()).unwrap()) * SAMPLE_S);
                let input = Input {
                    wheels_rad_s: wheels,
                    wheels_rad_s2: [0.0; 2],
                    heading_rad: 0.0,
                    acceleration_m_s2: [0.0; 2],
                    is_specific_force: false,
                    time_s: SAMPLE_S,
                };
                simulation.advance(&robot, &input, SAMPLE_S / COMPARED_S);
                all.push(delayed(simulation.newest.as_ref().unwrap()));
            }
            let outputs = simulation.take_outputs(COMPARED_S);
            if comparison < 20 {
                continue;
            }
            let first_order = Outputs {
                second_rates: [0.0; DELAYED],
                ..outputs
            };
            // 15 ms late.
            let window = all.len() - SAMPLES_PER_COMPARISON - 3..all.len() - 3;
            let late: Delayed<f64> = std::array::from_fn(|channel| {
                all[window.clone()]
                    .iter()
                    .map(|one| one[channel])
                    .sum::<f64>()
                    / 10.0
            });
            for (order, outputs) in [first_order, outputs].iter().enumerate() {
                let measured = outputs.measured([0.015; DELAYED]);
                squares[order][0] += (measured[0] - late[0]).powi(2);
                squares[order][1] += (measured[1] - late[1]).powi(2);
            }
        }
        let [first, second] = squares;
        for channel in 0..2 {
            let ratio = (second[channel] / first[channel]).sqrt();
            assert!(ratio < 0.3, "channel {channel}: {ratio}");
        }
    }
}
