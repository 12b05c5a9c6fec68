//! How the ground grips: θ measured, with an honest standard deviation.
//!
//! This is the figure that reaches the map; it never mixes with θ̂ of the loop. Per side, in the
//! linear range, `λ = θ μ` holds exactly under combined slip: slip is regressed on force, from
//! *measured* wheel speed, gyro, body speed and wheel torque. With u the rim speed reckoned from the
//! nominal radius, and δ the share by which it is too large (rolling radii are unknown to about two
//! percent), in metres per second:
//!
//! ```text
//! difference  u_R − u_L − Wφ̇     = θ (μ_R u_R − μ_L u_L)   + δ_c (u_R − u_L) + δ_d (u_R + u_L)/2
//! mean        (u_R + u_L)/2 − v  = θ (μ_R u_R + μ_L u_L)/2 + δ_c (u_R + u_L)/2 + δ_d (u_R − u_L)/4
//! ```
//! `δ_c` and `δ_d` are the robot's: they survive changes of the ground, θ is the ground's. Samples are
//! averaged over blocks; the noise of the measured torque is taken out of the regressor's square
//! (errors in variables), and its effect is part of the deviation. Rolling resistance acts like
//! `δ_c` in both rows and needs no state. Without torque there is no regressor, and no θ: `None`.

mod change;
mod offsets;
mod regression;
mod segment;

use serde::{Deserialize, Serialize};

use crate::measured::{BodyAcceleration, WheelSpeeds, WheelTorques};
use crate::robot::{GRAVITY_M_S2, RobotModel};

use change::ChangeDetector;
use offsets::OffsetKnowledge;
use regression::{Block, Sums};
pub use segment::SegmentStatistics;

/// Time over which samples are averaged, seconds.
pub const BLOCK_S: f64 = 0.2;
/// Rim speed below which a sample says nothing, metres per second.
const RIM_SPEED_MIN_M_S: f64 = 0.15;
/// Largest combined slip that is taken for the linear range.
const SLIP_LINEAR_MAX: f64 = 0.15;
/// The same before θ is known.
const SLIP_LINEAR_FIRST_MAX: f64 = 0.10;
/// Lateral slip beyond which a block is no straight driving, for rolling resistance.
const STRAIGHT_SLIP_MAX: f64 = 0.01;
/// Relative deviation above which there is said to be no measurement.
const RELATIVE_STD_DEV_MAX: f64 = 0.5;
/// Fewest blocks of a measurement.
const BLOCKS_MIN: u64 = 5;
/// Largest measured friction coefficient of one side that is believed.
const MU_MAX: f64 = 10.0;
/// θ used to weigh samples before there is any estimate.
const THETA_FIRST: f64 = 0.2;
/// Range in which an estimate of θ is believed.
const THETA_RANGE: std::ops::RangeInclusive<f64> = 5.0e-3..=10.0;

/// Noise of the sensors; white, one standard deviation per sample, unless said otherwise.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct SensorNoise {
    /// Gyro, radians per second.
    pub gyro_rad_s: f64,
    /// Accelerometer, metres per second squared.
    pub accelerometer_m_s2: f64,
    /// Offset of the accelerometer, unknown, metres per second squared.
    pub accelerometer_offset_m_s2: f64,
    /// Wheel speed, radians per second.
    pub wheel_speed_rad_s: f64,
    /// Body speed, metres per second.
    pub body_speed_m_s: f64,
    /// Wheel torque, as friction coefficient of one side.
    pub torque_mu: f64,
    /// Error of each side's torque constant, unknown, share.
    pub torque_gain_ratio: f64,
    /// Error of each side's rolling radius, unknown, share.
    pub radius_ratio: f64,
}

impl Default for SensorNoise {
    fn default() -> Self {
        Self {
            gyro_rad_s: 0.003,
            accelerometer_m_s2: 0.05,
            accelerometer_offset_m_s2: 0.02,
            wheel_speed_rad_s: 0.02,
            body_speed_m_s: 0.02,
            torque_mu: 0.01,
            torque_gain_ratio: 0.02,
            radius_ratio: 0.0115,
        }
    }
}

/// One sample of the robot's own sensors.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct SensorSample {
    /// Measured wheel speeds.
    pub wheel_speeds: WheelSpeeds,
    /// Turn rate, radians per second.
    pub gyro_rad_s: f64,
    /// Acceleration without gravity, body frame.
    pub acceleration: Option<BodyAcceleration>,
    /// Speed ahead, metres per second; only in the sample in which it is new.
    pub body_speed_m_s: Option<f64>,
    /// Drive torques per side, where the base gives them.
    pub wheel_torques: Option<WheelTorques>,
}

/// What is known about the ground under the robot now.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ThetaMeasurement {
    /// θ = 1/K.
    pub theta: f64,
    /// Its standard deviation, with that of the offsets and the torque constant.
    pub std_dev: f64,
    /// Blocks that carry the measurement, weighed by their share of its information.
    pub effective_samples: f64,
    /// Time that was used, seconds.
    pub duration_s: f64,
}

/// What the estimator can say.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Estimate {
    /// θ of the present ground; none while it is unexcited.
    pub theta: Option<ThetaMeasurement>,
    /// Whether the last block brought no new information on θ.
    pub no_new_information: bool,
    /// Friction coefficient that the ground has given at least; none before any force.
    pub mu_peak_lower_bound: Option<f64>,
    /// Measured effective track over W; none before enough turning.
    pub effective_track_ratio: Option<f64>,
    /// Rolling resistance over load; none before enough straight driving with torque.
    pub rolling_resistance_ratio: Option<f64>,
    /// Mean share by which the nominal rolling radii are too large, and its deviation.
    pub radius_offset: ValueWithDeviation,
    /// Right minus left of the same, and its deviation.
    pub radius_difference: ValueWithDeviation,
    /// Share of blocks beyond the linear range of slip, of those driven fast enough.
    pub saturation_share: f64,
    /// Samples dropped because they were not finite or not possible.
    pub dropped_samples: u64,
}

/// A figure and its standard deviation.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ValueWithDeviation {
    /// The figure.
    pub value: f64,
    /// Its standard deviation.
    pub std_dev: f64,
}

/// What a sample led to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct UpdateOutcome {
    /// A block of samples was finished and used.
    pub block_done: bool,
    /// In that block a wheel slipped beyond the range in which force grows with slip.
    pub slips: bool,
    /// The ground has changed: close the segment and call [`Estimator::begin_ground`].
    pub ground_changed: bool,
}

/// Measures θ.
#[derive(Debug, Clone, PartialEq)]
pub struct Estimator {
    model: RobotModel,
    noise: SensorNoise,
    block: BlockBuilder,
    offsets: OffsetKnowledge,
    /// Blocks of this ground in segments that are closed.
    ground: Sums,
    /// Blocks of the open segment that are certain to be of this ground.
    segment: Sums,
    /// Blocks since the change detector last stood at zero.
    pending: Sums,
    change: ChangeDetector,
    no_new_information: bool,
    dropped_samples: u64,
}

impl Estimator {
    /// An estimator that knows nothing but the model and the noise.
    pub fn new(model: RobotModel, noise: SensorNoise) -> Self {
        Self {
            model,
            noise,
            block: BlockBuilder::default(),
            offsets: OffsetKnowledge::unknown(noise.radius_ratio),
            ground: Sums::default(),
            segment: Sums::default(),
            pending: Sums::default(),
            change: ChangeDetector::default(),
            no_new_information: true,
            dropped_samples: 0,
        }
    }

    /// Takes one sample, `dt_s` after the one before.
    pub fn update(&mut self, sample: &SensorSample, dt_s: f64) -> UpdateOutcome {
        if !(is_possible(sample, &self.model) && dt_s.is_finite() && dt_s > 0.0) {
            self.dropped_samples += 1;
            return UpdateOutcome::default();
        }
        self.block.add(sample, &self.model, dt_s);
        if self.block.duration_s < BLOCK_S - 1.0e-6 {
            return UpdateOutcome::default();
        }
        let builder = std::mem::take(&mut self.block);
        let (ground_changed, slips) = match builder.finish(&self.model, &self.noise) {
            Some(block) => self.take(&block),
            None => (false, false),
        };
        UpdateOutcome {
            block_done: true,
            slips,
            ground_changed,
        }
    }

    /// Whether the ground has changed, and whether a wheel slips beyond the linear range.
    fn take(&mut self, block: &Block) -> (bool, bool) {
        let present = self.ground.plus(&self.segment).plus(&self.pending);
        let before = present.solve(&self.offsets);
        let measured = before.filter(|solution| solution.is_measurement(present.blocks));
        let mut block = *block;
        block.is_linear &= block.slips_little(measured.map(|solution| solution.theta));
        let block = &block;
        self.pending.add(block);
        let innovation = measured.and_then(|solution| solution.innovation(block));
        self.no_new_information = !block.is_linear || block.force_signal() < 2.0;
        let changed = innovation.is_some_and(|value| self.change.update(value));
        if changed {
            // These blocks may be of either ground: they belong to neither.
            self.pending = Sums::default();
            self.change = ChangeDetector::default();
        } else if self.change.is_quiet() {
            self.segment = self.segment.plus(&self.pending);
            self.pending = Sums::default();
        }
        (changed, !block.is_linear)
    }

    /// What is known now.
    pub fn estimate(&self) -> Estimate {
        let sums = self.ground.plus(&self.segment).plus(&self.pending);
        let solution = sums.solve(&self.offsets);
        let theta = solution
            .filter(|solution| solution.is_measurement(sums.blocks))
            .map(|solution| {
                // Errors of the torque constants scale the forces; each side has its own, and the
                // force difference holds half of each. Errors of the radii cancel: the torque reads
                // too high by what the rim speed beside it reads too low.
                let gain = self.noise.torque_gain_ratio * std::f64::consts::FRAC_1_SQRT_2;
                ThetaMeasurement {
                    theta: solution.theta,
                    std_dev: (solution.variance + (gain * solution.theta).powi(2)).sqrt(),
                    effective_samples: sums.effective_samples(),
                    duration_s: sums.duration_s,
                }
            });
        let offsets = self.offsets.with_ground(&sums);
        let (radius_offset, radius_difference) = offsets.values();
        Estimate {
            theta,
            no_new_information: self.no_new_information,
            mu_peak_lower_bound: sums.mu_peak(),
            effective_track_ratio: sums.effective_track(&offsets).map(|track| track.value),
            rolling_resistance_ratio: sums.rolling_resistance(),
            radius_offset,
            radius_difference,
            saturation_share: sums.saturation_share(),
            dropped_samples: self.dropped_samples,
        }
    }

    /// Ends the segment and gives its additive statistics, which hold no prior on θ. The offsets
    /// used are those known from everything else, and their deviation is inside.
    pub fn close_segment(&mut self) -> SegmentStatistics {
        let segment = self.segment.plus(&self.pending);
        let whole = self.ground.plus(&segment);
        let theta_ground = whole.solve(&self.offsets).map(|solution| solution.theta);
        let offsets = self.offsets.with_ground(&self.ground);
        let statistics = SegmentStatistics::of(&segment, &offsets, theta_ground);
        self.ground = whole;
        self.segment = Sums::default();
        self.pending = Sums::default();
        statistics
    }

    /// Starts on new ground: θ is forgotten, what was learned about the offsets stays.
    /// An open segment is dropped; close it first.
    pub fn begin_ground(&mut self) {
        self.offsets = self.offsets.with_ground(&self.ground);
        self.ground = Sums::default();
        self.segment = Sums::default();
        self.pending = Sums::default();
        self.change = ChangeDetector::default();
        self.block = BlockBuilder::default();
        self.no_new_information = true;
    }
}

/// Samples of one block.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct BlockBuilder {
    duration_s: f64,
    samples: u32,
    with_torque: u32,
    with_acceleration: u32,
    with_body_speed: u32,
    usable: u32,
    left_m_s: f64,
    right_m_s: f64,
    gyro_rad_s: f64,
    left_mu: f64,
    right_mu: f64,
    left_force_m_s: f64,
    right_force_m_s: f64,
    lateral_m_s2: f64,
    ahead_m_s2: f64,
    /// Mean rim speed minus body speed where the latter was new.
    slip_m_s: f64,
}

impl BlockBuilder {
    fn add(&mut self, sample: &SensorSample, model: &RobotModel, dt_s: f64) {
        let radius_m = model.wheel_radius_m();
        let left_m_s = sample.wheel_speeds.left_rad_s * radius_m;
        let right_m_s = sample.wheel_speeds.right_rad_s * radius_m;
        self.duration_s += dt_s;
        self.samples += 1;
        self.left_m_s += left_m_s;
        self.right_m_s += right_m_s;
        self.gyro_rad_s += sample.gyro_rad_s;
        if left_m_s.abs().min(right_m_s.abs()) > RIM_SPEED_MIN_M_S && left_m_s * right_m_s > 0.0 {
            self.usable += 1;
        }
        if let Some(torques) = sample.wheel_torques {
            let scale = 1.0 / (radius_m * model.side_load_n());
            let (left_mu, right_mu) = (torques.left_n_m * scale, torques.right_n_m * scale);
            self.with_torque += 1;
            self.left_mu += left_mu;
            self.right_mu += right_mu;
            self.left_force_m_s += left_mu * left_m_s.abs();
            self.right_force_m_s += right_mu * right_m_s.abs();
        }
        if let Some(acceleration) = sample.acceleration {
            self.with_acceleration += 1;
            self.lateral_m_s2 += acceleration.left_m_s2;
            self.ahead_m_s2 += acceleration.ahead_m_s2;
        }
        if let Some(body_m_s) = sample.body_speed_m_s {
            self.with_body_speed += 1;
            self.slip_m_s += 0.5 * (left_m_s + right_m_s) - body_m_s;
        }
    }

    /// The block's means; none when the robot was too slow or turned on the spot.
    fn finish(&self, model: &RobotModel, noise: &SensorNoise) -> Option<Block> {
        if self.samples == 0 || self.usable < self.samples {
            return None;
        }
        let count = f64::from(self.samples);
        let left_m_s = self.left_m_s / count;
        let right_m_s = self.right_m_s / count;
        let gyro_rad_s = self.gyro_rad_s / count;
        let mean_m_s = 0.5 * (left_m_s + right_m_s);
        let slower_m_s = left_m_s.abs().min(right_m_s.abs());
        let lateral = 0.5 * model.wheelbase_m() * gyro_rad_s.abs() / slower_m_s;
        // Slip ahead in the linear range is about the geometric one of a steady turn at most, plus
        // that of acceleration; the measured difference holds both.
        let difference_m_s = right_m_s - left_m_s - model.track_width_m() * gyro_rad_s;
        let ahead = 0.5 * difference_m_s.abs() / slower_m_s;
        let rim_noise_m_s = noise.wheel_speed_rad_s * model.wheel_radius_m();
        let force = (self.with_torque == self.samples).then(|| regression::Force {
            difference_m_s: (self.right_force_m_s - self.left_force_m_s) / count,
            mean_m_s: 0.5 * (self.right_force_m_s + self.left_force_m_s) / count,
            difference_noise: noise.torque_mu.powi(2)
                * (left_m_s * left_m_s + right_m_s * right_m_s)
                / count,
        });
        let mean_mu = 0.5 * (self.left_mu + self.right_mu) / count;
        let lateral_mu = if self.with_acceleration > 0 {
            self.lateral_m_s2 / f64::from(self.with_acceleration) / GRAVITY_M_S2
        } else {
            0.0
        };
        let side_mu = self.left_mu.abs().max(self.right_mu.abs()) / count;
        let mu_noise = 2.0 * (noise.torque_mu / count.sqrt()).hypot(0.01);
        let resistance = (force.is_some()
            && self.with_acceleration == self.samples
            && lateral < STRAIGHT_SLIP_MAX)
            .then(|| (mean_mu - self.ahead_m_s2 / count / GRAVITY_M_S2) * mean_m_s.signum());
        Some(Block {
            duration_s: self.duration_s,
            is_linear: lateral.hypot(ahead) < SLIP_LINEAR_MAX,
            slip_lateral: lateral,
            mu_side: side_mu,
            slower_m_s,
            difference_m_s,
            difference_noise: (2.0 * rim_noise_m_s.powi(2)
                + (model.track_width_m() * noise.gyro_rad_s).powi(2))
                / count,
            slip_m_s: (self.with_body_speed > 0)
                .then(|| self.slip_m_s / f64::from(self.with_body_speed)),
            slip_noise: if self.with_body_speed > 0 {
                (noise.body_speed_m_s.powi(2) + 0.5 * rim_noise_m_s.powi(2))
                    / f64::from(self.with_body_speed)
            } else {
                0.0
            },
            rim_difference_m_s: right_m_s - left_m_s,
            rim_mean_m_s: mean_m_s,
            force,
            turn_m_s: model.track_width_m() * gyro_rad_s,
            turn_noise: (model.track_width_m() * noise.gyro_rad_s).powi(2) / count,
            mu_seen: (side_mu.hypot(lateral_mu) - mu_noise).max(0.0),
            rolling_resistance: resistance,
        })
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
            acceleration.ahead_m_s2.hypot(acceleration.left_m_s2) < 200.0
        })
        && sample.wheel_torques.is_none_or(|torques| {
            (torques.left_n_m.abs().max(torques.right_n_m.abs()) * mu_scale) < MU_MAX
                && torques.is_finite()
        })
}
