//! Planned paths of missions, for display before and after they are driven.

use tread_api::ids::MissionId;
use tread_api::trajectory::PlannedPath;

use super::check::{Planning, Refused, begin_of, drawn, planned};
use super::{App, AppError};
use crate::db;

impl App {
    /// Returns the smooth path of a mission's present revision, with the traction limits that are
    /// known now. It begins where its robot planned
    /// it, once the robot has accepted it, and at the begin of the trajectory before that.
    ///
    /// # Errors
    /// [`AppError::UnknownMission`]; [`AppError::Impossible`] or [`AppError::TurnTooSharp`] for a
    /// trajectory that cannot be planned, which its robot refuses too.
    pub async fn planned_path(&self, id: MissionId) -> Result<PlannedPath, AppError> {
        let mut tx = self.db().read("planned_path").await?;
        let row = db::missions::find(&mut tx, id)
            .await?
            .ok_or(AppError::UnknownMission(id))?;
        let mission = row.mission;
        let site_row = super::site_row(&mut tx, &mission.site).await?;
        let robot = db::robots::find(&mut tx, site_row.pk, &mission.robot).await?;
        let unknown = || AppError::UnknownRobot(mission.site.clone(), mission.robot.clone());
        let model = robot.ok_or_else(unknown)?.model;
        drop(tx);
        let named = (&mission.site, &mission.robot);
        let traction = self
            .traction_along(named, &site_row.site.grid, &mission.trajectory)
            .await?;
        let _turn = self.check_turn().await;
        let trajectory = mission.trajectory;
        let begin = mission.plan.and_then(|plan| plan.begin);
        let planning = move || {
            let begin = begin.unwrap_or_else(|| begin_of(&trajectory));
            let planning = Planning {
                trajectory: &trajectory,
                traction: &traction,
            };
            let planned = planned(&model, planning, begin)?;
            Ok(drawn(&planned.plan, &trajectory))
        };
        match tokio::task::spawn_blocking(planning).await {
            Ok(path) => path.map_err(|refused: Refused| refused.without_field().of(mission.robot)),
            Err(_panic) => Err(AppError::Impossible {
                robot: mission.robot,
                detail: "the planner broke on it".to_owned(),
                field: None,
                place: None,
            }),
        }
    }
}
