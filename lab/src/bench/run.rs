//! One run of the comparison: a law on a course, with the free plant.

use crate::bench::Law;
use crate::bench::course::Course;
use crate::bench::driver::{Driver, LawInput};
use tread_control::friction::FrictionCurve;
use tread_control::gate::{GateInput, GateLimits, gate};
use tread_control::geometry::{Point, Pose};
use tread_control::measured::{Measured, WheelSpeeds};
use tread_control::plan::Plan;
use tread_control::plant::{Ground, Plant, PlantError, PlantSpec, PlantState};
use tread_control::robot::RobotModel;
use tread_control::tracking::{ThetaKnowledge, TrackerConfig, TrackerError, TrackerOutput};

/// Cross-track error above which a run is aborted, metres.
const GIVEN_UP_M: f64 = 50.0;

/// Conditions of a run.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Scenario {
    /// Friction curve of the ground at the start; the paper's law uses it.
    pub curve: FrictionCurve,
    /// True lag of the wheel servo, seconds.
    pub servo_lag_s: f64,
    /// Gains of the shipped law, and the servo lag that it assumes.
    pub tracker: TrackerConfig,
    /// Period of the control loop, seconds.
    pub loop_s: f64,
    /// Number of sensor samples per period, at least 1.
    pub samples: u32,
}

impl Scenario {
    /// Returns a loop of 50 Hz, sensors at 200 Hz, and 50 ms of servo lag, known to the law.
    pub fn usual(curve: FrictionCurve) -> Self {
        Self {
            curve,
            servo_lag_s: 0.05,
            tracker: TrackerConfig::default(),
            loop_s: 0.02,
            samples: 4,
        }
    }
}

/// Reason why a run cannot start.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum BenchError {
    /// A parameter of the plant is out of range.
    #[error("the simulated base was refused")]
    Plant(#[from] PlantError),
    /// A gain of the shipped law is out of range.
    #[error("the law was refused")]
    Tracker(#[from] TrackerError),
}

/// External input of one tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TickInput<'a> {
    /// Ground under the robot during this tick.
    pub ground: &'a Ground,
    /// Error to add to the measured pose.
    pub pose_error: Pose,
    /// Known θ.
    pub knowledge: Option<ThetaKnowledge>,
}

/// Result of one tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TickOutput {
    /// Time of the law's input, seconds.
    pub time_s: f64,
    /// True distance to the left of the course at that time, metres.
    pub cross_track_m: f64,
    /// Commanded wheel speeds after the gate.
    pub command: WheelSpeeds,
    /// Full output of the shipped law, if it drives.
    pub tracker: Option<TrackerOutput>,
}

/// Run in progress.
#[derive(Debug, Clone, PartialEq)]
pub struct Run {
    course: Course,
    scenario: Scenario,
    driver: Driver,
    plant: Plant,
    limits: GateLimits,
    /// Last output of the gate.
    command: WheelSpeeds,
    nearest_s: f64,
    ticks: u32,
    given_up: bool,
}

impl Run {
    /// Places a robot at the start of the course, with the course's motion there.
    ///
    /// # Errors
    /// [`BenchError`] if the scenario's servo lag or a gain of the shipped law is out of range.
    pub fn new(
        course: Course,
        model: RobotModel,
        scenario: Scenario,
        law: Law,
    ) -> Result<Self, BenchError> {
        let spec = PlantSpec {
            servo_lag_s: scenario.servo_lag_s,
            ..PlantSpec::default()
        };
        let start = course.sample(0.0);
        let command = model.wheel_speeds_from_twist(tread_control::geometry::Twist {
            linear_m_s: start.speed_m_s,
            angular_rad_s: start.turn_rad_s,
        });
        let mut plant = Plant::new(model, spec, start.pose)?;
        plant.set_state(PlantState {
            pose: start.pose,
            forward_m_s: start.speed_m_s,
            left_m_s: 0.0,
            yaw_rate_rad_s: start.turn_rad_s,
            wheel_speeds: command,
        });
        let driver = Driver::new(model, scenario.tracker, scenario.curve, law)?;
        Ok(Self {
            course,
            scenario,
            driver,
            plant,
            limits: GateLimits::of(&model),
            command,
            nearest_s: 0.0,
            ticks: 0,
            given_up: false,
        })
    }

    /// Returns the simulated base.
    pub fn plant(&self) -> &Plant {
        &self.plant
    }

    /// Returns the time since the start, seconds.
    pub fn time_s(&self) -> f64 {
        f64::from(self.ticks) * self.scenario.loop_s
    }

    /// Returns whether the run was aborted because the robot left the course.
    pub fn is_given_up(&self) -> bool {
        self.given_up
    }

    /// Runs one tick; calls `each_sample` after every sensor sample with the plant and the time
    /// since the last sample in seconds.
    ///
    /// Returns None at the end of the course, or after an abort.
    pub fn tick(
        &mut self,
        input: &TickInput,
        mut each_sample: impl FnMut(&Plant, f64),
    ) -> Option<TickOutput> {
        let time_s = self.time_s();
        if self.given_up || time_s >= self.course.duration_s() {
            return None;
        }
        let dt_s = self.scenario.loop_s;
        let state = *self.plant.state();
        let nearest = self.course.nearest(self.scored_point(), self.nearest_s);
        self.nearest_s = nearest.time_s;
        self.given_up = nearest.cross_track_m.is_nan() || nearest.cross_track_m.abs() > GIVEN_UP_M;
        let measured = Measured {
            pose: Pose {
                x_m: state.pose.x_m + input.pose_error.x_m,
                y_m: state.pose.y_m + input.pose_error.y_m,
                heading_rad: state.pose.heading_rad + input.pose_error.heading_rad,
            },
            twist: state.twist(),
            wheel_speeds: state.wheel_speeds,
            pose_age_s: 0.0,
            position_std_dev_m: 0.0,
        };
        let felt = self.plant.body_acceleration();
        let law_input = LawInput {
            course: &self.course,
            time_s,
            reference: &self.course.sample(time_s),
            measured: &measured,
            knowledge: input.knowledge,
            felt,
        };
        let (wanted, tracker) = self.driver.step(&law_input, dt_s);
        let passed = gate(
            &GateInput {
                command: Some(wanted),
                previous: self.command,
                stop: false,
                feedback_age_s: 0.0,
                dt_s,
            },
            &self.limits,
        );
        self.command = passed.wheel_speeds;
        let command = self.command;
        let sample_s = dt_s / f64::from(self.scenario.samples.max(1));
        for _ in 0..self.scenario.samples.max(1) {
            self.plant.step(command, input.ground, sample_s);
            each_sample(&self.plant, sample_s);
        }
        self.ticks += 1;
        Some(TickOutput {
            time_s,
            cross_track_m: nearest.cross_track_m,
            command,
            tracker,
        })
    }

    /// Returns the point that the law controls: the centre, or the paper's point D.
    fn scored_point(&self) -> Point {
        let pose = self.plant.state().pose;
        let forward_m = self.driver.point_forward_m();
        let (sin, cos) = pose.heading_rad.sin_cos();
        Point {
            x_m: pose.x_m + forward_m * cos,
            y_m: pose.y_m + forward_m * sin,
        }
    }
}

/// Cross-track errors of one run.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct CrossTrack {
    /// Root mean square over the second half of the time, metres.
    pub rms_m: f64,
    /// Maximum magnitude over the whole time, metres.
    pub most_m: f64,
}

/// Runs a law on a plan without noise on uniform ground. The shipped law has its known θ from the
/// start.
///
/// # Errors
/// [`BenchError`] if the scenario's servo lag or a gain of the shipped law is out of range.
pub fn cross_track(
    plan: &Plan,
    model: RobotModel,
    scenario: &Scenario,
    law: Law,
) -> Result<CrossTrack, BenchError> {
    let knowledge = match law {
        Law::Shipped(knowledge) => knowledge,
        Law::Kanayama(_) | Law::Pursuit(_) | Law::Yi2007 => None,
    };
    let course = Course::Plan(plan.clone());
    let half_s = 0.5 * course.duration_s();
    let ground = Ground::uniform(scenario.curve);
    let mut run = Run::new(course, model, *scenario, law)?;
    let (mut sum, mut count, mut most_m) = (0.0, 0.0_f64, 0.0_f64);
    let input = TickInput {
        ground: &ground,
        pose_error: Pose::default(),
        knowledge,
    };
    while let Some(output) = run.tick(&input, |_, _| {}) {
        most_m = most_m.max(output.cross_track_m.abs());
        if output.time_s > half_s {
            sum += output.cross_track_m * output.cross_track_m;
            count += 1.0;
        }
    }
    Ok(CrossTrack {
        rms_m: (sum / count.max(1.0)).sqrt(),
        most_m,
    })
}
