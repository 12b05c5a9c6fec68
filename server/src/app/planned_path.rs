//! Where the planner lays a mission's way, for people to see before and after it was driven.

use tread_api::geometry::Point;
use tread_api::ids::MissionId;
use tread_api::trajectory::{PLANNED_POINTS_MAX, PlannedPath, Trajectory};
use tread_control::plan::Plan;

use super::check::{Refused, begin_of, once_m, planned};
use super::{App, AppError};
use crate::db;

/// Least way from one point to the next, metres; it grows with long ways.
const STEP_MIN_M: f64 = 0.1;

impl App {
    /// The smooth way of a mission's present revision: from where its robot planned it, once it has
    /// taken it, and from the begin of the trajectory before.
    ///
    /// # Errors
    /// [`AppError::UnknownMission`]; [`AppError::Impossible`] for what its robot has refused or
    /// will refuse.
    pub async fn planned_path(&self, id: MissionId) -> Result<PlannedPath, AppError> {
        let mut tx = self.db().read().await?;
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
            Ok(way(&planned.plan, &trajectory))
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

/// Points along a plan, evenly spaced, at most [`PLANNED_POINTS_MAX`].
pub(super) fn way(plan: &Plan, trajectory: &Trajectory) -> PlannedPath {
    let length_m = once_m(plan, trajectory);
    #[expect(clippy::cast_precision_loss, reason = "a thousand")]
    let steps_max = (PLANNED_POINTS_MAX - 1) as f64;
    let steps = (length_m / STEP_MIN_M).ceil().clamp(1.0, steps_max);
    let step_m = length_m / steps;
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "1 to 999"
    )]
    let points = (0..=steps as u32).map(|step| {
        let pose = plan.path().sample(f64::from(step) * step_m).pose;
        Point {
            x_m: pose.x_m,
            y_m: pose.y_m,
        }
    });
    PlannedPath {
        step_m,
        points: points.collect(),
    }
}
