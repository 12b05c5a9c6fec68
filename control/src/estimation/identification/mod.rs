//! Grey-box identification of a robot whose model is not exact: θ together with everything else
//! that is unknown.
//!
//! The rows of the other modules are linear in θ for small slip and average over blocks, which is
//! exact for a robot that equals its model. For other robots they use a small part of the
//! measurements, and give no estimate beyond small slip. This module simulates the equations of
//! motion ([`model`]) with the measured wheel speeds as input, and estimates all 29 unknown
//! parameters ([`parameters`]) at once from the other sensors ([`hypothesis`]). The problem is
//! nonlinear, so three estimators start at different values of K; those that fit worse are
//! discarded.

mod blocks;
mod change;
mod curve_prior;
mod delays;
mod dual;
mod fast_changes;
mod fit;
mod hypothesis;
#[cfg(test)]
mod inertial_tests;
mod model;
#[cfg(test)]
mod outlier_tests;
mod parameters;
mod physical;
mod random_walk;
mod recent;
mod regimes;
mod robot;
mod scale;
#[cfg(test)]
mod scale_tests;
mod scales;
mod segment;
mod simulation;
#[cfg(test)]
mod tests;
#[cfg(test)]
mod tyre_tests;
mod wheel_noise;

use super::payload::STANDING_M_S;
use super::{EstimatorPrior, GAP_MAX_S, IdentifiedRobot, LateSensor, SensorNoise, SensorSample};
use crate::geometry::Twist;
use crate::measured::BodyAcceleration;
use crate::robot::RobotModel;

use change::{COMPARED, ChangeMonitor, ChannelComparison, Motion};
use delays::{DelayResidual, Delays};
use fit::Fit;
use hypothesis::{Hypothesis, Measured};
use model::{CHANNELS, Input, State, gravity_m_s2};
use parameters::{Prior, index};
use random_walk::RandomWalk;
use regimes::BlockMotion;
use scale::BlockEnd;
use scales::TimeScales;
use simulation::delays_s;
use wheel_noise::WheelNoise;

/// Starting values of ln K: K 1, 3.3 and 11.
const STARTS: [f64; 3] = [0.0, 1.2, 2.4];
/// Time over which outputs and measurements are averaged before they are compared, seconds.
const COMPARED_S: f64 = 0.05;
/// Duration of a block, seconds.
const BLOCK_S: f64 = 1.0;
/// Minimum number of blocks before a hypothesis is discarded or an estimate is returned.
const BLOCKS_MIN: u32 = 5;
/// Excess of a hypothesis's cost over the lowest one from which it is discarded, relative to the
/// mean square of the best one's residuals.
const COST_MARGIN: f64 = 60.0;
/// Excess of cost over the lowest one that reduces a hypothesis's weight to e⁻¹, relative likewise.
const COST_SCALE: f64 = 10.0;
/// Difference of ln K below which two hypotheses agree, so that the worse one is discarded.
const SAME: f64 = 0.03;
/// Rim speed of the slower side below which torques are not compared, because friction at rest is
/// undetermined, metres per second.
const TORQUE_FROM_M_S: f64 = 0.1;
/// Rim speed that both sides must exceed for a change of the ground to be detected, metres per
/// second.
const ROLLING_M_S: f64 = 0.2;
/// Standard deviations of ln K above which no change of the ground is detected, without and with
/// measured torque. Without torque an estimate that is still converging looks like a change.
const CHANGES_STD_DEVS_MAX: [f64; 2] = [0.2, 0.5];
/// Minimum number of blocks before a change of the ground is detected.
const CHANGES_BLOCKS_MIN: u32 = 10;
/// Bandwidth of the low-pass filter of accelerations, per second.
const SMOOTHED_PER_S: f64 = 35.0;
/// Standard deviations of the model's error in a mean over [`COMPARED_S`]: turn rate in radians per
/// second, acceleration in metres per second squared, torque as a friction coefficient.
const MODEL_TURN_RAD_S: f64 = 7.5e-3;
const MODEL_ACCELERATION_M_S2: f64 = 0.075;
const MODEL_TORQUE_MU: f64 = 0.025;
/// Standard deviations of the error that all estimates share because real contacts do not follow
/// the model's equations: a relative one, of ln θ, and an absolute one, of θ, which is a slip per
/// friction coefficient and dominates where θ is small: without and with measured torque, which
/// shows some of what the equations miss.
const MODEL_LN_THETA_STD_DEV: f64 = 0.037;
const MODEL_THETA_STD_DEVS: [f64; 2] = [0.010, 0.008];
/// Maximum time of one gap in which the gyro's offset drifts, seconds.
const DRIFTED_MAX_S: f64 = 3_600.0;
/// Minimum duration of the block with which a segment ends, seconds; a shorter one is not used.
const SHORT_BLOCK_S: f64 = 0.5;
/// Minimum of the mean square of a channel's standardised residuals in its weights, without and
/// with noise of the wheel speeds: that biases θ, and the more the less the assumed model errors
/// count.
const WEIGHT_SQUARE_MINS: [f64; 2] = [0.3, 1.0];
/// Mean square of standardised residuals above which the model does not describe the robot and no
/// estimate is returned.
const SQUARE_MAX: f64 = 30.0;

/// Estimate of θ, and the three independent parts of its standard deviation relative to θ.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Identified {
    /// Slip compliance θ = 1/K, above 0.
    pub(super) theta: f64,
    /// Part from the measurements of this drive: sensor noise and the scatter of the blocks.
    pub(super) own_ratio: f64,
    /// Part from the prior of the robot's other parameters; common to all estimates of the robot.
    pub(super) robot_ratio: f64,
    /// Part from the prior of the tyres, from a bend of the friction curve outside its prior, from
    /// tyres and ground that do not follow the model's equations, and from regimes of motion that
    /// disagree for that reason; common to all robots with these tyres.
    pub(super) tyres_ratio: f64,
    /// Part of `tyres_ratio` from the prior of the tyres alone.
    pub(super) tyre_prior_ratio: f64,
    /// Duration of the measurements in the estimate, seconds.
    pub(super) duration_s: f64,
}

/// Identification of a robot and its ground from samples of its sensors.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Identification {
    model: RobotModel,
    prior: Prior,
    hypotheses: Vec<Hypothesis>,
    /// Normal equations that no hypothesis uses.
    spare_scales: Vec<TimeScales>,
    /// Heading since the start, by the gyro without its offset.
    heading_rad: f64,
    gyro_offset_rad_s: f64,
    acceleration_m_s2: [f64; 2],
    /// The newest sample, which needs its successor for the wheels' acceleration.
    pending: Option<PendingSample>,
    /// Integrals of the measurements over time since the last comparison, and the time with
    /// measurements, seconds, by channel.
    sums: [f64; CHANNELS - 1],
    measured_s: [f64; CHANNELS - 1],
    /// Samples and time since the last comparison, and time of the open block, seconds.
    samples: f64,
    compared_s: f64,
    block_s: f64,
    /// Duration of the open segment's complete blocks together, seconds, and of the last block.
    segment_s: f64,
    last_block_s: f64,
    is_moving: bool,
    /// Motion of the wheels in the open block.
    block_motion: BlockMotion,
    /// Time since the last complete block, in which the offset of the gyro drifted, seconds.
    drifted_s: f64,
    robot: Option<IdentifiedRobot>,
    is_robot_due: bool,
    change: ChangeMonitor,
    fit: Fit,
    delays: Delays,
    wheel_noise: WheelNoise,
    /// Whether the last sample had wheel torques.
    has_torque: bool,
}

/// A sample that is used when its successor has come.
#[derive(Debug, Clone, Copy, PartialEq)]
struct PendingSample {
    sample: SensorSample,
    /// Time since the sample before, seconds.
    time_s: f64,
    /// Wheel speeds of the sample before, `[left, right]`, and the time that they are means over.
    before_rad_s: Option<([f64; 2], f64)>,
}

impl Identification {
    /// Creates the identification with its prior. None if the prior declares the model exact (no
    /// unexplained error of the tyres, or no relaxation length): then linear rows on means are more
    /// accurate.
    pub(super) fn new(
        model: RobotModel,
        noise: &SensorNoise,
        prior: &EstimatorPrior,
    ) -> Option<Self> {
        let is_uncertain = prior.tyres.unexplained_ratio > 0.0 && prior.tyres.relaxation_m > 0.0;
        if !is_uncertain {
            return None;
        }
        let mut identification = Self {
            model,
            prior: parameters::prior(prior, noise),
            hypotheses: Vec::with_capacity(STARTS.len()),
            spare_scales: Vec::with_capacity(STARTS.len()),
            heading_rad: 0.0,
            gyro_offset_rad_s: 0.0,
            acceleration_m_s2: [0.0; 2],
            pending: None,
            sums: [0.0; CHANNELS - 1],
            measured_s: [0.0; CHANNELS - 1],
            samples: 0.0,
            compared_s: 0.0,
            block_s: 0.0,
            segment_s: 0.0,
            last_block_s: 0.0,
            is_moving: false,
            block_motion: BlockMotion::default(),
            drifted_s: 0.0,
            robot: None,
            is_robot_due: false,
            change: ChangeMonitor::default(),
            fit: Fit::new(),
            delays: Delays::new(),
            wheel_noise: WheelNoise::new(),
            has_torque: false,
        };
        identification.begin(&State::rolling(Twist::default()));
        Some(identification)
    }

    /// Replaces all hypotheses by new ones from the prior and the starting values of ln K, in the
    /// motion `state`.
    fn begin(&mut self, state: &State<f64>) {
        while !self.hypotheses.is_empty() {
            self.discard(0);
        }
        self.change = ChangeMonitor::default();
        self.fit = Fit::new();
        self.delays.restart();
        for start in STARTS {
            let scales = self.spare_scales.pop().unwrap_or_else(TimeScales::new);
            self.hypotheses
                .push(Hypothesis::new(&self.prior, start, *state, scales));
        }
    }

    /// Starts on new ground: resets the parameters of the ground to the initial prior, and keeps
    /// the estimates of the robot's parameters.
    pub(super) fn begin_ground(&mut self) {
        self.begin_without(&parameters::OF_GROUND);
    }

    /// Starts with another payload: resets the parameters of load and ground to the initial prior,
    /// and keeps those of torques, radii and sensors.
    pub(super) fn begin_load(&mut self) {
        self.robot = None;
        self.begin_without(&parameters::OF_LOAD_AND_GROUND);
    }

    /// Begins with the posterior as the prior, in which the parameters `changed` are reset; keeps
    /// the prior if the best hypothesis is younger than [`BLOCKS_MIN`] blocks.
    fn begin_without(&mut self, changed: &[usize]) {
        let best = self.best().filter(|best| best.age() >= BLOCKS_MIN);
        if let Some(prior) = best.and_then(|best| best.prior_without(&self.prior, changed)) {
            self.prior = prior;
        }
        let state = self.state();
        self.begin(&state);
        self.interrupt();
        self.segment_s = 0.0;
        self.last_block_s = 0.0;
    }

    /// Returns the state of motion of a robot that rolls without slip as in the pending sample; at
    /// rest if there is none.
    fn state(&self) -> State<f64> {
        let twist = self.pending.map_or_else(Twist::default, |pending| {
            let wheels = pending.sample.wheel_speeds;
            let mean_rad_s = 0.5 * (wheels.left_rad_s + wheels.right_rad_s);
            Twist {
                linear_m_s: mean_rad_s * self.model.wheel_radius_m(),
                angular_rad_s: pending.sample.gyro_rad_s,
            }
        });
        State::rolling(twist)
    }

    /// Records a gap before the next sample: drops the open block and its sums, and keeps the
    /// estimates.
    pub(super) fn interrupt(&mut self) {
        let state = self.state();
        for hypothesis in &mut self.hypotheses {
            hypothesis.restart(state);
        }
        self.pending = None;
        self.wheel_noise.interrupt();
        self.change = ChangeMonitor::default();
        self.fit.drop_block();
        self.delays.restart();
        self.clear_sums();
        self.block_s = 0.0;
        self.is_moving = false;
        self.block_motion = BlockMotion::default();
    }

    /// Returns the sample with its acceleration without gravity, by the estimated slope.
    pub(super) fn without_gravity(&self, sample: &SensorSample) -> SensorSample {
        let slope = self.best().map_or([0.0; 2], |best| {
            [index::SLOPE_X, index::SLOPE_Y].map(|place| best.values()[place])
        });
        let [forward_m_s2, left_m_s2] = gravity_m_s2(slope, self.heading_rad);
        SensorSample {
            acceleration: sample.acceleration.map(|measured| BodyAcceleration {
                forward_m_s2: measured.forward_m_s2 + forward_m_s2,
                left_m_s2: measured.left_m_s2 + left_m_s2,
            }),
            is_specific_force: false,
            ..*sample
        }
    }

    fn clear_sums(&mut self) {
        self.sums = [0.0; CHANNELS - 1];
        self.measured_s = [0.0; CHANNELS - 1];
        self.samples = 0.0;
        self.compared_s = 0.0;
    }

    /// Adds a sample that came `time_s` seconds after the one before; a time above [`GAP_MAX_S`]
    /// counts as a gap. Returns whether the ground has changed.
    pub(super) fn update(
        &mut self,
        sample: &SensorSample,
        noise: &SensorNoise,
        time_s: f64,
    ) -> bool {
        self.drifted_s += time_s.min(DRIFTED_MAX_S);
        if time_s > GAP_MAX_S {
            self.interrupt();
        } else {
            self.wheel_noise.add(wheel_speeds_rad_s(sample), time_s);
        }
        let before_rad_s = self
            .pending
            .map(|pending| (wheel_speeds_rad_s(&pending.sample), pending.time_s));
        let pending = self.pending.replace(PendingSample {
            sample: *sample,
            time_s,
            before_rad_s,
        });
        pending.is_some_and(|pending| {
            self.advance(&pending, (wheel_speeds_rad_s(sample), time_s), noise)
        })
    }

    /// Advances the models by the sample that waited for its successor. Returns whether the ground
    /// has changed.
    fn advance(
        &mut self,
        now: &PendingSample,
        (after_rad_s, after_s): ([f64; 2], f64),
        noise: &SensorNoise,
    ) -> bool {
        let (sample, time_s) = (&now.sample, now.time_s);
        let wheels_rad_s = wheel_speeds_rad_s(sample);
        // Central difference of means over neighbouring samples.
        let (before_rad_s, before_s) = now.before_rad_s.unwrap_or((wheels_rad_s, time_s));
        let apart_s = 0.5 * (before_s + after_s) + time_s;
        let wheels_rad_s2 = [0, 1].map(|side| (after_rad_s[side] - before_rad_s[side]) / apart_s);
        self.heading_rad += (sample.gyro_rad_s - self.gyro_offset_rad_s) * time_s;
        let measured = sample
            .acceleration
            .map(|acceleration| [acceleration.forward_m_s2, acceleration.left_m_s2]);
        if let Some(measured) = measured {
            let share = (SMOOTHED_PER_S * time_s).min(1.0);
            for (smooth, value) in self.acceleration_m_s2.iter_mut().zip(measured) {
                *smooth += share * (value - *smooth);
            }
        }
        let input = Input {
            wheels_rad_s,
            wheels_rad_s2,
            heading_rad: self.heading_rad,
            acceleration_m_s2: self.acceleration_m_s2,
            is_specific_force: sample.is_specific_force,
            time_s,
        };
        let noise_of_wheels = self.wheel_noise.added_noise(apart_s);
        let perturbed = noise_of_wheels.map(|(speeds, rises)| Input {
            wheels_rad_s: [0, 1].map(|side| wheels_rad_s[side] + speeds[side]),
            wheels_rad_s2: [0, 1].map(|side| wheels_rad_s2[side] + rises[side]),
            ..input
        });
        let rims_m_s = wheels_rad_s.map(|speed| speed * self.model.wheel_radius_m());
        self.block_motion.add(rims_m_s);
        let rims_m_s = rims_m_s.map(f64::abs);
        self.is_moving |= rims_m_s[0].max(rims_m_s[1]) > STANDING_M_S;
        self.add(sample, measured, rims_m_s, time_s);
        let share = time_s / COMPARED_S;
        let square_min = self.weight_square_min();
        if self.compared_s >= 0.5 * COMPARED_S {
            // In another tick than the end of the block, which takes long enough.
            for hypothesis in &mut self.hypotheses {
                hypothesis.continue_deferred(&self.prior);
            }
        }
        let speed = sample.body_speed_m_s.map(|value| Measured {
            channel: CHANNELS - 1,
            value,
            std_dev: noise.body_speed_m_s,
            square_min,
        });
        for hypothesis in &mut self.hypotheses {
            hypothesis.advance(&self.model, &input, perturbed.as_ref(), share);
            if let Some((measured, output)) = speed.zip(hypothesis.forward_speed()) {
                hypothesis.compare(&output, measured);
            }
        }
        self.change.advance(&input, share);
        self.compared_s >= COMPARED_S - 1.0e-6 && self.compare(noise)
    }

    /// Adds a sample's measurements to their means.
    fn add(
        &mut self,
        sample: &SensorSample,
        acceleration: Option<[f64; 2]>,
        rims_m_s: [f64; 2],
        time_s: f64,
    ) {
        self.compared_s += time_s;
        self.samples += 1.0;
        let mut add = |channel: usize, value: f64| {
            self.sums[channel] += value * time_s;
            self.measured_s[channel] += time_s;
        };
        add(0, sample.gyro_rad_s);
        if let Some([forward, left]) = acceleration {
            add(1, forward);
            add(2, left);
        }
        self.has_torque = sample.wheel_torques.is_some();
        let is_rolling = rims_m_s[0].min(rims_m_s[1]) > TORQUE_FROM_M_S;
        if let Some(torques) = sample.wheel_torques.filter(|_| is_rolling) {
            add(3, torques.left_n_m);
            add(4, torques.right_n_m);
        }
    }

    /// Compares the means over [`COMPARED_S`], and ends the block where it is full. Returns whether
    /// the ground has changed.
    fn compare(&mut self, noise: &SensorNoise) -> bool {
        let torque_n_m = self.model.side_load_n() * self.model.wheel_radius_m();
        let root = self.samples.max(1.0).sqrt();
        let with_model = |sensor: f64, model: f64| (sensor / root).hypot(model);
        let acceleration = with_model(noise.accelerometer_m_s2, MODEL_ACCELERATION_M_S2);
        let torque = torque_n_m * with_model(noise.torque_mu, MODEL_TORQUE_MU);
        let std_devs = [
            with_model(noise.gyro_rad_s, MODEL_TURN_RAD_S),
            acceleration,
            acceleration,
            torque,
            torque,
        ];
        let (sums, measured_s, compared_s) = (self.sums, self.measured_s, self.compared_s);
        let least = self.least_cost();
        let square_min = self.weight_square_min();
        let mut compared = [None; COMPARED];
        for hypothesis in &mut self.hypotheses {
            let is_best = hypothesis.cost() <= least;
            let delays_s = delays_s(hypothesis.values());
            let outputs = hypothesis.take_outputs(compared_s);
            for (channel, output) in outputs.into_iter().enumerate() {
                // Means are of the same time only if nothing is missing.
                if measured_s[channel] < compared_s - 1.0e-6 {
                    continue;
                }
                let measured = sums[channel] / compared_s;
                if is_best {
                    let standardised = (measured - output.value()) / std_devs[channel];
                    self.fit.add(channel, standardised);
                    // Noise in outputs and their rates would look like a delay.
                    let is_noisy = self.wheel_noise.is_noise_added;
                    if let Some(delay_s) = delays_s.get(channel).filter(|_| !is_noisy) {
                        let compared = DelayResidual {
                            standardised,
                            slope_1_s: output.slope(index::GYRO_DELAY) / std_devs[channel],
                            delay_s: *delay_s,
                        };
                        self.delays.add(channel, compared);
                    }
                    compared[channel] = Some(ChannelComparison {
                        measured,
                        output: output.value(),
                        std_dev: std_devs[channel] * hypothesis.residual_ratio(channel),
                    });
                }
                hypothesis.compare(
                    &output,
                    Measured {
                        channel,
                        value: measured,
                        std_dev: std_devs[channel],
                        square_min,
                    },
                );
            }
            hypothesis.end_comparison();
        }
        self.fit.end_comparison();
        self.block_s += compared_s;
        self.clear_sums();
        let motion = self.motion();
        let changed = self.change.compare(&compared, compared_s, motion);
        if self.block_s >= BLOCK_S - 1.0e-6 {
            self.end_block();
            self.is_robot_due = true;
        } else if self.block_s >= SHORT_BLOCK_S && std::mem::take(&mut self.is_robot_due) {
            // In another sample than the end of the block, which takes long enough.
            self.robot = self.identify_robot().or(self.robot);
        }
        changed
    }

    /// Returns the present one of [`WEIGHT_SQUARE_MINS`].
    fn weight_square_min(&self) -> f64 {
        WEIGHT_SQUARE_MINS[usize::from(self.wheel_noise.is_noise_added)]
    }

    /// Returns the motion at the pending sample.
    fn motion(&self) -> Motion {
        let radius_m = self.model.wheel_radius_m();
        let [left_m_s, right_m_s] = self.pending.map_or([0.0; 2], |pending| {
            wheel_speeds_rad_s(&pending.sample).map(|rate| rate.abs() * radius_m)
        });
        if left_m_s.min(right_m_s) > ROLLING_M_S {
            Motion::Rolling
        } else if left_m_s.max(right_m_s) > STANDING_M_S {
            Motion::Slow
        } else {
            Motion::Standing
        }
    }

    /// Ends the open block: every hypothesis takes a step, unless the robot stood.
    fn end_block(&mut self) {
        let block_s = std::mem::take(&mut self.block_s);
        let is_moving = std::mem::take(&mut self.is_moving);
        let motion = std::mem::take(&mut self.block_motion);
        self.wheel_noise.end_block(is_moving);
        if !is_moving {
            for hypothesis in &mut self.hypotheses {
                hypothesis.drop_block();
            }
            self.fit.drop_block();
            self.delays.drop_block();
            return;
        }
        self.fit.end_block();
        let has_converged = self.best().is_some_and(Hypothesis::has_converged);
        self.delays.end_block(has_converged);
        self.segment_s += block_s;
        self.last_block_s = block_s;
        let drifted_s = std::mem::take(&mut self.drifted_s);
        let end = BlockEnd {
            regime: motion.regime(),
            gyro_walk: RandomWalk::of_gyro(&self.prior, drifted_s),
        };
        end.gyro_walk.add_to_prior(&mut self.prior);
        for index in (0..self.hypotheses.len()).rev() {
            if !self.hypotheses[index].end_block(&self.prior, &end) {
                self.discard(index);
            }
        }
        if self.hypotheses.is_empty() {
            let state = self.state();
            self.begin(&state);
            return;
        }
        self.discard_hypotheses();
        if let Some(best) = self.best() {
            self.gyro_offset_rad_s = best.values()[index::GYRO_OFFSET];
        }
        self.restart_with_wheel_noise();
        self.update_change_monitor();
    }

    /// Solves what the hypotheses deferred at the end of the last block.
    fn solve_deferred(&mut self) {
        for hypothesis in &mut self.hypotheses {
            hypothesis.solve_deferred(&self.prior);
        }
    }

    /// Gives the change monitor the best hypothesis, if its ln K is known well enough; otherwise
    /// resets the monitor.
    fn update_change_monitor(&mut self) {
        let most = CHANGES_STD_DEVS_MAX[usize::from(self.has_torque)];
        let is_known = |best: &&Hypothesis| {
            let std_dev = best.variance_before_step().sqrt();
            best.age() >= CHANGES_BLOCKS_MIN && std_dev < most
        };
        let known = self.best().filter(is_known);
        match known.map(|best| (*best.values(), best.motion())) {
            Some((values, state)) => self.change.set_best(&values, &self.model, state),
            None => self.change = ChangeMonitor::default(),
        }
    }

    /// Begins anew with noise of the wheel speeds taken into account if there is any that matters.
    fn restart_with_wheel_noise(&mut self) {
        let is_noisy = self.best().is_some_and(Hypothesis::is_noisy);
        let is_measured = self.wheel_noise.significant_density().is_some();
        // A model that late sensors or a change of the ground contradict may change faster than what is
        // measured, without any noise.
        let is_wrong = self.late_sensor().is_some() || self.newest_misfit_ratio().is_some();
        if !is_noisy || !is_measured || is_wrong || self.wheel_noise.is_noise_added {
            return;
        }
        self.wheel_noise.is_noise_added = true;
        // What was identified so far took the noise for slip.
        self.prior.assume_usual_tyres_and_constant_offset();
        self.prior.reset();
        self.delays = Delays::new();
        self.robot = None;
        self.segment_s = 0.0;
        self.last_block_s = 0.0;
        let state = self.state();
        self.begin(&state);
    }

    /// Discards hypotheses that fit worse than the best one, and all but one of those that agree.
    fn discard_hypotheses(&mut self) {
        let most = self.least_cost() + COST_MARGIN * self.residual_square();
        for index in (0..self.hypotheses.len()).rev() {
            let hypothesis = &self.hypotheses[index];
            let fits = hypothesis.cost() < most;
            if hypothesis.age() >= BLOCKS_MIN && !fits {
                self.discard(index);
            }
        }
        let mut index = 1;
        while index < self.hypotheses.len() {
            let is_same = |first: &Hypothesis, second: &Hypothesis| {
                first.age() > BLOCKS_MIN
                    && (first.values()[index::STIFFNESS] - second.values()[index::STIFFNESS]).abs()
                        < SAME
            };
            let (before, rest) = self.hypotheses.split_at(index);
            let same = before.iter().position(|other| is_same(other, &rest[0]));
            match same {
                Some(other) => {
                    let worse = if before[other].cost() < rest[0].cost() {
                        index
                    } else {
                        other
                    };
                    self.discard(worse);
                }
                None => index += 1,
            }
        }
    }

    /// Removes a hypothesis.
    fn discard(&mut self, index: usize) {
        let discarded = self.hypotheses.remove(index);
        self.spare_scales.push(discarded.scales);
    }

    /// Returns the lowest cost of all hypotheses.
    fn least_cost(&self) -> f64 {
        let costs = self.hypotheses.iter().map(Hypothesis::cost);
        costs.fold(f64::INFINITY, f64::min)
    }

    /// Returns the largest of the channels' mean squares of the best hypothesis's standardised
    /// residuals, at least 1. Differences of cost are relative to it, because they are less
    /// significant where no hypothesis fits.
    fn residual_square(&self) -> f64 {
        self.best().map_or(1.0, Hypothesis::worst_square).max(1.0)
    }

    /// Returns the hypothesis with the lowest cost.
    fn best(&self) -> Option<&Hypothesis> {
        self.hypotheses
            .iter()
            .min_by(|first, second| first.cost().total_cmp(&second.cost()))
    }

    /// Returns θ of the present ground: the mean of the hypotheses' ln K weighted by their fit,
    /// with a variance that contains their disagreement. None before [`BLOCKS_MIN`] blocks, if
    /// residuals are too large for the model, if those of the newest blocks are much larger than before,
    /// or if a sensor is late.
    pub(super) fn identified(&self) -> Option<Identified> {
        let best = self.best()?;
        let is_known = best.age() >= BLOCKS_MIN && best.is_determined();
        let fits = self.misfit_ratio().is_none() && self.newest_misfit_ratio().is_none();
        if !is_known || !fits || self.late_sensor().is_some() {
            return None;
        }
        let least = self.least_cost();
        let cost_scale = COST_SCALE * self.residual_square();
        let (mut weights, mut mean, mut square) = (0.0, 0.0, 0.0);
        let (mut known, mut tyres, mut bend, mut regimes) = (0.0, 0.0, 0.0, 0.0);
        for hypothesis in &self.hypotheses {
            let weight = (-(hypothesis.cost() - least) / cost_scale).exp();
            let value = hypothesis.values()[index::STIFFNESS];
            let (variance, of_prior) = hypothesis.variances(&self.prior);
            weights += weight;
            mean += weight * value;
            square += weight * (variance + value * value);
            known += weight * of_prior;
            tyres += weight * hypothesis.scale().tyre_variance(&self.prior);
            bend += weight * hypothesis.scale().bend_variance_inflation(&self.prior);
            regimes += weight * hypothesis.scale().regime_variance();
        }
        mean /= weights;
        let variance = square / weights - mean * mean;
        let of_prior = (known / weights).min(variance);
        let of_tyres = (tyres / weights).min(of_prior);
        let is_known = mean.is_finite() && variance.is_finite() && variance > 0.0;
        let theta = (-mean).exp();
        let absolute = MODEL_THETA_STD_DEVS[usize::from(self.has_torque)] / theta;
        let of_model = MODEL_LN_THETA_STD_DEV.powi(2) + absolute.powi(2);
        let of_model = of_model + (bend + regimes) / weights;
        is_known.then(|| Identified {
            theta,
            own_ratio: (variance - of_prior).max(0.0).sqrt(),
            robot_ratio: (of_prior - of_tyres).max(0.0).sqrt(),
            tyres_ratio: (of_model + of_tyres).sqrt(),
            tyre_prior_ratio: of_tyres.max(0.0).sqrt(),
            duration_s: f64::from(best.age()) * BLOCK_S,
        })
    }

    /// Returns the root mean square of the best hypothesis's standardised residuals in its worst
    /// channel, where it is too large for an estimate.
    pub(super) fn misfit_ratio(&self) -> Option<f64> {
        let square = self.best()?.worst_square();
        (square > SQUARE_MAX).then(|| square.sqrt())
    }

    /// Returns the factor by which residuals of the newest blocks exceed the usual ones, where they
    /// contradict a converged estimate.
    pub(super) fn newest_misfit_ratio(&self) -> Option<f64> {
        let best = self.best()?;
        self.fit.misfit_ratio().filter(|_| best.has_converged())
    }

    /// Returns the delays of gyro and accelerometer, where they are too large to be identified, or differ
    /// from those of the estimate or of earlier blocks. None before [`BLOCKS_MIN`] blocks.
    pub(super) fn late_sensor(&self) -> Option<LateSensor> {
        let best = self.best().filter(|best| best.age() >= BLOCKS_MIN)?;
        self.delays.late(best.values())
    }

    /// Returns the newest estimate of the robot's own parameters, of this ground or an earlier one.
    pub(super) fn robot(&self) -> Option<IdentifiedRobot> {
        self.robot
    }
}

/// Returns the wheel speeds, left and right, radians per second.
fn wheel_speeds_rad_s(sample: &SensorSample) -> [f64; 2] {
    let wheels = sample.wheel_speeds;
    [wheels.left_rad_s, wheels.right_rad_s]
}
