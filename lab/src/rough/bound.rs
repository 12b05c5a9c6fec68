//! How well θ could be known: the Bayesian Cramér–Rao bound of one drive.
//!
//! An observer that knows the equations of [`super::plant`], the noise of the sensors, and the
//! distributions from which robots are drawn, estimates all parameters of the robot and its ground
//! at once. The bound is the inverse of `Σ (∂y/∂p)ᵀ R⁻¹ (∂y/∂p) + C⁻¹`: y are the measurements, R
//! their noise, p the parameters and C the covariance of their distribution (Van Trees, Detection,
//! Estimation, and Modulation Theory, 1968, part I, 2.4.3). Derivatives are finite differences of
//! drives whose wheels turn as they did: the servo and its motors are unknown to the observer, and
//! the encoders' error is neglected. Offsets that walk or wander are piecewise constant. A curve's
//! shape counts as a mixture of all of them.

use nalgebra::{DMatrix, DVector};
use tread_control::geometry::Pose;
use tread_control::measured::WheelSpeeds;
use tread_control::robot::{GRAVITY_M_S2, RobotModel};

use super::curve::Shape;
use super::plant::{Plant, STEP_S};
use super::sensors::{POSITION_WANDERS_S, SAMPLE_PERIOD, SensorSpec};
use super::spec::Deviations;

/// Step of a finite difference over a parameter's standard deviation.
const STEP_RATIO: f64 = 0.02;
/// Time over which the gyro's offset counts as constant, seconds.
const GYRO_KNOT_S: f64 = 5.0;
/// Time over which the slow error of positions counts as constant, seconds.
const POSITION_KNOT_S: f64 = 10.0;
/// Standard deviation of where a robot starts, metres and radians.
const START_STD_DEV: f64 = 1.0;

/// Measurements of one sample: turn rate, acceleration (2), torque (2), speed, pose (3).
const CHANNELS: usize = 9;
type Sample = [f64; CHANNELS];

/// A parameter of the plant: standard deviation, and what a change of it changes.
type Parameter = (f64, fn(&mut Deviations, f64));

/// Standard deviations of [`Deviations::drawn`]; of a uniform distribution that is its range over
/// √12.
const PARAMETERS: [Parameter; 18] = [
    // ln K, of three grounds; it must be the first.
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
];
/// Shapes beside a robot's own.
const OTHERS: usize = Shape::ALL.len() - 1;

/// Where each kind of nuisance begins among the parameters.
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

/// What is bounded: a robot, its sensors, and how it drove.
#[derive(Debug, Clone, Copy)]
pub struct BoundInput<'drive> {
    /// The agent's model of it.
    pub model: &'drive RobotModel,
    /// What it truly is.
    pub deviations: Deviations,
    /// What it is measured with.
    pub sensors: SensorSpec,
    /// The commanded wheel speeds of each sample, from rest at the origin.
    pub commands: &'drive [WheelSpeeds],
    /// After how many samples the bound is asked for, in rising order.
    pub at_samples: &'drive [usize],
}

/// Lower bounds of the standard deviation of ln θ at each of the times; none if the plant cannot be.
pub fn bounds(input: &BoundInput<'_>) -> Option<Vec<f64>> {
    let wheels = wheels(input)?;
    let truth = measure(input, &wheels, input.deviations, None)?;
    let mut columns = Vec::with_capacity(PARAMETERS.len() + OTHERS);
    for (std_dev, change) in PARAMETERS {
        let step = STEP_RATIO * std_dev;
        let mut deviations = input.deviations;
        change(&mut deviations, step);
        let moved = measure(input, &wheels, deviations, None)?;
        columns.push(derivative(&truth, &moved, step));
    }
    let others = Shape::ALL.into_iter();
    for shape in others.filter(|shape| *shape != input.deviations.curve.shape) {
        let moved = measure(input, &wheels, input.deviations, Some((shape, STEP_RATIO)))?;
        columns.push(derivative(&truth, &moved, STEP_RATIO));
    }
    information(input, &truth, &columns)
}

/// The wheels' speeds after each step of the plant.
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

/// Noise-free measurements of a robot whose wheels turn so.
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
        // Without leaps at half a turn.
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

fn derivative(from: &[Sample], to: &[Sample], step: f64) -> Vec<Sample> {
    let pairs = from.iter().zip(to);
    pairs
        .map(|(from, to)| std::array::from_fn(|channel| (to[channel] - from[channel]) / step))
        .collect()
}

/// Covariance of all parameters before the drive.
fn prior(sensors: &SensorSpec, layout: &Layout) -> DMatrix<f64> {
    let mut covariance = DMatrix::zeros(layout.len, layout.len);
    for (index, (std_dev, _)) in PARAMETERS.iter().enumerate() {
        covariance[(index, index)] = std_dev.powi(2);
    }
    // Indicators of shapes that are equally likely.
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

/// Adds what each sample tells, and inverts at the times that are asked for.
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

/// Derivatives of a channel by offsets and the start.
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
