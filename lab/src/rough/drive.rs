//! Implements the agent's drive interface for a robot of the rough world.

use std::time::Duration;

use tread_agent::drive::{Drive, Feedback};
use tread_agent::testing::SteppedDrive;
use tread_control::geometry::Pose;
use tread_control::measured::WheelSpeeds;
use tread_control::robot::RobotModel;

use super::plant::{Plant, STEP_S};
use super::sensors::{SAMPLE_PERIOD, SensorSpec, Sensors};
use super::spec::Deviations;
use crate::random::Random;

/// A robot of the rough world with its sensors, driven by the agent.
#[derive(Debug, Clone)]
pub struct RoughDrive {
    plant: Plant,
    sensors: Sensors,
    command: WheelSpeeds,
    waiting: Feedback,
    simulated_to: Option<Duration>,
    steps_per_sample: u32,
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
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "a small whole number"
        )]
        let steps_per_sample = (SAMPLE_PERIOD.as_secs_f64() / STEP_S).round() as u32;
        Some(Self {
            plant: Plant::new(model, deviations, start)?,
            sensors: Sensors::new(sensors, model, random),
            command: WheelSpeeds::default(),
            waiting: Feedback::default(),
            simulated_to: None,
            steps_per_sample,
            commands: Vec::new(),
        })
    }

    /// Returns the command of each sample so far.
    pub fn commands(&self) -> &[WheelSpeeds] {
        &self.commands
    }

    /// Changes the payload to this ratio of the model's mass. The robot should be at rest.
    pub fn load(&mut self, model: &RobotModel, payload_ratio: f64) {
        self.plant.load(model, payload_ratio);
    }

    /// Changes the stiffness of the ground under all wheels.
    pub fn change_ground(&mut self, stiffness: f64) {
        self.plant.change_ground(stiffness);
    }

    /// Returns the simulated plant with its true state.
    pub fn plant(&self) -> &Plant {
        &self.plant
    }
}

impl SteppedDrive for RoughDrive {
    fn advance(&mut self, now: Duration) {
        let from = self
            .simulated_to
            .unwrap_or_else(|| now.saturating_sub(SAMPLE_PERIOD));
        let mut at = from;
        while at + SAMPLE_PERIOD <= now {
            at += SAMPLE_PERIOD;
            self.commands.push(self.command);
            let means = self.plant.advance(self.command, self.steps_per_sample);
            self.sensors
                .sample(&self.plant.truth(), &means, at, &mut self.waiting);
        }
        self.simulated_to = Some(at);
    }
}

impl Drive for RoughDrive {
    fn read(&mut self, _: Duration) -> Feedback {
        std::mem::take(&mut self.waiting)
    }

    fn write(&mut self, command: WheelSpeeds) {
        self.command = command;
    }
}
