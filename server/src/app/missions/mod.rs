//! Missions: creation, listing, and transitions of their state.
//!
//! A request stores the wanted state and returns; [`super::reconciler`] sends it to the robot.

pub mod control;
pub mod idempotency;
pub(super) mod immediate_offer;
pub(crate) mod reports;
pub mod transitions;

use jiff::Timestamp;
use tread_api::ids::{MissionId, RobotId, SiteId};
use tread_api::mission::{
    Actor, Cause, CreateMission, LINK_SILENCE_MAX_S, LINK_SILENCE_MIN_S, Mission, MissionDetail,
    MissionEvent, MissionState, PRIORITY_MAX, PRIORITY_MIN, REASON_LENGTH_MAX, StartPolicy,
};
use tread_api::page::Page;
use tread_api::robot::RobotLimits;
use tread_api::trajectory::Trajectory;
use tread_api::wire::command::Offer;

use self::immediate_offer::{EarlyPrior, OfferedNow};
use self::transitions::{Change, next};
use super::check::StartPlace;
use super::trajectory_value::TrajectoryValue;
use super::{App, AppError, check_named, site_row};
pub use crate::db::missions::MissionFilter;
use crate::db::missions::{Facts, Inserted, MissionRow, OpenMission, Transition};
use crate::db::{self, DbError, Tx};

/// Number of bytes of trajectories after which a page of missions ends, whatever its limit.
const PAGE_BYTES_MAX: usize = 4 * 1024 * 1024;
/// Maximum number of missions queued for one robot.
pub const QUEUE_MAX: usize = 1_000;
/// Maximum number of events in one mission's history; mere notes are dropped beyond half of it.
const EVENTS_MAX: u32 = 1_000;

/// A mission as it was inserted.
struct InsertedMission {
    row: MissionRow,
    /// Whether the same transaction set it to `offered`.
    is_offered: bool,
    /// Whether other missions were ended for it.
    has_ended_others: bool,
    /// [`App::recalls`] before its transaction.
    recalls: u64,
}

impl App {
    /// Creates a mission.
    pub async fn create_mission(&self, request: CreateMission) -> Result<Mission, AppError> {
        self.check_new(&request).await?;
        let key = (request.site.clone(), request.robot.clone());
        let trajectory = request.trajectory.clone();
        let storing = async {
            let mut tx = self.db().write_uncounted("missions").await?;
            let enqueued = self.enqueue(&mut tx, request).await?;
            tx.commit().await?;
            Ok::<InsertedMission, AppError>(enqueued)
        };
        let (prior, enqueued) = tokio::join!(self.early_prior(&key, &trajectory), storing);
        Ok(self.enqueued(enqueued?, prior))
    }

    /// Sends what follows the commit of a new mission on its way.
    fn enqueued(&self, enqueued: InsertedMission, prior: Option<EarlyPrior>) -> Mission {
        let InsertedMission { row, recalls, .. } = enqueued;
        let mission = row.mission.clone();
        if let Some(EarlyPrior(prior)) = prior.filter(|_| enqueued.is_offered) {
            let offered = OfferedNow {
                row,
                prior,
                recalls,
            };
            self.new_offers().add(offered);
        }
        if enqueued.has_ended_others {
            self.recall();
        } else {
            self.wake();
        }
        self.trace_stored(&mission);
        mission
    }

    /// Refuses a new mission that leaves the geofence, from the pose at which its robot is expected
    /// to begin it.
    async fn check_new(&self, request: &CreateMission) -> Result<(), AppError> {
        let place = StartPlace {
            priority: request.priority,
            policy: request.start_policy,
            replaces: None,
        };
        let robot = (&request.site, &request.robot);
        self.check_fence(robot, &request.trajectory, place).await
    }

    /// Inserts a mission into its robot's queue, according to its start policy.
    async fn enqueue(
        &self,
        tx: &mut Tx,
        request: CreateMission,
    ) -> Result<InsertedMission, AppError> {
        check_figures(&request)?;
        let recalls = self.recalls();
        let CreateMission {
            site,
            robot,
            trajectory,
            latest_start,
            priority,
            start_policy,
            link_policy,
            lost_after_s,
        } = request;
        let site_pk = site_row(tx, &site).await?.pk;
        let robot_row = db::robots::find(tx, site_pk, &robot).await?;
        let unknown = || AppError::UnknownRobot(site.clone(), robot.clone());
        let robot_row = robot_row.ok_or_else(unknown)?;
        if robot_row.retired_at.is_some() {
            return Err(AppError::RobotRetired(robot));
        }
        check_limits(&robot, &robot_row.model.limits, &trajectory)?;
        let (id, revision, created_at) = (self.clock().new_id(), 1, self.clock().now());
        if let Some(latest) = latest_start.filter(|latest| *latest <= created_at) {
            let detail = format!("latest_start {latest} has passed: it would never start");
            return Err(AppError::Invalid {
                field: "latest_start",
                detail,
            });
        }
        let mut open = db::missions::open_of_robot(tx, robot_row.pk).await?;
        let mut has_ended_others = false;
        match (start_policy, open.first()) {
            (StartPolicy::Append, _) | (_, None) => {}
            (StartPolicy::Refuse, Some(other)) => {
                return Err(AppError::RobotBusy {
                    robot,
                    mission: other.id,
                    state: other.state,
                });
            }
            (StartPolicy::Replace, Some(_)) => {
                let reason = format!("mission `{id}` was asked for in its place");
                let why = (Change::Supersede, Actor::Client, reason.as_str());
                end_each(tx, &open, why, created_at).await?;
                has_ended_others = true;
                open = db::missions::open_of_robot(tx, robot_row.pk).await?;
            }
        }
        let is_queued = |other: &&OpenMission| other.state == MissionState::Queued;
        if open.iter().filter(is_queued).count() >= QUEUE_MAX {
            return Err(AppError::TooMany {
                what: "missions that wait for it",
                count: QUEUE_MAX,
            });
        }
        let mission = Mission {
            id,
            site,
            robot,
            state: MissionState::Queued,
            reason: None,
            cause: Cause::Requested,
            pause_requested: false,
            revision,
            plan_hash: Offer::plan_hash_of(id, revision, &trajectory),
            trajectory,
            replacement: None,
            latest_start,
            priority,
            link_policy,
            lost_after_s,
            boot: None,
            plan: None,
            progress: None,
            created_at,
            started_at: None,
            ended_at: None,
        };
        let mut row = MissionRow {
            robot_pk: robot_row.pk,
            mission,
        };
        // It would start by itself once the robot is free again.
        row.mission.pause_requested = self.is_operator_controlled(tx, &row.mission).await?;
        let is_offered = open.is_empty() && self.may_offer_immediately(tx, &row).await?;
        insert(tx, &row, is_offered).await?;
        Ok(InsertedMission {
            row,
            is_offered,
            has_ended_others,
            recalls,
        })
    }

    /// Returns whether a mission's robot is stopped or teleoperated.
    async fn is_operator_controlled(
        &self,
        tx: &mut Tx,
        mission: &Mission,
    ) -> Result<bool, AppError> {
        let (site, robot) = (&mission.site, &mission.robot);
        let presence = self.presences().get(&(site.clone(), robot.clone()));
        Ok(presence.is_operator_controlled() || db::stops::is_stopped(tx, site, robot).await?)
    }

    /// Missions, newest first.
    pub async fn missions(
        &self,
        filter: &MissionFilter,
        limit: u32,
    ) -> Result<Page<Mission>, AppError> {
        let mut tx = self.db().read("missions").await?;
        check_named(
            &mut tx,
            filter.site.as_ref(),
            filter.robot.as_ref(),
            &filter.within,
        )
        .await?;
        let (rows, more) = db::missions::list(&mut tx, filter, limit, PAGE_BYTES_MAX).await?;
        let last = rows.last().filter(|_| more);
        let next_cursor = last.map(|row| row.mission.id.to_string());
        let with_progress = |row: MissionRow| self.with_progress(row.mission);
        let items = rows.into_iter().map(with_progress).collect();
        Ok(Page { items, next_cursor })
    }

    /// Returns the site and robot of a mission; `None` if it is not known.
    pub async fn mission_place(
        &self,
        id: MissionId,
    ) -> Result<Option<(SiteId, RobotId)>, AppError> {
        let mut tx = self.db().read("missions").await?;
        let found = db::missions::find(&mut tx, id).await?;
        Ok(found.map(|row| (row.mission.site, row.mission.robot)))
    }

    /// One mission with its history.
    pub async fn mission(&self, id: MissionId) -> Result<MissionDetail, AppError> {
        let mut tx = self.db().read("missions").await?;
        self.mission_detail(&mut tx, id).await
    }

    async fn mission_detail(&self, tx: &mut Tx, id: MissionId) -> Result<MissionDetail, AppError> {
        let row = db::missions::find(tx, id)
            .await?
            .ok_or(AppError::UnknownMission(id))?;
        let events = db::history::events(tx, id, EVENTS_MAX).await?;
        let (quality, driven) = db::missions::outcome(tx, id).await?;
        Ok(MissionDetail {
            mission: self.with_progress(row.mission),
            events,
            quality,
            driven,
        })
    }

    /// Adds the progress that the robot shows, while it drives this mission.
    pub(super) fn with_progress(&self, mut mission: Mission) -> Mission {
        if !mission.state.is_terminal() {
            let presence = self
                .presences()
                .get(&(mission.site.clone(), mission.robot.clone()));
            let progress = presence.state().and_then(|state| state.mission);
            if let Some(progress) = progress.filter(|progress| progress.id == mission.id) {
                mission.progress = Some(progress);
            }
        }
        mission
    }
}

fn check_figures(request: &CreateMission) -> Result<(), AppError> {
    let invalid = |field, detail| Err(AppError::Invalid { field, detail });
    if !(PRIORITY_MIN..=PRIORITY_MAX).contains(&request.priority) {
        let detail = format!(
            "priority must be {PRIORITY_MIN} to {PRIORITY_MAX}, not {}",
            request.priority
        );
        return invalid("priority", detail);
    }
    if let Err(detail) = request.link_policy.validate() {
        return invalid("link_policy", detail);
    }
    match request.lost_after_s {
        Some(lost_after_s)
            if !(LINK_SILENCE_MIN_S..=LINK_SILENCE_MAX_S).contains(&lost_after_s) =>
        {
            let detail = format!(
                "lost_after_s must be {LINK_SILENCE_MIN_S} to {LINK_SILENCE_MAX_S}, \
                 not {lost_after_s}"
            );
            invalid("lost_after_s", detail)
        }
        Some(_) | None => Ok(()),
    }
}

/// Inserts a mission with its history: as it is, or offered at once.
async fn insert(tx: &mut Tx, row: &MissionRow, is_offered: bool) -> Result<(), DbError> {
    let mission = &row.mission;
    let created = MissionEvent {
        at: mission.created_at,
        actor: Actor::Client,
        from: None,
        to: mission.state,
        cause: mission.cause,
        reason: None,
    };
    let offered = next(mission.state, Change::Offer).filter(|_| is_offered);
    let offered = offered.map(|to| MissionEvent {
        actor: Actor::Server,
        from: Some(mission.state),
        to,
        cause: Change::Offer.cause(),
        reason: Some(bounded(Change::Offer.reason())),
        ..created
    });
    let newest = offered.as_ref().unwrap_or(&created);
    let inserted = Inserted {
        state: newest.to,
        cause: newest.cause,
        reason: newest.reason.as_deref(),
    };
    db::missions::insert(tx, row, inserted).await?;
    db::history::begin(tx, mission.id, &created, offered.as_ref()).await?;
    if let Some(offered) = &offered {
        log_step(&mission.into(), offered.to);
    }
    Ok(())
}

fn log_step(open: &OpenMission, to: MissionState) {
    let OpenMission {
        id, robot, state, ..
    } = open;
    tracing::info!(
        mission.id = %id, robot.id = %robot,
        "mission `{id}` of robot `{robot}` went from {} to {}", state.as_str(), to.as_str(),
    );
}

/// Requests the end of all open missions of a robot.
pub(super) async fn end_all(
    tx: &mut Tx,
    robot_pk: i64,
    (change, actor, reason): (Change, Actor, &str),
    at: Timestamp,
) -> Result<(), DbError> {
    let open = db::missions::open_of_robot(tx, robot_pk).await?;
    end_each(tx, &open, (change, actor, reason), at).await
}

/// Requests the end of these open missions.
async fn end_each(
    tx: &mut Tx,
    open: &[OpenMission],
    (change, actor, reason): (Change, Actor, &str),
    at: Timestamp,
) -> Result<(), DbError> {
    for mission in open {
        let step = Step {
            change,
            actor,
            reason: Some(reason),
            at,
            facts: Facts::default(),
        };
        apply_transition(tx, mission, step).await?;
    }
    Ok(())
}

pub(super) fn check_limits(
    robot: &RobotId,
    limits: &RobotLimits,
    trajectory: &Trajectory,
) -> Result<(), AppError> {
    let beyond = |detail, field| AppError::BeyondLimits {
        robot: robot.clone(),
        detail,
        field,
    };
    let (fastest, speed_m_s) = TrajectoryValue::of_speed_max(trajectory);
    let limit_m_s = limits.linear_max_m_s;
    if speed_m_s > limit_m_s {
        let detail = format!("{speed_m_s} m/s is beyond its limit of {limit_m_s} m/s");
        return Err(beyond(detail, Some(fastest.path(trajectory).into())));
    }
    if let Trajectory::Circle(circle) = trajectory {
        let (rate_rad_s, limit_rad_s) = (speed_m_s / circle.radius_m, limits.angular_max_rad_s);
        if rate_rad_s > limit_rad_s {
            let detail = format!(
                "a yaw rate of {rate_rad_s} rad/s is beyond its limit of {limit_rad_s} rad/s"
            );
            return Err(beyond(detail, None));
        }
    }
    Ok(())
}

/// One transition of a mission, with the facts learned from it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Step<'step> {
    pub(super) change: Change,
    pub(super) actor: Actor,
    pub(super) reason: Option<&'step str>,
    pub(super) at: Timestamp,
    pub(super) facts: Facts,
}

/// Applies a transition if the table allows it and the mission is still in the state that was read.
///
/// Returns the new state; `None` if nothing changed.
pub(super) async fn apply_transition(
    tx: &mut Tx,
    open: &OpenMission,
    step: Step<'_>,
) -> Result<Option<MissionState>, DbError> {
    let (id, from) = (open.id, open.state);
    let Some(to) = next(from, step.change) else {
        return Ok(None);
    };
    let cause = step.change.cause();
    let reason = Some(bounded(step.reason.unwrap_or(step.change.reason())));
    let transition = Transition {
        from,
        to,
        cause,
        reason: reason.as_deref(),
    };
    if !db::missions::compare_and_set(tx, id, transition).await? {
        return Ok(None);
    }
    let ended_at = to
        .is_terminal()
        .then_some(step.facts.ended_at.unwrap_or(step.at));
    db::missions::add_facts(
        tx,
        id,
        Facts {
            ended_at,
            ..step.facts
        },
    )
    .await?;
    let event = MissionEvent {
        at: step.at,
        actor: step.actor,
        from: Some(from),
        to,
        cause,
        reason,
    };
    db::history::add_event(tx, id, &event).await?;
    log_step(open, to);
    Ok(Some(to))
}

/// Adds a note to a mission's history without a transition.
pub(super) async fn record_note(
    tx: &mut Tx,
    row: &MissionRow,
    actor: Actor,
    at: Timestamp,
    reason: &str,
) -> Result<(), DbError> {
    add_note(tx, &row.mission, (actor, Cause::Recorded), at, reason).await
}

/// Adds a note with its cause.
pub(super) async fn add_note(
    tx: &mut Tx,
    mission: &Mission,
    (actor, cause): (Actor, Cause),
    at: Timestamp,
    reason: &str,
) -> Result<(), DbError> {
    // Limits the notes of a robot that repeats a report for ever.
    if db::history::event_count(tx, mission.id).await? < EVENTS_MAX / 2 {
        let event = MissionEvent {
            at,
            actor,
            from: Some(mission.state),
            to: mission.state,
            cause,
            reason: Some(bounded(reason)),
        };
        db::history::add_event(tx, mission.id, &event).await?;
    }
    Ok(())
}

fn bounded(reason: &str) -> String {
    tread_api::text::cleaned(reason, REASON_LENGTH_MAX)
}
