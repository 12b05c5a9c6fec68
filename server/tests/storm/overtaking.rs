//! Requests of people that come between the decision for a command and its sending.

use tread_api::mission::{CreateMission, LinkPolicy, MissionState, StartPolicy};
use tread_server::db::Location;

use super::Storm;
use super::network::with;
use super::samples::circle;

/// What a person wants of a mission that was created a moment ago.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Wish {
    Pause,
    Cancel,
    Supersede,
    /// A stop of its robot, which is cleared at once.
    Stop,
}

impl Wish {
    pub(crate) const ALL: [Self; 4] = [Self::Pause, Self::Cancel, Self::Supersede, Self::Stop];
}

/// Creates a mission for a robot that is there, grants a wish, and only then lets the reconciler send what
/// it wants to.
///
/// # Errors
/// The robot was to drive the mission nevertheless.
pub(crate) async fn grant_before_the_offer(wish: Wish) -> Result<(), String> {
    let folder = tempfile::tempdir().map_err(|error| error.to_string())?;
    let mut storm = Storm::start(1, Location::from(folder.path().join("storm.db"))).await;
    with(&storm.world, |world| world.calm = true);
    storm.heartbeat(0);
    let robot = with(&storm.world, |world| world.robots[0].id.clone());
    let request = |start_policy| CreateMission {
        site: storm.site.clone(),
        robot: robot.clone(),
        trajectory: circle(3.0),
        latest_start: None,
        priority: 0,
        start_policy,
        link_policy: LinkPolicy::Continue,
        lost_after_s: None,
    };
    let create = async |policy| storm.app.create_mission(request(policy)).await;
    let mission = create(StartPolicy::Append).await;
    let mission = mission.map_err(|error| format!("{error:?}"))?;
    if mission.state != MissionState::Queued {
        return Err(format!("{mission:?}"));
    }
    let id = mission.id;
    match wish {
        Wish::Pause => storm.hold_if(id, storm.app.pause_mission(id).await)?,
        Wish::Cancel => storm.hold_if(id, storm.app.cancel_mission(id).await)?,
        Wish::Supersede => storm.hold_if(id, create(StartPolicy::Replace).await)?,
        Wish::Stop => {
            storm.reference.follow(storm.app.db()).await?;
            storm.stop(0).await?;
            storm.let_go().await?;
        }
    }
    storm.reconcile().await?;
    let wrong = with(&storm.world, |world| world.wrong.take());
    storm.app.db().close().await;
    wrong.map_or(Ok(()), |wrong| Err(format!("{wish:?}: {wrong}")))
}
