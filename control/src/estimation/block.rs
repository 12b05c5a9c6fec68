//! Averages samples over blocks of [`BLOCK_S`], and forms the regression rows of a block.

use super::contacts::{CurvatureInput, MeanSlip, StiffnessLoss};
use super::curved::{Curvatures, ForceAtSlip, SlipBySide, Turn};
use super::rows::{Regressors, Row, index};
use super::types::Curvature;
use super::window::{SampleSpan, TurnMeans, TurnWindow};
use super::{
    BLOCK_S, RIM_SPEED_MIN_M_S, SLIP_LINEAR_FIRST_MAX, SLIP_LINEAR_MAX, SensorNoise, SensorSample,
    THETA_INITIAL, ValueWithStdDev,
};
use crate::robot::{GRAVITY_M_S2, RobotModel};

/// Lateral slip below which a block counts as straight driving, for rolling resistance.
const STRAIGHT_SLIP_MAX: f64 = 0.01;
/// Maximum relative change of speed within a block for a row of the sides' mean: a body speed is
/// measured at one time of the block, but the force is the mean over it.
const STEADY_SHARE: f64 = 0.05;
/// Fraction of a block at its beginning and at its end over which forces are averaged for their
/// rate.
const ENDS_SHARE: f64 = 0.25;

/// Force regressors of a block.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Force {
    /// `μ_R u_R − μ_L u_L`, metres per second.
    difference_m_s: f64,
    /// `(μ_R u_R + μ_L u_L)/2`, metres per second.
    mean_m_s: f64,
    /// Variance of `difference_m_s`; that of `mean_m_s` is a quarter of it.
    difference_noise: f64,
    /// Regressors of θκ and θκ² in the rows of difference and mean, with each side at its own slip.
    difference_curvature: [f64; 2],
    mean_curvature: [f64; 2],
    /// Ratios of the regressors of θκ and θκ² to the force; they share its noise.
    curvature_ratio: [f64; 2],
    /// Covariances of the regressors `difference_curvature` with the response.
    slip_noise: [f64; 2],
    rate: Rate,
}

/// Rates of the sides' forces and rim speeds within a block, `[left, right]`.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct Rate {
    /// Rate of the friction coefficients, per second.
    mu: [f64; 2],
    /// Rim acceleration over gravity, times the rim speed, metres per second.
    rim_m_s: [f64; 2],
    /// Variance of the difference of the sides' `mu`.
    difference_noise: f64,
}

/// Sums over the samples at the beginning and at the end of a block.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct Ends {
    samples: [f64; 2],
    time_s: [f64; 2],
    mu: [[f64; 2]; 2],
    rim_m_s: [[f64; 2]; 2],
}

/// Friction coefficients and rim speeds of the sides in one sample, `[left, right]`.
#[derive(Debug, Clone, Copy)]
struct Sides {
    mu: [f64; 2],
    rim_m_s: [f64; 2],
}

impl Ends {
    /// Returns 0 for a sample at the beginning of a block, 1 at its end, else `None`. `span` is
    /// relative to the block's start.
    fn of(span: SampleSpan) -> Option<usize> {
        let SampleSpan { middle_s, dt_s } = span;
        if middle_s + 0.5 * dt_s <= ENDS_SHARE * BLOCK_S + 1.0e-6 {
            Some(0)
        } else if middle_s - 0.5 * dt_s >= (1.0 - ENDS_SHARE) * BLOCK_S - 1.0e-6 {
            Some(1)
        } else {
            None
        }
    }

    fn add(&mut self, end: usize, time_s: f64, sides: Sides) {
        self.samples[end] += 1.0;
        self.time_s[end] += time_s;
        for side in 0..2 {
            self.mu[end][side] += sides.mu[side];
            self.rim_m_s[end][side] += sides.rim_m_s[side];
        }
    }

    /// Returns the rates between both ends of a block; `torque_mu` is the noise of a sample's
    /// friction coefficient, `sides_m_s` the mean rim speeds. Zero without samples at both ends.
    fn rate(&self, torque_mu: f64, sides_m_s: [f64; 2]) -> Rate {
        let [first, last] = self.samples;
        let apart_s = self.time_s[1] / last - self.time_s[0] / first;
        if !apart_s.is_finite() || apart_s <= 0.0 {
            return Rate::default();
        }
        let rate =
            |of: &[[f64; 2]; 2], side: usize| (of[1][side] / last - of[0][side] / first) / apart_s;
        Rate {
            mu: [0, 1].map(|side| rate(&self.mu, side)),
            rim_m_s: [0, 1]
                .map(|side| rate(&self.rim_m_s, side) / GRAVITY_M_S2 * sides_m_s[side].abs()),
            difference_noise: 2.0 * torque_mu.powi(2) * (first.recip() + last.recip())
                / (apart_s * apart_s),
        }
    }
}

/// θ and its bounds, with which the linearity of a block is checked.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct ThetaBound {
    /// Measured θ, if there is one.
    pub(super) theta: Option<f64>,
    /// θ in the weights of rows: estimated, or [`THETA_INITIAL`].
    pub(super) theta_weights: f64,
    /// Upper bound of θ.
    pub(super) theta_most: f64,
    /// Maximum slip at which the prior of the tyres' friction curve is valid.
    pub(super) slip_max: f64,
}

impl ThetaBound {
    /// Returns the θ with which slip is computed from force: the measured one, else a small
    /// default. A vague θ may be far too large, and rows are never recomputed.
    pub(super) fn theta_of_slip(&self) -> f64 {
        self.theta.unwrap_or(THETA_INITIAL)
    }
}

/// Means over the samples of one block.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Block {
    pub(super) duration_s: f64,
    /// Whether the combined slip is in the linear range.
    pub(super) is_linear: bool,
    /// Combined slip of the slower side from lateral slip and the sides' difference, as computed by
    /// [`Self::check_slip`].
    pub(super) slip: f64,
    /// Geometric lateral slip of the slower side's wheels.
    slip_lateral: f64,
    /// Magnitude of the forward acceleration over gravity.
    longitudinal_mu: f64,
    /// Rim speed of the slower side, metres per second.
    slower_m_s: f64,
    /// `u_R − u_L − Wφ̇`, metres per second, and its variance.
    difference_m_s: f64,
    pub(super) difference_noise: f64,
    /// `(u_R + u_L)/2 − v`, metres per second, where body speed was new, and its variance.
    slip_m_s: Option<f64>,
    slip_noise: f64,
    is_steady: bool,
    /// `u_R − u_L`, metres per second, and its variance.
    pub(super) rim_difference_m_s: f64,
    rim_difference_noise: f64,
    /// `(u_R + u_L)/2`, metres per second.
    pub(super) rim_mean_m_s: f64,
    pub(super) force: Option<Force>,
    turning: Option<Row>,
    track_width_m: f64,
    /// `Wφ̇`, metres per second, and its variance.
    pub(super) turn_m_s: f64,
    pub(super) turn_noise: f64,
    /// Friction coefficient that the ground has given: of the side with the larger torque, combined
    /// with the lateral one, minus two standard deviations, at least 0.
    pub(super) mu_demonstrated: f64,
    pub(super) rolling_resistance: Option<ValueWithStdDev>,
}

impl Block {
    /// Checks whether the combined slip of the block is in the linear range, and sets
    /// [`Self::slip`].
    ///
    /// Lateral slip and the difference of the sides' longitudinal slip are measured without θ. The
    /// common longitudinal slip is θμ once θ is known. Before, it comes from the body speed if
    /// torque is measured; this is inaccurate, so the limit is tighter and a sliding robot is
    /// rejected. Without torque it is bounded by `theta_most`.
    pub(super) fn check_slip(&mut self, bound: &ThetaBound) {
        let turning = 0.5 * self.difference_m_s.abs() / self.slower_m_s;
        let most = SLIP_LINEAR_MAX.min(bound.slip_max);
        let (common, limit) = match (bound.theta, self.force) {
            (Some(theta), Some(force)) => {
                (theta * force.mean_m_s.abs() / self.rim_mean_m_s.abs(), most)
            }
            (None, Some(_)) => (
                self.slip_m_s.unwrap_or(0.0).abs() / self.slower_m_s,
                SLIP_LINEAR_FIRST_MAX.min(bound.slip_max),
            ),
            (_, None) => (bound.theta_most * self.longitudinal_mu, most),
        };
        // The accurate parts; `common` is an upper bound or inaccurate.
        self.slip = turning.hypot(self.slip_lateral);
        self.is_linear &= (turning + common).hypot(self.slip_lateral) < limit;
    }

    /// Returns the row of the sides' difference, from measured torques, or else from measured
    /// accelerations.
    pub(super) fn differential_row(&self) -> Option<Row> {
        let Some(force) = self.force else {
            return self.turning;
        };
        let mut regressors = Regressors::zeros();
        regressors[index::THETA] = force.difference_m_s;
        regressors[index::RADIUS_OFFSET] = self.rim_difference_m_s;
        regressors[index::RADIUS_DIFFERENCE] = self.rim_mean_m_s;
        regressors[index::GYRO_OFFSET] = -self.track_width_m;
        [
            regressors[index::CURVATURE],
            regressors[index::CURVATURE_SQUARE],
        ] = force.difference_curvature;
        regressors[index::RESISTANCE] = -self.rim_difference_m_s;
        regressors[index::RELAXATION] = force.rate.mu[1] - force.rate.mu[0];
        regressors[index::ROTORS] = -(force.rate.rim_m_s[1] - force.rate.rim_m_s[0]);
        regressors[index::LOADS] = 2.0 * force.mean_m_s;
        let mut common_noise = Regressors::zeros();
        common_noise[index::RADIUS_OFFSET] = self.rim_difference_noise;
        common_noise[index::RESISTANCE] = -self.rim_difference_noise;
        [
            common_noise[index::CURVATURE],
            common_noise[index::CURVATURE_SQUARE],
        ] = force.slip_noise;
        Some(Row {
            regressors,
            response: self.difference_m_s,
            innovation_variance: self.difference_noise,
            force_noise: force.difference_noise,
            curvature_ratio: [force.curvature_ratio[0], force.curvature_ratio[1], 0.0],
            common_noise,
            ramp_noise: 0.0,
            rate_noise: force.rate.difference_noise,
        })
    }

    /// Returns the row of the moment balance; `None` where torque is measured.
    pub(super) fn turning_row(&self) -> Option<Row> {
        self.turning.filter(|_| self.force.is_none())
    }

    /// Returns the row of the sides' mean, from measured torques and body speed; `None` without
    /// these or if the speed changed too much.
    pub(super) fn mean_row(&self) -> Option<Row> {
        let force = self.force?;
        let slip_m_s = self.slip_m_s.filter(|_| self.is_steady)?;
        let mut regressors = Regressors::zeros();
        regressors[index::THETA] = force.mean_m_s;
        regressors[index::RADIUS_OFFSET] = self.rim_mean_m_s;
        regressors[index::RADIUS_DIFFERENCE] = 0.25 * self.rim_difference_m_s;
        [
            regressors[index::CURVATURE],
            regressors[index::CURVATURE_SQUARE],
        ] = force.mean_curvature;
        regressors[index::RESISTANCE] = -self.rim_mean_m_s;
        regressors[index::RELAXATION] = 0.5 * (force.rate.mu[1] + force.rate.mu[0]);
        regressors[index::ROTORS] = -0.5 * (force.rate.rim_m_s[1] + force.rate.rim_m_s[0]);
        regressors[index::LOADS] = 0.5 * force.difference_m_s;
        Some(Row {
            regressors,
            response: slip_m_s,
            innovation_variance: self.slip_noise,
            force_noise: 0.25 * force.difference_noise,
            curvature_ratio: [force.curvature_ratio[0], force.curvature_ratio[1], 0.0],
            common_noise: Regressors::zeros(),
            ramp_noise: 0.0,
            rate_noise: 0.25 * force.rate.difference_noise,
        })
    }

    /// Returns twice the mean force on the sides, times rim speed, in metres per second.
    pub(super) fn mean_force_m_s(&self) -> f64 {
        self.force.map_or(
            2.0 * self.longitudinal_mu * self.rim_mean_m_s.abs(),
            |force| 2.0 * force.mean_m_s.abs(),
        )
    }
}

/// Sums over the samples of one block.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct BlockBuilder {
    duration_s: f64,
    samples: u32,
    with_torque: u32,
    with_acceleration: u32,
    with_body_speed: u32,
    usable: u32,
    left_m_s: f64,
    right_m_s: f64,
    first_m_s: f64,
    last_m_s: f64,
    gyro_rad_s: f64,
    left_mu: f64,
    right_mu: f64,
    left_force_m_s: f64,
    right_force_m_s: f64,
    lateral_m_s2: f64,
    forward_m_s2: f64,
    /// Sum of mean rim speed minus body speed, over samples with a new body speed.
    slip_m_s: f64,
    window: TurnWindow,
    ends: Ends,
}

/// Parameters with which a block is evaluated.
#[derive(Debug, Clone, Copy)]
pub(super) struct BlockContext<'robot> {
    pub(super) model: &'robot RobotModel,
    pub(super) noise: &'robot SensorNoise,
    /// Curvature of the tyres at this θ.
    pub(super) curvature: Curvature,
    /// Estimated `δ_d`.
    pub(super) radius_difference: f64,
    /// Estimated or assumed θ.
    pub(super) theta: f64,
}

impl BlockBuilder {
    /// Returns whether the block's time is over.
    pub(super) fn is_full(&self) -> bool {
        self.duration_s >= BLOCK_S - 1.0e-6
    }

    /// Returns whether half of the block's time is over.
    pub(super) fn is_half_full(&self) -> bool {
        self.duration_s >= 0.5 * BLOCK_S
    }

    /// Returns the builder of the next block, whose window began in this one.
    pub(super) fn next(&self) -> Self {
        Self {
            window: self.window.next(),
            ..Self::default()
        }
    }

    /// Adds a sample, `dt_s` seconds after the one before.
    pub(super) fn add(&mut self, sample: &SensorSample, model: &RobotModel, dt_s: f64) {
        let radius_m = model.wheel_radius_m();
        let left_m_s = sample.wheel_speeds.left_rad_s * radius_m;
        let right_m_s = sample.wheel_speeds.right_rad_s * radius_m;
        let span = SampleSpan {
            middle_s: self.duration_s + 0.5 * dt_s,
            dt_s,
        };
        self.window.add(sample, model, span);
        self.duration_s += dt_s;
        self.samples += 1;
        self.left_m_s += left_m_s;
        self.right_m_s += right_m_s;
        self.last_m_s = 0.5 * (left_m_s + right_m_s);
        if self.samples == 1 {
            self.first_m_s = self.last_m_s;
        }
        self.gyro_rad_s += sample.gyro_rad_s;
        if left_m_s.abs().min(right_m_s.abs()) > RIM_SPEED_MIN_M_S && left_m_s * right_m_s > 0.0 {
            self.usable += 1;
        }
        if let Some(torques) = sample.wheel_torques {
            let scale = 1.0 / (radius_m * model.side_load_n());
            let (left_mu, right_mu) = (torques.left_n_m * scale, torques.right_n_m * scale);
            self.with_torque += 1;
            let middle_s = self.duration_s - 0.5 * dt_s;
            if let Some(end) = Ends::of(SampleSpan { middle_s, dt_s }) {
                let sides = Sides {
                    mu: [left_mu, right_mu],
                    rim_m_s: [left_m_s, right_m_s],
                };
                self.ends.add(end, middle_s, sides);
            }
            self.left_mu += left_mu;
            self.right_mu += right_mu;
            self.left_force_m_s += left_mu * left_m_s.abs();
            self.right_force_m_s += right_mu * right_m_s.abs();
        }
        if let Some(acceleration) = sample.acceleration {
            self.with_acceleration += 1;
            self.lateral_m_s2 += acceleration.left_m_s2;
            self.forward_m_s2 += acceleration.forward_m_s2;
        }
        if let Some(body_m_s) = sample.body_speed_m_s {
            self.with_body_speed += 1;
            self.slip_m_s += 0.5 * (left_m_s + right_m_s) - body_m_s;
        }
    }

    /// Returns the means of the block; `None` if the robot was too slow or turned on the spot.
    pub(super) fn finish(&self, context: BlockContext<'_>) -> Option<Block> {
        let BlockContext { model, noise, .. } = context;
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
        // In the linear range longitudinal slip is about the geometric slip of a steady turn at
        // most, plus that of acceleration; the measured difference contains both.
        let difference_m_s = right_m_s - left_m_s - model.track_width_m() * gyro_rad_s;
        let slip = lateral.hypot(0.5 * difference_m_s.abs() / slower_m_s);
        let rim_noise_m_s = noise.wheel_speed_rad_s * model.wheel_radius_m();
        let has_acceleration = self.with_acceleration == self.samples;
        let longitudinal_mu = self.forward_m_s2 / count / GRAVITY_M_S2;
        let force = (self.with_torque == self.samples).then(|| self.force(&context));
        let turning = has_acceleration
            .then(|| self.window.means(self.duration_s))
            .flatten()
            .map(|means| turning_row(&means, context));
        let lateral_mu = if self.with_acceleration > 0 {
            self.lateral_m_s2 / f64::from(self.with_acceleration) / GRAVITY_M_S2
        } else {
            0.0
        };
        let side_mu = self.left_mu.abs().max(self.right_mu.abs()) / count;
        let mu_noise = 2.0 * (noise.torque_mu / count.sqrt()).hypot(0.01);
        let mean_mu = 0.5 * (self.left_mu + self.right_mu) / count;
        let resistance =
            (force.is_some() && has_acceleration && lateral < STRAIGHT_SLIP_MAX).then(|| {
                ValueWithStdDev {
                    value: (mean_mu - longitudinal_mu) * mean_m_s.signum(),
                    std_dev: (noise.torque_mu * std::f64::consts::FRAC_1_SQRT_2)
                        .hypot(noise.accelerometer_m_s2 / GRAVITY_M_S2)
                        / count.sqrt(),
                }
            });
        let body_samples = f64::from(self.with_body_speed);
        Some(Block {
            duration_s: self.duration_s,
            is_linear: slip < SLIP_LINEAR_MAX,
            slip,
            slip_lateral: lateral,
            longitudinal_mu: longitudinal_mu.abs(),
            slower_m_s,
            difference_m_s,
            difference_noise: (2.0 * rim_noise_m_s.powi(2)
                + (model.track_width_m() * noise.gyro_rad_s).powi(2))
                / count,
            slip_m_s: (self.with_body_speed > 0).then(|| self.slip_m_s / body_samples),
            slip_noise: (noise.body_speed_m_s.powi(2) + 0.5 * rim_noise_m_s.powi(2))
                / body_samples.max(1.0),
            is_steady: (self.last_m_s - self.first_m_s).abs()
                < STEADY_SHARE * mean_m_s.abs() + 4.0 * rim_noise_m_s,
            rim_difference_m_s: right_m_s - left_m_s,
            rim_difference_noise: 2.0 * rim_noise_m_s.powi(2) / count,
            rim_mean_m_s: mean_m_s,
            force,
            turning,
            track_width_m: model.track_width_m(),
            turn_m_s: model.track_width_m() * gyro_rad_s,
            turn_noise: (model.track_width_m() * noise.gyro_rad_s).powi(2) / count,
            mu_demonstrated: (side_mu.hypot(lateral_mu) - mu_noise).max(0.0),
            rolling_resistance: resistance,
        })
    }

    /// Computes the force regressors from torques; every sample must have one.
    fn force(&self, context: &BlockContext<'_>) -> Force {
        let BlockContext {
            model,
            noise,
            curvature,
            radius_difference,
            theta,
        } = *context;
        let count = f64::from(self.samples);
        let (left_m_s, right_m_s) = (self.left_m_s / count, self.right_m_s / count);
        let mean_m_s = 0.5 * (left_m_s + right_m_s);
        let left_force_m_s = self.left_force_m_s / count;
        let right_force_m_s = self.right_force_m_s / count;
        let mean_force_m_s = 0.5 * (right_force_m_s + left_force_m_s);
        let turn = Turn {
            rim_m_s: mean_m_s.abs(),
            rim_difference_m_s: right_m_s - left_m_s,
            yaw_rate_rad_s: self.gyro_rad_s / count,
            radius_difference: radius_difference * mean_m_s.signum(),
        };
        // Torques include rolling resistance, which is no contact force.
        let contact_m_s = if self.with_acceleration == self.samples {
            self.forward_m_s2 / count / GRAVITY_M_S2 * mean_m_s.abs()
        } else {
            mean_force_m_s
        };
        let rolling_m_s = mean_force_m_s - contact_m_s;
        let sides = SlipBySide::of(&turn, theta * contact_m_s / mean_m_s, model);
        // In reverse the model is that of the mirrored robot.
        let (left_slip, right_slip) = if mean_m_s < 0.0 {
            (sides.right, sides.left)
        } else {
            (sides.left, sides.right)
        };
        // Rim speeds and gyro determine both the slip and the response, so their noises correlate.
        let order = if mean_m_s < 0.0 { [1, 0] } else { [0, 1] };
        let left = ForceAtSlip {
            force_m_s: left_force_m_s - rolling_m_s,
            slip: left_slip,
        };
        let right = ForceAtSlip {
            force_m_s: right_force_m_s - rolling_m_s,
            slip: right_slip,
        };
        let unit = ForceAtSlip {
            force_m_s: 1.0,
            slip: sides.mean,
        };
        let rim_noise = 2.0 * (noise.wheel_speed_rad_s * model.wheel_radius_m()).powi(2) / count;
        let turn_noise = model.track_width_m() * noise.gyro_rad_s.powi(2) / count;
        let slip_noise = |curvature: f64| {
            let slopes = [
                -left.curvature_regressor_slope(curvature),
                right.curvature_regressor_slope(curvature),
            ];
            let longitudinal = |by: [f64; 2]| slopes[0] * by[order[0]] + slopes[1] * by[order[1]];
            longitudinal(sides.by_slip_difference) / mean_m_s.abs()
                * (rim_noise + model.track_width_m() * turn_noise)
                - longitudinal(sides.by_turn_s) * turn_noise
        };
        let curvatures = Curvatures::of(curvature);
        let nodes = curvatures.nodes();
        let of_curvature =
            nodes.map(|curvature| [left, right].map(|side| side.curvature_regressor(curvature)));
        Force {
            difference_m_s: right_force_m_s - left_force_m_s,
            mean_m_s: mean_force_m_s,
            difference_noise: noise.torque_mu.powi(2)
                * (left_m_s * left_m_s + right_m_s * right_m_s)
                / count,
            difference_curvature: curvatures.split(of_curvature.map(|[left, right]| right - left)),
            mean_curvature: curvatures
                .split(of_curvature.map(|[left, right]| 0.5 * (left + right))),
            curvature_ratio: curvatures
                .split(nodes.map(|curvature| unit.curvature_regressor(curvature))),
            slip_noise: curvatures.split(nodes.map(slip_noise)),
            rate: self.ends.rate(noise.torque_mu, [left_m_s, right_m_s]),
        }
    }
}

/// Returns the row of the moment balance, see [`super::window`].
fn turning_row(means: &TurnMeans, context: BlockContext<'_>) -> Row {
    let BlockContext {
        model,
        noise,
        curvature,
        radius_difference,
        theta,
    } = context;
    let track_m = model.track_width_m();
    // 4 I_G/(m g W), seconds squared.
    let inertia = 4.0 * model.yaw_inertia_kg_m2() / (model.mass_kg() * GRAVITY_M_S2 * track_m);
    // The known difference of radii corrects the rim speeds' difference where it multiplies θ.
    let force_m_s = inertia * means.harmonic_m_s * means.turn_acceleration_rad_s2
        + means.longitudinal_force_m_s
        - radius_difference * means.rim_mean_m_s * means.longitudinal_mu;
    let mut regressors = Regressors::zeros();
    regressors[index::RADIUS_OFFSET] = means.rim_difference_m_s;
    regressors[index::RADIUS_DIFFERENCE] = means.rim_mean_m_s;
    regressors[index::TRACK] = track_m * (model.effective_track_ratio() - 1.0) * means.turn_rad_s;
    regressors[index::GYRO_OFFSET] = -model.effective_track_m();
    regressors[index::LONGITUDINAL_OFFSET] = -theta * means.rim_difference_m_s / GRAVITY_M_S2;
    regressors[index::RELAXATION] = inertia * means.turn_jerk_rad_s3;
    let jerk_noise = (4.0 * inertia / means.duration_s.powi(2)).powi(2)
        * noise.gyro_rad_s.powi(2)
        * (2.0 / means.ramp_samples + 4.0 / means.middle_samples);
    // A side with more slip has less stiffness; this effect is odd in the turn rate.
    let rim_noise_m_s = noise.wheel_speed_rad_s * model.wheel_radius_m();
    let gyro_noise = noise.gyro_rad_s.powi(2);
    let turn = Turn {
        rim_m_s: means.harmonic_m_s,
        rim_difference_m_s: means.rim_difference_m_s,
        yaw_rate_rad_s: means.turn_rad_s,
        radius_difference: radius_difference * means.rim_mean_m_s.signum(),
    };
    // Control on noisy poses varies the slip within a window; remove the sensor noise from it.
    let variation = means.variation.without_noise(
        (2.0 * rim_noise_m_s.powi(2) + track_m * track_m * gyro_noise) / means.harmonic_m_s.powi(2),
    );
    regressors[index::THETA] = force_m_s;
    let gap = means.rim_difference_m_s / means.harmonic_m_s;
    let input = CurvatureInput {
        turn: &turn,
        variation: &variation,
        mu: MeanSlip {
            forward: means.longitudinal_mu,
            lateral: means.harmonic_m_s * means.turn_rad_s / GRAVITY_M_S2,
        },
        theta,
        force_m_s,
        uneven_m_s: |loss: &StiffnessLoss| {
            means.harmonic_m_s * (4.0 * loss.moment_m / track_m + gap * loss.forward)
        },
    };
    let (curvature_regressors, curvature_ratio) = input.regressors(model, curvature);
    curvature_regressors.write_to(&mut regressors);
    let difference_noise = 2.0 * rim_noise_m_s.powi(2) / means.samples;
    let mut common_noise = Regressors::zeros();
    common_noise[index::RADIUS_OFFSET] = difference_noise;
    common_noise[index::TRACK] =
        -track_m * (model.effective_track_ratio() - 1.0) * model.effective_track_m() * gyro_noise
            / means.samples;
    common_noise[index::LONGITUDINAL_OFFSET] = -theta * difference_noise / GRAVITY_M_S2;
    let ramp_noise = (inertia * means.harmonic_m_s / means.duration_s).powi(2) * 2.0 * gyro_noise
        / means.ramp_samples;
    Row {
        regressors,
        response: means.slip_m_s,
        innovation_variance: (2.0 * rim_noise_m_s.powi(2)
            + model.effective_track_m().powi(2) * gyro_noise)
            / means.samples,
        force_noise: ramp_noise
            + (means.rim_difference_m_s * noise.accelerometer_m_s2 / GRAVITY_M_S2).powi(2)
                / means.samples,
        curvature_ratio,
        common_noise,
        ramp_noise,
        rate_noise: jerk_noise,
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn the_rate_of_a_straight_rise_is_its_slope(
            samples in 8_u32..80, from in -0.5..0.5_f64, slope in -2.0..2.0_f64,
            rim in 0.2..2.0_f64,
        ) {
            let mut ends = Ends::default();
            let dt_s = BLOCK_S / f64::from(samples);
            for sample in 0..samples {
                let middle_s = (f64::from(sample) + 0.5) * dt_s;
                if let Some(end) = Ends::of(SampleSpan { middle_s, dt_s }) {
                    let mu = from + slope * middle_s;
                    let rim_m_s = [rim, rim + slope * middle_s];
                    ends.add(end, middle_s, Sides { mu: [mu, -mu], rim_m_s });
                }
            }
            let rate = ends.rate(0.01, [rim, rim]);
            prop_assert!((rate.mu[0] - slope).abs() < 1.0e-9);
            prop_assert!((rate.mu[1] + slope).abs() < 1.0e-9);
            prop_assert!(rate.rim_m_s[0].abs() < 1.0e-9);
            prop_assert!((rate.rim_m_s[1] - slope / GRAVITY_M_S2 * rim).abs() < 1.0e-9);
            prop_assert!(rate.difference_noise > 0.0);
        }
    }
}
