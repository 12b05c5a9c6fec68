//! Missions: what is asked for, and what robots report of it.
//!
//! A request writes what is wanted and returns; [`super::reconciler`] makes it so.

pub mod transitions;

use jiff::Timestamp;
use tread_api::ids::{MissionId, RobotId};
use tread_api::mission::{
    Actor, CreateMission, Mission, MissionDetail, MissionEvent, MissionState, REASON_LENGTH_MAX,
};
use tread_api::page::Page;
use tread_api::robot::RobotLimits;
use tread_api::trajectory::Trajectory;
use tread_api::wire::command::Offer;
use tread_api::wire::ingest::{MissionPhase, MissionReport};

use self::transitions::{Change, next};
use super::{App, AppError, site_row};
use crate::db::missions::{Facts, MissionFilter, MissionRow, Standing};
use crate::db::{self, DbError, Tx};

/// Bytes of trajectories after which a page of missions ends, however many it has.
const PAGE_BYTES_MAX: usize = 4 * 1024 * 1024;
/// Most missions that wait for one robot.
pub const QUEUE_MAX: usize = 1_000;
/// Most steps of one mission's history; what only notes something is left out beyond half of it.
const EVENTS_MAX: u32 = 1_000;

impl App {
    /// Asks a robot to drive something.
    pub async fn create_mission(&self, request: CreateMission) -> Result<Mission, AppError> {
        let CreateMission {
            site,
            robot,
            trajectory,
            latest_start,
        } = request;
        let mut tx = self.db().write().await?;
        let site_pk = site_row(&mut tx, &site).await?.pk;
        let robot_row = db::robots::find(&mut tx, site_pk, &robot).await?;
        let unknown = || AppError::UnknownRobot(site.clone(), robot.clone());
        let robot_row = robot_row.ok_or_else(unknown)?;
        check_limits(&robot, &robot_row.model.limits, &trajectory)?;
        if db::missions::queued_count(&mut tx, robot_row.pk).await? >= QUEUE_MAX {
            return Err(AppError::TooMany {
                what: "missions that wait for it",
                count: QUEUE_MAX,
            });
        }
        let (id, revision, created_at) = (self.clock().mission_id(), 1, self.clock().now());
        let mission = Mission {
            id,
            site,
            robot,
            state: MissionState::Queued,
            reason: None,
            revision,
            plan_hash: Offer::plan_hash_of(id, revision, &trajectory),
            trajectory,
            latest_start,
            boot: None,
            plan: None,
            progress: None,
            created_at,
            started_at: None,
            ended_at: None,
        };
        let row = MissionRow {
            robot_pk: robot_row.pk,
            mission,
        };
        db::missions::insert(&mut tx, &row).await?;
        let event = MissionEvent {
            at: created_at,
            actor: Actor::Client,
            from: None,
            to: MissionState::Queued,
            reason: None,
        };
        db::missions::add_event(&mut tx, id, &event).await?;
        tx.commit().await?;
        self.wake();
        Ok(row.mission)
    }

    /// Missions, newest first.
    pub async fn missions(
        &self,
        filter: &MissionFilter,
        limit: u32,
    ) -> Result<Page<Mission>, AppError> {
        let mut tx = self.db().read().await?;
        if let Some(site) = &filter.site {
            site_row(&mut tx, site).await?;
        }
        let (rows, more) = db::missions::list(&mut tx, filter, limit, PAGE_BYTES_MAX).await?;
        let last = rows.last().filter(|_| more);
        let next_cursor = last.map(|row| row.mission.id.to_string());
        let with_progress = |row: MissionRow| self.with_progress(row.mission);
        let items = rows.into_iter().map(with_progress).collect();
        Ok(Page { items, next_cursor })
    }

    /// One mission with its history.
    pub async fn mission(&self, id: MissionId) -> Result<MissionDetail, AppError> {
        let mut tx = self.db().read().await?;
        self.mission_detail(&mut tx, id).await
    }

    async fn mission_detail(&self, tx: &mut Tx, id: MissionId) -> Result<MissionDetail, AppError> {
        let row = db::missions::find(tx, id)
            .await?
            .ok_or(AppError::UnknownMission(id))?;
        let events = db::missions::events(tx, id, EVENTS_MAX).await?;
        Ok(MissionDetail {
            mission: self.with_progress(row.mission),
            events,
        })
    }

    /// Wants a mission to end: one that waits ends at once, one in hand when its robot says so.
    pub async fn cancel_mission(&self, id: MissionId) -> Result<MissionDetail, AppError> {
        let mut tx = self.db().write().await?;
        let row = db::missions::find(&mut tx, id)
            .await?
            .ok_or(AppError::UnknownMission(id))?;
        let state = row.mission.state;
        if state.is_terminal() {
            return Err(AppError::MissionEnded {
                id,
                state: state.as_str(),
            });
        }
        // Asked for twice is asked for once.
        if state != MissionState::Cancelling {
            let step = Step {
                change: Change::RequestCancel,
                actor: Actor::Client,
                reason: Some("cancelled by request"),
                at: self.clock().now(),
                facts: Facts::default(),
            };
            take_step(&mut tx, &(&row.mission).into(), step).await?;
        }
        let detail = self.mission_detail(&mut tx, id).await?;
        tx.commit().await?;
        self.wake();
        Ok(detail)
    }

    /// The robot's last word on how far it has come, while it still drives this mission.
    fn with_progress(&self, mut mission: Mission) -> Mission {
        if !mission.state.is_terminal() {
            let presence = self
                .presences()
                .get(&(mission.site.clone(), mission.robot.clone()));
            let said = presence.state().and_then(|state| state.mission);
            if let Some(progress) = said.filter(|progress| progress.id == mission.id) {
                mission.progress = Some(progress);
            }
        }
        mission
    }
}

fn check_limits(
    robot: &RobotId,
    limits: &RobotLimits,
    trajectory: &Trajectory,
) -> Result<(), AppError> {
    let beyond = |detail| AppError::BeyondLimits {
        robot: robot.clone(),
        detail,
    };
    let (speed_m_s, limit_m_s) = (trajectory.speed_max_m_s(), limits.linear_max_m_s);
    if speed_m_s > limit_m_s {
        return Err(beyond(format!(
            "{speed_m_s} m/s is beyond its limit of {limit_m_s} m/s"
        )));
    }
    if let Trajectory::Circle(circle) = trajectory {
        let (rate_rad_s, limit_rad_s) = (speed_m_s / circle.radius_m, limits.angular_max_rad_s);
        if rate_rad_s > limit_rad_s {
            return Err(beyond(format!(
                "a yaw rate of {rate_rad_s} rad/s is beyond its limit of {limit_rad_s} rad/s"
            )));
        }
    }
    Ok(())
}

/// One step of a mission, with what is learned by it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Step<'step> {
    pub(super) change: Change,
    pub(super) actor: Actor,
    pub(super) reason: Option<&'step str>,
    pub(super) at: Timestamp,
    pub(super) facts: Facts,
}

/// Takes a step if the table allows it and the mission still stands where it was read.
///
/// Gives the new state; `None` if nothing moved.
pub(super) async fn take_step(
    tx: &mut Tx,
    standing: &Standing,
    step: Step<'_>,
) -> Result<Option<MissionState>, DbError> {
    let (id, from) = (standing.id, standing.state);
    let Some(to) = next(from, step.change) else {
        return Ok(None);
    };
    let reason = step.reason.map(bounded);
    if !db::missions::compare_and_set(tx, id, from, to, reason.as_deref()).await? {
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
        reason,
    };
    db::missions::add_event(tx, id, &event).await?;
    tracing::info!(
        mission.id = %id, robot.id = %standing.robot,
        "mission `{id}` of robot `{}` went from {} to {}",
        standing.robot, from.as_str(), to.as_str(),
    );
    Ok(Some(to))
}

/// Notes something in a mission's history without moving it.
pub(super) async fn note(
    tx: &mut Tx,
    row: &MissionRow,
    actor: Actor,
    at: Timestamp,
    reason: &str,
) -> Result<(), DbError> {
    let (id, state) = (row.mission.id, row.mission.state);
    // A robot that repeats itself for ever does not fill the disk.
    if db::missions::event_count(tx, id).await? < EVENTS_MAX / 2 {
        let reason = Some(bounded(reason));
        let event = MissionEvent {
            at,
            actor,
            from: Some(state),
            to: state,
            reason,
        };
        db::missions::add_event(tx, id, &event).await?;
    }
    Ok(())
}

fn bounded(reason: &str) -> String {
    reason.chars().take(REASON_LENGTH_MAX).collect()
}

/// Takes a robot's durable report on a mission of its own, once; the caller has seen to that.
///
/// `Err` in the answer is why the report can never be taken.
pub(super) async fn take_report(
    tx: &mut Tx,
    robot_pk: i64,
    boot: tread_api::ids::BootId,
    report: &MissionReport,
    at: Timestamp,
) -> Result<Result<(), String>, DbError> {
    let id = report.mission;
    let row = db::missions::find(tx, id).await?;
    let Some(row) = row.filter(|row| row.robot_pk == robot_pk) else {
        return Ok(Err(format!("mission `{id}` is not one of this robot")));
    };
    let mission = &row.mission;
    if (report.revision, report.plan_hash) != (mission.revision, mission.plan_hash) {
        return Ok(Err(format!("mission `{id}` was sent with other content")));
    }
    let (change, name) = match report.phase {
        MissionPhase::Started => (Change::Accept, "started"),
        MissionPhase::Succeeded => (Change::Succeed, "succeeded"),
        MissionPhase::Failed => (Change::Fail, "failed"),
        MissionPhase::Cancelled => (Change::Cancel, "cancelled"),
        MissionPhase::Expired => (Change::Expire, "expired"),
    };
    let started = report.phase == MissionPhase::Started;
    let facts = Facts {
        boot: Some(boot),
        plan: None,
        progress: report.progress,
        started_at: started.then_some(report.at),
        ended_at: (!started).then_some(report.at),
    };
    let reason = report.reason.as_deref();
    let step = Step {
        change,
        actor: Actor::Robot,
        reason,
        at,
        facts,
    };
    if take_step(tx, &mission.into(), step).await?.is_some() {
        return Ok(Ok(()));
    }
    let open = !mission.state.is_terminal();
    if started && open && mission.started_at.is_none() {
        db::missions::add_facts(tx, id, facts).await?;
        note(tx, &row, Actor::Robot, at, "the robot began to drive").await?;
    } else {
        let reason = reason
            .map(|reason| format!(": {reason}"))
            .unwrap_or_default();
        let text = format!("the robot reported late that it {name}{reason}");
        note(tx, &row, Actor::Robot, at, &text).await?;
    }
    Ok(Ok(()))
}
