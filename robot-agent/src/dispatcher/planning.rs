//! Plans offers on the blocking pool, outside the loop thread and the runtime's threads.

use std::sync::Arc;
use std::time::Duration;

use tread_api::mission::{LinkPolicy, PlanSummary};
use tread_api::wire::command::Offer;
use tread_api::wire::reply::{CommandRefusal, CommandRefusalCode};
use tread_control::geometry::Pose;
use tread_control::plan::Plan;

use super::{Dispatcher, refused};
use crate::control_loop::channels::GivenPlan;
use crate::control_loop::job::{Job, JobOrigin};
use crate::geometry::{control_pose, wire_pose};
use crate::missions::ActiveMission;

/// A plan, its summary, and the job that tracks it.
pub(super) struct Planned {
    pub(super) summary: PlanSummary,
    pub(super) plan: Arc<Plan>,
    pub(super) job: Box<Job>,
}

/// Returns the longest silence of the server for a link policy; `None` for no limit.
fn silence_max(policy: LinkPolicy) -> Result<Option<Duration>, String> {
    policy.validate()?;
    Ok(match policy {
        LinkPolicy::Continue => None,
        LinkPolicy::StopAfter { silence_s } => Some(Duration::from_secs_f64(silence_s)),
    })
}

/// Returns the active mission of an accepted offer.
pub(super) fn active_of(offer: &Offer, plan: PlanSummary) -> ActiveMission {
    ActiveMission {
        mission: offer.mission,
        revision: offer.revision,
        plan_hash: offer.plan_hash,
        plan,
        is_cancelled: false,
    }
}

/// Returns the plan of an accepted offer, for other threads.
pub(super) fn given_of(offer: &Offer, plan: Arc<Plan>) -> GivenPlan {
    GivenPlan {
        mission: offer.mission,
        revision: offer.revision,
        plan,
    }
}

impl Dispatcher {
    /// Plans an offer from a pose, or from the start that the offer expects, if that is near.
    pub(super) async fn plan(
        &self,
        offer: &Offer,
        start: Pose,
        start_by: Option<Duration>,
    ) -> Result<Planned, CommandRefusal> {
        let model = self.model;
        let view = self.site.view();
        let offer = offer.clone();
        let options = offer.trajectory.options();
        let start = control_pose(options.planning_start(wire_pose(start)));
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
        let planned = planning.await;
        planned
            .unwrap_or_else(|_| Err("planning ended in a panic".to_owned()))
            .or_else(|detail| refused(CommandRefusalCode::Impossible, detail))
    }
}
