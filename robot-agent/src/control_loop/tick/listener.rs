//! The first two stages alone: what the loop makes of the samples of a robot that somebody else
//! drove.

use std::time::Duration;

use jiff::Timestamp;
use tread_control::consistency::Findings;
use tread_control::estimation::{Estimate, EstimatorPrior};
use tread_control::measured::WheelSpeeds;
use tread_control::robot::RobotModel;

use super::estimation::{Estimation, EstimationInput};
use super::sensing::{Sensing, SensingInput};
use super::{TICK_MAX_S, Tick};
use crate::control_loop::segments::Moment;
use crate::drive::{Feedback, StatedNoise};

/// Output of one tick.
#[derive(Debug, Clone, Copy)]
pub struct ListenerOutput {
    /// State of the estimator.
    pub estimate: Estimate,
    /// Sensors that contradict each other; while there are any, nothing is learned.
    pub findings: Findings,
    /// Changes of the ground that were detected so far.
    pub ground_changes: u64,
}

/// Sensing and estimation of the loop, without missions, safety and a base.
///
/// The wheel commands of a recorded robot are unknown. Each tick therefore uses the last measured
/// wheel speeds as the command, so that no finding reports wheels that do not follow their commands.
#[derive(Debug)]
pub struct Listener {
    sensing: Sensing,
    estimation: Estimation,
    last_tick: Option<Duration>,
    measured: Option<WheelSpeeds>,
}

impl Listener {
    /// Creates the stages before the first sample.
    pub fn new(model: RobotModel, prior: EstimatorPrior) -> Self {
        let mut estimation = Estimation::new(model);
        estimation.set_prior(prior);
        Self {
            sensing: Sensing::new(model),
            estimation,
            last_tick: None,
            measured: None,
        }
    }

    /// Runs one tick at `now` on the samples since the tick before.
    pub fn step(
        &mut self,
        now: Duration,
        feedback: &Feedback,
        noise: StatedNoise,
    ) -> ListenerOutput {
        let before = self.last_tick.replace(now).unwrap_or(now);
        let tick = Tick {
            now: Moment {
                monotonic: now,
                wall: Timestamp::UNIX_EPOCH,
            },
            dt_s: now.saturating_sub(before).as_secs_f64().min(TICK_MAX_S),
            stop: false,
        };
        let sensed = self.sensing.step(&SensingInput {
            feedback,
            is_base_silent: false,
            commanded: self.measured,
        });
        if sensed.last_sample.is_some() {
            self.measured = Some(sensed.wheel_speeds);
        }
        let (estimated, _) = self.estimation.step(EstimationInput {
            tick,
            sensed: &sensed,
            noise,
            site: None,
            mission: None,
        });
        ListenerOutput {
            estimate: estimated.estimate,
            findings: sensed.findings,
            ground_changes: estimated.ground_changes,
        }
    }
}
