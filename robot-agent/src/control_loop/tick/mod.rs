//! One tick of the control loop: read → localise → estimate → track → gate → write.
//!
//! Pure but for the drive and the channels' ends; nothing here waits, allocates or looks at a
//! clock but the one that it is handed. What has to be freed goes out with an event, to be freed by
//! somebody else. [`sensing`] is what comes from the base, [`sensors`] whether it can be true,
//! [`orders`] what comes from the rest of the agent, [`guard`] what may only
//! slow the robot down, [`snapshot`] what goes out, [`noting`] what a record holds of a tick.

mod guard;
mod noting;
mod orders;
mod sensing;
mod sensors;
mod snapshot;

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use tread_control::consistency::{Findings, Monitor};
use tread_control::estimation::{Estimate, Estimator, EstimatorPrior, SensorNoise};
use tread_control::gate::GateLimits;
use tread_control::localisation::{Localisation, LocalisationNoise};
use tread_control::measured::WheelSpeeds;
use tread_control::robot::RobotModel;

use super::active::Active;
use super::channels::{EndReason, LoopEnds, Shared};
use super::gain::GroundRecord;
use super::outgoing::Outgoing;
use super::overrun::{Overrun, OverrunWatch};
use super::progress::ProgressWatch;
use super::segments::{Moment, SegmentCutter};
use super::site_view::{Footing, SiteView};
use super::slip::SlipMeter;
use super::standing::{Motion, StandingWatch};
use super::surface::SurfaceWatch;
use crate::drive::{Drive, SILENT_AFTER_MAX, StatedNoise};
use crate::recording::frame::NoteTaker;
use guard::Guard;

/// Longest time that one tick is taken to have lasted, seconds; a loop that slept does not leap.
const TICK_MAX_S: f64 = 0.2;
/// Speed below which the robot counts as standing, m/s and rad/s.
const STANDING: f64 = 0.02;

/// The state of the loop between two ticks.
#[derive(Debug)]
pub(crate) struct LoopCore {
    model: RobotModel,
    limits: GateLimits,
    ends: LoopEnds,
    localisation: Localisation,
    estimator: Estimator,
    estimate: Estimate,
    cutter: SegmentCutter,
    site: Option<Arc<SiteView>>,
    active: Option<Active>,
    outgoing: Outgoing,
    command: WheelSpeeds,
    measured_wheels: WheelSpeeds,
    theta_loop: Option<f64>,
    footing: Option<Footing>,
    last_tick: Option<Duration>,
    last_sample: Option<Duration>,
    last_fix: Option<Duration>,
    /// Until when the localisation has accounted for the robot's motion.
    integrated_to: Option<Duration>,
    /// How fast the robot went by a sensor of its own, m/s, and when.
    body_speed: Option<(f64, Duration)>,
    /// How far the robot leans, if the base measures it.
    tilt_rad: Option<f64>,
    /// Oldest word of the base with which it does not count as silent.
    silent_after: Duration,
    /// Whether the drive says that the base is silent.
    is_base_silent: bool,
    /// When the base was last silent, if its mission is held for that.
    base_silent_at: Option<Duration>,
    /// What the base says of its sensors' noise.
    stated_noise: StatedNoise,
    guard: Guard,
    /// Whether the loop keeps its rate, where that is known.
    overrun: Option<OverrunWatch>,
    /// Whether the robot may be teleoperated within a fence without knowing where it is.
    blind_within_fence: bool,
    /// Whether a wheel slips beyond the model.
    slips: bool,
    /// What was known of the ground in this tick of a mission.
    known: GroundRecord,
    surface: SurfaceWatch,
    progress: ProgressWatch,
    /// How much they slip.
    slip: SlipMeter,
    /// Whether the sensors agree, and what was found.
    monitor: Monitor,
    findings: Findings,
    /// Since when they hold the mission.
    sensors_hold_since: Option<Duration>,
    /// Whether the robot stands where it is to, and what was measured for that.
    standing: StandingWatch,
    motion: Motion,
    /// Until when the mission is held for its next revision.
    replacement_until: Option<Duration>,
    ticks: u64,
    /// Sums on θ of the segment that this tick closed.
    closed: Option<(f64, f64)>,
    /// Where ticks are noted, if they are recorded.
    notes: Option<NoteTaker>,
}

impl LoopCore {
    pub(crate) fn new(model: RobotModel, ends: LoopEnds) -> Self {
        let prior = EstimatorPrior::default();
        let estimator = Estimator::with_prior(model, SensorNoise::default(), prior);
        Self {
            model,
            limits: GateLimits::of(&model),
            localisation: Localisation::new(model, LocalisationNoise::default()),
            estimate: estimator.estimate(),
            estimator,
            cutter: SegmentCutter::default(),
            site: None,
            active: None,
            outgoing: Outgoing::new(ends.events.clone(), Arc::clone(&ends.shared)),
            ends,
            command: WheelSpeeds::default(),
            measured_wheels: WheelSpeeds::default(),
            theta_loop: None,
            footing: None,
            last_tick: None,
            last_sample: None,
            last_fix: None,
            integrated_to: None,
            body_speed: None,
            tilt_rad: None,
            silent_after: SILENT_AFTER_MAX,
            is_base_silent: false,
            base_silent_at: None,
            stated_noise: StatedNoise::default(),
            guard: Guard::default(),
            overrun: None,
            blind_within_fence: false,
            slips: false,
            known: GroundRecord::default(),
            surface: SurfaceWatch::default(),
            progress: ProgressWatch::default(),
            slip: SlipMeter::default(),
            monitor: Monitor::new(model),
            findings: Findings::default(),
            sensors_hold_since: None,
            standing: StandingWatch::default(),
            motion: Motion::default(),
            replacement_until: None,
            ticks: 0,
            closed: None,
            notes: None,
        }
    }

    /// The same loop with the configuration's word on teleoperation within a fence without
    /// knowing where the robot is.
    #[must_use]
    pub(crate) fn with_blind_within_fence(mut self, may: bool) -> Self {
        self.blind_within_fence = may;
        self
    }

    /// The same loop with a base that counts as silent earlier.
    #[must_use]
    pub(crate) fn with_silent_after(mut self, silent_after: Duration) -> Self {
        self.silent_after = silent_after.min(SILENT_AFTER_MAX);
        self.limits.feedback_age_max_s = self.silent_after.as_secs_f64();
        self
    }

    /// The same loop with what is known beforehand of its robot.
    #[must_use]
    pub(crate) fn with_prior(mut self, prior: EstimatorPrior) -> Self {
        self.estimator = Estimator::with_prior(self.model, SensorNoise::default(), prior);
        self.estimate = self.estimator.estimate();
        self
    }

    /// The same loop, which holds the robot when it does not keep this period.
    #[must_use]
    pub(crate) fn with_period(mut self, period: Duration) -> Self {
        self.overrun = Some(OverrunWatch::new(period));
        self
    }

    /// From now on it notes what it takes and gives, or no longer.
    pub(crate) fn record_to(&mut self, notes: Option<NoteTaker>) {
        self.notes = notes;
    }

    /// What the base was commanded last.
    #[cfg(test)]
    pub(crate) fn command(&self) -> WheelSpeeds {
        self.command
    }

    /// Whether the wheels are commanded to rest and do.
    pub(crate) fn stands(&self) -> bool {
        let radius_m = self.model.wheel_radius_m();
        self.command == WheelSpeeds::default()
            && self.measured_wheels.magnitude_max_rad_s() * radius_m < 5.0 * STANDING
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
        self.outgoing.flush();
        self.closed = None;
        let dt_s = self.time_step_s(now.monotonic);
        let feedback = drive.read(now.monotonic);
        self.is_base_silent = drive.is_silent();
        self.take_noise(drive.noise());
        let ground_changed = self.take_samples(&feedback);
        self.measure_slip(now.monotonic, dt_s);
        self.take_commands(now, stop);
        self.cut_segments(now, ground_changed, dt_s);
        self.check_safety(now.monotonic);
        self.check_bounds(now.monotonic);
        let fault = self.fault(now.monotonic);
        self.hold_for_base(now.monotonic, fault);
        self.hold_for_sensors(now);
        let by_mission = self.follow(now, fault, dt_s);
        let judged = clock().max(now.monotonic);
        self.guard.judge(judged);
        let wanted = self.choose(judged, by_mission, dt_s);
        let gated = self.pass(judged, fault, &wanted, stop, dt_s);
        self.command = gated.wheel_speeds;
        drive.write(self.command);
        self.note_written();
        self.check_standstill(now.monotonic, &gated);
        self.record(dt_s, ground_changed, gated.cause);
        if stop {
            self.end_mission(now, EndReason::AgentStopped);
        }
        self.report_start(now);
        self.ticks += 1;
        self.ends.shared.ticks.store(self.ticks, Ordering::Relaxed);
        let snapshot = self.snapshot(now.monotonic, fault, drive.battery());
        self.ends.shared.publish(&snapshot);
        self.note(now, stop, &feedback, &wanted, &snapshot);
    }

    fn time_step_s(&mut self, now: Duration) -> f64 {
        let before = self.last_tick.replace(now).unwrap_or(now);
        now.saturating_sub(before).as_secs_f64().min(TICK_MAX_S)
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

    /// How far the loop is from its rate, while the robot is held for it.
    fn overrun(&self) -> Option<Overrun> {
        self.overrun.as_ref().and_then(OverrunWatch::overrun)
    }

    /// Whether the rest of the agent wants the loop to end.
    pub(crate) fn stop_requested(&self) -> bool {
        self.ends.shared.stop.load(Ordering::Relaxed)
    }

    /// Hands out what still waits; false if there was no room for all of it.
    pub(crate) fn flush(&mut self) -> bool {
        self.outgoing.flush()
    }
}

/// Age of something, seconds; infinite for what never was.
fn age_s(now: Duration, at: Option<Duration>) -> f64 {
    at.map_or(f64::INFINITY, |at| now.saturating_sub(at).as_secs_f64())
}
