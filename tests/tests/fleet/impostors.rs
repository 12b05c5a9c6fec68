//! Robots whose agents are not what they seem: two under one name, and one whose loop stands still.

use serde_json::Value;
use tread_api::ids::RobotId;
use tread_api::mission::{Cause, MissionState};
use tread_api::robot::{LinkCause, LinkState, RobotMode};
use tread_tests::wait::{DRIVE, SHORT, eventually};

use crate::{arc, bend, fleet};

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn of_two_agents_under_one_name_the_newest_counts_and_the_other_ends_its_mission() {
    let mut fleet = fleet().await;
    let robot: RobotId = "rover-1".parse().unwrap();
    fleet.start_agent(&robot, 0.0).await;
    let older = fleet.rest.robot(&robot).await.unwrap().live.unwrap().boot;
    let mission = fleet.rest.send(&robot, arc(0.0, 20.0)).await;
    fleet
        .rest
        .mission_reaches(mission, &[MissionState::Active], SHORT)
        .await;

    let second = fleet.spawn_second_agent(&robot, 5.0);
    let look = || fleet.rest.robot(&robot);
    let seen = eventually("both are named", SHORT, look, |seen| {
        let seen = seen.as_ref();
        seen.is_some_and(|seen| {
            seen.alerts
                .iter()
                .any(|it| it.code.as_str() == "two-agents")
        })
    })
    .await
    .unwrap();
    let newer = seen.live.unwrap().boot;
    assert_ne!(newer, older);
    let alert = seen
        .alerts
        .iter()
        .find(|it| it.code.as_str() == "two-agents");
    let alert = alert.unwrap();
    for boot in [older, newer] {
        assert!(alert.text.contains(&boot.to_string()), "{alert:?}");
    }
    let failed = fleet
        .rest
        .mission_reaches(mission, &[MissionState::Failed], SHORT)
        .await;
    assert_eq!(failed.mission.cause, Cause::AgentRestarted);
    // The older one does not drive on: it got a cancel, and what it reports of that is kept.
    let log = || async { fleet.log(robot.as_str()) };
    let ended = format!("mission {mission} ended: Cancelled");
    eventually("the older one ends it", SHORT, log, |log| {
        log.contains(&ended)
    })
    .await;
    let status: Value = fleet.rest.get("/v1/server").await;
    let counted = |name: &str| status["counters"][name].as_u64().unwrap();
    assert!(counted("refused_other_run") > 0 && counted("missions_unknown") > 0);
    // Commands reach the newer one, and it alone.
    let next = fleet.rest.send(&robot, bend(5.0)).await;
    let driven = fleet
        .rest
        .mission_reaches(next, &[MissionState::Succeeded], DRIVE)
        .await;
    assert_eq!(driven.mission.boot, Some(newer));
    assert!(
        !fleet
            .log(robot.as_str())
            .contains(&format!("took mission {next}"))
    );

    // When the newer one is gone the older one is the robot again, and all is quiet.
    fleet.kill_agent(&second);
    let look = || fleet.rest.robot(&robot);
    eventually("the older one is the robot", SHORT, look, |seen| {
        seen.as_ref().is_some_and(|seen| {
            let live = seen.live.as_ref();
            let is_older = live.is_some_and(|it| it.boot == older && it.mode == RobotMode::Idle);
            is_older && seen.link == LinkState::Online && seen.alerts.is_empty()
        })
    })
    .await;
    let last = fleet.rest.send(&robot, bend(0.0)).await;
    let driven = fleet
        .rest
        .mission_reaches(last, &[MissionState::Succeeded], DRIVE)
        .await;
    assert_eq!(driven.mission.boot, Some(older));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_robot_whose_loop_stands_still_is_offline_although_its_agent_speaks() {
    let mut fleet = fleet().await;
    let robot: RobotId = "rover-1".parse().unwrap();
    // Shorter than the 2 s after which the agent's own watchdog would end it.
    fleet.agents_get(&["--stall-s=5,1.9"]);
    fleet.start_agent(&robot, 0.0).await;
    let link = || async {
        let seen = fleet.rest.robot(&robot).await;
        seen.map(|seen| (seen.link, seen.link_cause))
    };
    let stopped = Some((LinkState::Offline, Some(LinkCause::LoopStopped)));
    eventually("its loop is known to stand", SHORT, link, |seen| {
        *seen == stopped
    })
    .await;
    let online = Some((LinkState::Online, None));
    eventually("it is back", SHORT, link, |seen| *seen == online).await;
    let mission = fleet.rest.send(&robot, bend(0.0)).await;
    fleet
        .rest
        .mission_reaches(mission, &[MissionState::Succeeded], DRIVE)
        .await;
}
