//! What a person may want of a mission that is there: pause, resume, replace, cancel.
//!
//! Each only writes what is wanted; the reconciler brings it to the robot, and the robot's answer
//! moves the mission. Wanted twice is wanted once.

use tread_api::ids::MissionId;
use tread_api::mission::{Actor, Cause, MissionDetail, MissionState, ReplaceMission, Replacement};
use tread_api::wire::command::Offer;

use super::transitions::Change;
use super::{Step, add_note, check_limits, take_step};
use crate::app::{App, AppError};
use crate::db::missions::{Facts, MissionRow};
use crate::db::robots::RobotRow;
use crate::db::{self, Tx};

impl App {
    /// Wants a mission to end: one that waits ends at once, one in hand when its robot says so.
    pub async fn cancel_mission(&self, id: MissionId) -> Result<MissionDetail, AppError> {
        let mut tx = self.db().write().await?;
        let row = open_row(&mut tx, id).await?;
        if row.mission.state != MissionState::Cancelling {
            let step = Step {
                change: Change::RequestCancel,
                actor: Actor::Client,
                reason: None,
                at: self.clock().now(),
                facts: Facts::default(),
            };
            take_step(&mut tx, &(&row.mission).into(), step).await?;
        }
        self.written(tx, id).await
    }

    /// Wants a mission in hand to be held, the robot standing.
    pub async fn pause_mission(&self, id: MissionId) -> Result<MissionDetail, AppError> {
        self.want_pause(id, true).await
    }

    /// Wants a paused mission to go on.
    pub async fn resume_mission(&self, id: MissionId) -> Result<MissionDetail, AppError> {
        self.want_pause(id, false).await
    }

    async fn want_pause(&self, id: MissionId, wanted: bool) -> Result<MissionDetail, AppError> {
        let (asked, cause) = if wanted {
            ("paused", Cause::PauseRequested)
        } else {
            ("resumed", Cause::ResumeRequested)
        };
        let mut tx = self.db().write().await?;
        let row = open_row(&mut tx, id).await?;
        let mission = &row.mission;
        let state = mission.state;
        if !matches!(
            state,
            MissionState::Offered | MissionState::Active | MissionState::Paused
        ) {
            return Err(AppError::MissionState { id, state, asked });
        }
        if wanted && !robot_of(&mut tx, &row).await?.capabilities.pause {
            return Err(AppError::RobotCannot {
                robot: mission.robot.clone(),
                what: "pause a mission",
            });
        }
        if mission.pause_wanted != wanted && db::missions::want_pause(&mut tx, id, wanted).await? {
            let why = (Actor::Client, cause);
            let reason = format!("to be {asked}");
            add_note(&mut tx, mission, why, self.clock().now(), &reason).await?;
        }
        self.written(tx, id).await
    }

    /// Wants a mission to be another trajectory. What waits is changed at once; what is in hand
    /// when its robot holds the new revision whole, and until then the old one is driven.
    pub async fn replace_mission(
        &self,
        id: MissionId,
        request: ReplaceMission,
    ) -> Result<MissionDetail, AppError> {
        let asked = "replaced";
        let mut tx = self.db().write().await?;
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
        let in_hand = matches!(state, MissionState::Active | MissionState::Paused);
        if state == MissionState::Queued && mission.boot.is_none() {
            // Nobody drives it yet; a robot that has it all the same takes the new revision.
            db::missions::swap_content(&mut tx, id, mission.revision, &replacement).await?;
        } else if in_hand && mission.replacement.is_none() {
            if !robot.capabilities.replace {
                return Err(AppError::RobotCannot {
                    robot: mission.robot.clone(),
                    what: "swap a mission while it drives it",
                });
            }
            db::missions::set_replacement(&mut tx, id, Some(&replacement)).await?;
        } else {
            return Err(AppError::MissionState { id, state, asked });
        }
        let reason = format!("to be driven as revision {revision}");
        add_note(&mut tx, mission, why, at, &reason).await?;
        self.written(tx, id).await
    }

    async fn written(&self, mut tx: Tx, id: MissionId) -> Result<MissionDetail, AppError> {
        let detail = self.mission_detail(&mut tx, id).await?;
        tx.commit().await?;
        self.wake();
        Ok(detail)
    }
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
