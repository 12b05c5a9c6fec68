//! What people want of missions that are there, and what robots make of it.

use std::time::Duration;

use reqwest::StatusCode;
use serde_json::{Value, json};
use tread_api::identity::Role;
use tread_api::keys::Verb;
use tread_api::mission::{Cause, Mission, MissionDetail, MissionState};
use tread_api::robot::{LinkCause, LinkState, Robot as ShownRobot};
use tread_api::wire::ingest::MissionPhase;
use tread_api::wire::reply::CommandRefusalCode;

use crate::harness::{Yard, circle, client, eventually};
use crate::robot::{Mood, Robot};

async fn act(yard: &Yard, mission: &Mission, verb: &str, body: &Value) -> (StatusCode, Value) {
    let path = format!("/v1/missions/{}/{verb}", mission.id);
    yard.post(&path, body).await
}

pub(crate) fn causes(detail: &MissionDetail) -> Vec<Cause> {
    detail.events.iter().map(|event| event.cause).collect()
}

async fn ask(yard: &Yard, robot: &Robot, more: Value) -> (StatusCode, Value) {
    let mut body = circle(&robot.id);
    let fields = body.as_object_mut().unwrap();
    fields.extend(more.as_object().unwrap().clone());
    yard.post("/v1/missions", &body).await
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_mission_is_paused_and_resumed_when_its_robot_says_so() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let mission = yard.create_mission(&robot.id).await;
    yard.mission_becomes(mission.id, MissionState::Active).await;
    let (status, body) = act(&yard, &mission, "pause", &json!({})).await;
    assert_eq!(status, StatusCode::ACCEPTED, "{body}");
    assert_eq!(
        (&body["state"], &body["pause_requested"]),
        (&json!("active"), &json!(true))
    );
    yard.mission_becomes(mission.id, MissionState::Paused).await;
    let (status, _) = act(&yard, &mission, "resume", &json!({})).await;
    assert_eq!(status, StatusCode::ACCEPTED);
    let resumed = yard.mission_becomes(mission.id, MissionState::Active).await;
    // A command may come again before the robot's state has shown it.
    let mut holds = robot.holds();
    holds.dedup();
    assert_eq!(holds[..2], [Verb::Pause, Verb::Resume]);
    let expected = [
        Cause::PauseRequested,
        Cause::Paused,
        Cause::ResumeRequested,
        Cause::Resumed,
    ];
    assert!(
        causes(&resumed).ends_with(&expected),
        "{:?}",
        resumed.events
    );
    robot.report(0, &mission, MissionPhase::Succeeded).await;
    let (status, body) = act(&yard, &mission, "pause", &json!({})).await;
    assert_eq!(
        (status, &body["state"]),
        (StatusCode::CONFLICT, &json!("succeeded"))
    );
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_mission_is_paused_when_its_robot_stands_and_not_when_it_was_commanded() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let mission = yard.create_mission(&robot.id).await;
    yard.mission_becomes(mission.id, MissionState::Active).await;
    robot.set_mood(Mood::Braking);
    act(&yard, &mission, "pause", &json!({})).await;
    eventually("the robot was commanded to pause", async || {
        let holds = robot.holds();
        if holds.is_empty() { Err(holds) } else { Ok(()) }
    })
    .await;
    // It was commanded, it has answered, and it drives still.
    tokio::time::sleep(Duration::from_millis(1_500)).await;
    let braking = yard.mission(mission.id).await;
    assert_eq!(braking.mission.state, MissionState::Active);
    assert!(braking.mission.pause_requested);
    assert_eq!(robot.holds(), [Verb::Pause], "once is enough for a while");
    robot.report(0, &mission, MissionPhase::Paused).await;
    assert_eq!(
        yard.mission(mission.id).await.mission.state,
        MissionState::Paused
    );
    act(&yard, &mission, "resume", &json!({})).await;
    eventually("the robot was commanded to go on", async || {
        let holds = robot.holds();
        if holds.contains(&Verb::Resume) {
            Ok(())
        } else {
            Err(holds)
        }
    })
    .await;
    robot.report(1, &mission, MissionPhase::Resumed).await;
    let resumed = yard.mission(mission.id).await;
    assert_eq!(resumed.mission.state, MissionState::Active);
    let robots = |cause| {
        let mut events = resumed.events.iter();
        let event = events.find(|event| event.cause == cause).unwrap();
        event.actor == tread_api::mission::Actor::Robot
    };
    assert!(robots(Cause::Paused) && robots(Cause::Resumed));
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_mission_that_only_the_robots_state_shows_as_taken_knows_its_run() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    robot.set_mood(Mood::Silent);
    let mission = yard.create_mission(&robot.id).await;
    eventually("it is offered", async || {
        let offers = robot.offers().len();
        if offers > 0 { Ok(()) } else { Err(offers) }
    })
    .await;
    robot.drive(&mission, 0.5);
    let active = yard.mission_becomes(mission.id, MissionState::Active).await;
    assert_eq!(active.mission.boot, Some(robot.boot));
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_filter_that_names_nothing_known_is_named() {
    let yard = Yard::start().await;
    let _robot = Robot::join(&yard, "rover-1").await;
    for (query, field) in [
        ("/v1/missions?robot=nobody", "robot"),
        ("/v1/missions?site=moon", "site"),
        ("/v1/missions?site=moon&robot=rover-1", "site"),
        ("/v1/alerts?robot=nobody", "robot"),
    ] {
        let (status, body) = yard.get_value(query).await;
        assert_eq!(status, StatusCode::BAD_REQUEST, "{query}: {body}");
        assert_eq!(body["field"], field, "{query}: {body}");
    }
    let (status, body) = yard.get_value("/v1/missions?site=yard&robot=rover-1").await;
    assert_eq!(status, StatusCode::OK, "{body}");
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_the_present_state_forbids_is_refused_with_that_state() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    robot.set_mood(Mood::Refusing(CommandRefusalCode::Busy));
    let first = yard.create_mission(&robot.id).await;
    let second = yard.create_mission(&robot.id).await;
    let (status, body) = act(&yard, &second, "pause", &json!({})).await;
    assert_eq!(status, StatusCode::CONFLICT, "{body}");
    assert_eq!(
        (&body["type"], &body["state"]),
        (&json!("/problems/mission-state"), &json!("queued"))
    );
    let (status, body) = ask(&yard, &robot, json!({"start_policy": "refuse"})).await;
    assert_eq!(
        (status, &body["type"]),
        (StatusCode::CONFLICT, &json!("/problems/robot-busy"))
    );
    let (status, body) = ask(&yard, &robot, json!({"priority": 101})).await;
    assert_eq!(
        (status, &body["field"]),
        (StatusCode::UNPROCESSABLE_ENTITY, &json!("priority"))
    );
    let policy = json!({"link_policy": {"stop_after": {"silence_s": 0.1}}});
    let (status, body) = ask(&yard, &robot, policy).await;
    assert_eq!(
        (status, &body["field"]),
        (StatusCode::UNPROCESSABLE_ENTITY, &json!("link_policy"))
    );
    assert!(!yard.mission(first.id).await.mission.state.is_terminal());
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_replacement_counts_when_the_robot_holds_it_and_not_before() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let mission = yard.create_mission(&robot.id).await;
    yard.mission_becomes(mission.id, MissionState::Active).await;
    robot.set_mood(Mood::Silent);
    let mut other = json!({"trajectory": circle(&robot.id)["trajectory"]});
    other["trajectory"]["circle"]["radius_m"] = json!(5.0);
    let (status, body) = act(&yard, &mission, "replace", &other).await;
    assert_eq!(status, StatusCode::ACCEPTED, "{body}");
    assert_eq!(
        (&body["revision"], &body["replacement"]["revision"]),
        (&json!(1), &json!(2))
    );
    let (status, _) = act(&yard, &mission, "replace", &other).await;
    assert_eq!(status, StatusCode::CONFLICT, "one is on its way");
    robot.set_mood(Mood::Willing);
    let swapped = eventually("the new revision counts", async || {
        let seen = yard.mission(mission.id).await;
        if seen.mission.revision == 2 {
            Ok(seen)
        } else {
            Err(seen)
        }
    })
    .await;
    assert_eq!(swapped.mission.state, MissionState::Active);
    assert_eq!(swapped.mission.replacement, None);
    assert_ne!(swapped.mission.plan_hash, mission.plan_hash);
    // The robot had reached the end of the old one just before.
    robot.report(0, &mission, MissionPhase::Succeeded).await;
    yard.mission_becomes(mission.id, MissionState::Succeeded)
        .await;
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_refused_replacement_leaves_the_old_one() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let mission = yard.create_mission(&robot.id).await;
    yard.mission_becomes(mission.id, MissionState::Active).await;
    robot.set_mood(Mood::Refusing(CommandRefusalCode::Impossible));
    let other = json!({"trajectory": circle(&robot.id)["trajectory"]});
    act(&yard, &mission, "replace", &other).await;
    let refused = eventually("the replacement is gone", async || {
        let seen = yard.mission(mission.id).await;
        if seen.mission.replacement.is_none() {
            Ok(seen)
        } else {
            Err(seen)
        }
    })
    .await;
    assert_eq!(
        (refused.mission.state, refused.mission.revision),
        (MissionState::Active, 1)
    );
    assert_eq!(causes(&refused).last(), Some(&Cause::ReplaceRefused));
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn higher_priority_goes_first_and_a_replacing_mission_ends_the_others() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let driven = yard.create_mission(&robot.id).await;
    yard.mission_becomes(driven.id, MissionState::Active).await;
    let later = yard.create_mission(&robot.id).await;
    let (_, urgent) = ask(&yard, &robot, json!({"priority": 5})).await;
    let urgent: Mission = serde_json::from_value(urgent).unwrap();
    robot.report(0, &driven, MissionPhase::Succeeded).await;
    yard.mission_becomes(urgent.id, MissionState::Active).await;
    assert_eq!(
        yard.mission(later.id).await.mission.state,
        MissionState::Queued
    );
    let (_, sole) = ask(&yard, &robot, json!({"start_policy": "replace"})).await;
    let sole: Mission = serde_json::from_value(sole).unwrap();
    let ended = yard
        .mission_becomes(urgent.id, MissionState::Cancelled)
        .await;
    assert!(
        causes(&ended).contains(&Cause::Superseded),
        "{:?}",
        ended.events
    );
    assert_eq!(
        yard.mission(later.id).await.mission.state,
        MissionState::Cancelled
    );
    yard.mission_becomes(sole.id, MissionState::Active).await;
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn one_key_makes_one_mission_also_after_a_restart() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let robot_id = robot.id.clone();
    drop(robot);
    // A key belongs to its token, and the admin of the tests has another after a restart.
    let token = yard.token("desk", Role::Operator).await.secret;
    let client = client(Some(&token));
    let send = async |yard: &Yard, key: &str, body: &Value| {
        let request = client.post(yard.url("/v1/missions"));
        yard.send(request.header("idempotency-key", key).json(body))
            .await
    };
    let (status, first) = send(&yard, "k-1", &circle(&robot_id)).await;
    assert_eq!(status, StatusCode::CREATED, "{first}");
    assert_eq!(
        send(&yard, "k-1", &circle(&robot_id)).await,
        (status, first.clone())
    );
    let mut other = circle(&robot_id);
    other["priority"] = json!(1);
    let (refused, body) = send(&yard, "k-1", &other).await;
    assert_eq!(refused, StatusCode::UNPROCESSABLE_ENTITY);
    assert_eq!(body["type"], "/problems/idempotency-key-reused");
    let yard = yard.restart().await;
    assert_eq!(
        send(&yard, "k-1", &circle(&robot_id)).await,
        (status, first)
    );
    let (_, all) = yard.get_value("/v1/missions").await;
    assert_eq!(all["items"].as_array().unwrap().len(), 1);
    let (status, body) = send(&yard, "", &circle(&robot_id)).await;
    assert_eq!(
        (status, &body["field"]),
        (StatusCode::BAD_REQUEST, &json!("idempotency-key"))
    );
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn the_same_key_many_times_at_once_makes_one_mission() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let body = circle(&robot.id);
    let sends = (0..20).map(|_| {
        let request = yard.client().post(yard.url("/v1/missions"));
        yard.send(request.header("idempotency-key", "same").json(&body))
    });
    let mut created = std::collections::BTreeSet::new();
    for (status, answer) in futures_util::future::join_all(sends).await {
        if status == StatusCode::CREATED {
            created.insert(answer["id"].to_string());
        } else {
            assert_eq!(answer["type"], "/problems/idempotency-key-in-flight");
        }
    }
    assert_eq!(created.len(), 1, "{created:?}");
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_robot_that_stays_away_loses_its_mission_and_gets_a_cancel_when_it_comes_back() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let (status, body) = ask(&yard, &robot, json!({"lost_after_s": 1.0})).await;
    assert_eq!(status, StatusCode::CREATED, "{body}");
    let mission: Mission = serde_json::from_value(body).unwrap();
    yard.mission_becomes(mission.id, MissionState::Active).await;
    robot.stop_loop();
    let lost = yard.mission_becomes(mission.id, MissionState::Failed).await;
    assert_eq!(lost.mission.cause, Cause::RobotLost);
    let shown: ShownRobot = yard.get("/v1/sites/yard/robots/rover-1").await;
    assert_eq!(
        (shown.link, shown.link_cause),
        (LinkState::Offline, Some(LinkCause::LoopStopped))
    );
    robot.start_loop();
    eventually("the robot gets a cancel", async || {
        let is_cancelled = robot
            .cancels()
            .iter()
            .any(|cancel| cancel.mission == mission.id);
        if is_cancelled { Ok(()) } else { Err(()) }
    })
    .await;
    robot.report(0, &mission, MissionPhase::Succeeded).await;
    let after = yard.mission(mission.id).await;
    assert_eq!(
        (after.mission.state, after.mission.cause),
        (MissionState::Failed, Cause::RobotLost)
    );
    assert_eq!(causes(&after).last(), Some(&Cause::Recorded));
    assert!(yard.counters().await.missions_unknown >= 1);
    yard.server.stop().await.unwrap();
}
