//! Restoring a backup: what robots did since is not done twice, and nothing is dispatched until an
//! operator releases them.

use std::path::{Path, PathBuf};

use reqwest::StatusCode;
use serde_json::{Value, json};
use tread_api::mission::{Mission, MissionState};
use tread_api::robot::Robot as RobotView;
use tread_api::wire::ingest::MissionPhase;

use crate::backups::{back_up, run, words};
use crate::harness::{Yard, client, database, eventually, measured, segment, time};
use crate::robot::Robot;

async fn backup_of(yard: &Yard) -> PathBuf {
    let folder = yard.folder.path().to_owned();
    let made = tokio::task::spawn_blocking(move || back_up(&folder, "backup.tar"));
    made.await.unwrap()
}

fn restore(folder: &Path) {
    let output = run(&[
        "restore",
        "--from",
        folder.join("backup.tar").to_str().unwrap(),
        "--database",
        database(folder).to_str().unwrap(),
        "--force",
    ]);
    assert!(output.status.success(), "{}", words(&output));
}

async fn awaiting(yard: &Yard) -> u64 {
    let (_, status) = yard.get_value("/v1/server").await;
    status["restoration"]["robots_awaiting_release"]
        .as_u64()
        .unwrap()
}

async fn release(yard: &Yard, robot: &str) {
    let path = format!("/v1/sites/yard/robots/{robot}/release");
    let (status, body) = yard.send(yard.client().post(yard.url(&path))).await;
    assert_eq!(status, StatusCode::OK, "{body}");
    assert_eq!(body["awaits_release_since"], Value::Null, "{body}");
}

fn offered(robot: &Robot, mission: &Mission) -> usize {
    let offers = robot.offers();
    offers
        .iter()
        .filter(|offer| offer.mission == mission.id)
        .count()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn missions_that_ended_after_the_backup_are_closed_as_that_and_others_wait_for_a_release() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let driven = yard.create_mission(&robot.id).await;
    yard.mission_becomes(driven.id, MissionState::Active).await;
    let cancelled = yard.create_mission(&robot.id).await;
    let left = yard.create_mission(&robot.id).await;
    backup_of(&yard).await;

    // The robot goes on, and the server hears of it.
    robot.report(0, &driven, MissionPhase::Succeeded).await;
    yard.mission_becomes(cancelled.id, MissionState::Active)
        .await;
    robot.report(1, &cancelled, MissionPhase::Cancelled).await;
    yard.mission_becomes(cancelled.id, MissionState::Cancelled)
        .await;
    yard.mission_becomes(left.id, MissionState::Active).await;
    robot.report(2, &left, MissionPhase::Failed).await;
    yard.mission_becomes(left.id, MissionState::Failed).await;
    robot.remember(
        &[
            (driven.id, MissionPhase::Succeeded),
            (cancelled.id, MissionPhase::Cancelled),
        ],
        None,
    );

    // The third mission never got to a robot that remembers it, as with another robot's disk.
    let yard = yard.restart_after(restore).await;
    robot.hello().await;
    yard.mission_becomes(driven.id, MissionState::Succeeded)
        .await;
    yard.mission_becomes(cancelled.id, MissionState::Cancelled)
        .await;
    assert_eq!(
        yard.mission(left.id).await.mission.state,
        MissionState::Queued
    );
    assert_eq!((awaiting(&yard).await, offered(&robot, &left)), (1, 1));
    let (_, alerts) = yard.get_value("/v1/alerts?raised=true").await;
    assert!(
        alerts.to_string().contains("robots-await-release"),
        "{alerts}"
    );
    let new = yard.create_mission(&robot.id).await;
    assert_eq!((offered(&robot, &left), offered(&robot, &new)), (1, 0));

    let view: RobotView = yard.get("/v1/sites/yard/robots/rover-1").await;
    assert!(view.awaits_release_since.is_some());
    release(&yard, "rover-1").await;
    yard.mission_becomes(left.id, MissionState::Active).await;
    assert_eq!(awaiting(&yard).await, 0);
    eventually("the alert is over", async || {
        let (_, alerts) = yard.get_value("/v1/alerts?raised=true").await;
        let is_over = !alerts.to_string().contains("robots-await-release");
        if is_over { Ok(()) } else { Err(alerts) }
    })
    .await;
    for mission in [&driven, &cancelled] {
        assert_eq!(offered(&robot, mission), 1, "never again");
    }
    // A second time changes nothing.
    release(&yard, "rover-1").await;
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_mission_that_the_robot_drives_on_is_taken_up_and_one_of_after_the_backup_is_ended() {
    let yard = Yard::start().await;
    let known = Robot::join(&yard, "rover-1").await;
    let other = Robot::join(&yard, "rover-2").await;
    known.set_mood(crate::robot::Mood::Silent);
    let queued = yard.create_mission(&known.id).await;
    yard.mission_becomes(queued.id, MissionState::Offered).await;
    backup_of(&yard).await;
    known.set_mood(crate::robot::Mood::Willing);
    yard.mission_becomes(queued.id, MissionState::Active).await;
    let sent = offered(&known, &queued);
    let unknown = yard.create_mission(&other.id).await;
    yard.mission_becomes(unknown.id, MissionState::Active).await;

    let yard = yard.restart_after(restore).await;
    known.hello().await;
    other.hello().await;
    let taken_up = yard.mission_becomes(queued.id, MissionState::Active).await;
    assert_eq!(taken_up.mission.boot, Some(known.boot));
    assert_eq!(offered(&known, &queued), sent, "not once more");
    eventually("the other one gets a cancel", async || {
        let cancels = other.cancels();
        let is_there = cancels.iter().any(|cancel| cancel.mission == unknown.id);
        if is_there { Ok(()) } else { Err(cancels) }
    })
    .await;
    assert!(known.cancels().is_empty());
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_mission_that_the_robot_may_have_forgotten_is_not_sent_again() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let first = yard.create_mission(&robot.id).await;
    yard.mission_becomes(first.id, MissionState::Active).await;
    let old = yard.create_mission(&robot.id).await;
    let young = yard.create_mission(&robot.id).await;
    backup_of(&yard).await;
    robot.set_mood(crate::robot::Mood::Silent);
    robot.report(0, &first, MissionPhase::Succeeded).await;
    robot.remember(&[(first.id, MissionPhase::Succeeded)], Some(old.id));
    let yard = yard.restart_after(restore).await;
    robot.hello().await;
    let failed = yard.mission_becomes(old.id, MissionState::Failed).await;
    let reason = failed.mission.reason.unwrap_or_default();
    assert!(reason.contains("no longer remembers"), "{reason}");
    robot.set_mood(crate::robot::Mood::Willing);
    release(&yard, "rover-1").await;
    yard.mission_becomes(young.id, MissionState::Active).await;
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_older_agent_that_does_not_know_the_question_does_not_hold_its_robot_for_ever() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    robot.be_deaf_to_outcomes();
    backup_of(&yard).await;
    let yard = yard.restart_after(restore).await;
    robot.hello().await;
    release(&yard, "rover-1").await;
    let mission = yard.create_mission(&robot.id).await;
    yard.mission_becomes(mission.id, MissionState::Active).await;
    assert!(robot.outcomes_asked() > 1);
    yard.server.stop().await.unwrap();
}

async fn cells_of(yard: &Yard) -> Value {
    let (_, cells) = yard.get_value("/v1/sites/yard/friction/cells").await;
    cells["items"].clone()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn segments_of_before_the_backup_count_once_and_those_that_the_robot_still_has_are_taken() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let of = |numbers: std::ops::Range<u64>| {
        numbers
            .map(|seq| measured(seq, segment((1, 1), 0.2, i64::try_from(seq).unwrap())))
            .collect::<Vec<_>>()
    };
    robot.upload(of(0..40)).await.unwrap();
    backup_of(&yard).await;
    let yard = yard.restart_after(restore).await;
    robot.hello().await;
    // Its outbox held the last ones of before, and those that it measured since.
    let receipt = robot.upload(of(30..60)).await.unwrap();
    assert_eq!((receipt.committed, receipt.duplicates), (20, 10));
    let once = Yard::start().await;
    let robot = Robot::join(&once, "rover-1").await;
    robot.upload(of(0..60)).await.unwrap();
    // What was measured loses weight by the minute, so both are read in the same one.
    let (mut restored, mut expected) = (cells_of(&yard).await, cells_of(&once).await);
    if restored[0]["friction"]["age_s"] != expected[0]["friction"]["age_s"] {
        (restored, expected) = (cells_of(&yard).await, cells_of(&once).await);
    }
    assert_eq!(restored[0]["friction"]["segments"], 60, "{restored}");
    assert_eq!(restored, expected);
    yard.server.stop().await.unwrap();
    once.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn sessions_and_join_tokens_end_and_numbers_that_were_given_are_not_given_again() {
    let yard = Yard::start_joining_at(time("2026-11-24T12:00:00Z")).await;
    let signing_in = client(None).post(yard.url("/v1/session"));
    let signing_in = signing_in.json(&json!({"token": yard.admin()}));
    assert!(yard.send(signing_in).await.0.is_success());
    let (status, made) = yard
        .post(
            "/v1/join-tokens",
            &json!({"site": "yard", "robot": "rover-1"}),
        )
        .await;
    assert_eq!(status, StatusCode::CREATED, "{made}");
    let square = json!([{"x_m": 0, "y_m": 0}, {"x_m": 9, "y_m": 0}, {"x_m": 9, "y_m": 9}]);
    let lawn = json!({"id": "lawn", "class": "grass", "polygon": square});
    assert!(
        yard.post("/v1/sites/yard/terrains", &lawn)
            .await
            .0
            .is_success()
    );
    let (_, before) = yard.get_value("/v1/sites/yard").await;
    backup_of(&yard).await;
    let yard = yard.restart_after(restore).await;
    let (_, sessions) = yard.get_value("/v1/sessions").await;
    assert_eq!(sessions["items"], json!([]), "{sessions}");
    let (_, tokens) = yard.get_value("/v1/join-tokens").await;
    assert!(tokens["items"][0]["revoked_at"].is_string(), "{tokens}");
    let (_, after) = yard.get_value("/v1/sites/yard").await;
    for revision in ["terrain_revision", "geofence_revision"] {
        let skipped = after[revision].as_u64().unwrap() - before[revision].as_u64().unwrap();
        assert_eq!(skipped, 1_000_000, "{revision}");
    }
    let (_, drawn) = yard.get_value("/v1/sites/yard/terrains/lawn").await;
    assert_eq!(drawn["revision"], 1, "what was measured on it still counts");
    let (status, again) = yard
        .send(
            yard.client()
                .put(yard.url("/v1/sites/yard/terrains/lawn"))
                .json(&json!({"class": "grass", "polygon": square, "layer": 1})),
        )
        .await;
    assert!(status.is_success(), "{again}");
    assert!(again["revision"].as_u64().unwrap() > 1_000_000, "{again}");
    // The audit log says so, and its chain holds.
    let (_, audit) = yard.get_value("/v1/audit?who=tread-server%20restore").await;
    assert_eq!(audit["items"][0]["method"], "RESTORE", "{audit}");
    assert!(audit["items"][0]["hash"].is_string(), "{audit}");
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_restoration_refuses_what_could_do_harm_and_lists_what_to_review() {
    let yard = Yard::start().await;
    let backup = backup_of(&yard).await;
    let folder = yard.folder.path().to_owned();
    let refused = |arguments: Vec<String>| async {
        let output = tokio::task::spawn_blocking(move || {
            let arguments: Vec<&str> = arguments.iter().map(|argument| &**argument).collect();
            run(&arguments)
        });
        let output = output.await.unwrap();
        assert_eq!(output.status.code(), Some(1), "{}", words(&output));
        words(&output)
    };
    let database = database(&folder);
    let arguments = |from: &Path, more: &[&str]| {
        let mut all = vec!["restore", "--from", from.to_str().unwrap(), "--database"];
        all.push(database.to_str().unwrap());
        all.extend(more);
        all.into_iter().map(str::to_owned).collect::<Vec<_>>()
    };
    let said = refused(arguments(&backup, &["--force"])).await;
    assert!(said.contains("used by another server"), "{said}");
    yard.server.stop().await.unwrap();
    let before = std::fs::read(&database).unwrap();
    let said = refused(arguments(&backup, &[])).await;
    assert!(said.contains("--force"), "{said}");
    let mut damaged = std::fs::read(&backup).unwrap();
    let middle = damaged.len() / 2;
    damaged[middle] ^= 1;
    let broken = folder.join("broken.tar");
    std::fs::write(&broken, damaged).unwrap();
    let said = refused(arguments(&broken, &["--force"])).await;
    assert!(said.contains("damaged"), "{said}");
    let said = refused(arguments(&folder.join("nothing"), &["--force"])).await;
    assert!(said.contains("nothing"), "{said}");
    assert_eq!(
        std::fs::read(&database).unwrap(),
        before,
        "nothing was touched"
    );
    assert!(!folder.join("tread.db.restoring").exists());

    let output = tokio::task::spawn_blocking({
        let arguments = arguments(&backup, &["--force"]);
        move || {
            let arguments: Vec<&str> = arguments.iter().map(|argument| &**argument).collect();
            run(&arguments)
        }
    });
    let output = output.await.unwrap();
    assert!(output.status.success(), "{}", words(&output));
    let said = words(&output);
    for part in [
        "token `tests` (admin)",
        "tread tokens revoke",
        "tread robots release",
    ] {
        assert!(said.contains(part), "{part} in {said}");
    }
    let aside = std::fs::read_dir(&folder).unwrap();
    let aside: Vec<_> = aside
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.to_str().unwrap().contains("before-restore"))
        .collect();
    assert_eq!(aside.len(), 1, "{aside:?}");
    assert_eq!(
        std::fs::read(&aside[0]).unwrap(),
        before,
        "the old one is kept"
    );
}
