//! Missions are paused, resumed and replaced over REST, and robots left alone do what was agreed.

use std::time::Duration;

use serde_json::{Value, json};
use tread_api::friction::StoredSegment;
use tread_api::ids::{MissionId, RobotId};
use tread_api::mission::{Cause, MissionDetail, MissionState};
use tread_api::problem::ProblemType;
use tread_api::robot::{MissionProgress, RobotMode};
use tread_tests::fleet::{Fleet, SITE};
use tread_tests::wait::{DRIVE, SHORT, eventually};

use crate::{arc, bend, fleet};

fn robot() -> RobotId {
    "rover-1".parse().expect("it is an identifier")
}

async fn progress(fleet: &Fleet, from_m: f64) -> MissionProgress {
    let look = || async { fleet.rest.robot(&robot()).await?.live?.mission };
    eventually("the robot drives", SHORT, look, |mission| {
        mission.is_some_and(|mission| !mission.paused && mission.driven_m > from_m)
    })
    .await
    .expect("it was just seen")
}

async fn ask(fleet: &Fleet, mission: MissionId, verb: &str, body: &Value) {
    let path = format!("/v1/missions/{mission}/{verb}");
    fleet.rest.post(&path, body).await;
}

fn has_cause(detail: &MissionDetail, cause: Cause) -> bool {
    detail.events.iter().any(|event| event.cause == cause)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_mission_is_paused_resumed_and_replaced_and_its_record_is_kept() {
    let mut fleet = fleet().await;
    fleet.start_agent(&robot(), 0.0).await;
    let mission = fleet.rest.send(&robot(), arc(0.0, 20.0)).await;
    progress(&fleet, 0.3).await;
    ask(&fleet, mission, "pause", &Value::Null).await;
    fleet
        .rest
        .mission_reaches(mission, &[MissionState::Paused], SHORT)
        .await;
    let look = || async { fleet.rest.robot(&robot()).await?.live };
    let stood = eventually("it stands", SHORT, look, |live| {
        live.as_ref().is_some_and(|live| {
            let speed_m_s = live.twist.map_or(1.0, |twist| twist.value.linear_m_s);
            live.mission.is_some_and(|mission| mission.paused) && speed_m_s.abs() < 0.05
        })
    })
    .await
    .unwrap();

    ask(&fleet, mission, "resume", &Value::Null).await;
    fleet
        .rest
        .mission_reaches(mission, &[MissionState::Active], SHORT)
        .await;
    let before = progress(&fleet, stood.mission.unwrap().driven_m).await;
    assert_eq!(before.revision, 1);

    // What cannot be driven is refused, and what is driven goes on.
    let tight = json!({"circle": {
        "center": {"x_m": 0.0, "y_m": 1.5}, "radius_m": 0.1, "speed_m_s": 0.9, "turns": 1.0,
    }});
    let path = format!("/v1/missions/{mission}/replace");
    let answer = fleet
        .rest
        .call(
            reqwest::Method::POST,
            &path,
            Some(&json!({"trajectory": tight})),
        )
        .await;
    assert!(answer.is_some());
    let look = || fleet.rest.mission(mission);
    let after = eventually("the refusal is known", SHORT, look, |detail| {
        detail.mission.replacement.is_none()
    })
    .await;
    assert_eq!(
        (after.mission.revision, after.mission.state),
        (1, MissionState::Active)
    );

    let body = json!({"trajectory": bend(0.0)});
    ask(&fleet, mission, "replace", &body).await;
    let ended = fleet
        .rest
        .mission_reaches(mission, &[MissionState::Succeeded], DRIVE)
        .await;
    assert!(
        ended.mission.revision > 1 && has_cause(&ended, Cause::Replaced),
        "{ended:#?}"
    );
    assert_eq!(
        ended.mission.trajectory,
        serde_json::from_value(bend(0.0)).unwrap()
    );
    let quality = ended.quality.expect("the robot reported how it went");
    assert!(
        quality.paused_s > 0.0 && quality.cross_track_rms_m < 0.2,
        "{quality:?}"
    );
    assert!(!quality.theta.is_empty());
    let driven = ended.driven.expect("the robot reported where it was");
    let first = driven.points.first().unwrap();
    let last = driven.points.last().unwrap();
    assert!(first.x_m.hypot(first.y_m) < 0.3, "{first:?}");
    assert!((last.x_m - 3.0).hypot(last.y_m - 0.6) < 0.3, "{last:?}");
    fleet
        .rest
        .post_refused(
            &format!("/v1/missions/{mission}/pause"),
            &Value::Null,
            ProblemType::MissionEnded,
        )
        .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_robot_that_stays_away_is_lost_and_its_late_success_changes_nothing() {
    let mut fleet = fleet().await;
    let relay = fleet.start_agent_behind_relay(&robot(), 0.0).await;
    let body = json!({
        "site": SITE, "robot": robot(), "trajectory": bend(0.0), "lost_after_s": 2.0,
    });
    let mission = fleet.rest.post("/v1/missions", &body).await;
    let mission: MissionId = serde_json::from_value(mission["id"].clone()).unwrap();
    progress(&fleet, 0.3).await;
    relay.cut();
    let lost = fleet
        .rest
        .mission_reaches(mission, &[MissionState::Failed], SHORT)
        .await;
    assert_eq!(lost.mission.cause, Cause::RobotLost);
    // The robot knows nothing of that and drives to the end.
    tokio::time::sleep(Duration::from_secs(5)).await;
    relay.reset();
    relay.heal();
    let look = || fleet.rest.mission(mission);
    let detail = eventually("the late success is kept", DRIVE, look, |detail| {
        detail.events.len() > lost.events.len() && detail.quality.is_some()
    })
    .await;
    assert_eq!(detail.mission.state, MissionState::Failed);
    assert_eq!(detail.mission.cause, Cause::RobotLost);
    // The robot is free and its next mission is driven.
    let next = fleet.rest.send(&robot(), bend(0.0)).await;
    fleet
        .rest
        .mission_reaches(next, &[MissionState::Succeeded], DRIVE)
        .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_robot_that_minds_silence_stops_in_a_silent_partition_and_says_so_afterwards() {
    let mut fleet = fleet().await;
    let relay = fleet.start_agent_behind_relay(&robot(), 0.0).await;
    let body = json!({
        "site": SITE, "robot": robot(), "trajectory": arc(0.0, 20.0),
        "link_policy": {"stop_after": {"silence_s": 1.5}}, "lost_after_s": 60.0,
    });
    let mission = fleet.rest.post("/v1/missions", &body).await;
    let mission: MissionId = serde_json::from_value(mission["id"].clone()).unwrap();
    progress(&fleet, 0.5).await;
    relay.cut();
    tokio::time::sleep(Duration::from_secs(5)).await;
    relay.heal();
    let failed = fleet
        .rest
        .mission_reaches(mission, &[MissionState::Failed], SHORT)
        .await;
    assert_eq!(failed.mission.cause, Cause::Failed);
    assert!(
        failed.mission.reason.as_deref().unwrap().contains("silent"),
        "{failed:#?}"
    );
    // It braked about when it should have: 1.5 s and the braking after the cut, not 5 s.
    let quality = failed.quality.unwrap();
    assert!(quality.distance_m < 6.0, "{quality:?}");
    let mode = || async { fleet.rest.robot(&robot()).await?.live.map(|live| live.mode) };
    eventually("the robot is free", SHORT, mode, |mode| {
        *mode == Some(RobotMode::Idle)
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_robot_whose_clock_is_wrong_by_days_loses_nothing_and_confuses_nobody() {
    let mut fleet = fleet().await;
    let mut asked = Vec::new();
    for (name, x_m, ahead_s) in [("slow", 0.0, -9 * 86_400), ("fast", 30.0, 5 * 86_400)] {
        let robot: RobotId = name.parse().unwrap();
        fleet.agents_get(&[
            &format!("--clock-ahead-s={ahead_s}"),
            "--battery-charge=0.1",
        ]);
        fleet.start_agent(&robot, x_m).await;
        let asked_at = tread_tests::light_robot::now();
        let body = json!({
            "site": SITE, "robot": robot, "trajectory": crate::slalom(x_m, 4),
            "latest_start": asked_at + Duration::from_secs(10),
        });
        let mission = fleet.rest.post("/v1/missions", &body).await;
        let mission: MissionId = serde_json::from_value(mission["id"].clone()).unwrap();
        asked.push((robot, ahead_s, asked_at, mission));
    }
    for (robot, ahead_s, asked_at, mission) in asked {
        let ended = fleet
            .rest
            .mission_reaches(mission, &[MissionState::Succeeded], DRIVE)
            .await
            .mission;
        let margin = Duration::from_secs(2);
        let now = tread_tests::light_robot::now();
        for at in [ended.started_at.unwrap(), ended.ended_at.unwrap()] {
            assert!(asked_at - margin < at && at < now + margin, "{at}");
        }
        let look = || async { fleet.rest.robot(&robot).await };
        let seen = eventually("its alert is known", SHORT, look, |robot| {
            robot.as_ref().is_some_and(|robot| !robot.alerts.is_empty())
        })
        .await
        .unwrap();
        assert_eq!(seen.alerts[0].code.as_str(), "battery-low");
        let live = seen.live.unwrap();
        assert!(
            (live.clock_offset_ms - 1_000 * ahead_s).abs() < 2_000,
            "{live:?}"
        );
        let look = || async {
            let all: Vec<StoredSegment> = fleet.rest.all("/v1/sites/yard/segments").await;
            let own = all.into_iter().filter(|stored| stored.robot == robot);
            own.collect::<Vec<_>>()
        };
        let segments = eventually("segments arrive", SHORT, look, |list| list.len() > 3).await;
        for stored in segments {
            let ended_at = stored.segment.ended_at;
            assert!(asked_at < ended_at && ended_at < now + margin, "{ended_at}");
        }
    }
}
