//! Answers the server's commands: offers, cancellations, new definitions of the site.
//!
//! One command after the other, so that an offer that comes twice finds the first one decided.
//! Planning and disks are waited for here, never in the loop.

use std::sync::atomic::Ordering;
use std::sync::mpsc::{SyncSender, TrySendError};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio_util::sync::CancellationToken;
use tracing::{error, info, warn};
use tread_api::ids::BootId;
use tread_api::keys::Verb;
use tread_api::mission::PlanSummary;
use tread_api::robot::RobotMode;
use tread_api::wire::command::{Answer, Cancel, Offer, OfferRefusal, Outcome};
use tread_api::wire::hello::SiteDefinition;
use tread_api::wire::{self, Refusal, WireError};
use tread_control::follower::{Follower, FollowerConfig};
use tread_control::plan::Plan;
use tread_control::robot::RobotModel;

use crate::clock::SharedClock;
use crate::control_loop::seam::{Job, LoopCommand, Shared};
use crate::control_loop::site_view::SiteView;
use crate::fleet::Commands;
use crate::geometry::control_trajectory;
use crate::missions::memory::Memory;
use crate::missions::{CancelDecision, Held, Holder, OfferDecision};

/// The robot's missions, shared by those who answer and those who record.
#[derive(Debug)]
pub(crate) struct Missions {
    holder: Mutex<Holder>,
    memory: Memory,
}

impl Missions {
    pub(crate) fn new(holder: Holder, memory: Memory) -> Arc<Self> {
        Arc::new(Self {
            holder: Mutex::new(holder),
            memory,
        })
    }

    pub(crate) fn holder(&self) -> MutexGuard<'_, Holder> {
        self.holder.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Makes what is known safe from a crash. Blocks.
    pub(crate) fn save(&self) {
        // The lock is not held while the disk is waited for.
        let holder = self.holder().clone();
        if let Err(cause) = self.memory.save(&holder) {
            error!(
                error = &cause as &dyn std::error::Error,
                "cannot save the missions"
            );
        }
    }
}

/// Where the site's definition is kept for those outside the loop.
#[derive(Debug, Default)]
pub(crate) struct SiteCell {
    view: Mutex<Option<(SiteDefinition, Arc<SiteView>)>>,
}

impl SiteCell {
    fn lock(&self) -> MutexGuard<'_, Option<(SiteDefinition, Arc<SiteView>)>> {
        self.view.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The view that was last handed to the loop.
    pub(crate) fn view(&self) -> Option<Arc<SiteView>> {
        self.lock().as_ref().map(|(_, view)| Arc::clone(view))
    }
}

/// Who answers commands.
#[derive(Debug)]
pub(crate) struct Dispatcher {
    pub(crate) boot: BootId,
    pub(crate) model: RobotModel,
    pub(crate) clock: SharedClock,
    pub(crate) missions: Arc<Missions>,
    pub(crate) site: Arc<SiteCell>,
    pub(crate) shared: Arc<Shared>,
    pub(crate) to_loop: SyncSender<LoopCommand>,
}

fn refused(code: OfferRefusal, detail: impl Into<String>) -> Outcome {
    Outcome::Refused {
        code,
        detail: detail.into(),
    }
}

impl Dispatcher {
    /// Answers for ever.
    pub(crate) async fn run(self: Arc<Self>, mut commands: Commands, stop: CancellationToken) {
        loop {
            let command = tokio::select! {
                command = commands.recv() => command,
                () = stop.cancelled() => return,
            };
            let Some(command) = command else { return };
            match self.decide(command.verb, &command.payload).await {
                Ok(outcome) => {
                    command
                        .answer(&Answer {
                            boot: self.boot,
                            outcome,
                        })
                        .await;
                }
                Err(cause) => {
                    self.shared.commands_refused.fetch_add(1, Ordering::Relaxed);
                    warn!(
                        error = &cause as &dyn std::error::Error,
                        "refused a `{}` command",
                        command.verb.as_str(),
                    );
                    command.refuse(&Refusal::from(&cause)).await;
                }
            }
        }
    }

    async fn decide(&self, verb: Verb, payload: &[u8]) -> Result<Outcome, WireError> {
        Ok(match verb {
            Verb::Offer => self.offer(wire::decode(payload)?).await,
            Verb::Cancel => self.cancel(&wire::decode(payload)?).await,
            Verb::Site => {
                let definition: SiteDefinition = wire::decode(payload)?;
                if self.take_site(definition) {
                    Outcome::Done
                } else {
                    refused(OfferRefusal::NotReady, "the control loop is busy")
                }
            }
        })
    }

    /// Takes a definition of the site; false if the loop has no room for it now.
    pub(crate) fn take_site(&self, definition: SiteDefinition) -> bool {
        let mut cell = self.site.lock();
        if cell.as_ref().is_some_and(|(known, _)| *known == definition) {
            return true;
        }
        let revision = definition.terrain_revision;
        let view = Arc::new(SiteView::new(definition.clone()));
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
        let decision = self.missions.holder().offer(&offer);
        match decision {
            OfferDecision::AcceptAgain(plan) => Outcome::Accepted { plan: Some(plan) },
            OfferDecision::Refuse(code, detail) => {
                info!(mission.id = %offer.mission, ?code, "refused a mission: {detail}");
                refused(code, detail)
            }
            OfferDecision::Plan => self.plan_and_start(offer, start_by).await,
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
                    .map_or("", super::control_loop::seam::Fault::text);
                return refused(
                    OfferRefusal::NotReady,
                    format!("the robot is {mode:?} {fault}"),
                );
            }
        };
        let model = self.model;
        let (mission, revision, plan_hash) = (offer.mission, offer.revision, offer.plan_hash);
        let planning = tokio::task::spawn_blocking(move || {
            let trajectory = control_trajectory(&offer.trajectory);
            let plan = Plan::new(&trajectory, start, &model).map_err(|cause| cause.to_string())?;
            let summary = PlanSummary {
                length_m: plan.length_m(),
                duration_s: plan.duration_s(),
                speed_peak_m_s: plan.peak_speed_m_s(),
            };
            let follower = Follower::new(plan, model, FollowerConfig::default())
                .map_err(|cause| cause.to_string())?;
            Ok::<_, String>((summary, follower))
        });
        let (plan, follower) = match planning.await {
            Ok(Ok(planned)) => planned,
            Ok(Err(detail)) => return refused(OfferRefusal::Impossible, detail),
            Err(_) => return refused(OfferRefusal::Impossible, "planning ended in a panic"),
        };
        if start_by.is_some_and(|latest| self.clock.monotonic() > latest) {
            return refused(OfferRefusal::TooLate, "its latest start has passed");
        }
        // Held before the loop has it, so that its end cannot be reported before its begin.
        let held = Held {
            mission,
            revision,
            plan_hash,
            plan,
        };
        if !self.missions.holder().take(held) {
            return refused(OfferRefusal::Busy, "another mission was taken meanwhile");
        }
        let job = Box::new(Job {
            mission,
            revision,
            plan_hash,
            follower,
            start_by,
        });
        match self.to_loop.try_send(LoopCommand::Start(job)) {
            Ok(()) => {}
            Err(TrySendError::Full(_) | TrySendError::Disconnected(_)) => {
                self.missions.holder().release(mission);
                return refused(OfferRefusal::NotReady, "the control loop is busy");
            }
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

    async fn cancel(&self, cancel: &Cancel) -> Outcome {
        let mission = cancel.mission;
        let decision = self.missions.holder().cancel(mission);
        match decision {
            CancelDecision::Brake => match self.to_loop.try_send(LoopCommand::Cancel(mission)) {
                Ok(()) => {
                    info!(mission.id = %mission, reason = cancel.reason, "cancelling {mission}");
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
