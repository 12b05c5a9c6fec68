//! Drives of the report: robots with one difference, and the population with all deviations.

use tread_lab::random::Random;
use tread_lab::rough::curve::Shape;
use tread_lab::rough::run::{Course, Trial};
use tread_lab::rough::sensors::SensorSpec;
use tread_lab::rough::spec::{Deviations, MAKES};
use tread_lab::rough::width::Width;

use crate::Arguments;

/// Friction stiffnesses K of the grounds.
pub(crate) const GROUNDS: [f64; 3] = [0.7, 3.0, 12.0];

/// Relaxation length of robots with late sensors, metres. A contact with the 2 mm of the other lines
/// follows the wheels faster than any tyre, so that a late wheel speed would be one that is before its
/// time.
const TYRE_RELAXATION_M: f64 = 0.03;

pub(crate) type Change = fn(&mut Deviations, &mut SensorSpec);

/// Single differences, each with its name in the report.
pub(crate) const CHANGES: [(&str, Change); 34] = [
    ("nothing", |_, _| {}),
    ("payload 20 %", |robot, _| {
        robot.payload_ratio = 0.2;
    }),
    ("payload -10 %", |robot, _| {
        robot.payload_ratio = -0.1;
    }),
    ("yaw inertia +25 %", |robot, _| {
        robot.inertia_ratio = 1.25;
    }),
    ("yaw inertia -20 %", |robot, _| {
        robot.inertia_ratio = 0.8;
    }),
    ("brush, peak 0.3", |robot, _| {
        with_curve(robot, Shape::Brush, 0.3);
    }),
    ("brush, peak 0.8", |robot, _| {
        with_curve(robot, Shape::Brush, 0.8);
    }),
    ("Magic Formula, peak 0.5", |robot, _| {
        with_curve(robot, Shape::MagicFormula, 0.5);
    }),
    ("LuGre, peak 0.6", |robot, _| {
        with_curve(robot, Shape::LuGre, 0.6);
    }),
    ("relaxation 1 cm", |robot, _| {
        robot.relaxation_m = 0.01;
    }),
    ("relaxation 5 cm", |robot, _| {
        robot.relaxation_m = 0.05;
    }),
    ("lateral stiffness -25 %", |robot, _| {
        robot.lateral_stiffness_ratio = 0.75;
    }),
    ("lateral stiffness +25 %", |robot, _| {
        robot.lateral_stiffness_ratio = 1.25;
    }),
    ("torque scale +3 %", |robot, _| {
        robot.torque_scale = [1.03; 2];
    }),
    ("torque scale -3 %", |robot, _| {
        robot.torque_scale = [0.97; 2];
    }),
    ("rotors 10 %, gears 3 %", |robot, _| {
        robot.rotor_ratio = 0.1;
        robot.gear_loss_ratio = 0.03;
    }),
    ("center of mass 5 % forward", |robot, _| {
        robot.center_forward_ratio = 0.05;
    }),
    ("center of mass 5 % rearward", |robot, _| {
        robot.center_forward_ratio = -0.05;
    }),
    ("center of mass 3 % left", |robot, _| {
        robot.center_left_ratio = 0.03;
    }),
    ("center of mass 3 % right", |robot, _| {
        robot.center_left_ratio = -0.03;
    }),
    ("slope 5°", |robot, _| {
        robot.slope_rad = [0.0, 5.0_f64.to_radians()];
    }),
    ("slope -5°", |robot, _| {
        robot.slope_rad = [0.0, -5.0_f64.to_radians()];
    }),
    ("slope 5°, no attitude", |robot, sensors| {
        robot.slope_rad = [0.0, 5.0_f64.to_radians()];
        sensors.has_attitude = false;
    }),
    ("slope -5°, no attitude", |robot, sensors| {
        robot.slope_rad = [0.0, -5.0_f64.to_radians()];
        sensors.has_attitude = false;
    }),
    ("rolling resistance 4 %", |robot, _| {
        robot.rolling_resistance_ratio = 0.04;
    }),
    ("servo lag 0.1 s", |robot, _| {
        robot.servo_lag_s = 0.1;
    }),
    ("wheel speed noise 0.02 rad/s", |_, sensors| {
        sensors.wheel_speed_rad_s = 0.02;
    }),
    ("wheel speed noise 0.05 rad/s", |_, sensors| {
        sensors.wheel_speed_rad_s = 0.05;
    }),
    ("gyro 20 ms late", |robot, sensors| {
        set_delays(robot, sensors, [0.02, 0.0, 0.0]);
    }),
    ("accelerometer 20 ms late", |robot, sensors| {
        set_delays(robot, sensors, [0.0, 0.02, 0.0]);
    }),
    ("accelerometer 30 ms late", |robot, sensors| {
        set_delays(robot, sensors, [0.0, 0.03, 0.0]);
    }),
    ("gyro and accelerometer 20 ms late", |robot, sensors| {
        set_delays(robot, sensors, [0.02, 0.02, 0.0]);
    }),
    ("wheels and torques 10 ms late", |robot, sensors| {
        set_delays(robot, sensors, [0.0, 0.0, 0.01]);
    }),
    ("wheels and torques 20 ms late", |robot, sensors| {
        set_delays(robot, sensors, [0.0, 0.0, 0.02]);
    }),
];

/// Gives a robot on tyres that deflect delays of gyro, accelerometer, and wheels with torques, seconds.
fn set_delays(robot: &mut Deviations, sensors: &mut SensorSpec, delays_s: [f64; 3]) {
    robot.relaxation_m = TYRE_RELAXATION_M;
    [
        sensors.gyro_delay_s,
        sensors.acceleration_delay_s,
        sensors.wheel_delay_s,
    ] = delays_s;
}

fn with_curve(robot: &mut Deviations, shape: Shape, mu_peak: f64) {
    robot.curve.shape = shape;
    robot.curve.mu_peak = mu_peak.min(0.9 * robot.curve.stiffness);
}

/// Returns the drives with one difference: the paper's robot on three grounds and two courses.
pub(crate) fn alone(change: Change, has_torque: bool, arguments: &Arguments) -> Vec<Trial> {
    let trial = |index: u32| {
        let stiffness = GROUNDS[index as usize % GROUNDS.len()];
        let mut deviations = Deviations::none(stiffness);
        let mut sensors = SensorSpec::usual(has_torque);
        change(&mut deviations, &mut sensors);
        let is_circle = (index / 3).is_multiple_of(2);
        Trial {
            make: MAKES[0],
            deviations,
            sensors,
            course: if is_circle {
                Course::Circle
            } else {
                Course::Figure8
            },
            seed: arguments.seed + u64::from(index),
            prior: arguments.prior(),
            is_bounded: index < arguments.bounds,
        }
    };
    (0..arguments.runs).map(trial).collect()
}

/// Returns the drives of the population: robots of all makes with all deviations.
pub(crate) fn population(has_torque: bool, arguments: &Arguments) -> Vec<Trial> {
    let trial = |index: u32| {
        let seed = arguments.seed + u64::from(index);
        let mut random = Random::new(seed ^ 0x5eed);
        let mut trial = Trial {
            make: random.one_of(&MAKES).unwrap_or(MAKES[0]),
            deviations: Deviations::drawn(&mut random),
            sensors: SensorSpec::drawn(&mut random, has_torque),
            course: random
                .one_of(&[Course::Figure8, Course::Circle])
                .unwrap_or(Course::Figure8),
            seed,
            prior: arguments.prior(),
            is_bounded: index < arguments.bounds,
        };
        trial.sensors = trial
            .sensors
            .with_drawn_inertial_unit(&mut random, Width::default());
        trial
    };
    let runs = arguments.runs.saturating_mul(10);
    (0..runs).map(trial).collect()
}
