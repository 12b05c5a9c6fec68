//! One tick of the control loop, as stages that own their state:
//!
//! ```text
//!                     commands        demands: stops, leases, limits
//!                      │ site   begin    │
//!                      ▼          ▼      ▼
//! base ─► sensing ─► estimation ─► mission ─► safety ─► base, output
//! ```
//! Each stage takes a named input and gives a named output, from which the next ones are made: the
//! compiler keeps their order. [`sensing`] says whether what comes from the base can be true,
//! [`estimation`] where the robot is and on what ground, [`demands`] what stops, leases and limits
//! ask for, [`mission`] what the mission wants, [`safety`] what of that the base is commanded,
//! [`output`] what the loop says of itself.
//!
//! Pure but for the drive and the channels' ends; nothing here waits, allocates or looks at a
//! clock but the one that it is handed. What has to be freed goes out with an event, to be freed by
//! somebody else.

mod demands;
mod estimation;
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
use crate::drive::{Drive, SILENT_AFTER_MAX};
use crate::recording::frame::NoteTaker;
use demands::DemandReader;
use estimation::{Estimation, EstimationInput};
use mission::{MissionInput, MissionStage, Orders, RecordInput};
use output::{Output, OutputInput};
use safety::{Safety, SafetyInput};
use sensing::{Sensing, SensingInput};

/// Longest time that one tick is taken to have lasted, seconds; a loop that slept does not leap.
const TICK_MAX_S: f64 = 0.2;
/// Speed below which the robot counts as standing, m/s and rad/s.
const STANDING: f64 = 0.02;

/// What all stages know of a tick.
#[derive(Debug, Clone, Copy)]
struct Tick {
    now: Moment,
    /// Time since the tick before, seconds.
    dt_s: f64,
    /// Whether the robot is to brake and its mission to end.
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

    /// The same loop with the configuration's word on teleoperation within a fence without
    /// knowing where the robot is.
    #[must_use]
    pub(crate) fn with_blind_within_fence(mut self, may: bool) -> Self {
        self.safety.set_blind_within_fence(may);
        self
    }

    /// The same loop with a base that counts as silent earlier.
    #[must_use]
    pub(crate) fn with_silent_after(mut self, silent_after: Duration) -> Self {
        let silent_after = silent_after.min(SILENT_AFTER_MAX);
        self.estimation.set_silent_after(silent_after);
        self.safety.set_silent_after(silent_after);
        self
    }

    /// The same loop with what is known beforehand of its robot.
    #[must_use]
    pub(crate) fn with_prior(mut self, prior: EstimatorPrior) -> Self {
        self.estimation.set_prior(prior);
        self
    }

    /// The same loop, which holds the robot when it does not keep this period.
    #[must_use]
    pub(crate) fn with_period(mut self, period: Duration) -> Self {
        self.demands.set_period(period);
        self
    }

    /// From now on it notes what it takes and gives, or no longer.
    pub(crate) fn record_to(&mut self, notes: Option<NoteTaker>) {
        self.output.record_to(notes);
    }

    /// What the base was commanded last.
    #[cfg(test)]
    pub(crate) fn command(&self) -> WheelSpeeds {
        self.safety.commanded().unwrap_or_default()
    }

    /// Whether the wheels are commanded to rest and do.
    pub(crate) fn stands(&self) -> bool {
        self.output.stands()
    }

    /// One tick that begins at `now`. With `stop`, the robot brakes and its mission ends. What carries
    /// its own end, such as a driver's command, is judged by the clock right before the gate: a tick
    /// that was interrupted lets nothing last longer.
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
        let orders = self.take_orders(tick);
        let (estimated, released) = self.estimation.step(EstimationInput {
            tick,
            sensed: &sensed,
            noise,
            site: orders.site,
            mission: self.mission.active(),
        });
        let demands = self.demands.read(now.monotonic, &self.ends.shared);
        let following = MissionInput {
            tick,
            sensed: &sensed,
            estimated: &estimated,
            demands: &demands,
            has_begun: orders.has_begun,
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
            // The base has the command: a stop that the gate knew of has set the target to zero.
            self.ends.shared.safety.note_zeroed(demands.stop);
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

    /// Takes what the rest of the agent asks for.
    fn take_orders(&mut self, tick: Tick) -> Orders {
        let mut orders = Orders::default();
        // Bounded: the channel holds a few, and whoever refills it waits for the network.
        for _ in 0..COMMANDS_MAX {
            let Ok(command) = self.ends.commands.try_recv() else {
                break;
            };
            self.output.note_command(&command);
            self.mission
                .take(command, tick, &mut orders, &mut self.events);
        }
        orders
    }

    /// Notes how long a tick computed.
    pub(crate) fn note_tick_time(&self, took: Duration) {
        let microseconds = u32::try_from(took.as_micros()).unwrap_or(u32::MAX);
        self.ends
            .shared
            .tick_max_us
            .fetch_max(microseconds, Ordering::Relaxed);
    }

    /// Notes a tick that began more than one period late.
    pub(crate) fn note_overrun(&self) {
        Shared::count(&self.ends.shared.overruns);
    }

    /// Whether the rest of the agent wants the loop to end.
    pub(crate) fn stop_requested(&self) -> bool {
        self.ends.shared.stop.load(Ordering::Relaxed)
    }

    /// Hands out what still waits; false if there was no room for all of it.
    pub(crate) fn flush(&mut self) -> bool {
        self.events.flush()
    }
}

/// Age of something, seconds; infinite for what never was.
fn age_s(now: Duration, at: Option<Duration>) -> f64 {
    at.map_or(f64::INFINITY, |at| now.saturating_sub(at).as_secs_f64())
}
