//! Computes the Bayesian Cramér–Rao bound of ln θ for one drive: the smallest standard deviation
//! that any estimator can have.
//!
//! The bound assumes an observer that uses the equations of [`super::plant`], the noise of the
//! sensors, and the distributions from which robots are drawn, and estimates all parameters of
//! robot and ground together. It is the inverse of `Σ (∂y/∂p)ᵀ R⁻¹ (∂y/∂p) + C⁻¹`, with the
//! measurements y, the covariance R of their noise, the parameters p and the covariance C of their
//! distribution (Van Trees, Detection, Estimation, and Modulation Theory, 1968, part I, 2.4.3).
//! Derivatives are finite differences between drives with the same wheel speeds: the observer does
//! not know the servo and its motors, and the encoders' error is neglected. Offsets that drift are
//! piecewise constant. The shape of the friction curve is a mixture of all shapes.

use nalgebra::{DMatrix, DVector};
use tread_control::geometry::Pose;
use tread_control::measured::WheelSpeeds;
use tread_control::robot::{GRAVITY_M_S2, RobotModel};

use super::curve::Shape;
use super::plant::{Plant, STEP_S};
use super::sensors::{POSITION_WANDERS_S, SAMPLE_PERIOD, SensorSpec};
use super::spec::Deviations;

/// Step of a finite difference, relative to the standard deviation of the parameter.
const STEP_RATIO: f64 = 0.02;
/// Length of the intervals in which the gyro's offset is constant, in seconds.
const GYRO_KNOT_S: f64 = 5.0;
/// Length of the intervals in which the slow error of positions is constant, in seconds.
const POSITION_KNOT_S: f64 = 10.0;
/// Standard deviation of a robot's start pose, in metres and radians.
const START_STD_DEV: f64 = 1.0;

/// Number of measurements of one sample: turn rate, acceleration (2), torque (2), speed, pose (3).
const CHANNELS: usize = 9;
type Sample = [f64; CHANNELS];

/// A parameter of the plant: its standard deviation, and the function that changes it by an amount.
type Parameter = (f64, fn(&mut Deviations, f64));

/// Parameters with the standard deviations of [`Deviations::drawn`]; that of a uniform distribution
/// is its range over √12.
const PARAMETERS: [Parameter; 19] = [
    // ln K over three grounds; it must be the first parameter.
    (1.16, |robot, by| robot.curve.stiffness *= by.exp()),
    (0.0866, |robot, by| robot.payload_ratio += by),
    (0.13, |robot, by| robot.inertia_ratio += by),
    (0.0289, |robot, by| robot.center_forward_ratio += by),
    (0.0173, |robot, by| robot.center_left_ratio += by),
    (0.0866, |robot, by| robot.center_height_ratio += by),
    (0.665, |robot, by| robot.relaxation_m *= by.exp()),
    (0.0349, |robot, by| robot.slope_rad[0] += by),
    (0.0349, |robot, by| robot.slope_rad[1] += by),
    (0.03, |robot, by| {
        for scale in &mut robot.torque_scale {
            *scale *= 1.0 + by;
        }
    }),
    (0.02, |robot, by| robot.torque_scale[0] += by),
    (0.02, |robot, by| robot.torque_scale[1] += by),
    (0.026, |robot, by| robot.rotor_ratio += by),
    (0.0087, |robot, by| robot.gear_loss_ratio += by),
    (0.0087, |robot, by| robot.rolling_resistance_ratio += by),
    (0.005, |robot, by| robot.radius_ratio[0] += by),
    (0.005, |robot, by| robot.radius_ratio[1] += by),
    (0.173, |robot, by| robot.curve.mu_peak += by),
    (0.13, |robot, by| {
        robot.lateral_stiffness_ratio *= by.exp();
    }),
];
/// Number of shapes other than the robot's own.
const OTHERS: usize = Shape::ALL.len() - 1;

/// Indices at which the groups of nuisance parameters begin, and the number of all parameters.
struct Layout {
    gyro: usize,
    acceleration: usize,
    start: usize,
    wander: [usize; 2],
    len: usize,
}

impl Layout {
    fn of(duration_s: f64) -> Self {
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "a minute over some seconds"
        )]
        let knots = |knot_s: f64| (duration_s / knot_s).floor() as usize + 1;
        let gyro = PARAMETERS.len() + OTHERS;
        let acceleration = gyro + knots(GYRO_KNOT_S);
        let start = acceleration + 2;
        let first = start + 3;
        let second = first + knots(POSITION_KNOT_S);
        Self {
            gyro,
            acceleration,
            start,
            wander: [first, second],
            len: second + knots(POSITION_KNOT_S),
        }
    }
}

/// Input of [`bounds`]: a robot, its sensors and its drive.
#[derive(Debug, Clone, Copy)]
pub struct BoundInput<'drive> {
    /// Agent's model of the robot.
    pub model: &'drive RobotModel,
    /// True parameters of robot and ground.
    pub deviations: Deviations,
    /// Specification of the sensors.
    pub sensors: SensorSpec,
    /// Commanded wheel speeds of each sample; the robot starts at rest at the origin.
    pub commands: &'drive [WheelSpeeds],
    /// Numbers of samples after which the bound is computed, ascending.
    pub at_samples: &'drive [usize],
}

/// Returns the lower bound of the standard deviation of ln θ at each time of `at_samples`; `None`
/// if the plant cannot be constructed or the information matrix is singular.
pub fn bounds(input: &BoundInput<'_>) -> Option<Vec<f64>> {
    let wheels = wheels(input)?;
    let truth = measure(input, &wheels, input.deviations, None)?;
    let derivative = |moved: &[Sample], step: f64| -> Vec<Sample> {
        let pairs = truth.iter().zip(moved);
        pairs
            .map(|(from, to)| std::array::from_fn(|channel| (to[channel] - from[channel]) / step))
            .collect()
    };
    let mut columns = Vec::with_capacity(PARAMETERS.len() + OTHERS);
    for (std_dev, change) in PARAMETERS {
        let step = STEP_RATIO * std_dev;
        let mut deviations = input.deviations;
        change(&mut deviations, step);
        let moved = measure(input, &wheels, deviations, None)?;
        columns.push(derivative(&moved, step));
    }
    let others = Shape::ALL.into_iter();
    for shape in others.filter(|shape| *shape != input.deviations.curve.shape) {
        let moved = measure(input, &wheels, input.deviations, Some((shape, STEP_RATIO)))?;
        columns.push(derivative(&moved, STEP_RATIO));
    }
    information(input, &truth, &columns)
}

/// Returns the wheel speeds `[left, right]` after each integration step, by sample, in rad/s.
fn wheels(input: &BoundInput<'_>) -> Option<Vec<Vec<[f64; 2]>>> {
    let mut plant = Plant::new(input.model, input.deviations, Pose::default())?;
    let steps = steps_per_sample();
    let of_sample = |command: &WheelSpeeds| {
        let step = |_| {
            plant.advance(*command, 1);
            plant.wheels_rad_s()
        };
        (0..steps).map(step).collect()
    };
    Some(input.commands.iter().map(of_sample).collect())
}

#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "a small whole number"
)]
fn steps_per_sample() -> usize {
    (SAMPLE_PERIOD.as_secs_f64() / STEP_S).round() as usize
}

/// Returns the noise-free measurements of a robot with these wheel speeds. `blend` replaces a
/// fraction of the friction by that of another shape.
fn measure(
    input: &BoundInput<'_>,
    wheels: &[Vec<[f64; 2]>],
    deviations: Deviations,
    blend: Option<(Shape, f64)>,
) -> Option<Vec<Sample>> {
    let mut plant = Plant::new(input.model, deviations, Pose::default())?;
    if let Some((shape, share)) = blend {
        plant = plant.with_blend(shape, share);
    }
    let mut heading_rad = 0.0;
    let of_sample = |wheels: &Vec<[f64; 2]>| {
        let means = plant.advance_along(wheels);
        let state = plant.state();
        // Unwrapped heading, without jumps at ±π.
        heading_rad += means.yaw_rate_rad_s * SAMPLE_PERIOD.as_secs_f64();
        let [left, right] = deviations.torque_scale;
        [
            means.yaw_rate_rad_s,
            means.acceleration.forward_m_s2,
            means.acceleration.left_m_s2,
            left * means.torques.left_n_m,
            right * means.torques.right_n_m,
            state.forward_m_s,
            state.pose.x_m,
            state.pose.y_m,
            heading_rad,
        ]
    };
    Some(wheels.iter().map(of_sample).collect())
}

/// Returns the covariance of all parameters before the drive.
fn prior(sensors: &SensorSpec, layout: &Layout) -> DMatrix<f64> {
    let mut covariance = DMatrix::zeros(layout.len, layout.len);
    for (index, (std_dev, _)) in PARAMETERS.iter().enumerate() {
        covariance[(index, index)] = std_dev.powi(2);
    }
    // Indicator variables of equally likely shapes.
    #[expect(clippy::cast_precision_loss, reason = "four shapes")]
    let likely = 1.0 / Shape::ALL.len() as f64;
    let shapes = PARAMETERS.len()..PARAMETERS.len() + OTHERS;
    for row in shapes.clone() {
        for column in shapes.clone() {
            let own = if row == column { likely } else { 0.0 };
            covariance[(row, column)] = own - likely * likely;
        }
    }
    #[expect(clippy::cast_precision_loss, reason = "some knots")]
    let time = |from: usize, to: usize, knot_s: f64| (to - from) as f64 * knot_s;
    for row in layout.gyro..layout.acceleration {
        for column in layout.gyro..layout.acceleration {
            let walked_s = time(layout.gyro, row.min(column), GYRO_KNOT_S);
            covariance[(row, column)] =
                sensors.gyro_offset_rad_s.powi(2) + sensors.gyro_walk_rad_s.powi(2) * walked_s;
        }
    }
    for index in layout.acceleration..layout.start {
        covariance[(index, index)] = sensors.acceleration_offset_m_s2.powi(2);
    }
    for index in layout.start..layout.wander[0] {
        covariance[(index, index)] = START_STD_DEV.powi(2);
    }
    for knots in [
        layout.wander[0]..layout.wander[1],
        layout.wander[1]..layout.len,
    ] {
        for row in knots.clone() {
            for column in knots.clone() {
                let apart_s = time(row.min(column), row.max(column), POSITION_KNOT_S);
                covariance[(row, column)] =
                    sensors.position_wander_m.powi(2) * (-apart_s / POSITION_WANDERS_S).exp();
            }
        }
    }
    covariance
}

/// Accumulates the information of the samples, and returns the standard deviation of ln θ at the
/// requested times.
fn information(
    input: &BoundInput<'_>,
    truth: &[Sample],
    columns: &[Vec<Sample>],
) -> Option<Vec<f64>> {
    let (sensors, period_s) = (&input.sensors, SAMPLE_PERIOD.as_secs_f64());
    #[expect(clippy::cast_precision_loss, reason = "samples of a minute")]
    let layout = Layout::of(truth.len() as f64 * period_s);
    let mut information = prior(sensors, &layout).cholesky()?.inverse();
    let torque_n_m = sensors.torque_mu
        * 0.5
        * input.model.mass_kg()
        * GRAVITY_M_S2
        * input.model.wheel_radius_m();
    let noise = [
        sensors.gyro_rad_s,
        sensors.acceleration_m_s2,
        sensors.acceleration_m_s2,
        torque_n_m,
        torque_n_m,
        sensors.body_speed_m_s,
        sensors.position_m,
        sensors.position_m,
        sensors.heading_rad,
    ];
    let mut found = Vec::with_capacity(input.at_samples.len());
    let mut wanted = input.at_samples.iter().peekable();
    let mut row = DVector::zeros(layout.len);
    for (index, sample) in truth.iter().enumerate() {
        for channel in 0..CHANNELS {
            let is_new = match channel {
                3 | 4 => sensors.has_torque,
                5 => is_due(index, sensors.body_speed_period),
                6.. => is_due(index, sensors.position_period),
                _ => true,
            };
            if !is_new {
                continue;
            }
            row.fill(0.0);
            for (place, column) in row.iter_mut().zip(columns) {
                *place = column[index][channel];
            }
            nuisances(&mut row, &layout, channel, (index, sample));
            information.ger(noise[channel].powi(-2), &row, &row, 1.0);
        }
        while wanted.next_if(|wanted| **wanted == index + 1).is_some() {
            // ln θ = −ln K.
            let covariance = information.clone().cholesky()?.inverse();
            found.push(covariance[(0, 0)].sqrt());
        }
    }
    Some(found)
}

fn is_due(sample: usize, period: std::time::Duration) -> bool {
    let every = (period.as_nanos() / SAMPLE_PERIOD.as_nanos()).max(1);
    (sample as u128).is_multiple_of(every)
}

/// Sets the derivatives of a channel with respect to sensor offsets and start pose.
fn nuisances(
    row: &mut DVector<f64>,
    layout: &Layout,
    channel: usize,
    (index, sample): (usize, &Sample),
) {
    #[expect(
        clippy::cast_precision_loss,
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "knots of a minute"
    )]
    let knot = |knot_s: f64| (index as f64 * SAMPLE_PERIOD.as_secs_f64() / knot_s) as usize;
    match channel {
        0 => row[layout.gyro + knot(GYRO_KNOT_S)] = 1.0,
        1 | 2 => row[layout.acceleration + channel - 1] = 1.0,
        6 => {
            row[layout.start] = 1.0;
            row[layout.start + 2] = -sample[7];
            row[layout.wander[0] + knot(POSITION_KNOT_S)] = 1.0;
        }
        7 => {
            row[layout.start + 1] = 1.0;
            row[layout.start + 2] = sample[6];
            row[layout.wander[1] + knot(POSITION_KNOT_S)] = 1.0;
        }
        8 => row[layout.start + 2] = 1.0,
        _ => {}
    }
}
