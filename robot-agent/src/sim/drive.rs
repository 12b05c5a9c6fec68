//! A simulated base behind the drive interface.
//!
//! It has no thread of its own: a read advances it to the present time in steps of its sensors'
//! period, under the last command, so that the robot moves on while a loop is late.

use std::time::Duration;

use tread_control::geometry::Pose;
use tread_control::measured::WheelSpeeds;
use tread_control::plant::{Plant, PlantError, PlantSpec};
use tread_control::robot::RobotModel;

use crate::drive::{Battery, Drive, Feedback, SensorSample};
use crate::sim::battery::SimulatedBattery;
use crate::sim::faults::{Fault, Faults};
use crate::sim::ground::GroundMap;
use crate::sim::scenario::{Scenario, ScenarioError};
use crate::sim::sensors::{SAMPLE_PERIOD, SensorSpec, Sensors};
use crate::sim::trace::{Trace, TruthSample};

/// Largest simulated time of one call; beyond it, as after a suspended process, time is skipped.
const CATCH_UP_MAX: Duration = Duration::from_secs(1);

/// Time without a new command after which the base stops its wheels, as every base must.
pub const COMMAND_TIMEOUT: Duration = Duration::from_millis(300);

/// What advances the simulated time.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum SimMode {
    /// A read advances it to the time of the call.
    #[default]
    Auto,
    /// Only [`SimulatedDrive::advance`] advances it; for tests.
    Explicit,
}

/// Why a simulated base could not be made.
#[derive(Debug, thiserror::Error)]
pub enum SimulatedDriveError {
    /// A parameter of the plant is out of its range.
    #[error("the simulated base cannot be made")]
    Plant(#[from] PlantError),
    /// The scenario's ground is invalid.
    #[error("the simulated ground cannot be made")]
    Ground(#[from] ScenarioError),
}

/// A fault of the base: a read blocks once, as with a stuck bus.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Stall {
    /// Time after the first read at which the fault begins.
    pub after: Duration,
    /// Duration for which the read blocks.
    pub lasting: Duration,
}

/// A simulated base.
#[derive(Debug, Clone)]
pub struct SimulatedDrive {
    mode: SimMode,
    plant: Plant,
    ground: GroundMap,
    sensors: Sensors,
    faults: Faults,
    track_width_m: f64,
    battery: SimulatedBattery,
    command: WheelSpeeds,
    /// Simulated time of the command.
    commanded_at: Duration,
    tilt_rad: f64,
    waiting: Feedback,
    /// Time up to which the base is simulated; `None` before the first call.
    simulated_to: Option<Duration>,
    stall: Option<Stall>,
    first_read_at: Option<Duration>,
    has_torque: bool,
    trace: Option<Trace>,
}

/// Properties in which one base differs from others of its model.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Individual {
    /// Seed of its sensor noise, offsets and rolling radii.
    pub seed: u64,
    /// Ratio of the friction stiffness on its tyres to that of the scenario.
    pub stiffness_ratio: f64,
    /// Whether it measures wheel torque.
    pub has_torque: bool,
}

impl Individual {
    /// Creates properties with a stiffness ratio of 1 and a torque sensor.
    pub fn of_seed(seed: u64) -> Self {
        Self {
            seed,
            stiffness_ratio: 1.0,
            has_torque: true,
        }
    }
}

impl SimulatedDrive {
    /// Creates a stopped base at a pose on a scenario's ground.
    ///
    /// # Errors
    /// [`SimulatedDriveError`] if a parameter of the plant or the ground is out of its range.
    pub fn new(
        scenario: &Scenario,
        model: RobotModel,
        start: Pose,
        individual: Individual,
        mode: SimMode,
    ) -> Result<Self, SimulatedDriveError> {
        let Individual {
            seed,
            stiffness_ratio,
            has_torque,
        } = individual;
        let sensors = Sensors::new(SensorSpec::default(), &model, seed);
        let (left_radius_ratio, right_radius_ratio) = sensors.radius_ratios();
        let spec = PlantSpec {
            left_radius_ratio,
            right_radius_ratio,
            ..PlantSpec::default()
        };
        Ok(Self {
            mode,
            plant: Plant::new(model, spec, start)?,
            ground: GroundMap::new(scenario, stiffness_ratio)?,
            sensors,
            faults: Faults::default(),
            track_width_m: model.track_width_m(),
            battery: SimulatedBattery::new(1.0),
            command: WheelSpeeds::default(),
            commanded_at: Duration::ZERO,
            tilt_rad: 0.0,
            waiting: Feedback::default(),
            simulated_to: None,
            stall: None,
            first_read_at: None,
            has_torque,
            trace: None,
        })
    }

    /// Sets the charge of the battery, 0 to 1.
    #[must_use]
    pub fn with_charge(mut self, charge_ratio: f64) -> Self {
        self.battery = SimulatedBattery::new(charge_ratio);
        self
    }

    /// Adds a stall.
    #[must_use]
    pub fn with_stall(mut self, stall: Option<Stall>) -> Self {
        self.stall = stall;
        self
    }

    /// Sets the faults.
    #[must_use]
    pub fn with_faults(mut self, faults: Vec<Fault>) -> Self {
        self.faults = Faults::new(faults);
        self
    }

    /// Records the true state in a trace.
    #[must_use]
    pub fn with_trace(mut self, trace: Option<Trace>) -> Self {
        self.trace = trace;
        self
    }

    /// Sets the measured tilt, radians; a simulated fault.
    #[cfg(any(test, feature = "testing"))]
    pub fn lean(&mut self, tilt_rad: f64) {
        self.tilt_rad = tilt_rad;
    }

    /// Returns the true state.
    #[cfg(any(test, feature = "testing"))]
    pub fn truth(&self) -> &tread_control::plant::PlantState {
        self.plant.state()
    }

    /// Returns the true ground under the robot's centre.
    #[cfg(any(test, feature = "testing"))]
    pub fn ground_truth(&self) -> crate::sim::scenario::GroundSpec {
        let at = self.simulated_to.unwrap_or_default();
        let curve = self.ground.under(self.plant.state().pose, 0.0, at).left;
        crate::sim::scenario::GroundSpec {
            stiffness: curve.stiffness(),
            peak_slip: curve.peak_slip(),
            sliding_ratio: curve.sliding_ratio(),
        }
    }

    /// Advances the simulated time to `now`.
    pub fn advance(&mut self, now: Duration) {
        let from = self
            .simulated_to
            .unwrap_or_else(|| now.saturating_sub(SAMPLE_PERIOD));
        let mut at = from.max(now.saturating_sub(CATCH_UP_MAX));
        while at + SAMPLE_PERIOD <= now {
            at += SAMPLE_PERIOD;
            if at.saturating_sub(self.commanded_at) > COMMAND_TIMEOUT {
                self.command = WheelSpeeds::default();
            }
            let command = self.faults.command(at, self.command);
            let pose = self.plant.state().pose;
            let ground = self.ground.under(pose, self.track_width_m, at);
            self.plant
                .step(command, &ground, SAMPLE_PERIOD.as_secs_f64());
            let (wheels, torques) = (self.plant.state().wheel_speeds, self.plant.wheel_torques());
            let wheels_w =
                wheels.left_rad_s * torques.left_n_m + wheels.right_rad_s * torques.right_n_m;
            self.battery.step(wheels_w, SAMPLE_PERIOD);
            let sample = self.sensors.sample(&self.plant, at);
            let sample = self.faults.sample(sample, pose.heading_rad);
            self.waiting.push(SensorSample {
                tilt_rad: Some(self.tilt_rad),
                wheel_torques: sample.wheel_torques.filter(|_| self.has_torque),
                ..sample
            });
            if let Some(trace) = self.trace.as_ref().filter(|trace| trace.is_due(at)) {
                let state = *self.plant.state();
                trace.add(TruthSample {
                    at,
                    state,
                    command: self.command,
                    theta: self.ground.under(state.pose, 0.0, at).left.theta(),
                });
            }
        }
        self.simulated_to = Some(at);
    }
}

impl Drive for SimulatedDrive {
    fn read(&mut self, now: Duration) -> Feedback {
        let since_first = now.saturating_sub(*self.first_read_at.get_or_insert(now));
        if let Some(stall) = self.stall.take_if(|stall| since_first >= stall.after) {
            std::thread::sleep(stall.lasting);
        }
        if self.mode == SimMode::Auto {
            self.advance(now);
        }
        std::mem::take(&mut self.waiting)
    }

    fn write(&mut self, command: WheelSpeeds) {
        self.command = command;
        self.commanded_at = self.simulated_to.unwrap_or_default();
    }

    fn battery(&self) -> Option<Battery> {
        Some(self.battery.reading())
    }
}
