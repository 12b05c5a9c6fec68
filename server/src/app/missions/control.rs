//! Requests on an existing mission: pause, resume, replace, cancel.
//!
//! On an active mission each only stores the wanted state; the reconciler sends it to the robot, and
//! the robot's answer changes the mission's state. A queued mission changes at once. Pause and resume are
//! idempotent, and so is cancel until the mission has ended; each replacement of a queued mission makes
//! a new revision.

use jiff::Timestamp;
use tread_api::ids::MissionId;
use tread_api::mission::{
    Actor, Cause, Mission, MissionDetail, MissionEvent, MissionState, ReplaceMission, Replacement,
    StartPolicy,
};
use tread_api::wire::command::Offer;

use super::transitions::Change;
use super::{Step, add_note, apply_transition, check_limits};
use crate::app::check::StartPlace;
use crate::app::{App, AppError};
use crate::db::missions::{Facts, MissionRow};
use crate::db::robots::RobotRow;
use crate::db::{self, DbError, Tx};

impl App {
    /// Requests the end of a mission. A queued mission ends at once, an active one when its robot
    /// confirms.
    pub async fn cancel_mission(&self, id: MissionId) -> Result<MissionDetail, AppError> {
        let mut tx = self.db().write_uncounted("missions").await?;
        let row = open_row(&mut tx, id).await?;
        if row.mission.state != MissionState::Cancelling {
            let step = Step {
                change: Change::RequestCancel,
                actor: Actor::Client,
                reason: None,
                at: self.clock().now(),
                facts: Facts::default(),
            };
            apply_transition(&mut tx, &(&row.mission).into(), step).await?;
        }
        self.written(tx, id).await
    }

    /// Requests that an active mission is paused, with the robot stopped.
    pub async fn pause_mission(&self, id: MissionId) -> Result<MissionDetail, AppError> {
        self.request_pause(id, true).await
    }

    /// Requests that a paused mission is resumed.
    pub async fn resume_mission(&self, id: MissionId) -> Result<MissionDetail, AppError> {
        self.request_pause(id, false).await
    }

    async fn request_pause(&self, id: MissionId, pauses: bool) -> Result<MissionDetail, AppError> {
        let (action, cause) = if pauses {
            ("paused", Cause::PauseRequested)
        } else {
            ("resumed", Cause::ResumeRequested)
        };
        let mut tx = self.db().write_uncounted("missions").await?;
        let row = open_row(&mut tx, id).await?;
        let mission = &row.mission;
        let state = mission.state;
        // A queued mission that was held because its robot was stopped or teleoperated can be
        // resumed.
        let held_in_queue = state == MissionState::Queued && mission.pause_requested && !pauses;
        let in_progress = matches!(
            state,
            MissionState::Offered | MissionState::Active | MissionState::Paused
        );
        if !in_progress && !held_in_queue {
            return Err(AppError::MissionState { id, state, action });
        }
        if !pauses {
            self.check_free(&mut tx, mission).await?;
        }
        if pauses && !robot_of(&mut tx, &row).await?.capabilities.pause {
            return Err(AppError::RobotCannot {
                robot: mission.robot.clone(),
                what: "pause a mission",
            });
        }
        if mission.pause_requested != pauses
            && db::missions::set_pause_requested(&mut tx, id, pauses).await?
        {
            let why = (Actor::Client, cause);
            let reason = format!("to be {action}");
            add_note(&mut tx, mission, why, self.clock().now(), &reason).await?;
        }
        self.written(tx, id).await
    }

    /// Refuses to resume a mission while its robot is stopped or teleoperated: the robot would
    /// start by itself afterwards.
    async fn check_free(&self, tx: &mut Tx, mission: &Mission) -> Result<(), AppError> {
        let (site, robot) = (&mission.site, &mission.robot);
        let presence = self.presences().get(&(site.clone(), robot.clone()));
        let safety = presence.state().map(|state| &state.safety);
        let detail = if db::stops::is_stopped(tx, site, robot).await?
            || safety.is_some_and(|safety| safety.stop.is_some())
        {
            "a stop is in force; clear it first".to_owned()
        } else if let Some(driver) = presence.driver() {
            format!("`{driver}` teleoperates it")
        } else {
            return Ok(());
        };
        let robot = robot.clone();
        Err(AppError::RobotRefused { robot, detail })
    }

    /// Requests that a mission gets another trajectory. A queued mission changes at once. An active
    /// one changes when its robot has the complete new revision; until then the robot drives the
    /// old one.
    pub async fn replace_mission(
        &self,
        id: MissionId,
        request: ReplaceMission,
    ) -> Result<MissionDetail, AppError> {
        let action = "replaced";
        let mut tx = self.db().read("missions").await?;
        let row = open_row(&mut tx, id).await?;
        drop(tx);
        let robot = (&row.mission.site, &row.mission.robot);
        let place = StartPlace {
            priority: row.mission.priority,
            policy: StartPolicy::Append,
            replaces: Some(id),
        };
        self.check_fence(robot, &request.trajectory, place).await?;
        let mut tx = self.db().write_uncounted("missions").await?;
        let row = open_row(&mut tx, id).await?;
        let mission = &row.mission;
        let robot = robot_of(&mut tx, &row).await?;
        check_limits(&mission.robot, &robot.model.limits, &request.trajectory)?;
        let revision = mission.revision + 1;
        let replacement = Replacement {
            revision,
            plan_hash: Offer::plan_hash_of(id, revision, &request.trajectory),
            trajectory: request.trajectory,
        };
        let at = self.clock().now();
        let why = (Actor::Client, Cause::ReplaceRequested);
        let state = mission.state;
        let in_progress = matches!(state, MissionState::Active | MissionState::Paused);
        if state == MissionState::Queued && mission.boot.is_none() {
            // The robot does not drive it yet; if it has it nevertheless, it takes the new
            // revision.
            db::missions::swap_content(&mut tx, id, mission.revision, &replacement).await?;
        } else if in_progress && mission.replacement.is_none() {
            if !robot.capabilities.replace {
                return Err(AppError::RobotCannot {
                    robot: mission.robot.clone(),
                    what: "swap a mission while it drives it",
                });
            }
            db::missions::set_replacement(&mut tx, id, Some(&replacement)).await?;
        } else {
            return Err(AppError::MissionState { id, state, action });
        }
        let reason = format!("to be driven as revision {revision}");
        add_note(&mut tx, mission, why, at, &reason).await?;
        self.written(tx, id).await
    }

    async fn written(&self, mut tx: Tx, id: MissionId) -> Result<MissionDetail, AppError> {
        let detail = self.mission_detail(&mut tx, id).await?;
        self.commit_recalling(tx).await?;
        Ok(detail)
    }
}

/// Holds all active and queued missions of a robot, because it was stopped or is teleoperated. They
/// are resumed only by a person.
pub(in crate::app) async fn hold_all(
    tx: &mut Tx,
    robot_pk: i64,
    reason: &str,
    at: Timestamp,
) -> Result<(), DbError> {
    for open in db::missions::open_of_robot(tx, robot_pk).await? {
        if !open.pause_requested && db::missions::set_pause_requested(tx, open.id, true).await? {
            let event = MissionEvent {
                at,
                actor: Actor::Server,
                from: Some(open.state),
                to: open.state,
                cause: Cause::PauseRequested,
                reason: Some(reason.to_owned()),
            };
            db::history::add_event(tx, open.id, &event).await?;
        }
    }
    Ok(())
}

async fn open_row(tx: &mut Tx, id: MissionId) -> Result<MissionRow, AppError> {
    let row = db::missions::find(tx, id)
        .await?
        .ok_or(AppError::UnknownMission(id))?;
    let state = row.mission.state;
    if state.is_terminal() {
        return Err(AppError::MissionEnded { id, state });
    }
    Ok(row)
}

async fn robot_of(tx: &mut Tx, row: &MissionRow) -> Result<RobotRow, AppError> {
    let (site, robot) = (&row.mission.site, &row.mission.robot);
    let site_pk = super::site_row(tx, site).await?.pk;
    let found = db::robots::find(tx, site_pk, robot).await?;
    found.ok_or_else(|| AppError::UnknownRobot(site.clone(), robot.clone()))
}
