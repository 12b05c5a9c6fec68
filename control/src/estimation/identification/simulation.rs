//! The model's state of motion and its outputs since the last comparison.

use super::dual::Real;
use super::model::{CHANNELS, Input, Output, State};
use super::parameters::{Number, Robot, Values};

/// A simulated robot that follows the measured wheel speeds.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Simulation<T> {
    pub(super) state: State<T>,
    /// Weighted sum of outputs since the last comparison.
    mean: Output<T>,
}

impl<T: Real> Simulation<T> {
    /// Creates a robot that moves as in `state`.
    pub(super) fn new(state: State<T>) -> Self {
        Self {
            state,
            mean: Output::zero(),
        }
    }

    /// Advances the robot by one sample and adds its outputs with the weight `share`. Returns the
    /// forward speed at the sample's end, metres per second.
    pub(super) fn advance(&mut self, robot: &Robot<T>, input: &Input, share: f64) -> T {
        let output = robot.advance(&mut self.state, input);
        let add = |mean: &mut T, value: T| *mean = *mean + value * share;
        add(&mut self.mean.turn_rad_s, output.turn_rad_s);
        for axis in 0..2 {
            add(
                &mut self.mean.acceleration_m_s2[axis],
                output.acceleration_m_s2[axis],
            );
            add(&mut self.mean.torques_n_m[axis], output.torques_n_m[axis]);
        }
        output.forward_m_s
    }

    /// Returns the outputs since the last call, multiplied by `ratio`, in the order of the channels
    /// without the body speed, and begins anew.
    pub(super) fn take_mean(&mut self, ratio: f64) -> [T; CHANNELS - 1] {
        let mean = std::mem::replace(&mut self.mean, Output::zero());
        let [forward, left] = mean.acceleration_m_s2;
        let [torque_left, torque_right] = mean.torques_n_m;
        [mean.turn_rad_s, forward, left, torque_left, torque_right].map(|mean| mean * ratio)
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
