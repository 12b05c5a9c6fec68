//! Measures the slip compliance θ of the ground with its standard deviation.
//!
//! Only this value reaches the map; it is never mixed with the tracking law's θ̂. Per side, in the
//! linear range, `λ = θ μ` holds exactly under combined slip (the paper's (7) with θ = 1/K, per
//! contact): slip is regressed on force, from *measured* wheel speed, gyro, accelerometer, body
//! speed and wheel torque. Every row is linear in twelve parameters: θ; the robot's own, namely
//! `δ_c` and `δ_d` (relative errors of the nominal radii, positive if they are too large: mean, and
//! right minus left), the effective track width, the offsets of gyro and accelerometer and the
//! latter's scale; θf, with the rolling resistance coefficient f in measured torques; θκ, with the
//! curvature κ of the tyres' friction curve; θℓ, with the contacts' relaxation length, whose
//! regressor is the force's rate; θj, with the inertia j of rotors and wheels over the mass, whose
//! torque does not reach the contacts; and θε, with the difference of the sides' loads. Without the
//! last four, in metres per second, u rim speeds:
//!
//! ```text
//! with wheel torque
//!   u_R − u_L − Wφ̇    = θ (μ_R u_R − μ_L u_L)   + (δ_c − θf)(u_R − u_L)   + δ_d (u_R + u_L)/2 − W b_g
//!   (u_R + u_L)/2 − v = θ (μ_R u_R + μ_L u_L)/2 + (δ_c − θf)(u_R + u_L)/2 + δ_d (u_R − u_L)/4
//! without
//!   the moment balance ([`window`]) and the innovations of the forward speed ([`longitudinal`])
//! ```
//! The robot's own parameters are kept when the ground changes; θ, f and κ belong to the ground.
//! Samples are averaged over blocks. The noise variance of the regressor is subtracted from its
//! square (errors in variables), and its effect is part of the standard deviation. Only the
//! difference of `δ_c` and θf is observable, so their joint information is passed from segment to
//! segment (`offsets.rs`). Torques are divided by the model's mass; with accelerations they give
//! the factor by which the robot is heavier ([`apparent_mass`]). Without excitation of θ the
//! estimator abstains: `None`.
//!
//! These rows are exact for a robot that equals its model. For any other robot θ, its segments and
//! the changes of the ground come from [`identification`].

mod apparent_mass;
mod block;
mod change;
mod contacts;
mod curved;
mod demonstrated_friction;
mod excitation;
mod expectation;
mod frozen_speed;
mod frozen_torque;
mod ground_offsets;
mod identification;
mod longitudinal;
pub mod manoeuvre;
mod offsets;
mod payload;
mod regression;
mod rows;
mod segment;
mod sums;
mod types;
mod window;

use crate::measured::WheelSpeeds;
use crate::robot::{GRAVITY_M_S2, RobotModel};

use apparent_mass::ApparentMass;
use block::{Block, BlockBuilder, BlockContext, ThetaBound};
use change::ChangeDetector;
use excitation::Excitation;
pub use expectation::{ExpectedAccuracy, expected_accuracy};
use frozen_speed::FrozenSpeed;
use frozen_torque::FrozenTorque;
use identification::{Identification, Identified};
use longitudinal::{LongitudinalFilter, SlipBound};
use manoeuvre::{ESTIMATE_HALF_WIDTH_MAX_RATIO, Manoeuvres, NoEstimate, RimMotion};
use offsets::OffsetKnowledge;
use payload::PayloadMonitor;
use regression::{SharedCovariance, Solution, SolveInput, solve};
use rows::Row;
pub use segment::SegmentStatistics;
use segment::{SegmentTheta, SegmentVariance, StatedInformation};
use sums::Sums;
pub use types::{
    CommonError, Estimate, EstimatorPrior, IdentifiedRobot, IdentifiedValue, LateSensor,
    ModelUncertainty, PayloadChange, SensorDelays, SensorNoise, SensorSample, ThetaMeasurement,
    TyrePrior, UpdateOutcome, ValueWithStdDev,
};

/// Duration of a block, over which samples are averaged, seconds.
pub const BLOCK_S: f64 = 0.2;
/// Rim speed of either side below which a sample is not used, because slip is undefined at
/// standstill, metres per second.
const RIM_SPEED_MIN_M_S: f64 = 0.15;
/// Maximum combined slip that counts as the linear range.
const SLIP_LINEAR_MAX: f64 = 0.15;
/// Maximum combined slip before θ is measured; lower, because longitudinal slip then comes from the
/// body speed.
const SLIP_LINEAR_FIRST_MAX: f64 = 0.10;
/// Relative standard deviation above which an estimate of θ does not count as a measurement.
const RELATIVE_STD_DEV_MAX: f64 = 0.5;
/// Minimum number of blocks of a measurement.
const BLOCKS_MIN: u64 = 5;
/// Prior standard deviation of the rolling resistance coefficient; the apparent mass takes it as the
/// prior mean too.
const ROLLING_STD_DEV: f64 = 0.02;
/// Maximum plausible friction coefficient of one side; a sample with more torque is dropped.
const MU_MAX: f64 = 10.0;
/// θ in the weights of rows before the first estimate.
const THETA_INITIAL: f64 = 0.2;
/// Range of plausible θ; an estimate outside it is not a measurement.
const THETA_RANGE: std::ops::RangeInclusive<f64> = 5.0e-3..=10.0;
/// Upper bound of θ before the first measurement.
const THETA_INITIAL_MAX: f64 = 2.0;
/// Relative error of θ from rows on accelerations because they neglect products of θ with
/// parameters that are still being estimated. It is common to all of a robot's segments; with
/// torque the error of the torque constants takes its place.
pub const MODEL_RATIO: f64 = 1.5e-3;
/// Maximum fraction of a segment's own variance that counts as an error that it shares with earlier
/// segments.
const OFFSETS_SHARE_MAX: f64 = 0.9;
/// Half-width of a 95 % interval, in standard deviations.
pub const NORMAL_95: f64 = 1.959_963_984_540_054;
/// Minimum prior standard deviation of the torque scale.
const SCALE_STD_DEV_MIN: f64 = 1.0e-3;
/// Maximum time between two samples; after a longer gap all averages restart, seconds.
const GAP_MAX_S: f64 = 0.1;
/// Maximum number of consecutive samples that are dropped because the wheel speeds jumped; then the
/// new speeds are accepted.
const JUMPS_MAX: u32 = 5;
/// Maximum plausible wheel acceleration, as a multiple of the robot's limit.
const JUMP_ACCELERATION_RATIO: f64 = 10.0;

/// Estimator of θ and of the robot's parameters from samples of the robot's own sensors.
#[derive(Debug, Clone, PartialEq)]
pub struct Estimator {
    model: RobotModel,
    noise: SensorNoise,
    tyres: TyrePrior,
    uncertainty: ModelUncertainty,
    block: BlockBuilder,
    longitudinal: LongitudinalFilter,
    offsets: OffsetKnowledge,
    /// Sums over the blocks of this ground's closed segments; boxed because all sums are large.
    ground: Box<Sums>,
    /// Information on θ that these segments state together; its variance includes the tyres' error.
    stated: StatedInformation,
    /// Sums over the open segment's blocks that are certainly of this ground.
    segment: Box<Sums>,
    /// Sums over the blocks since the change detector's sums were last zero; they may be of the
    /// next ground.
    pending: Box<Sums>,
    change: ChangeDetector,
    excitation: Excitation,
    apparent_mass: ApparentMass,
    payload: PayloadMonitor,
    bound: ThetaBound,
    estimate: Estimate,
    /// Solution from all blocks of this ground, if it is a measurement.
    measured: Option<Solution>,
    /// Newest solution until radii and track are computed with it, and whether that is due.
    solution: Option<Solution>,
    are_offsets_due: bool,
    /// Moment balance of the last block, if the block was used.
    turning_before: Option<Row>,
    last_wheels: Option<WheelSpeeds>,
    frozen_torque: FrozenTorque,
    frozen_speed: FrozenSpeed,
    /// Manoeuvres of the last minutes on this ground.
    manoeuvres: Manoeuvres,
    /// Time of the samples dropped since the last used one, seconds.
    skipped_s: f64,
    jumps_in_a_row: u32,
    dropped_samples: u64,
    /// Source of θ if the robot's model is not exact; None if it is.
    identification: Option<Box<Identification>>,
}

impl Estimator {
    /// Creates the estimator of a robot that equals its model, with tyres linear up to the peak, as
    /// in the paper's (7).
    pub fn new(model: RobotModel, noise: SensorNoise) -> Self {
        Self::with_prior(model, noise, EstimatorPrior::exact())
    }

    /// Creates an estimator with a prior of the robot and its tyres.
    pub fn with_prior(model: RobotModel, noise: SensorNoise, prior: EstimatorPrior) -> Self {
        let EstimatorPrior {
            tyres,
            model: uncertainty,
        } = prior;
        let mut estimator = Self {
            model,
            noise,
            tyres,
            uncertainty,
            block: BlockBuilder::default(),
            longitudinal: LongitudinalFilter::new(),
            offsets: OffsetKnowledge::unknown(&noise, &tyres),
            ground: Box::default(),
            stated: StatedInformation::default(),
            segment: Box::default(),
            pending: Box::default(),
            change: ChangeDetector::default(),
            excitation: Excitation::default(),
            apparent_mass: ApparentMass::default(),
            payload: PayloadMonitor::default(),
            bound: ThetaBound {
                theta: None,
                slip_max: f64::INFINITY,
                theta_weights: THETA_INITIAL,
                theta_most: THETA_INITIAL_MAX,
            },
            estimate: Estimate::default(),
            measured: None,
            solution: None,
            are_offsets_due: false,
            turning_before: None,
            last_wheels: None,
            frozen_torque: FrozenTorque::default(),
            frozen_speed: FrozenSpeed::default(),
            manoeuvres: Manoeuvres::default(),
            skipped_s: 0.0,
            jumps_in_a_row: 0,
            dropped_samples: 0,
            identification: Identification::new(model, &noise, &prior).map(Box::new),
        };
        estimator.refresh();
        estimator
    }

    /// Replaces the standard deviations of the sensors' noise for all later samples.
    pub fn set_noise(&mut self, noise: SensorNoise) {
        self.noise = noise;
    }

    /// Adds one sample, taken `dt_s` seconds after the one before. A sample is dropped and counted
    /// if it is not finite or not plausible, if the wheel speeds jump, or if `dt_s` is not above 0.
    pub fn update(&mut self, sample: &SensorSample, dt_s: f64) -> UpdateOutcome {
        let is_in_order = dt_s.is_finite() && dt_s > 0.0;
        if !(is_in_order && is_possible(sample, &self.model))
            || self.wheel_speeds_jump(sample, dt_s)
        {
            self.dropped_samples += 1;
            self.estimate.dropped_samples = self.dropped_samples;
            if is_in_order {
                self.skipped_s += dt_s;
            }
            return UpdateOutcome::default();
        }
        let dt_s = dt_s + std::mem::take(&mut self.skipped_s);
        self.last_wheels = Some(sample.wheel_speeds);
        if dt_s > GAP_MAX_S {
            // The motion during the gap is unknown: all averages restart.
            self.block = BlockBuilder::default();
            self.apparent_mass.interrupt();
            self.payload.interrupt();
            self.manoeuvres.interrupt();
            self.turning_before = None;
            self.longitudinal = LongitudinalFilter::new();
            if let Some(identification) = &mut self.identification {
                identification.interrupt();
            }
            return UpdateOutcome::default();
        }
        let wheels = sample.wheel_speeds;
        let radius_m = self.model.wheel_radius_m();
        let motion = RimMotion {
            rims_m_s: [wheels.left_rad_s, wheels.right_rad_s].map(|rate| rate * radius_m),
            turn_rad_s: sample.gyro_rad_s,
        };
        self.manoeuvres.add(motion, dt_s);
        let sample = &self.frozen_torque.without(sample, &self.model, dt_s);
        let sample = &self.frozen_speed.without(sample, dt_s);
        let level = match &self.identification {
            Some(identification) if sample.is_specific_force => {
                identification.without_gravity(sample)
            }
            Some(_) | None => *sample,
        };
        self.step_longitudinal(&level, dt_s);
        let ground_changed = match &mut self.identification {
            Some(identification) => identification.update(sample, &self.noise, dt_s),
            None => false,
        };
        if ground_changed {
            self.drop_pending();
        }
        self.apparent_mass
            .add(sample, &self.model, &self.noise, dt_s);
        if self.payload.add(sample, &self.model, &self.noise, dt_s) {
            self.begin_load();
        }
        self.block.add(&level, &self.model, dt_s);
        if !self.block.is_full() {
            if self.are_offsets_due && self.block.is_half_full() {
                // In another tick than θ, because a tick with both takes long.
                let solution = self.solution.take();
                self.refresh_offsets(solution.as_ref());
            }
            return UpdateOutcome {
                ground_changed,
                ..UpdateOutcome::default()
            };
        }
        let next = self.block.next();
        let builder = std::mem::replace(&mut self.block, next);
        let context = BlockContext {
            model: &self.model,
            noise: &self.noise,
            curvature: self.tyres.at(self.bound.theta_of_slip()),
            radius_difference: self.estimate.radius_difference.value,
            theta: self.bound.theta_of_slip(),
        };
        let block = builder.finish(context);
        if block.is_none() {
            self.turning_before = None;
        }
        self.manoeuvres.decay();
        let (of_rows, slips) = block.map_or((false, false), |block| self.add_block(block));
        self.excitation.end_block();
        let solution = self.refresh_theta();
        if self.identification.is_some() {
            self.solution = solution;
        } else {
            self.refresh_offsets(solution.as_ref());
        }
        UpdateOutcome {
            block_done: true,
            slips,
            ground_changed: ground_changed || of_rows,
        }
    }

    /// Returns whether the wheel speeds differ from the last ones by more than a wheel can
    /// accelerate.
    fn wheel_speeds_jump(&mut self, sample: &SensorSample, dt_s: f64) -> bool {
        let Some(last) = self.last_wheels else {
            return false;
        };
        let span_s = dt_s + self.skipped_s;
        let most_rad_s = JUMP_ACCELERATION_RATIO
            * (self.model.limits().wheel_acceleration_max_rad_s2 * span_s
                + self.noise.wheel_speed_rad_s);
        let jump_rad_s = (sample.wheel_speeds.left_rad_s - last.left_rad_s)
            .abs()
            .max((sample.wheel_speeds.right_rad_s - last.right_rad_s).abs());
        let is_jump = jump_rad_s > most_rad_s && self.jumps_in_a_row < JUMPS_MAX;
        self.jumps_in_a_row = if is_jump { self.jumps_in_a_row + 1 } else { 0 };
        is_jump
    }

    /// Updates the filter of the forward speed; without measured torque its innovations are rows.
    fn step_longitudinal(&mut self, sample: &SensorSample, dt_s: f64) {
        let bound = SlipBound {
            theta_most: self.bound.theta_most,
            theta: self.bound.theta_of_slip(),
            slip_max: SLIP_LINEAR_MAX.min(self.bound.slip_max),
            radius_difference: self.estimate.radius_difference.value,
            curvature: self.tyres.at(self.bound.theta_of_slip()),
        };
        let rows = self
            .longitudinal
            .add(sample, dt_s, &self.model, &self.noise, &bound);
        if sample.wheel_torques.is_some() {
            return;
        }
        for row in rows.into_iter().flatten().flatten() {
            self.excitation.add_longitudinal_row(&row);
            self.pending.add_longitudinal(&row, bound.theta);
        }
    }

    /// Adds a block to the pending sums. Returns whether the ground has changed, and whether a
    /// wheel slips beyond the linear range.
    fn add_block(&mut self, mut block: Block) -> (bool, bool) {
        block.check_slip(&self.bound);
        block.mu_demonstrated /= self.torque_scale_upper_bound();
        self.pending.add(&block);
        let row = block.turning_row().filter(|_| block.is_linear);
        if let (Some(row), Some(before)) = (row, self.turning_before) {
            self.pending.add_neighbour_covariance(&row, &before);
        }
        self.turning_before = row;
        let innovation = self
            .measured
            .and_then(|solution| solution.innovation(&block));
        if block.is_linear
            && let Some(row) = block.differential_row()
        {
            self.excitation.add_block(&row, block.force.is_some());
        }
        // Without an exact model the innovations of rows contain model errors.
        let changed = self.identification.is_none()
            && innovation.is_some_and(|value| self.change.update(value));
        if changed {
            self.drop_pending();
        } else if self.change.is_quiet() {
            *self.segment = self.segment.plus(&self.pending);
            *self.pending = Sums::default();
        }
        (changed, !block.is_linear)
    }

    /// Drops the pending blocks, which may contain samples of both grounds.
    fn drop_pending(&mut self) {
        self.turning_before = None;
        *self.pending = Sums::default();
        self.change = ChangeDetector::default();
        if let Some(identification) = &mut self.identification {
            identification.drop_last_block();
        }
    }

    fn solve(&self, sums: &Sums, theta_given: Option<f64>) -> Option<Solution> {
        let input = SolveInput {
            offsets: &self.offsets,
            tyres: &self.tyres,
            theta_given,
            theta_start: self.bound.theta_weights,
        };
        solve(sums, input)
    }

    /// Returns the present estimates.
    pub fn estimate(&self) -> Estimate {
        self.estimate
    }

    /// Computes the present estimates from all sums.
    fn refresh(&mut self) {
        let solution = self.refresh_theta();
        self.refresh_offsets(solution.as_ref());
    }

    /// Computes θ and all that follows from it from all sums. Returns the solution.
    fn refresh_theta(&mut self) -> Option<Solution> {
        let sums = self.sums();
        let solution = self.solve(&sums, None);
        self.measured = solution.filter(|solution| self.is_measurement(solution, &sums));
        let of_rows = self.measured.map(|solution| {
            let scale = self.load_scale(&sums);
            let robot = self.gain_ratio(&sums) * solution.theta;
            ThetaMeasurement {
                theta: scale * solution.theta,
                std_dev: scale * (solution.variance + robot * robot).sqrt(),
                own_std_dev: scale * solution.own_variance().sqrt(),
                common: CommonError {
                    robot: scale * robot,
                    tyres: scale * solution.tyre_std_dev(),
                },
                effective_samples: sums.effective_samples(),
                duration_s: sums.duration_s,
            }
        });
        let theta = match &self.identification {
            Some(identification) => identification.identified().and_then(measurement),
            None => of_rows,
        };
        let most = solution.map_or(THETA_INITIAL_MAX, |found| {
            found.theta.max(0.0) + 2.0 * found.variance.max(0.0).sqrt()
        });
        self.bound = ThetaBound {
            theta: self.measured.map(|found| found.theta),
            slip_max: self
                .measured
                .map_or(f64::INFINITY, |found| self.slip_max(&found, &sums)),
            theta_weights: solution
                .filter(|found| found.variance > 0.0 && found.variance.sqrt() < found.theta)
                .map_or(THETA_INITIAL, |found| {
                    found.theta.clamp(*THETA_RANGE.start(), *THETA_RANGE.end())
                }),
            // A measured θ may exceed the bound assumed before.
            theta_most: if of_rows.is_some() {
                most
            } else {
                most.min(THETA_INITIAL_MAX)
            },
        };
        let identification = self.identification.as_ref();
        let misfit_ratio = identification.and_then(|found| found.misfit_ratio());
        let newest_misfit_ratio = identification.and_then(|found| found.newest_misfit_ratio());
        let late_sensor = identification.and_then(|found| found.late_sensor());
        let is_estimate = theta.is_some_and(|found| {
            NORMAL_95 * found.std_dev <= ESTIMATE_HALF_WIDTH_MAX_RATIO * found.theta
        });
        let no_estimate = (!is_estimate).then(|| {
            if misfit_ratio.or(newest_misfit_ratio).is_some() {
                NoEstimate::Misfit
            } else if late_sensor.is_some() {
                NoEstimate::LateSensor
            } else {
                self.manoeuvres.times().lacks(sums.saturation_share())
            }
        });
        self.estimate = Estimate {
            theta,
            no_estimate,
            no_new_information: !self.excitation.is_present(),
            mu_peak_lower_bound: sums.mu_peak(),
            saturation_share: sums.saturation_share(),
            misfit_ratio,
            newest_misfit_ratio,
            late_sensor,
            frozen_torque: self.frozen_torque.frozen(),
            dropped_samples: self.dropped_samples,
            robot: self.identification.as_ref().and_then(|found| found.robot()),
            payload_change: self.payload.change(),
            ..self.estimate
        };
        self.are_offsets_due = true;
        solution
    }

    /// Computes the estimates of radii and track from all sums and their `solution`.
    fn refresh_offsets(&mut self, solution: Option<&Solution>) {
        self.are_offsets_due = false;
        let sums = self.sums();
        let offsets = self.offsets.with_ground(&sums, &self.tyres, solution);
        let (radius_offset, radius_difference) = offsets.values();
        self.estimate = Estimate {
            effective_track_ratio: sums.effective_track(&offsets).map(|track| track.value),
            rolling_resistance_ratio: sums
                .rolling_resistance(self.accelerometer_offset_mu())
                .map(|rolling| rolling.value),
            radius_offset,
            radius_difference,
            ..self.estimate
        };
    }

    /// Returns the sums over all blocks of this ground.
    fn sums(&self) -> Sums {
        self.ground.plus(&self.segment).plus(&self.pending)
    }

    /// Restarts the estimation of mass and inertia after a change of the payload.
    fn begin_load(&mut self) {
        self.apparent_mass = ApparentMass::default();
        self.manoeuvres = Manoeuvres::default();
        if let Some(identification) = &mut self.identification {
            identification.begin_load();
        }
    }

    /// Returns the factor that corrects θ for the robot's true mass: θ from torques assumes the
    /// model's mass, and a heavier robot needs more torque for the same friction coefficient. θ
    /// from accelerations needs no correction.
    fn load_scale(&self, sums: &Sums) -> f64 {
        if sums.has_torque() {
            self.torque_scale().value
        } else {
            1.0
        }
    }

    /// Returns the torque scale times the true mass over the model's mass: the prior combined with
    /// the apparent mass from torques and accelerations.
    fn torque_scale(&self) -> ValueWithStdDev {
        let uncertainty = &self.uncertainty;
        // Errors of the torque constants scale the forces; each side has its own, and the force
        // difference contains half of each. Errors of the radii cancel: the torque is too high by
        // the same ratio by which the rim speed beside it is too low.
        let constants = self.noise.torque_gain_ratio * std::f64::consts::FRAC_1_SQRT_2;
        let known = ValueWithStdDev {
            value: 1.0 + uncertainty.payload_ratio,
            std_dev: constants
                .hypot(uncertainty.mass_ratio)
                .max(SCALE_STD_DEV_MIN),
        };
        // An exactly known mass needs no correction.
        let apparent = self.apparent_mass.value();
        let Some(apparent) = apparent.filter(|_| uncertainty.mass_ratio > 0.0) else {
            return known;
        };
        let std_dev = apparent
            .std_dev
            .hypot(self.tyres.rotor_std_dev_ratio)
            .hypot(self.noise.accelerometer_scale_ratio * known.value);
        let weights = [known.std_dev.powi(-2), std_dev.powi(-2)];
        let values = [known.value, apparent.value - self.tyres.rotor_ratio];
        let sum = weights[0] + weights[1];
        let value = (weights[0] * values[0] + weights[1] * values[1]) / sum;
        ValueWithStdDev {
            value,
            std_dev: sum.sqrt().recip(),
        }
    }

    /// Returns the upper end of the 95 % interval of the torque scale: the ground gives at least
    /// the measured friction coefficient divided by it. What the accelerometer shows does not
    /// depend on the load, and is divided all the same.
    fn torque_scale_upper_bound(&self) -> f64 {
        let scale = self.torque_scale();
        (scale.value + NORMAL_95 * scale.std_dev).max(1.0)
    }

    /// Returns the largest slip at which the prior of the tyres is valid on ground of this θ.
    /// Without torque the friction coefficient at a slip follows from θ alone, so the lower end of
    /// its 95 % interval is used.
    fn slip_max(&self, solution: &Solution, sums: &Sums) -> f64 {
        let doubt = if sums.has_torque() {
            0.0
        } else {
            let robot = self.gain_ratio(sums) * solution.theta;
            NORMAL_95 * (solution.variance + robot * robot).sqrt()
        };
        self.tyres.slip_max((solution.theta - doubt).max(0.0))
    }

    /// Returns the relative standard deviation of the error that scales every θ of this robot.
    fn gain_ratio(&self, sums: &Sums) -> f64 {
        if sums.has_torque() {
            let scale = self.torque_scale();
            scale.std_dev / scale.value
        } else {
            MODEL_RATIO.hypot(self.uncertainty.inertia_ratio)
        }
    }

    /// Returns whether a solution counts as a measurement: θ was excited, and the blocks' slip was
    /// in the range in which the tyres' prior is valid. Blocks from before the first measurement
    /// may exceed that range.
    fn is_measurement(&self, solution: &Solution, sums: &Sums) -> bool {
        solution.is_measurement(sums.blocks) && sums.slip_rms() <= self.slip_max(solution, sums)
    }

    fn accelerometer_offset_mu(&self) -> f64 {
        self.noise.accelerometer_offset_m_s2 / GRAVITY_M_S2
    }

    /// Ends the segment and returns its additive statistics, without any prior on θ. The robot's
    /// own parameters come from all other segments, and their uncertainty is included.
    ///
    /// The error of the robot's parameters is common to all segments, so summing independent
    /// information would overstate the precision: each segment states only as much information as
    /// keeps the variance of the sum of this ground's segments truthful. Errors that do not average
    /// out over drives are reported separately, as [`CommonError`].
    pub fn close_segment(&mut self) -> SegmentStatistics {
        let segment = self.segment.plus(&self.pending);
        let before = self
            .solve(&self.ground, None)
            .filter(|found| found.theta > 0.0);
        let tyres = before.map_or(self.tyres, |found| found.tyres(&self.tyres));
        let offsets = self
            .offsets
            .with_ground(&self.ground, &self.tyres, before.as_ref());
        *self.ground = self.ground.plus(&segment);
        let theta = match &mut self.identification {
            Some(identification) => identification
                .close_segment()
                .map(|found| self.stated.identified(&found)),
            None => self.segment_of_rows(&segment, before.as_ref(), (&offsets, &tyres)),
        };
        let statistics = SegmentStatistics::of(
            &segment,
            &offsets,
            theta.filter(|found| found.own_information > 0.0),
            self.accelerometer_offset_mu(),
        );
        *self.segment = Sums::default();
        *self.pending = Sums::default();
        self.refresh();
        statistics
    }

    /// Returns θ of a segment of this ground from its rows; None unless all blocks of the ground
    /// are a measurement.
    fn segment_of_rows(
        &mut self,
        segment: &Sums,
        before: Option<&Solution>,
        (offsets, tyres): (&OffsetKnowledge, &TyrePrior),
    ) -> Option<SegmentTheta> {
        // A segment is no measurement if all blocks of the ground together are none.
        let ground = self
            .solve(&self.ground, None)
            .filter(|found| self.is_measurement(found, &self.ground))?;
        let input = SolveInput {
            offsets,
            tyres,
            theta_given: Some(ground.theta),
            theta_start: ground.theta,
        };
        let found = solve(segment, input).filter(|found| found.is_informative(ground.theta))?;
        let shared = before.map_or_else(SharedCovariance::default, |before| {
            before.shared_with(&found, offsets, tyres)
        });
        let scale = self.load_scale(segment);
        let square = scale * scale;
        // The error shared with earlier segments belongs to the robot: it is reported and does not
        // average out.
        let own_variance = found.own_variance();
        let of_offsets = shared.own.clamp(0.0, OFFSETS_SHARE_MAX * own_variance);
        // A proportional error is stated relative to the most precise θ.
        let common_ratio = CommonError {
            robot: self
                .gain_ratio(segment)
                .hypot(of_offsets.sqrt() / ground.theta),
            tyres: found.tyre_std_dev() / ground.theta,
        };
        Some(SegmentTheta {
            theta: scale * found.theta,
            information: self.stated.add(SegmentVariance {
                total: square * found.variance,
                shared: square * shared.all,
            }),
            own_information: (square * (own_variance - of_offsets)).recip(),
            common_ratio,
            duration_s: segment.duration_s,
        })
    }

    /// Starts on new ground: discards θ and keeps the estimates of the robot's parameters. An open
    /// segment is dropped; close it first.
    pub fn begin_ground(&mut self) {
        let found = self.solve(&self.ground, None);
        self.offsets = self
            .offsets
            .with_ground(&self.ground, &self.tyres, found.as_ref())
            .on_new_ground();
        *self.ground = Sums::default();
        self.stated = StatedInformation::default();
        *self.segment = Sums::default();
        *self.pending = Sums::default();
        self.change = ChangeDetector::default();
        self.turning_before = None;
        self.block = BlockBuilder::default();
        self.longitudinal = LongitudinalFilter::new();
        self.excitation = Excitation::default();
        self.manoeuvres = Manoeuvres::default();
        if let Some(identification) = &mut self.identification {
            identification.begin_ground();
        }
        self.refresh();
    }
}

/// Converts an identified θ to a measurement; None if it is out of range or too uncertain.
fn measurement(found: Identified) -> Option<ThetaMeasurement> {
    let own_std_dev = found.theta * found.own_ratio;
    let common = CommonError {
        robot: found.theta * found.robot_ratio,
        tyres: found.theta * found.tyres_ratio,
    };
    let std_dev = own_std_dev.hypot(common.std_dev());
    let is_measurement =
        THETA_RANGE.contains(&found.theta) && std_dev < RELATIVE_STD_DEV_MAX * found.theta;
    is_measurement.then_some(ThetaMeasurement {
        theta: found.theta,
        std_dev,
        own_std_dev,
        common,
        effective_samples: found.duration_s / BLOCK_S,
        duration_s: found.duration_s,
    })
}

/// Rim speeds of the two sides, mirrored in reverse so that the robot drives forward.
#[derive(Debug, Clone, Copy, PartialEq)]
struct RimSpeeds {
    left_m_s: f64,
    right_m_s: f64,
    /// 1 forward; −1 in reverse, where the robot's left side becomes the right one.
    sign: f64,
}

/// Returns the rim speeds; None if a side is slower than [`RIM_SPEED_MIN_M_S`] or the sides turn in
/// opposite directions.
fn signed_rims(sample: &SensorSample, model: &RobotModel) -> Option<RimSpeeds> {
    let left_m_s = sample.wheel_speeds.left_rad_s * model.wheel_radius_m();
    let right_m_s = sample.wheel_speeds.right_rad_s * model.wheel_radius_m();
    if left_m_s.min(right_m_s) > RIM_SPEED_MIN_M_S {
        Some(RimSpeeds {
            left_m_s,
            right_m_s,
            sign: 1.0,
        })
    } else if left_m_s.max(right_m_s) < -RIM_SPEED_MIN_M_S {
        Some(RimSpeeds {
            left_m_s: -right_m_s,
            right_m_s: -left_m_s,
            sign: -1.0,
        })
    } else {
        None
    }
}

fn is_possible(sample: &SensorSample, model: &RobotModel) -> bool {
    let fastest_rad_s = 3.0 * model.limits().wheel_speed_max_rad_s;
    let mu_scale = 1.0 / (model.wheel_radius_m() * model.side_load_n());
    sample.wheel_speeds.is_finite()
        && sample.wheel_speeds.magnitude_max_rad_s() < fastest_rad_s
        && sample.gyro_rad_s.is_finite()
        && sample.gyro_rad_s.abs() < 50.0
        && sample
            .body_speed_m_s
            .is_none_or(|speed| speed.is_finite() && speed.abs() < 100.0)
        && sample.acceleration.is_none_or(|acceleration| {
            acceleration.forward_m_s2.hypot(acceleration.left_m_s2) < 200.0
        })
        && sample.wheel_torques.is_none_or(|torques| {
            (torques.left_n_m.abs().max(torques.right_n_m.abs()) * mu_scale) < MU_MAX
                && torques.is_finite()
        })
}
