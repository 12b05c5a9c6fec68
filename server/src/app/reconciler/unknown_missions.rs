//! Commands that end missions which nobody expects of a robot, or of a second agent under its name.

use tracing::warn;
use tread_api::ids::MissionId;
use tread_api::wire::command::Cancel;

use super::jobs::Finished;
use crate::app::presence::{DuplicateAgent, RobotKey};
use crate::app::{App, AppError};
use crate::db;

/// Commands a robot to end a mission that is not among its open ones in the database.
pub(super) async fn cancel_foreign_mission(
    app: App,
    key: RobotKey,
    mission: MissionId,
) -> Result<Finished, AppError> {
    let mut tx = app.db().read("reconciler").await?;
    let row = db::missions::find(&mut tx, mission).await?;
    drop(tx);
    let own = row.filter(|row| (&row.mission.site, &row.mission.robot) == (&key.0, &key.1));
    let reason = match own {
        Some(row) if !row.mission.state.is_terminal() => return Ok(Finished::Settled),
        Some(row) => format!(
            "it has ended at the server: it is {}, {}",
            row.mission.state.as_str(),
            row.mission.cause.as_str()
        ),
        None => "it is no mission of this robot".to_owned(),
    };
    warn!(
        mission.id = %mission, robot.id = %key.1,
        "robot `{}` drives mission `{mission}`, and gets a cancel: {reason}", key.1
    );
    app.counters().missions_unknown.one();
    let command = Cancel { mission, reason };
    // The answer is ignored: the robot's next states show whether it has ended; if not, the cancel
    // is sent again.
    let _ = app.commands().send(&key, &command).await;
    Ok(Finished::Again)
}

/// Sends a cancel of its mission to a second agent that runs under a robot's name. Settled if that
/// agent drives no mission; otherwise the job runs again until it has ended.
pub(super) async fn end_duplicate_agent(app: App, duplicate: DuplicateAgent) -> Finished {
    let DuplicateAgent { key, boot, mission } = duplicate;
    let Some(mission) = mission else {
        return Finished::Settled;
    };
    warn!(
        mission.id = %mission, robot.id = %key.1,
        "a second agent drives mission `{mission}` under the name of robot `{}`, as boot {boot}, \
         and gets a cancel", key.1
    );
    app.counters().missions_unknown.one();
    let reason = "another agent has taken this robot's name".to_owned();
    let command = Cancel { mission, reason };
    // The answer is ignored: the agent's next states show whether it has ended; if not, the cancel
    // is sent again.
    let _ = app.commands().send_to(&key, Some(boot), &command).await;
    Finished::Again
}
