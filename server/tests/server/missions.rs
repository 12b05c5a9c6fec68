//! Missions from the request to their end, whatever arrives late, twice or not at all.

use std::time::Duration;

use reqwest::StatusCode;
use serde_json::json;
use tread_api::ids::{BootId, RobotId};
use tread_api::mission::{Actor, Mission, MissionDetail, MissionState};
use tread_api::page::Page;
use tread_api::wire::ingest::{MissionPhase, Record};
use tread_api::wire::reply::CommandRefusalCode;
use uuid::Uuid;

use crate::harness::{Yard, circle, eventually, report, site};
use crate::ingest::{Writer, boot};
use crate::robot::{Mood, Robot, first_state};

/// Who moved a mission into which states, in their order.
fn steps_of(mission: &MissionDetail) -> Vec<(Actor, MissionState)> {
    let events = mission.events.iter();
    events.map(|event| (event.actor, event.to)).collect()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_mission_is_offered_driven_and_succeeds_with_its_whole_history() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let mission = yard.create_mission(&robot.id).await;
    assert_eq!(mission.state, MissionState::Queued);
    let active = yard.mission_becomes(mission.id, MissionState::Active).await;
    assert_eq!(active.mission.boot, Some(robot.boot));
    let offers = robot.offers();
    assert_eq!(offers.len(), 1);
    assert_eq!(
        (offers[0].mission, offers[0].plan_hash),
        (mission.id, mission.plan_hash)
    );

    robot.report(0, &mission, MissionPhase::Started).await;
    robot.drive(&mission, 4.5);
    eventually("progress is shown", async || {
        let progress = yard.mission(mission.id).await.mission.progress;
        if progress.is_some_and(|progress| progress.driven_m > 4.0) {
            Ok(())
        } else {
            Err(progress)
        }
    })
    .await;
    robot.report(1, &mission, MissionPhase::Succeeded).await;
    let ended = yard.mission(mission.id).await;
    assert_eq!(ended.mission.state, MissionState::Succeeded);
    assert!(ended.mission.started_at.is_some() && ended.mission.ended_at.is_some());
    assert_eq!(
        steps_of(&ended),
        [
            (Actor::Client, MissionState::Queued),
            (Actor::Server, MissionState::Offered),
            (Actor::Robot, MissionState::Active),
            (Actor::Robot, MissionState::Active),
            (Actor::Robot, MissionState::Succeeded),
        ]
    );
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_arrives_late_or_twice_never_reopens_a_mission() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let mission = yard.create_mission(&robot.id).await;
    yard.mission_becomes(mission.id, MissionState::Active).await;
    assert_eq!(
        robot
            .report(0, &mission, MissionPhase::Failed)
            .await
            .committed,
        1
    );
    let before = yard.mission(mission.id).await;
    assert_eq!(before.mission.state, MissionState::Failed);

    let again = robot.report(0, &mission, MissionPhase::Failed).await;
    assert_eq!((again.committed, again.duplicates), (0, 1));
    assert_eq!(
        yard.mission(mission.id).await,
        before,
        "sent twice is nothing new"
    );
    for (seq, phase) in [(1, MissionPhase::Started), (2, MissionPhase::Succeeded)] {
        assert_eq!(robot.report(seq, &mission, phase).await.committed, 1);
    }
    robot.drive(&mission, 1.0);
    let after = yard.mission(mission.id).await;
    assert_eq!(after.mission.state, MissionState::Failed);
    assert_eq!(after.mission.ended_at, before.mission.ended_at);
    assert!(
        after
            .events
            .last()
            .unwrap()
            .reason
            .as_deref()
            .unwrap()
            .contains("late")
    );
    let (status, _) = yard
        .post(&format!("/v1/missions/{}/cancel", mission.id), &())
        .await;
    assert_eq!(status, StatusCode::CONFLICT);
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_end_that_its_robot_reports_again_is_nothing_new() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    for (first, phase) in [(0, MissionPhase::Succeeded), (10, MissionPhase::Failed)] {
        let mission = yard.create_mission(&robot.id).await;
        yard.mission_becomes(mission.id, MissionState::Active).await;
        robot.report(first, &mission, phase).await;
        let before = yard.mission(mission.id).await;
        assert!(before.mission.state.is_terminal());
        // In a further record, as of an agent that was killed while it recorded the end.
        let again = robot.report(first + 1, &mission, phase).await;
        assert_eq!((again.committed, again.duplicates), (1, 0));
        assert_eq!(yard.mission(mission.id).await, before);
        // Another end is noted.
        robot
            .report(first + 2, &mission, MissionPhase::Expired)
            .await;
        let after = yard.mission(mission.id).await;
        assert_eq!(after.mission.state, before.mission.state);
        assert_eq!(after.events.len(), before.events.len() + 1);
    }
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn two_missions_of_one_robot_run_one_after_the_other() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let first = yard.create_mission(&robot.id).await;
    let second = yard.create_mission(&robot.id).await;
    yard.mission_becomes(first.id, MissionState::Active).await;
    assert_eq!(
        yard.mission(second.id).await.mission.state,
        MissionState::Queued
    );
    robot.report(0, &first, MissionPhase::Started).await;
    assert_eq!(robot.offers().len(), 1, "the second one waits");
    robot.report(1, &first, MissionPhase::Succeeded).await;
    yard.mission_becomes(second.id, MissionState::Active).await;
    let offered: Vec<_> = robot.offers().iter().map(|offer| offer.mission).collect();
    assert_eq!(offered, [first.id, second.id]);

    let newest: Page<Mission> = yard.get("/v1/missions?robot=rover-1&limit=1").await;
    assert_eq!(newest.items[0].id, second.id);
    let cursor = newest.next_cursor.unwrap();
    let rest: Page<Mission> = yard
        .get(&format!("/v1/missions?limit=1&cursor={cursor}"))
        .await;
    assert_eq!(rest.items[0].id, first.id);
    assert_eq!(rest.next_cursor, None);
    let active: Page<Mission> = yard.get("/v1/missions?state=active&site=yard").await;
    assert_eq!(active.items.len(), 1);
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_busy_robot_is_asked_again_and_a_silent_one_too() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    robot.set_mood(Mood::Refusing(CommandRefusalCode::Busy));
    let mission = yard.create_mission(&robot.id).await;
    let offers = async |count: usize| {
        eventually("further offers", async || {
            let seen = robot.offers().len();
            if seen >= count { Ok(()) } else { Err(seen) }
        })
        .await;
    };
    offers(2).await;
    assert!(!yard.mission(mission.id).await.mission.state.is_terminal());
    robot.set_mood(Mood::Silent);
    offers(4).await;
    robot.set_mood(Mood::Willing);
    yard.mission_becomes(mission.id, MissionState::Active).await;
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_a_robot_cannot_drive_is_rejected_with_its_words() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    robot.set_mood(Mood::Refusing(CommandRefusalCode::Impossible));
    let mission = yard.create_mission(&robot.id).await;
    let rejected = yard
        .mission_becomes(mission.id, MissionState::Rejected)
        .await;
    assert_eq!(
        rejected.mission.reason.as_deref(),
        Some("as the test asked")
    );
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_cancellation_reaches_the_robot_and_its_next_mission_follows() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let first = yard.create_mission(&robot.id).await;
    let second = yard.create_mission(&robot.id).await;
    let third = yard.create_mission(&robot.id).await;
    yard.mission_becomes(first.id, MissionState::Active).await;
    let cancel = async |id| yard.post(&format!("/v1/missions/{id}/cancel"), &()).await;
    let (status, body) = cancel(second.id).await;
    assert_eq!(
        (status, body["state"].as_str()),
        (StatusCode::ACCEPTED, Some("cancelled"))
    );
    let (status, body) = cancel(first.id).await;
    assert_eq!(
        (status, body["state"].as_str()),
        (StatusCode::ACCEPTED, Some("cancelling"))
    );
    yard.mission_becomes(first.id, MissionState::Cancelled)
        .await;
    assert_eq!(robot.cancels()[0].mission, first.id);
    yard.mission_becomes(third.id, MissionState::Active).await;
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_mission_that_waits_past_its_latest_start_expires() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let id = robot.id.clone();
    drop(robot);
    let mut body = circle(&id);
    body["latest_start"] = "2026-01-01T00:00:00Z".into();
    let (status, problem) = yard.post("/v1/missions", &body).await;
    assert_eq!(status, StatusCode::UNPROCESSABLE_ENTITY, "{problem}");
    assert_eq!(problem["field"], "latest_start");
    let soon = yard.server.app().clock().now() + Duration::from_millis(300);
    body["latest_start"] = json!(soon);
    let (status, body) = yard.post("/v1/missions", &body).await;
    assert_eq!(status, StatusCode::CREATED, "{body}");
    let mission: Mission = serde_json::from_value(body).unwrap();
    yard.mission_becomes(mission.id, MissionState::Expired)
        .await;
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_restarted_server_knows_its_queue_and_what_is_driven() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let first = yard.create_mission(&robot.id).await;
    let second = yard.create_mission(&robot.id).await;
    yard.mission_becomes(first.id, MissionState::Active).await;
    robot.drive(&first, 1.0);
    let yard = yard.restart().await;
    assert_eq!(
        yard.mission(first.id).await.mission.state,
        MissionState::Active
    );
    assert_eq!(
        yard.mission(second.id).await.mission.state,
        MissionState::Queued
    );
    let receipt = eventually("the robot is back and reports", async || {
        let record = Record {
            seq: 0,
            content: report(&first, MissionPhase::Succeeded),
        };
        robot.upload(vec![record]).await
    })
    .await;
    assert_eq!(receipt.committed, 1);
    yard.mission_becomes(second.id, MissionState::Active).await;
    assert_eq!(
        yard.mission(first.id).await.mission.state,
        MissionState::Succeeded
    );
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_mission_of_an_agent_that_restarted_fails_unless_its_records_say_otherwise() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let lost = yard.create_mission(&robot.id).await;
    yard.mission_becomes(lost.id, MissionState::Active).await;
    let robot = robot.reboot(&yard).await;
    let failed = yard.mission_becomes(lost.id, MissionState::Failed).await;
    assert_eq!(
        failed.mission.reason.as_deref(),
        Some("agent restarted during the mission")
    );

    let saved = yard.create_mission(&robot.id).await;
    yard.mission_becomes(saved.id, MissionState::Active).await;
    let first_boot = robot.boot;
    let robot = {
        let id = robot.id.clone();
        drop(robot);
        // The new run still has the old one's record in its store.
        let robot = Robot::join_with_pending(&yard, id.as_str(), 1).await;
        let record = Record {
            seq: 9,
            content: report(&saved, MissionPhase::Succeeded),
        };
        robot.upload_as(first_boot, vec![record]).await.unwrap();
        robot.say(|state| state.outbox.pending = 0);
        robot
    };
    yard.mission_becomes(saved.id, MissionState::Succeeded)
        .await;
    drop(robot);
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_robot_cannot_end_the_mission_of_another_one() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let other = Robot::join(&yard, "rover-2").await;
    let mission = yard.create_mission(&robot.id).await;
    yard.mission_becomes(mission.id, MissionState::Active).await;
    let receipt = other.report(0, &mission, MissionPhase::Failed).await;
    assert_eq!((receipt.committed, receipt.refused.len()), (0, 1));
    let again = other.report(0, &mission, MissionPhase::Failed).await;
    assert_eq!(
        again.refused.len(),
        1,
        "refused again, not called a duplicate"
    );
    let boot = BootId::from_uuid(Uuid::from_u128(3));
    let mut lie = mission.clone();
    lie.revision = 2;
    let record = Record {
        seq: 0,
        content: report(&lie, MissionPhase::Failed),
    };
    let receipt = robot.upload_as(boot, vec![record]).await.unwrap();
    assert!(
        receipt.refused[0].reason.contains("other content"),
        "{receipt:?}"
    );
    assert_eq!(
        yard.mission(mission.id).await.mission.state,
        MissionState::Active
    );
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_mission_is_offered_in_the_commit_that_creates_it_where_nothing_comes_before_it() {
    // There is no reconciler that would offer it.
    let writer = Writer::start().await;
    let (app, robot): (_, RobotId) = (&writer.app, "rover-1".parse().unwrap());
    let create = async |robot: &RobotId| {
        let request = serde_json::from_value(circle(robot)).unwrap();
        let created = app.create_mission(request).await.unwrap();
        assert_eq!(created.state, MissionState::Queued);
        app.mission(created.id).await.unwrap()
    };
    let appears = |robot: &RobotId| {
        let (key, now) = ((site(), robot.clone()), app.clock().elapsed());
        app.presences().token_appeared(key.clone(), boot(1), now);
        let state = first_state(robot, boot(1), 0);
        app.presences().state(&key, state, now, app.clock().now());
    };
    let unheard = create(&robot).await;
    assert_eq!(unheard.mission.state, MissionState::Queued, "nobody hears");
    appears(&robot);
    let second = create(&robot).await;
    assert_eq!(second.mission.state, MissionState::Queued, "behind another");
    let other: RobotId = "rover-2".parse().unwrap();
    appears(&other);
    let generation = app.db().generation();
    let offered = create(&other).await;
    assert_eq!(offered.mission.state, MissionState::Offered);
    // What map requests keep of sites and robots stays valid.
    assert_eq!(app.db().generation(), generation);
    assert_eq!(
        steps_of(&offered),
        [
            (Actor::Client, MissionState::Queued),
            (Actor::Server, MissionState::Offered),
        ]
    );
}
