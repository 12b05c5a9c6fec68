//! Answers the server's commands: offers, pauses, cancellations, new definitions of the site, requests
//! for states more often.
//!
//! Offers are processed one after the other, so that a repeated offer finds the first one decided;
//! all other commands run concurrently, so that planning does not delay a cancellation. Planning
//! and disk writes are awaited here, never in the loop.
//!
//! A new revision of the active mission is planned from where the robot will stop:
//! ```text
//! offer ─► loop holds the mission ─► predict where it stops ─► plan ─► held ─► loop swaps there
//!                                                                 └ refused: hold released
//! ```

pub(crate) mod answers;
mod planning;
mod traces;

use std::sync::Arc;
use std::sync::mpsc::SyncSender;
use std::time::Duration;

use serde::de::DeserializeOwned;
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;
use tracing::{error, info, warn};
use tread_api::ids::{BootId, MissionId};
use tread_api::keys::Verb;
use tread_api::mission::PlanSummary;
use tread_api::robot::RobotMode;
use tread_api::wire::command::{Cancel, OUTCOMES_MAX, Offer, Outcomes, Pause, Resume};
use tread_api::wire::hello::SiteDefinition;
use tread_api::wire::reply::{
    Answer, Command, CommandRefusal, CommandRefusalCode, MissionOutcomes,
};
use tread_api::wire::safety::{AcquireLease, LeaseCommand, ReleaseLease};
use tread_api::wire::{self, Refusal, WireError};
use tread_control::geometry::Pose;
use tread_control::robot::RobotModel;
use tread_telemetry::Telemetry;

use self::planning::{active_of, given_of};
use crate::clock::SharedClock;
use crate::control_loop::channels::Hold;
use crate::control_loop::channels::{LoopCommand, Shared};
use crate::control_loop::site_view::SiteView;
use crate::fleet::{Commands, IncomingCommand};
use crate::knowledge::{Missions, SiteCell};
use crate::missions::{CancelDecision, OfferDecision};
use crate::safety::Safety;
use crate::state_rate::PublishRate;

/// Capacity of the queue of offers; the server repeats an offer that finds it full.
const OFFERS_MAX: usize = 8;
/// Capacity of the queue of stops, clears, leases and limits.
const URGENT_MAX: usize = 32;
/// Largest distance of a robot from the reference of its paused mission at which it may be resumed,
/// metres.
const RESUME_WITHIN_M: f64 = 0.5;
/// Longest wait for the loop to hold a mission for its next revision.
const HOLD_WAIT_MAX: Duration = Duration::from_secs(5);
/// Interval of the checks of the loop's snapshot.
const HOLD_POLL_EVERY: Duration = Duration::from_millis(5);
/// Speed of a reference up to which it counts as stopped, m/s.
const STANDS_M_S: f64 = 0.02;

/// Processes and answers commands.
#[derive(Debug)]
pub(crate) struct Dispatcher {
    pub(crate) boot: BootId,
    pub(crate) model: RobotModel,
    pub(crate) clock: SharedClock,
    pub(crate) missions: Arc<Missions>,
    pub(crate) site: Arc<SiteCell>,
    pub(crate) shared: Arc<Shared>,
    pub(crate) safety: Arc<Safety>,
    pub(crate) publish_rate: Arc<PublishRate>,
    pub(crate) to_loop: SyncSender<LoopCommand>,
    pub(crate) telemetry: Telemetry,
}

fn refused<T>(code: CommandRefusalCode, detail: impl Into<String>) -> Result<T, CommandRefusal> {
    Err(CommandRefusal::new(code, detail))
}

fn loop_is_busy() -> CommandRefusal {
    CommandRefusal::new(CommandRefusalCode::NotReady, "the control loop is busy")
}

impl Dispatcher {
    /// Answers commands until requested to stop.
    pub(crate) async fn run(self: Arc<Self>, mut commands: Commands, stop: CancellationToken) {
        let (to_planner, mut offers) = mpsc::channel(OFFERS_MAX);
        let (to_guard, mut urgent) = mpsc::channel(URGENT_MAX);
        let answering = async {
            while let Some(command) = commands.recv().await {
                let lane = match command.verb {
                    Verb::Offer => &to_planner,
                    Verb::Stop | Verb::Clear | Verb::Lease | Verb::Limit => &to_guard,
                    Verb::Cancel
                    | Verb::Pause
                    | Verb::Resume
                    | Verb::Site
                    | Verb::StateRate
                    | Verb::Outcomes => {
                        self.respond(command).await;
                        continue;
                    }
                };
                if lane.try_send(command).is_err() {
                    // Dropped: the server gets no reply and repeats the command.
                    Shared::count(&self.shared.lost_commands);
                }
            }
        };
        let guarding = async {
            while let Some(command) = urgent.recv().await {
                self.respond(command).await;
            }
        };
        let planning = async {
            while let Some(offer) = offers.recv().await {
                self.respond(offer).await;
            }
        };
        tokio::select! {
            ((), (), ()) = async { tokio::join!(answering, guarding, planning) } => {}
            () = stop.cancelled() => {}
        }
    }

    async fn respond(&self, command: IncomingCommand) {
        match command.verb {
            Verb::Offer => {
                let parent = wire::traceparent(&command.payload);
                let offer = |offer| self.traced_offer(offer, parent);
                self.answer(command, offer).await;
            }
            Verb::Cancel => self.answer(command, |cancel| self.cancel(cancel)).await,
            Verb::Pause => {
                let pause = async |pause: Pause| self.hold(pause.mission, pause.revision, true);
                self.answer(command, pause).await;
            }
            Verb::Resume => {
                let resume =
                    async |resume: Resume| self.hold(resume.mission, resume.revision, false);
                self.answer(command, resume).await;
            }
            Verb::Site => {
                let site = async |definition| self.apply_valid_site(definition);
                self.answer(command, site).await;
            }
            Verb::Stop => {
                let stop = async |stop| answers::stop(&self.safety, &stop).await;
                self.answer(command, stop).await;
            }
            Verb::Clear => {
                let clear = async |clear| {
                    answers::clear(&self.safety, &self.shared, &self.clock, &clear).await
                };
                self.answer(command, clear).await;
            }
            Verb::Lease => match wire::decode(&command.payload) {
                Ok(LeaseCommand::Acquire(acquire)) => {
                    let acquired = answers::acquire_lease(&self.safety, &acquire);
                    self.reply::<AcquireLease, _>(command, acquired).await;
                }
                Ok(LeaseCommand::Release(release)) => {
                    let released = answers::release_lease(&self.safety, &release);
                    self.reply::<ReleaseLease, _>(command, released).await;
                }
                Err(cause) => self.refuse(command, &cause).await,
            },
            Verb::Limit => {
                let limit = async |limit| answers::limit(&self.safety, &limit);
                self.answer(command, limit).await;
            }
            Verb::StateRate => {
                let rate = async |request| self.publish_rate.request(request);
                self.answer(command, rate).await;
            }
            Verb::Outcomes => {
                let outcomes = async |request| self.outcomes(&request);
                self.answer(command, outcomes).await;
            }
        }
    }

    fn outcomes(&self, request: &Outcomes) -> Result<MissionOutcomes, CommandRefusal> {
        let count = request.missions.len();
        if count > OUTCOMES_MAX {
            let detail = format!("{count} missions; at most {OUTCOMES_MAX} are possible");
            return refused(CommandRefusalCode::TooMany, detail);
        }
        Ok(self.missions.slot().outcomes(&request.missions))
    }

    /// Decodes a command, decides on it and answers.
    async fn answer<C, T>(
        &self,
        command: IncomingCommand,
        decide: impl AsyncFnOnce(C) -> Result<T, CommandRefusal>,
    ) where
        C: Command + DeserializeOwned,
        C::Reply: From<Result<T, CommandRefusal>>,
    {
        match wire::decode(&command.payload) {
            Ok(request) => self.reply::<C, T>(command, decide(request).await).await,
            Err(cause) => self.refuse(command, &cause).await,
        }
    }

    async fn reply<C, T>(&self, command: IncomingCommand, decided: Result<T, CommandRefusal>)
    where
        C: Command,
        C::Reply: From<Result<T, CommandRefusal>>,
    {
        let boot = self.boot;
        let reply = C::Reply::from(decided);
        command.answer(&Answer { boot, reply }).await;
    }

    /// Refuses a command that cannot be decoded.
    async fn refuse(&self, command: IncomingCommand, cause: &WireError) {
        Shared::count(&self.shared.commands_refused);
        warn!(
            error = cause as &dyn std::error::Error,
            "refused a `{}` command",
            command.verb.as_str(),
        );
        command.refuse(&Refusal::from(cause)).await;
    }

    fn apply_valid_site(&self, definition: SiteDefinition) -> Result<(), CommandRefusal> {
        let checked = definition.geofence.validate();
        checked.or_else(|cause| refused(CommandRefusalCode::Impossible, cause.to_string()))?;
        if !self.apply_site(definition) {
            return Err(loop_is_busy());
        }
        Ok(())
    }

    /// Applies the site definition of a server's welcome; false if the loop's command queue is
    /// full.
    ///
    /// With a geofence beyond the size that a tick can process the robot does not drive without
    /// one, but has no room anywhere until it gets another.
    pub(crate) fn handle_welcome(&self, definition: SiteDefinition) -> bool {
        match definition.geofence.validate() {
            Ok(()) => self.apply_site(definition),
            Err(cause) => {
                error!("the site's geofence cannot be kept, so the robot stays: {cause}");
                self.take(SiteView::without_room(definition))
            }
        }
    }

    /// Applies a site definition; false if the loop's command queue is full.
    pub(crate) fn apply_site(&self, definition: SiteDefinition) -> bool {
        self.take(SiteView::new(definition))
    }

    fn take(&self, view: SiteView) -> bool {
        let mut cell = self.site.lock();
        let definition = view.definition().clone();
        if cell.as_ref().is_some_and(|(known, _)| *known == definition) {
            return true;
        }
        let revision = definition.terrain_revision;
        let view = Arc::new(view);
        if self
            .to_loop
            .try_send(LoopCommand::Site(Arc::clone(&view)))
            .is_err()
        {
            return false;
        }
        info!(revision, "the site's terrains are at revision {revision}");
        *cell = Some((definition, view));
        true
    }

    async fn offer(&self, offer: Offer) -> Result<PlanSummary, CommandRefusal> {
        let received_at = self.clock.monotonic();
        let start_by = offer
            .start_within_ms
            .map(|within_ms| received_at.saturating_add(Duration::from_millis(within_ms)));
        let decision = self.missions.slot().offer(&offer);
        match decision {
            OfferDecision::AcceptAgain(plan) => Ok(plan),
            OfferDecision::Refuse(refusal) => {
                let CommandRefusal { code, detail } = &refusal;
                info!(mission.id = %offer.mission, ?code, "refused a mission: {detail}");
                Err(refusal)
            }
            OfferDecision::Plan => self.plan_and_start(offer, start_by).await,
            OfferDecision::Replace => {
                let mission = offer.mission;
                if !self.send_to_loop(LoopCommand::Hold(mission, Hold::Replacement)) {
                    return Err(loop_is_busy());
                }
                let replaced = self.plan_and_replace(offer).await;
                if replaced.is_err() {
                    // If it does not arrive, the loop ends the hold by itself after a while.
                    self.send_to_loop(LoopCommand::Release(mission, Hold::Replacement));
                }
                replaced
            }
        }
    }

    fn send_to_loop(&self, command: LoopCommand) -> bool {
        self.to_loop.try_send(command).is_ok()
    }

    fn hold(
        &self,
        mission: MissionId,
        revision: u32,
        is_pause: bool,
    ) -> Result<(), CommandRefusal> {
        self.missions.slot().check_active(mission, revision)?;
        if !is_pause {
            self.may_resume()?;
        }
        let (command, what) = if is_pause {
            (LoopCommand::Hold(mission, Hold::Pause), "pausing")
        } else {
            (LoopCommand::Release(mission, Hold::Pause), "resuming")
        };
        if !self.send_to_loop(command) {
            return Err(loop_is_busy());
        }
        info!(mission.id = %mission, "{what} {mission}");
        Ok(())
    }

    /// Checks whether a paused mission may go on.
    fn may_resume(&self) -> Result<(), CommandRefusal> {
        if let Some(latch) = self.safety.latch() {
            let detail = format!("stopped by {}: {}", latch.by, latch.reason);
            return refused(CommandRefusalCode::Stopped, detail);
        }
        if let Some(lease) = self.safety.lease_now() {
            return Err(answers::leased_by(&lease.driver));
        }
        match self.shared.snapshot().off_path_m {
            Some(off_m) if off_m.is_nan() || off_m > RESUME_WITHIN_M => refused(
                CommandRefusalCode::Impossible,
                format!(
                    "the robot is {off_m:.1} m from where the mission goes on: drive it back, or replace the mission"
                ),
            ),
            Some(_) | None => Ok(()),
        }
    }

    async fn plan_and_start(
        &self,
        offer: Offer,
        start_by: Option<Duration>,
    ) -> Result<PlanSummary, CommandRefusal> {
        let snapshot = self.shared.snapshot();
        let start = match (snapshot.mode, snapshot.pose) {
            (RobotMode::Idle, Some((pose, _))) => pose,
            (RobotMode::Idle, None) => {
                return refused(
                    CommandRefusalCode::NotReady,
                    "the robot does not know where it is",
                );
            }
            (mode, _) => {
                let fault = snapshot
                    .fault
                    .map_or("", super::control_loop::channels::Fault::text);
                return refused(
                    CommandRefusalCode::NotReady,
                    format!("the robot is {mode:?} {fault}"),
                );
            }
        };
        let planned = self.plan(&offer, start, start_by).await?;
        if start_by.is_some_and(|latest| self.clock.monotonic() > latest) {
            return refused(CommandRefusalCode::TooLate, "its latest start has passed");
        }
        // Made active before the loop has it, so that its end cannot be reported before its begin.
        let (mission, plan) = (offer.mission, planned.summary);
        if !self.missions.slot().take(active_of(&offer, plan)) {
            // What arrived meanwhile gives the reason: a cancellation, or another mission.
            return match self.missions.slot().offer(&offer) {
                OfferDecision::Refuse(refusal) => Err(refusal),
                OfferDecision::Plan | OfferDecision::Replace | OfferDecision::AcceptAgain(_) => {
                    refused(CommandRefusalCode::NotReady, "another command came first")
                }
            };
        }
        self.shared.show_plan(given_of(&offer, planned.plan));
        if !self.send_to_loop(LoopCommand::Start(planned.job)) {
            self.missions.slot().release(mission);
            return Err(loop_is_busy());
        }
        // Both commands reach the same tick. If the queue is full, the server pauses the active
        // mission.
        if offer.on_hold && !self.send_to_loop(LoopCommand::Hold(mission, Hold::Pause)) {
            warn!(mission.id = %mission, "{mission} was to be held, and the control loop is busy");
        }
        info!(
            mission.id = %mission,
            length_m = plan.length_m,
            duration_s = plan.duration_s,
            "took mission {mission}",
        );
        self.save().await;
        Ok(plan)
    }

    /// Replaces the active mission by its next revision, once the loop holds it.
    async fn plan_and_replace(&self, offer: Offer) -> Result<PlanSummary, CommandRefusal> {
        let Some(start) = self.rest_of(offer.mission).await else {
            return refused(CommandRefusalCode::NotReady, "the robot could not be held");
        };
        let planned = self.plan(&offer, start, None).await?;
        let (mission, plan) = (offer.mission, planned.summary);
        let Some(former) = self.missions.slot().replace(active_of(&offer, plan)) else {
            return refused(CommandRefusalCode::Ended, "the mission ended meanwhile");
        };
        if !self.send_to_loop(LoopCommand::Replace(planned.job)) {
            self.missions.slot().restore(former);
            return Err(loop_is_busy());
        }
        self.shared.show_plan(given_of(&offer, planned.plan));
        let revision = offer.revision;
        info!(mission.id = %mission, revision, "took revision {revision} of {mission}");
        self.save().await;
        Ok(plan)
    }

    /// Predicts where the robot stops, once the loop holds the mission; `None` if the mission is
    /// not held in time.
    async fn rest_of(&self, mission: MissionId) -> Option<Pose> {
        let driving = self.shared.given_plan()?;
        let looking = async {
            loop {
                let snapshot = self.shared.snapshot();
                let progress = snapshot.mission.filter(|now| now.id == mission)?;
                // A revision that was accepted just before may still wait for the robot to stop.
                if snapshot.is_on_hold && progress.revision == driving.revision {
                    let governor = snapshot.governor?;
                    let (measured, _) = snapshot.pose?;
                    let speed_m_s = governor.sample(&driving.plan).speed_m_s;
                    let is_moving = speed_m_s > STANDS_M_S;
                    return Some((is_moving.then_some(governor), measured));
                }
                tokio::time::sleep(HOLD_POLL_EVERY).await;
            }
        };
        let is_known = driving.mission == mission;
        let found = tokio::time::timeout(HOLD_WAIT_MAX, looking).await.ok()?;
        let (moving, measured) = found.filter(|_| is_known)?;
        let Some(governor) = moving else {
            return Some(measured);
        };
        let computing_rest = tokio::task::spawn_blocking(move || governor.rest(&driving.plan));
        computing_rest.await.ok()
    }

    async fn cancel(&self, cancel: Cancel) -> Result<(), CommandRefusal> {
        let mission = cancel.mission;
        let decision = self.missions.slot().cancel(mission);
        match decision {
            CancelDecision::Brake => {
                if !self.send_to_loop(LoopCommand::Cancel(mission)) {
                    return Err(loop_is_busy());
                }
                info!(mission.id = %mission, reason = cancel.reason, "cancelling {mission}");
                // Once answered, it stays cancelled even if the agent dies.
                self.save().await;
                Ok(())
            }
            CancelDecision::CancelledBefore => Ok(()),
            CancelDecision::EndedBefore(phase) => refused(
                CommandRefusalCode::Ended,
                format!("it has ended before: {phase:?}"),
            ),
            CancelDecision::Unknown => {
                self.save().await;
                refused(CommandRefusalCode::Unknown, "it was never offered here")
            }
        }
    }

    async fn save(&self) {
        let missions = Arc::clone(&self.missions);
        // Fails only when the runtime shuts down.
        let _ = tokio::task::spawn_blocking(move || missions.save()).await;
    }
}
