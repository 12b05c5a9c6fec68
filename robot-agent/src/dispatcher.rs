//! Answers the server's commands: offers, pauses, cancellations, new definitions of the site.
//!
//! One offer after the other, so that one that comes twice finds the first one decided; all other
//! commands beside them, so that no planning delays a cancellation. Planning and disks are waited
//! for here, never in the loop.
//!
//! A new revision of the active mission is planned from where the robot comes to stand:
//! ```text
//! offer ─► loop holds the mission ─► foretell where it stands ─► plan ─► held ─► loop swaps there
//!                                                                 └ refused: loop lets it go on
//! ```

use std::sync::Arc;
use std::sync::mpsc::{SyncSender, TrySendError};
use std::time::Duration;

use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;
use tracing::{error, info, warn};
use tread_api::ids::{BootId, MissionId};
use tread_api::keys::Verb;
use tread_api::mission::{LinkPolicy, PlanSummary};
use tread_api::robot::RobotMode;
use tread_api::wire::command::{Answer, Cancel, Offer, OfferRefusal, Outcome, Pause, Resume};
use tread_api::wire::hello::SiteDefinition;
use tread_api::wire::{self, Refusal, WireError};
use tread_control::geometry::Pose;
use tread_control::plan::Plan;
use tread_control::robot::RobotModel;

use crate::clock::SharedClock;
use crate::control_loop::active::Hold;
use crate::control_loop::channels::{GivenPlan, Job, LoopCommand, Shared};
use crate::control_loop::origin::JobOrigin;
use crate::control_loop::site_view::SiteView;
use crate::fleet::{Commands, IncomingCommand};
use crate::geometry::wire_pose;
use crate::knowledge::{Missions, SiteCell};
use crate::missions::{ActiveMission, CancelDecision, OfferDecision};
use crate::safety::{Safety, answers};

/// Offers that may wait while another is planned; the server asks again for more.
const OFFERS_MAX: usize = 8;
/// Stops, leases and limits that may wait while one is written to the disk.
const URGENT_MAX: usize = 32;
/// Farthest that a robot may be from where a paused mission goes on, metres.
const RESUME_WITHIN_M: f64 = 0.5;
/// Longest wait until the loop holds a mission for its next revision.
const HOLD_WAIT_MAX: Duration = Duration::from_secs(5);
/// Time between two looks at what the loop does.
const HOLD_LOOK_EVERY: Duration = Duration::from_millis(5);
/// A reference slower than this stands as good as, metres per second.
const STANDS_M_S: f64 = 0.02;

/// Who answers commands.
#[derive(Debug)]
pub(crate) struct Dispatcher {
    pub(crate) boot: BootId,
    pub(crate) model: RobotModel,
    pub(crate) clock: SharedClock,
    pub(crate) missions: Arc<Missions>,
    pub(crate) site: Arc<SiteCell>,
    pub(crate) shared: Arc<Shared>,
    pub(crate) safety: Arc<Safety>,
    pub(crate) to_loop: SyncSender<LoopCommand>,
}

/// A plan that can be driven.
struct Planned {
    summary: PlanSummary,
    plan: Arc<Plan>,
    job: Box<Job>,
}

fn refused(code: OfferRefusal, detail: impl Into<String>) -> Outcome {
    Outcome::Refused {
        code,
        detail: detail.into(),
    }
}

fn active_of(offer: &Offer, plan: PlanSummary) -> ActiveMission {
    ActiveMission {
        mission: offer.mission,
        revision: offer.revision,
        plan_hash: offer.plan_hash,
        plan,
        is_cancelled: false,
    }
}

fn given_of(offer: &Offer, plan: Arc<Plan>) -> GivenPlan {
    GivenPlan {
        mission: offer.mission,
        revision: offer.revision,
        plan,
    }
}

/// Longest silence of the server that a mission bears.
fn silence_max(policy: LinkPolicy) -> Result<Option<Duration>, String> {
    policy.validate()?;
    Ok(match policy {
        LinkPolicy::Continue => None,
        LinkPolicy::StopAfter { silence_s } => Some(Duration::from_secs_f64(silence_s)),
    })
}

impl Dispatcher {
    /// Answers for ever.
    pub(crate) async fn run(self: Arc<Self>, mut commands: Commands, stop: CancellationToken) {
        let (to_planner, mut offers) = mpsc::channel(OFFERS_MAX);
        let (to_guard, mut urgent) = mpsc::channel(URGENT_MAX);
        let answering = async {
            while let Some(command) = commands.recv().await {
                let lane = match command.verb {
                    Verb::Offer => &to_planner,
                    Verb::Stop | Verb::Clear | Verb::Lease | Verb::Limit => &to_guard,
                    Verb::Cancel | Verb::Pause | Verb::Resume | Verb::Site => {
                        self.respond(command).await;
                        continue;
                    }
                };
                if lane.try_send(command).is_err() {
                    // Dropped: the server sees no reply and asks again.
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
        match self.decide(command.verb, &command.payload).await {
            Ok(outcome) => {
                let boot = self.boot;
                command.answer(&Answer { boot, outcome }).await;
            }
            Err(cause) => {
                Shared::count(&self.shared.commands_refused);
                warn!(
                    error = &cause as &dyn std::error::Error,
                    "refused a `{}` command",
                    command.verb.as_str(),
                );
                command.refuse(&Refusal::from(&cause)).await;
            }
        }
    }

    async fn decide(&self, verb: Verb, payload: &[u8]) -> Result<Outcome, WireError> {
        Ok(match verb {
            Verb::Offer => self.offer(wire::decode(payload)?).await,
            Verb::Cancel => self.cancel(&wire::decode(payload)?).await,
            Verb::Pause => {
                let Pause { mission, revision } = wire::decode(payload)?;
                self.hold(mission, revision, true)
            }
            Verb::Resume => {
                let Resume { mission, revision } = wire::decode(payload)?;
                self.hold(mission, revision, false)
            }
            Verb::Site => {
                let definition: SiteDefinition = wire::decode(payload)?;
                let checked = definition.geofence.validate();
                if let Err(cause) = checked {
                    refused(OfferRefusal::Impossible, cause.to_string())
                } else if self.take_site(definition) {
                    Outcome::Done
                } else {
                    refused(OfferRefusal::NotReady, "the control loop is busy")
                }
            }
            Verb::Stop => answers::stop(&self.safety, &wire::decode(payload)?).await,
            Verb::Clear => {
                let clear = wire::decode(payload)?;
                answers::clear(&self.safety, &self.shared, &self.clock, &clear).await
            }
            Verb::Lease => answers::lease(&self.safety, &wire::decode(payload)?),
            Verb::Limit => answers::limit(&self.safety, &wire::decode(payload)?),
        })
    }

    /// Takes the site of a server's welcome; false if the loop has no room for it now.
    ///
    /// A geofence that is larger than a tick can look at is no reason to drive without any: the
    /// robot then finds no room anywhere until it is told of another.
    pub(crate) fn take_welcome(&self, definition: SiteDefinition) -> bool {
        match definition.geofence.validate() {
            Ok(()) => self.take_site(definition),
            Err(cause) => {
                error!("the site's geofence cannot be kept, so the robot stays: {cause}");
                self.take(SiteView::without_room(definition))
            }
        }
    }

    /// Takes a definition of the site; false if the loop has no room for it now.
    pub(crate) fn take_site(&self, definition: SiteDefinition) -> bool {
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

    async fn offer(&self, offer: Offer) -> Outcome {
        let received_at = self.clock.monotonic();
        let start_by = offer
            .start_within_ms
            .map(|within_ms| received_at.saturating_add(Duration::from_millis(within_ms)));
        let decision = self.missions.slot().offer(&offer);
        match decision {
            OfferDecision::AcceptAgain(plan) => Outcome::Accepted { plan: Some(plan) },
            OfferDecision::Refuse(code, detail) => {
                info!(mission.id = %offer.mission, ?code, "refused a mission: {detail}");
                refused(code, detail)
            }
            OfferDecision::Plan => self.plan_and_start(offer, start_by).await,
            OfferDecision::Replace => {
                let mission = offer.mission;
                if !self.tell_loop(LoopCommand::Hold(mission, Hold::Replacement)) {
                    return refused(OfferRefusal::NotReady, "the control loop is busy");
                }
                let outcome = self.plan_and_replace(offer).await;
                if !matches!(outcome, Outcome::Accepted { .. }) {
                    // Should it not arrive, the loop lets go by itself after a while.
                    self.tell_loop(LoopCommand::Release(mission, Hold::Replacement));
                }
                outcome
            }
        }
    }

    fn tell_loop(&self, command: LoopCommand) -> bool {
        self.to_loop.try_send(command).is_ok()
    }

    fn hold(&self, mission: MissionId, revision: u32, is_pause: bool) -> Outcome {
        if let Err((code, detail)) = self.missions.slot().check_active(mission, revision) {
            return refused(code, detail);
        }
        if !is_pause && let Err(refusal) = self.may_resume() {
            return refusal;
        }
        let (command, what) = if is_pause {
            (LoopCommand::Hold(mission, Hold::Pause), "pausing")
        } else {
            (LoopCommand::Release(mission, Hold::Pause), "resuming")
        };
        if !self.tell_loop(command) {
            return refused(OfferRefusal::NotReady, "the control loop is busy");
        }
        info!(mission.id = %mission, "{what} {mission}");
        Outcome::Done
    }

    /// Whether a paused mission may go on now.
    fn may_resume(&self) -> Result<(), Outcome> {
        if let Some(latch) = self.safety.latch() {
            let detail = format!("stopped by {}: {}", latch.by, latch.reason);
            return Err(refused(OfferRefusal::Stopped, detail));
        }
        if let Some(lease) = self.safety.lease_now() {
            let detail = format!("{} teleoperates the robot", lease.driver.name);
            return Err(refused(OfferRefusal::Leased, detail));
        }
        match self.shared.snapshot().off_path_m {
            Some(off_m) if off_m.is_nan() || off_m > RESUME_WITHIN_M => Err(refused(
                OfferRefusal::Impossible,
                format!(
                    "the robot is {off_m:.1} m from where the mission goes on: drive it back, or replace the mission"
                ),
            )),
            Some(_) | None => Ok(()),
        }
    }

    async fn plan_and_start(&self, offer: Offer, start_by: Option<Duration>) -> Outcome {
        let snapshot = self.shared.snapshot();
        let start = match (snapshot.mode, snapshot.pose) {
            (RobotMode::Idle, Some((pose, _))) => pose,
            (RobotMode::Idle, None) => {
                return refused(
                    OfferRefusal::NotReady,
                    "the robot does not know where it is",
                );
            }
            (mode, _) => {
                let fault = snapshot
                    .fault
                    .map_or("", super::control_loop::channels::Fault::text);
                return refused(
                    OfferRefusal::NotReady,
                    format!("the robot is {mode:?} {fault}"),
                );
            }
        };
        let planned = match self.plan(&offer, start, start_by).await {
            Ok(planned) => planned,
            Err(detail) => return refused(OfferRefusal::Impossible, detail),
        };
        if start_by.is_some_and(|latest| self.clock.monotonic() > latest) {
            return refused(OfferRefusal::TooLate, "its latest start has passed");
        }
        // Held before the loop has it, so that its end cannot be reported before its begin.
        let (mission, plan) = (offer.mission, planned.summary);
        if !self.missions.slot().take(active_of(&offer, plan)) {
            // What came meanwhile says why: a cancellation, or another mission.
            return match self.missions.slot().offer(&offer) {
                OfferDecision::Refuse(code, detail) => refused(code, detail),
                OfferDecision::Plan | OfferDecision::Replace | OfferDecision::AcceptAgain(_) => {
                    refused(OfferRefusal::NotReady, "another command came first")
                }
            };
        }
        self.shared.show_plan(given_of(&offer, planned.plan));
        match self.to_loop.try_send(LoopCommand::Start(planned.job)) {
            Ok(()) => {}
            Err(TrySendError::Full(_) | TrySendError::Disconnected(_)) => {
                self.missions.slot().release(mission);
                return refused(OfferRefusal::NotReady, "the control loop is busy");
            }
        }
        // The same tick takes both. Without room the server pauses it once it sees it driven.
        if offer.on_hold && !self.tell_loop(LoopCommand::Hold(mission, Hold::Pause)) {
            warn!(mission.id = %mission, "{mission} was to be held, and the control loop is busy");
        }
        info!(
            mission.id = %mission,
            length_m = plan.length_m,
            duration_s = plan.duration_s,
            "took mission {mission}",
        );
        self.save().await;
        Outcome::Accepted { plan: Some(plan) }
    }

    /// Swaps the active mission for its next revision; the loop holds it already or soon.
    async fn plan_and_replace(&self, offer: Offer) -> Outcome {
        let Some(start) = self.rest_of(offer.mission).await else {
            return refused(OfferRefusal::NotReady, "the robot could not be held");
        };
        let planned = match self.plan(&offer, start, None).await {
            Ok(planned) => planned,
            Err(detail) => return refused(OfferRefusal::Impossible, detail),
        };
        let (mission, plan) = (offer.mission, planned.summary);
        let Some(former) = self.missions.slot().replace(active_of(&offer, plan)) else {
            return refused(OfferRefusal::Ended, "the mission ended meanwhile");
        };
        if !self.tell_loop(LoopCommand::Replace(planned.job)) {
            self.missions.slot().restore(former);
            return refused(OfferRefusal::NotReady, "the control loop is busy");
        }
        self.shared.show_plan(given_of(&offer, planned.plan));
        let revision = offer.revision;
        info!(mission.id = %mission, revision, "took revision {revision} of {mission}");
        self.save().await;
        Outcome::Accepted { plan: Some(plan) }
    }

    /// Where the robot comes to stand, once the loop holds the mission.
    async fn rest_of(&self, mission: MissionId) -> Option<Pose> {
        let driving = self.shared.given_plan()?;
        let looking = async {
            loop {
                let snapshot = self.shared.snapshot();
                let progress = snapshot.mission.filter(|now| now.id == mission)?;
                // A revision that was taken a moment ago may still wait for the robot to stand.
                if snapshot.is_on_hold && progress.revision == driving.revision {
                    let governor = snapshot.governor?;
                    let (measured, _) = snapshot.pose?;
                    let speed_m_s = governor.sample(&driving.plan).speed_m_s;
                    let is_moving = speed_m_s > STANDS_M_S;
                    return Some((is_moving.then_some(governor), measured));
                }
                tokio::time::sleep(HOLD_LOOK_EVERY).await;
            }
        };
        let is_known = driving.mission == mission;
        let found = tokio::time::timeout(HOLD_WAIT_MAX, looking).await.ok()?;
        let (moving, measured) = found.filter(|_| is_known)?;
        let Some(governor) = moving else {
            return Some(measured);
        };
        let foretelling = tokio::task::spawn_blocking(move || governor.rest(&driving.plan));
        foretelling.await.ok()
    }

    /// Plans an offer from a pose.
    async fn plan(
        &self,
        offer: &Offer,
        start: Pose,
        start_by: Option<Duration>,
    ) -> Result<Planned, String> {
        let model = self.model;
        let view = self.site.view();
        let offer = offer.clone();
        let planning = tokio::task::spawn_blocking(move || {
            let origin = JobOrigin {
                mission: offer.mission,
                revision: offer.revision,
                plan_hash: offer.plan_hash,
                trajectory: offer.trajectory,
                start,
                prior: offer.prior,
                grid: view.as_ref().map(|view| view.grid()),
                start_by,
                silence_max: silence_max(offer.link_policy)?,
            };
            let plan = origin.plan(&model)?;
            if let Some(breach) = view.and_then(|view| view.fence().plan_breach(&plan, &model)) {
                return Err(format!(
                    "the path leaves the geofence at ({:.1} m, {:.1} m), {:.1} m along it",
                    breach.point.x_m, breach.point.y_m, breach.arc_m,
                ));
            }
            let summary = PlanSummary {
                length_m: plan.length_m(),
                duration_s: plan.duration_s(),
                speed_peak_m_s: plan.peak_speed_m_s(),
                begin: Some(wire_pose(start)),
            };
            let kept = Arc::new(plan.clone());
            let job = origin.job(plan, model)?;
            Ok(Planned {
                summary,
                plan: kept,
                job,
            })
        });
        planning
            .await
            .unwrap_or_else(|_| Err("planning ended in a panic".to_owned()))
    }

    async fn cancel(&self, cancel: &Cancel) -> Outcome {
        let mission = cancel.mission;
        let decision = self.missions.slot().cancel(mission);
        match decision {
            CancelDecision::Brake => match self.to_loop.try_send(LoopCommand::Cancel(mission)) {
                Ok(()) => {
                    info!(mission.id = %mission, reason = cancel.reason, "cancelling {mission}");
                    // Once this is answered it is cancelled, even if the agent dies on the way.
                    self.save().await;
                    Outcome::Done
                }
                Err(_) => refused(OfferRefusal::NotReady, "the control loop is busy"),
            },
            CancelDecision::CancelledBefore => Outcome::Done,
            CancelDecision::EndedBefore(phase) => refused(
                OfferRefusal::Ended,
                format!("it has ended before: {phase:?}"),
            ),
            CancelDecision::Unknown => {
                self.save().await;
                refused(OfferRefusal::Unknown, "it was never offered here")
            }
        }
    }

    async fn save(&self) {
        let missions = Arc::clone(&self.missions);
        // Fails only when the runtime goes down.
        let _ = tokio::task::spawn_blocking(move || missions.save()).await;
    }
}
