//! One tick of the control loop, as stages that own their state:
//!
//! ```text
//!                     commands        demands: stops, leases, limits
//!                      │ site   begin    │
//!                      ▼          ▼      ▼
//! base ─► sensing ─► estimation ─► mission ─► safety ─► base, output
//! ```
//! Each stage takes a named input and returns a named output, from which the inputs of the later
//! stages are made, so the compiler enforces their order. [`sensing`] checks the samples of the
//! base for consistency, [`estimation`] computes the pose and the friction of the ground,
//! [`demands`] reads stops, leases and limits, [`mission`] computes the mission's wheel speeds,
//! [`safety`] computes the command to the base, and [`output`] publishes the state of the loop.
//!
//! Pure except for the drive and the ends of the channels: no stage blocks, allocates, or reads a
//! clock other than the one passed in. What must be deallocated is sent out with an event.

mod demands;
mod estimation;
#[cfg(any(test, feature = "testing"))]
pub(crate) mod listener;
mod mission;
mod output;
mod safety;
mod sensing;

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use tread_control::estimation::EstimatorPrior;
#[cfg(test)]
use tread_control::measured::WheelSpeeds;
use tread_control::robot::RobotModel;

use super::channels::{COMMANDS_MAX, LoopEnds, Shared};
use super::outgoing::Outgoing;
use super::segments::Moment;
use crate::control_loop::frame::RecordSender;
use crate::drive::{Drive, SILENT_AFTER_MAX};
use demands::DemandReader;
use estimation::{Estimation, EstimationInput};
use mission::{CommandEffects, MissionInput, MissionStage, RecordInput};
use output::{Output, OutputInput};
use safety::{Safety, SafetyInput};
use sensing::{Sensing, SensingInput};

/// Upper bound of the time step of a tick, seconds; a longer gap, such as a suspended process, is
/// integrated as this.
const TICK_MAX_S: f64 = 0.2;
/// Speed below which the robot counts as stopped: m/s for speeds, rad/s for rates.
const STANDING: f64 = 0.02;

/// Times and stop request of a tick, common to all stages.
#[derive(Debug, Clone, Copy)]
struct Tick {
    now: Moment,
    /// Time since the previous tick, seconds; at most [`TICK_MAX_S`].
    dt_s: f64,
    /// Whether the robot shall brake and its mission end.
    stop: bool,
}

/// The state of the loop between two ticks.
#[derive(Debug)]
pub(crate) struct LoopCore {
    ends: LoopEnds,
    events: Outgoing,
    last_tick: Option<Duration>,
    sensing: Sensing,
    estimation: Estimation,
    demands: DemandReader,
    mission: MissionStage,
    safety: Safety,
    output: Output,
}

impl LoopCore {
    pub(crate) fn new(model: RobotModel, ends: LoopEnds) -> Self {
        Self {
            events: Outgoing::new(ends.events.clone(), Arc::clone(&ends.shared)),
            last_tick: None,
            sensing: Sensing::new(model),
            estimation: Estimation::new(model),
            demands: DemandReader::default(),
            mission: MissionStage::new(model),
            safety: Safety::new(model),
            output: Output::new(model, Arc::clone(&ends.shared)),
            ends,
        }
    }

    /// Sets whether the robot may be teleoperated inside a fence without a known position.
    #[must_use]
    pub(crate) fn with_blind_within_fence(mut self, may: bool) -> Self {
        self.safety.set_blind_within_fence(may);
        self
    }

    /// Sets the time after which the base counts as silent, at most [`SILENT_AFTER_MAX`].
    #[must_use]
    pub(crate) fn with_silent_after(mut self, silent_after: Duration) -> Self {
        let silent_after = silent_after.min(SILENT_AFTER_MAX);
        self.estimation.set_silent_after(silent_after);
        self.safety.set_silent_after(silent_after);
        self
    }

    /// Sets the estimator's prior of the robot's parameters.
    #[must_use]
    pub(crate) fn with_prior(mut self, prior: EstimatorPrior) -> Self {
        self.estimation.set_prior(prior);
        self
    }

    /// Holds the robot whenever the loop does not keep this period.
    #[must_use]
    pub(crate) fn with_period(mut self, period: Duration) -> Self {
        self.demands.set_period(period);
        self
    }

    /// Starts recording the inputs and outputs of ticks; `None` stops it.
    pub(crate) fn record_to(&mut self, notes: Option<RecordSender>) {
        self.output.record_to(notes);
    }

    /// Returns the wheel speeds that the base was commanded last; zero before the first tick.
    #[cfg(test)]
    pub(crate) fn command(&self) -> WheelSpeeds {
        self.safety.commanded().unwrap_or_default()
    }

    /// Whether the wheels are commanded to zero and are measured near zero.
    pub(crate) fn is_standing(&self) -> bool {
        self.output.is_standing()
    }

    /// Runs one tick that begins at `now`. With `stop`, the robot brakes and its mission ends.
    /// Inputs with an expiry, such as a drive command, are judged by `clock` right before the gate,
    /// so that a tick that was interrupted does not prolong them.
    pub(crate) fn tick_by(
        &mut self,
        now: Moment,
        clock: &dyn Fn() -> Duration,
        stop: bool,
        drive: &mut dyn Drive,
    ) {
        self.events.flush();
        let dt_s = self.time_step_s(now.monotonic);
        let tick = Tick { now, dt_s, stop };
        let feedback = drive.read(now.monotonic);
        let noise = drive.noise();
        let commanded = self.safety.commanded();
        let sensed = self.sensing.step(&SensingInput {
            feedback: &feedback,
            is_base_silent: drive.is_silent(),
            commanded,
        });
        let effects = self.receive_commands(tick);
        let (estimated, released) = self.estimation.step(EstimationInput {
            tick,
            sensed: &sensed,
            noise,
            site: effects.site,
            mission: self.mission.active(),
        });
        let demands = self.demands.read(now.monotonic, &self.ends.shared);
        let following = MissionInput {
            tick,
            sensed: &sensed,
            estimated: &estimated,
            demands: &demands,
            has_begun: effects.has_begun,
            commanded: commanded.unwrap_or_default(),
        };
        let followed = self.mission.step(&following, released, &mut self.events);
        let gated = self.safety.step(&SafetyInput {
            tick,
            judged: clock().max(now.monotonic),
            sensed: &sensed,
            estimated: &estimated,
            demands: &demands,
            followed,
        });
        drive.write(gated.output.wheel_speeds);
        if demands.is_stopped() {
            // The base has the command, and the gate's target was zero under this stop.
            self.ends.shared.safety.record_zeroed(demands.stop);
        }
        let recorded = RecordInput {
            tick,
            sensed: &sensed,
            estimated: &estimated,
            gate: gated.output.cause,
        };
        let mission = self.mission.record(&recorded, &mut self.events);
        self.output.step(&OutputInput {
            tick,
            feedback: &feedback,
            noise,
            battery: drive.battery(),
            sensed: &sensed,
            estimated: &estimated,
            demands: &demands,
            gated: &gated,
            mission: &mission,
        });
    }

    fn time_step_s(&mut self, now: Duration) -> f64 {
        let before = self.last_tick.replace(now).unwrap_or(now);
        now.saturating_sub(before).as_secs_f64().min(TICK_MAX_S)
    }

    /// Takes the commands of the rest of the agent.
    fn receive_commands(&mut self, tick: Tick) -> CommandEffects {
        let mut effects = CommandEffects::default();
        // Bounded: a tick takes at most the capacity of the channel.
        for _ in 0..COMMANDS_MAX {
            let Ok(command) = self.ends.commands.try_recv() else {
                break;
            };
            self.output.record_command(&command);
            self.mission
                .take(command, tick, &mut effects, &mut self.events);
        }
        effects
    }

    /// Records the computing time of a tick.
    pub(crate) fn record_tick_time(&self, took: Duration) {
        let microseconds = u32::try_from(took.as_micros()).unwrap_or(u32::MAX);
        self.ends
            .shared
            .tick_max_us
            .fetch_max(microseconds, Ordering::Relaxed);
    }

    /// Counts a tick that began more than one period late.
    pub(crate) fn count_overrun(&self) {
        Shared::count(&self.ends.shared.overruns);
    }

    /// Whether the rest of the agent has requested the loop to end.
    pub(crate) fn stop_requested(&self) -> bool {
        self.ends.shared.stop.load(Ordering::Relaxed)
    }

    /// Sends the events that wait for room; false if some still wait.
    pub(crate) fn flush(&mut self) -> bool {
        self.events.flush()
    }
}

/// Returns the age of `at` in seconds; infinite for `None`.
fn age_s(now: Duration, at: Option<Duration>) -> f64 {
    at.map_or(f64::INFINITY, |at| now.saturating_sub(at).as_secs_f64())
}
