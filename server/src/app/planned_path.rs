//! Where the planner lays a mission's path, for people to see before and after it was driven.

use tread_api::ids::MissionId;
use tread_api::trajectory::PlannedPath;

use super::check::{Refused, begin_of, drawn, planned};
use super::{App, AppError};
use crate::db;

impl App {
    /// The smooth path of a mission's present revision: from where its robot planned it, once it
    /// has taken it, and from the begin of the trajectory before.
    ///
    /// # Errors
    /// [`AppError::UnknownMission`]; [`AppError::Impossible`] for what its robot has refused or
    /// will refuse.
    pub async fn planned_path(&self, id: MissionId) -> Result<PlannedPath, AppError> {
        let mut tx = self.db().read("planned_path").await?;
        let row = db::missions::find(&mut tx, id)
            .await?
            .ok_or(AppError::UnknownMission(id))?;
        let mission = row.mission;
        let site_pk = super::site_row(&mut tx, &mission.site).await?.pk;
        let robot = db::robots::find(&mut tx, site_pk, &mission.robot).await?;
        let unknown = || AppError::UnknownRobot(mission.site.clone(), mission.robot.clone());
        let model = robot.ok_or_else(unknown)?.model;
        drop(tx);
        let _turn = self.check_turn().await;
        let trajectory = mission.trajectory;
        let begin = mission.plan.and_then(|plan| plan.begin);
        let planning = move || {
            let begin = begin.unwrap_or_else(|| begin_of(&trajectory));
            let planned = planned(&model, &trajectory, begin)?;
            Ok(drawn(&planned.plan, &trajectory))
        };
        match tokio::task::spawn_blocking(planning).await {
            Ok(path) => path.map_err(|refused: Refused| refused.of(mission.robot)),
            Err(_panic) => Err(AppError::Impossible {
                robot: mission.robot,
                detail: "the planner broke on it".to_owned(),
                place: None,
            }),
        }
    }
}
