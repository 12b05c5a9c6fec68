//! Implements the agent's drive interface for robots of the rough world, and for other plants with the
//! rough world's sensors.

use std::time::Duration;

use tread_agent::drive::{Drive, Feedback};
use tread_agent::testing::SteppedDrive;
use tread_control::geometry::Pose;
use tread_control::measured::WheelSpeeds;
use tread_control::robot::RobotModel;

use super::means::Means;
use super::plant::{Plant, STEP_S, Truth};
use super::sensors::{SAMPLE_PERIOD, SensorSpec, Sensors};
use super::spec::Deviations;
use crate::random::Random;

/// A simulated plant, as a drive needs it.
pub trait SimulatedPlant: Send {
    /// Simulates one [`SAMPLE_PERIOD`] with commanded wheel speeds. Returns the means over it.
    fn advance_sample(&mut self, command: WheelSpeeds) -> Means;

    /// Returns the true values from which sensor values are made.
    fn truth(&self) -> Truth;

    /// Returns the ratio of the largest contact slip to the slip at the peak of the friction curve.
    fn slip_over_peak(&self) -> f64;

    /// Checks that everything so far was simulated.
    ///
    /// # Errors
    /// What went wrong in the simulation; figures since then are void.
    fn check(&self) -> anyhow::Result<()> {
        Ok(())
    }
}

impl SimulatedPlant for Plant {
    fn advance_sample(&mut self, command: WheelSpeeds) -> Means {
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "a small whole number"
        )]
        let steps = (SAMPLE_PERIOD.as_secs_f64() / STEP_S).round() as u32;
        self.advance(command, steps)
    }

    fn truth(&self) -> Truth {
        self.truth()
    }

    fn slip_over_peak(&self) -> f64 {
        self.slip_over_peak()
    }
}

/// A simulated robot with its sensors, driven by the agent; by default one of the rough world.
#[derive(Debug, Clone)]
pub struct RoughDrive<P = Plant> {
    plant: P,
    sensors: Sensors,
    command: WheelSpeeds,
    waiting: Feedback,
    simulated_to: Option<Duration>,
    /// Command of each sample so far.
    commands: Vec<WheelSpeeds>,
}

impl RoughDrive {
    /// Creates a robot at rest at the pose `start`; `None` if the wheels of `model` do not form a
    /// rectangle.
    pub fn new(
        model: &RobotModel,
        deviations: Deviations,
        sensors: SensorSpec,
        start: Pose,
        random: Random,
    ) -> Option<Self> {
        Some(Self::with_plant(
            Plant::new(model, deviations, start)?,
            Sensors::new(sensors, model, random),
        ))
    }

    /// Changes the payload to this ratio of the model's mass. The robot should be at rest.
    pub fn load(&mut self, model: &RobotModel, payload_ratio: f64) {
        self.plant.load(model, payload_ratio);
    }

    /// Changes the stiffness of the ground under all wheels.
    pub fn change_ground(&mut self, stiffness: f64) {
        self.plant.change_ground(stiffness);
    }
}

impl<P> RoughDrive<P> {
    /// Creates a robot from a plant at rest and its sensors.
    pub fn with_plant(plant: P, sensors: Sensors) -> Self {
        Self {
            plant,
            sensors,
            command: WheelSpeeds::default(),
            waiting: Feedback::default(),
            simulated_to: None,
            commands: Vec::new(),
        }
    }

    /// Returns the command of each sample so far.
    pub fn commands(&self) -> &[WheelSpeeds] {
        &self.commands
    }

    /// Returns the simulated plant with its true state.
    pub fn plant(&self) -> &P {
        &self.plant
    }
}

impl<P: SimulatedPlant> SteppedDrive for RoughDrive<P> {
    fn advance(&mut self, now: Duration) {
        let from = self
            .simulated_to
            .unwrap_or_else(|| now.saturating_sub(SAMPLE_PERIOD));
        let mut at = from;
        while at + SAMPLE_PERIOD <= now {
            at += SAMPLE_PERIOD;
            self.commands.push(self.command);
            let means = self.plant.advance_sample(self.command);
            self.sensors
                .sample(&self.plant.truth(), &means, at, &mut self.waiting);
        }
        self.simulated_to = Some(at);
    }
}

impl<P: SimulatedPlant> Drive for RoughDrive<P> {
    fn read(&mut self, _: Duration) -> Feedback {
        std::mem::take(&mut self.waiting)
    }

    fn write(&mut self, command: WheelSpeeds) {
        self.command = command;
    }
}
