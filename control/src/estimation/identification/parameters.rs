//! Unknown parameters of a robot, its tyres and its ground, and their prior.

use nalgebra::{SMatrix, SVector};

use super::curve_prior::CurvePrior;
use super::dual::Dual;
use crate::estimation::{EstimatorPrior, SensorNoise};

/// Number of parameters.
pub(super) const PARAMETERS: usize = 29;
/// Number of parameters of the equations of motion and of the sensors' scales and offsets: all but
/// the delays, which are the last ones.
pub(super) const MODELLED: usize = 27;
/// Values of all parameters.
pub(super) type Values = SVector<f64, PARAMETERS>;
/// Covariance or information of all parameters.
pub(super) type Square = SMatrix<f64, PARAMETERS, PARAMETERS>;
/// Value with its derivatives with respect to the first [`MODELLED`] parameters.
pub(super) type Number = Dual<MODELLED>;

/// Where each parameter is in [`Values`].
pub(super) mod index {
    /// ln K, of the ground.
    pub(in super::super) const STIFFNESS: usize = 0;
    /// ln of the mass over that of the model.
    pub(in super::super) const MASS: usize = 1;
    /// ln of the yaw inertia over mass, over that of the model.
    pub(in super::super) const INERTIA: usize = 2;
    /// Centre of mass forward of the wheels' centre, over the wheelbase.
    pub(in super::super) const CENTRE_FORWARD: usize = 3;
    /// Centre of mass to the left of it, over the track.
    pub(in super::super) const CENTRE_LEFT: usize = 4;
    /// Square root of the relaxation length in metres.
    pub(in super::super) const RELAXATION: usize = 5;
    /// Slopes of the ground (rise per distance) along the axes of the frame in which identification
    /// began.
    pub(in super::super) const SLOPE_X: usize = 6;
    pub(in super::super) const SLOPE_Y: usize = 7;
    /// Relative error of the torque scale: mean of the sides, and half the difference right minus
    /// left.
    pub(in super::super) const TORQUE_SCALE: usize = 8;
    pub(in super::super) const TORQUE_DIFFERENCE: usize = 9;
    /// Inertia of rotors and wheels over the square of the wheel radius, relative to the model's
    /// mass.
    pub(in super::super) const ROTORS: usize = 10;
    /// Torque lost in the gears, relative to the transmitted torque.
    pub(in super::super) const GEAR_LOSS: usize = 11;
    /// Rolling resistance coefficient: torque that is lost in the tyres, over load and wheel radius.
    pub(in super::super) const RESISTANCE: usize = 12;
    /// Relative error of the rolling radius: mean, and difference right minus left.
    pub(in super::super) const RADIUS: usize = 13;
    pub(in super::super) const RADIUS_DIFFERENCE: usize = 14;
    /// ln of the friction coefficient `μ_p` that the curve approaches, of the ground.
    pub(in super::super) const PEAK: usize = 15;
    /// Shape of the friction curve of the ground: `1/n` and `a` of the module `model`.
    pub(in super::super) const SHAPE: usize = 16;
    pub(in super::super) const BEND: usize = 17;
    /// Offset of the gyro, radians per second.
    pub(in super::super) const GYRO_OFFSET: usize = 18;
    /// Offsets of the accelerometer, forward and left, metres per second squared.
    pub(in super::super) const FORWARD_OFFSET: usize = 19;
    pub(in super::super) const LEFT_OFFSET: usize = 20;
    /// Height of the centre of mass over the track.
    pub(in super::super) const HEIGHT: usize = 21;
    /// Offset of the measured body speed, metres per second.
    pub(in super::super) const SPEED_OFFSET: usize = 22;
    /// 0 for theoretical slip, which is relative to the rim speed, 1 for practical slip, which is
    /// relative to the forward speed of the wheel's centre; p of the module `model`.
    pub(in super::super) const PRACTICAL_SLIP: usize = 23;
    /// Decrease of the relaxation length with slip, q of the module `model`.
    pub(in super::super) const RELAXATION_DECREASE: usize = 24;
    /// Motion resistance coefficient: force of the ground against the wheels' motion, over their
    /// load.
    pub(in super::super) const MOTION_RESISTANCE: usize = 25;
    /// ln of the lateral stiffness of the tyres over the longitudinal one.
    pub(in super::super) const LATERAL_STIFFNESS: usize = 26;
    /// Delay of the gyro relative to the wheel speeds, and of the accelerometer relative to the
    /// gyro, seconds.
    pub(in super::super) const GYRO_DELAY: usize = 27;
    pub(in super::super) const ACCELEROMETER_DELAY: usize = 28;
}

/// Normal prior of the parameters at the start of a ground, in the units of [`index`].
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Prior {
    /// Mean.
    pub(super) mean: Values,
    /// Information matrix, the inverse of the covariance.
    pub(super) information: Square,
    /// Information matrix times mean: the prior's part of the right side of the normal equations.
    pub(super) information_vector: Values,
    /// Standard deviations of the initial prior, before any measurement. They scale the maximum
    /// step and the range of each parameter.
    pub(super) std_devs: Values,
    /// Mean of the initial prior, the middle of each parameter's range.
    pub(super) first_mean: Values,
    /// Standard deviation of the bend that intervals assume.
    pub(super) interval_bend_std_dev: f64,
    /// Maximum distance of each parameter from its first mean.
    pub(super) ranges: Values,
    /// Variance by which the gyro's offset changes in a second, (rad/s)²/s.
    pub(super) gyro_walk: f64,
}

impl Prior {
    /// Resets to the initial prior of independent parameters.
    pub(super) fn reset(&mut self) {
        let information = Square::from_diagonal(&self.std_devs.map(|std_dev| std_dev.powi(-2)));
        let mean = self.first_mean;
        self.set(&mean, &information);
    }

    /// Replaces mean and information matrix.
    pub(super) fn set(&mut self, mean: &Values, information: &Square) {
        self.mean = *mean;
        self.information = *information;
        self.information_vector = information * mean;
    }

    /// Assumes tyres that are as stiff to the side as along the wheel and do not relax at once, and a gyro
    /// that does not drift, where noise of the wheel speeds leaves too little information to tell them from
    /// K; [`Self::reset`] applies it.
    pub(super) fn assume_usual_tyres_and_constant_offset(&mut self) {
        self.std_devs[index::LATERAL_STIFFNESS] = STD_DEV_MIN;
        let relaxation = &mut self.std_devs[index::RELAXATION];
        *relaxation = relaxation.min(RELAXATION_ROOT_STD_DEV_WITH_NOISE);
        self.gyro_walk = 0.0;
    }

    /// Returns the variance that the prior of the tyres' parameters [`OF_TYRES`] contributes to a
    /// parameter with these posterior covariances with all parameters. On each ground they start
    /// from the initial prior, in which they are independent.
    pub(super) fn tyre_variance(&self, covariances: &Values) -> f64 {
        let contributed = |place: usize| (covariances[place] / self.std_devs[place]).powi(2);
        OF_TYRES.into_iter().map(contributed).sum()
    }

    /// Limits parameters to their ranges.
    pub(super) fn in_range(&self, mut values: Values) -> Values {
        for place in 0..PARAMETERS {
            let most = self.ranges[place];
            let mean = self.first_mean[place];
            values[place] = values[place].clamp(mean - most, mean + most);
        }
        for (place, least, most) in LIMITS {
            values[place] = values[place].clamp(least, most);
        }
        values
    }

    /// Returns the solution of normal equations under the limits [`LIMITS`], given the solution
    /// `values` without them and a function that multiplies by the covariance matrix.
    ///
    /// A parameter beyond its limit is set to it, and all others to their conditional means, so
    /// that they stay the best fit with the values that are used. Parameters are limited one after
    /// the other, the farthest one first.
    pub(super) fn limited(
        &self,
        mut values: Values,
        covariance_times: impl Fn(&Values) -> Values,
    ) -> Values {
        let mut limited: [Option<(usize, Values)>; LIMITS.len()] = [const { None }; LIMITS.len()];
        for number in 0..LIMITS.len() {
            let is_free = |place: usize| limited.iter().flatten().all(|(own, _)| *own != place);
            let beyond = |(place, least, most): (usize, f64, f64)| {
                let at = values[place].clamp(least, most);
                (place, at, (values[place] - at).abs() / self.std_devs[place])
            };
            let free = LIMITS.into_iter().filter(|(place, ..)| is_free(*place));
            let farthest = free.map(beyond).max_by(|a, b| a.2.total_cmp(&b.2));
            let Some((place, at, _)) = farthest.filter(|(.., beyond)| *beyond > 0.0) else {
                break;
            };
            let mut gradient = Values::zeros();
            gradient[place] = 1.0;
            let mut covariances = covariance_times(&gradient);
            for (other, of_other) in limited.iter().flatten() {
                let ratio = covariances[*other] / of_other[*other];
                covariances.axpy(-ratio, of_other, 1.0);
            }
            if covariances[place] <= 0.0 {
                break;
            }
            values.axpy((at - values[place]) / covariances[place], &covariances, 1.0);
            values[place] = at;
            limited[number] = Some((place, covariances));
        }
        values
    }
}

/// Parameters with limits besides the range of their prior: minimum and maximum.
const LIMITS: [(usize, f64, f64); 5] = [
    (index::RELAXATION, RELAXATION_ROOT_MIN, f64::INFINITY),
    (index::SHAPE, SHAPE_MIN, f64::INFINITY),
    (index::BEND, 0.0, f64::INFINITY),
    (index::PRACTICAL_SLIP, 0.0, 1.0),
    (index::RELAXATION_DECREASE, 0.0, RELAXATION_DECREASE_MAX),
];

/// Parameters of the tyres that start from the initial prior on each ground: the friction curve,
/// the speed that slip is relative to, and the decrease of the relaxation length. All robots with
/// the same tyres share the errors of their priors.
pub(super) const OF_TYRES: [usize; 6] = [
    index::PEAK,
    index::SHAPE,
    index::BEND,
    index::PRACTICAL_SLIP,
    index::RELAXATION_DECREASE,
    index::LATERAL_STIFFNESS,
];

/// Parameters of the ground and of its contacts with the tyres. They start from the initial
/// prior on new ground.
pub(super) const OF_GROUND: [usize; 11] = [
    index::STIFFNESS,
    index::RESISTANCE,
    index::MOTION_RESISTANCE,
    index::PEAK,
    index::SHAPE,
    index::BEND,
    index::PRACTICAL_SLIP,
    index::RELAXATION_DECREASE,
    index::LATERAL_STIFFNESS,
    index::SLOPE_X,
    index::SLOPE_Y,
];

/// Parameters of the load and the ground. Both are reset with a new load, because the friction
/// curve of the tyres after a stop that is long enough for loading may differ.
pub(super) const OF_LOAD_AND_GROUND: [usize; 16] = [
    index::MASS,
    index::INERTIA,
    index::CENTRE_FORWARD,
    index::CENTRE_LEFT,
    index::HEIGHT,
    index::STIFFNESS,
    index::RESISTANCE,
    index::MOTION_RESISTANCE,
    index::PEAK,
    index::SHAPE,
    index::BEND,
    index::PRACTICAL_SLIP,
    index::RELAXATION_DECREASE,
    index::LATERAL_STIFFNESS,
    index::SLOPE_X,
    index::SLOPE_Y,
];

/// Mean and standard deviation of ln K: ground from wet ice to asphalt.
const LN_STIFFNESS: (f64, f64) = (1.1, 2.0);
/// Mean and standard deviation of the curve's `1/n`.
const SHAPE: (f64, f64) = (0.3, 0.2);
/// Mean and standard deviation of the part of practical slip.
const PRACTICAL_SLIP: (f64, f64) = (0.25, 0.35);
/// Minimum of the relaxation length's square root: with 1 mm the contacts' forces follow slip at once.
const RELAXATION_ROOT_MIN: f64 = 0.0316;
/// Maximum standard deviation of it where noise of the wheel speeds is subtracted: contacts that relax at
/// once would pass that noise to the accelerations.
const RELAXATION_ROOT_STD_DEV_WITH_NOISE: f64 = 0.06;
/// Mean, standard deviation and maximum of the relaxation length's decrease.
const RELAXATION_DECREASE: (f64, f64) = (0.3, 0.35);
const RELAXATION_DECREASE_MAX: f64 = 1.5;
/// Minimum of `1/n`, at which the curve is practically straight up to its peak.
pub(super) const SHAPE_MIN: f64 = 0.05;
/// Standard deviation of the centre of mass's forward position, relative to the wheelbase.
const CENTRE_FORWARD_STD_DEV: f64 = 0.03;
/// Mean and standard deviation of the centre of mass's height, relative to the track width.
const HEIGHT: (f64, f64) = (0.35, 0.1);
/// Standard deviation of the ground's slope along one axis.
const SLOPE_STD_DEV: f64 = 0.035;
/// Standard deviation of the torque scale's mean over both sides, relative to the configured
/// standard deviation of one side.
const TORQUE_SCALE_RATIO: f64 = 1.75;
/// Mean and standard deviation of the gear loss, relative to the transmitted torque.
const GEAR_LOSS: (f64, f64) = (0.025, 0.025);
/// Means and standard deviations of the coefficients of rolling resistance and of motion resistance. The
/// second one may be below 0, where slip at no force was taken for a smaller rolling radius.
const RESISTANCE: (f64, f64) = (0.035, 0.025);
const MOTION_RESISTANCE: (f64, f64) = (0.0, 0.015);
/// Standard deviation of an offset of the body speed, metres per second.
const SPEED_OFFSET_STD_DEV: f64 = 0.005;
/// Standard deviations of the gyro's delay relative to the wheel speeds, and of the accelerometer's
/// relative to the gyro's, seconds. Filters, the periods of differences, buses and time stamps of
/// reception delay all of them.
const GYRO_DELAY_STD_DEV_S: f64 = 0.015;
const ACCELEROMETER_DELAY_STD_DEV_S: f64 = 0.010;
/// Range in which parameters stay, in standard deviations of their initial prior and of their random walk
/// together.
pub(super) const PRIOR_RANGE: f64 = 5.0;
/// Minimum standard deviation, used where the configuration gives 0.
pub(super) const STD_DEV_MIN: f64 = 1.0e-4;

/// Returns the gradient of ln K with respect to the parameters.
pub(super) fn ln_stiffness_gradient() -> Values {
    let mut stiffness = Values::zeros();
    stiffness[index::STIFFNESS] = 1.0;
    stiffness
}

/// Returns the initial prior, before any measurement.
pub(super) fn prior(prior: &EstimatorPrior, noise: &SensorNoise) -> Prior {
    let tyres = &prior.tyres;
    let curve = CurvePrior::of(tyres);
    let payload = 1.0 + prior.model.payload_ratio;
    // To first order; so that the mean of the squares is the configured one.
    let root_std_dev = 0.5 * tyres.relaxation_std_dev_m / tyres.relaxation_m.sqrt();
    let root_mean = (tyres.relaxation_m - root_std_dev.powi(2)).max(0.0).sqrt();
    let side = noise.torque_gain_ratio * std::f64::consts::FRAC_1_SQRT_2;
    let table = [
        (index::STIFFNESS, LN_STIFFNESS),
        (
            index::MASS,
            (payload.ln(), prior.model.mass_ratio / payload),
        ),
        (index::INERTIA, (0.0, prior.model.inertia_ratio)),
        (index::CENTRE_FORWARD, (0.0, CENTRE_FORWARD_STD_DEV)),
        // Loads of the sides differ by twice the offset over the track.
        (
            index::CENTRE_LEFT,
            (0.0, 0.5 * tyres.load_difference_std_dev),
        ),
        (index::RELAXATION, (root_mean, root_std_dev)),
        (index::SLOPE_X, (0.0, SLOPE_STD_DEV)),
        (index::SLOPE_Y, (0.0, SLOPE_STD_DEV)),
        (
            index::TORQUE_SCALE,
            (0.0, TORQUE_SCALE_RATIO * noise.torque_gain_ratio),
        ),
        (index::TORQUE_DIFFERENCE, (0.0, side)),
        (
            index::ROTORS,
            (tyres.rotor_ratio, tyres.rotor_std_dev_ratio),
        ),
        (index::GEAR_LOSS, GEAR_LOSS),
        (index::RESISTANCE, RESISTANCE),
        (index::MOTION_RESISTANCE, MOTION_RESISTANCE),
        (
            index::RADIUS,
            (0.0, noise.radius_ratio * std::f64::consts::FRAC_1_SQRT_2),
        ),
        (
            index::RADIUS_DIFFERENCE,
            (0.0, noise.radius_ratio * std::f64::consts::SQRT_2),
        ),
        (index::PEAK, curve.peak),
        (index::SHAPE, SHAPE),
        (index::BEND, curve.bend),
        (index::PRACTICAL_SLIP, PRACTICAL_SLIP),
        (index::RELAXATION_DECREASE, RELAXATION_DECREASE),
        (
            index::LATERAL_STIFFNESS,
            (0.0, tyres.lateral_stiffness_std_dev),
        ),
        (index::GYRO_OFFSET, (0.0, noise.gyro_offset_rad_s)),
        (
            index::FORWARD_OFFSET,
            (0.0, noise.accelerometer_offset_m_s2),
        ),
        (index::LEFT_OFFSET, (0.0, noise.accelerometer_offset_m_s2)),
        (index::HEIGHT, HEIGHT),
        (index::SPEED_OFFSET, (0.0, SPEED_OFFSET_STD_DEV)),
        (index::GYRO_DELAY, (0.0, GYRO_DELAY_STD_DEV_S)),
        (
            index::ACCELEROMETER_DELAY,
            (0.0, ACCELEROMETER_DELAY_STD_DEV_S),
        ),
    ];
    let mut initial = Prior {
        mean: Values::zeros(),
        information: Square::zeros(),
        information_vector: Values::zeros(),
        std_devs: Values::zeros(),
        first_mean: Values::zeros(),
        ranges: Values::zeros(),
        interval_bend_std_dev: curve.interval_bend_std_dev,
        gyro_walk: noise.gyro_offset_walk.powi(2),
    };
    for (place, (mean, std_dev)) in table {
        initial.first_mean[place] = mean;
        initial.std_devs[place] = std_dev.max(STD_DEV_MIN);
        initial.ranges[place] = PRIOR_RANGE * initial.std_devs[place];
    }
    initial.reset();
    initial
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn limits_hold_and_all_other_parameters_are_the_best_ones_with_them(
            off in proptest::collection::vec(-3.0..3.0, PARAMETERS),
            rows in proptest::collection::vec(-2.0..2.0, 3 * PARAMETERS),
        ) {
            let prior = prior(&EstimatorPrior::default(), &SensorNoise::default());
            let mut information = prior.information;
            for row in rows.chunks(PARAMETERS) {
                let slopes = Values::from_column_slice(row).component_div(&prior.std_devs);
                information.ger(1.0, &slopes, &slopes, 1.0);
            }
            let free = prior.mean + Values::from_column_slice(&off).component_mul(&prior.std_devs);
            let cholesky = information.cholesky().expect("it has the prior");
            let limited = prior.limited(free, |gradient| cholesky.solve(gradient));
            for (place, least, most) in LIMITS {
                let slack = 1.0e-6 * prior.std_devs[place];
                prop_assert!(limited[place] >= least - slack && limited[place] <= most + slack);
            }
            // The gradient of the cost vanishes but at a limit, where the cost falls beyond it.
            let gradient = (information * (limited - free)).component_mul(&prior.std_devs);
            for place in 0..PARAMETERS {
                let limits = LIMITS.iter().find(|(own, ..)| *own == place);
                let slack = 1.0e-6 * prior.std_devs[place];
                let is_at = |limit: f64| (limited[place] - limit).abs() < slack;
                let is_least = limits.is_some_and(|(_, least, _)| is_at(*least));
                let is_most = limits.is_some_and(|(.., most)| is_at(*most));
                prop_assert!(is_least || gradient[place] < 1.0e-6, "{place}: {}", gradient[place]);
                prop_assert!(is_most || gradient[place] > -1.0e-6, "{place}: {}", gradient[place]);
            }
            let inside = prior.in_range(prior.mean);
            prop_assert_eq!(prior.limited(inside, |gradient| cholesky.solve(gradient)), inside);
        }
    }
}
