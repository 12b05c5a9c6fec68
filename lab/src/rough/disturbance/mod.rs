//! Drives with one disturbance: a faulty channel, blocked wheels, a position that jumps, ground that
//! becomes slippery, a start beside the path.

mod drive;

use std::time::Duration;

use tread_agent::testing::Bench;
use tread_control::estimation::EstimatorPrior;
use tread_control::geometry::Pose;
use tread_control::robot::RobotModel;

use self::drive::DisturbedDrive;
use super::drive::RoughDrive;
use super::run::{Course, SETTLES};
use super::sensors::SensorSpec;
use super::spec::{Deviations, MAKES, Make};
use super::width::Width;
use crate::random::Random;
use crate::report::WIDE_RATIO;

/// Time from the start of the mission to the disturbance, after which most agents have an estimate.
const DISTURBED_AFTER: Duration = Duration::from_secs(30);
/// Time from the beginning of a disturbance in which the drive is observed.
const OBSERVED: Duration = Duration::from_secs(20);
/// Time after a change of the ground in which the estimate may be of the old ground.
const CHANGE_KNOWN_AFTER_S: u64 = 3;
/// Mask of the seed for drawing the robot, so that robot and sensor noise are independent.
const ROBOT_SEED: u64 = 0xd157;
/// Stiffness K of the ground before it changes.
pub const CHANGE_FROM: f64 = 5.0;
/// Ticks of the control loop in one second.
const TICKS_PER_S: u32 = 100;
/// Laps of the course.
const LAPS: u32 = 3;
/// Start 2 m beside the path, in the opposite direction.
const ASIDE: Pose = Pose {
    x_m: 0.0,
    y_m: -2.0,
    heading_rad: std::f64::consts::PI,
};
/// Excess over a limit of speed that counts as rounding, metres per second and radians per second.
const ROUNDING: f64 = 1.0e-9;
/// Error of θ, in half-widths of its 95 % interval, above which an estimate is confidently wrong: four
/// standard deviations.
const CONFIDENTLY_WRONG: f64 = 2.0;
/// Half-width of a 95 % interval in standard deviations.
const HALF_WIDTH_STD_DEVS: f64 = 1.96;

/// A channel of the sensors.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Channel {
    /// Turn rate.
    Gyro,
    /// Acceleration.
    Accelerometer,
    /// Wheel speeds of both sides.
    WheelSpeeds,
    /// Wheel torques of both sides.
    WheelTorques,
    /// Speed over ground.
    BodySpeed,
    /// Position.
    Position,
}

/// Fault of a channel. Time stamps stay current.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ChannelFault {
    /// It repeats its last value.
    Frozen,
    /// It reports zero.
    Zero,
    /// It reports nothing.
    Dropped,
    /// It reports what was this long ago.
    Late(Duration),
}

/// What disturbs a drive.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Disturbance {
    /// Nothing.
    None,
    /// The robot starts 2 m beside the path and in the opposite direction.
    StartAside,
    /// Positions are 1 m off, for so long.
    PositionJump {
        /// Duration.
        lasts: Duration,
    },
    /// A channel fails, until the end.
    Channel {
        /// The channel.
        channel: Channel,
        /// Its fault.
        fault: ChannelFault,
    },
    /// The left wheels do not turn, for so long.
    BlockedWheels {
        /// Duration.
        lasts: Duration,
    },
    /// The ground changes to this stiffness K.
    GroundChange {
        /// Stiffness K of the new ground.
        stiffness: f64,
    },
}

impl Disturbance {
    /// Returns how long it lasts.
    fn duration(self) -> Duration {
        match self {
            Self::PositionJump { lasts } | Self::BlockedWheels { lasts } => lasts,
            Self::None | Self::StartAside | Self::Channel { .. } | Self::GroundChange { .. } => {
                Duration::MAX
            }
        }
    }
}

/// Specification of a drive.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DisturbedTrial {
    /// The robot.
    pub make: Make,
    /// Differences of robot and ground from the agent's model.
    pub deviations: Deviations,
    /// Specification of the sensors.
    pub sensors: SensorSpec,
    /// Course to drive.
    pub course: Course,
    /// Seed of the sensor noise.
    pub seed: u64,
    /// What disturbs the drive.
    pub disturbance: Disturbance,
}

impl DisturbedTrial {
    /// Draws robot, sensors and course of the population. Where the ground changes, the course is a
    /// circle and K is [`CHANGE_FROM`] before.
    pub fn drawn(seed: u64, has_torque: bool, disturbance: Disturbance) -> Self {
        let mut random = Random::new(seed ^ ROBOT_SEED);
        let courses = [Course::Figure8, Course::Circle];
        let mut trial = Self {
            make: random.one_of(&MAKES).unwrap_or(MAKES[0]),
            deviations: Deviations::drawn(&mut random),
            sensors: SensorSpec::drawn(&mut random, has_torque),
            course: random.one_of(&courses).unwrap_or(Course::Figure8),
            seed,
            disturbance,
        };
        let sensors = trial.sensors;
        trial.sensors = sensors.with_drawn_inertial_unit(&mut random, Width::default());
        if let Disturbance::GroundChange { stiffness } = disturbance {
            let curve = &mut trial.deviations.curve;
            curve.stiffness = CHANGE_FROM;
            curve.mu_peak = curve.mu_peak.min(0.9 * stiffness);
            trial.course = Course::Circle;
        }
        trial
    }
}

/// Result of a drive from the beginning of its disturbance.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct DisturbedOutcome {
    /// Number of readings of the agent's θ that are estimates.
    pub estimates: usize,
    /// Number of those whose interval contains the true θ of the present ground.
    pub covered: usize,
    /// Largest error of an estimate, in half-widths of its interval.
    pub farthest: f64,
    /// Number of ticks whose command exceeds a limit of the robot.
    pub over_limit_ticks: usize,
    /// Whether the robot stood at the end.
    pub stands: bool,
}

impl DisturbedOutcome {
    /// Returns whether an estimate was wrong by more than twice the half-width of its interval.
    pub fn is_confidently_wrong(&self) -> bool {
        self.farthest > CONFIDENTLY_WRONG
    }

    fn read(&mut self, bench: &Bench<DisturbedDrive>, theta: f64) {
        let Some(found) = bench.theta() else {
            return;
        };
        let half_width = HALF_WIDTH_STD_DEVS * found.std_dev;
        if half_width > WIDE_RATIO * found.theta {
            return;
        }
        let error = (found.theta - theta).abs() / half_width;
        self.estimates += 1;
        self.covered += usize::from(error <= 1.0);
        self.farthest = self.farthest.max(error);
    }
}

/// Compares each command of the agent with the one before it and the limits of the robot.
struct LimitWatch {
    model: RobotModel,
    before: [f64; 2],
}

impl LimitWatch {
    fn new(model: RobotModel, bench: &Bench<DisturbedDrive>) -> Self {
        let mut watch = Self {
            model,
            before: [0.0; 2],
        };
        watch.exceeds(bench);
        watch
    }

    /// Returns whether the command of this tick exceeds a limit: of speed, of turn rate, of the wheels,
    /// or of the acceleration from one tick to the next.
    fn exceeds(&mut self, bench: &Bench<DisturbedDrive>) -> bool {
        let (model, limits) = (&self.model, self.model.limits());
        let wheels = bench.drive().command();
        let twist = model.twist_from_wheel_speeds(wheels);
        let now = [twist.linear_m_s.abs(), twist.angular_rad_s.abs()];
        let tick_s = f64::from(TICKS_PER_S).recip();
        let rises = [
            limits.linear_acceleration_max_m_s2,
            model.angular_acceleration_max_rad_s2(),
        ];
        let speeds = [limits.linear_max_m_s, limits.angular_max_rad_s];
        let before = std::mem::replace(&mut self.before, now);
        let is_fast = (0..2).any(|axis| {
            now[axis] > speeds[axis] + ROUNDING
                || now[axis] - before[axis] > rises[axis] * tick_s + ROUNDING
        });
        is_fast || wheels.magnitude_max_rad_s() > limits.wheel_speed_max_rad_s + ROUNDING
    }
}

/// Runs a drive.
///
/// # Errors
/// The robot's model or its plan is impossible.
pub fn run(trial: &DisturbedTrial) -> anyhow::Result<DisturbedOutcome> {
    let model = trial.make.model()?;
    let is_aside = trial.disturbance == Disturbance::StartAside;
    let start = if is_aside { ASIDE } else { Pose::default() };
    let (deviations, sensors) = (trial.deviations, trial.sensors);
    let robot = RoughDrive::new(&model, deviations, sensors, start, Random::new(trial.seed))
        .ok_or_else(|| anyhow::anyhow!("the wheels of {} are no rectangle", trial.make.name))?;
    let mut bench =
        Bench::with_drive(DisturbedDrive::new(robot), model).with_prior(EstimatorPrior::default());
    bench.run_for(SETTLES);
    bench.begin(1, &trial.course.laps(LAPS), None)?;
    let mut theta = deviations.curve.theta();
    let mut read_from_s = 0;
    let mut observed = OBSERVED;
    if is_aside {
        observed += DISTURBED_AFTER;
    } else {
        bench.run_for(DISTURBED_AFTER);
        bench.drive_mut().disturb(trial.disturbance);
    }
    if let Disturbance::GroundChange { stiffness } = trial.disturbance {
        theta = stiffness.recip();
        read_from_s = CHANGE_KNOWN_AFTER_S;
    }
    let mut outcome = DisturbedOutcome::default();
    let mut watch = LimitWatch::new(model, &bench);
    let ends_at = bench.now().saturating_add(trial.disturbance.duration());
    for second in 0..observed.as_secs() {
        for _ in 0..TICKS_PER_S {
            bench.tick();
            if bench.now() >= ends_at {
                bench.drive_mut().disturb(Disturbance::None);
            }
            outcome.over_limit_ticks += usize::from(watch.exceeds(&bench));
        }
        if second >= read_from_s {
            outcome.read(&bench, theta);
        }
    }
    outcome.stands = bench.drive().stands();
    Ok(outcome)
}
