//! Processes die and networks break; nothing is lost and nothing counts twice.

use std::collections::HashMap;
use std::time::Duration;

use serde_json::Value;
use tread_api::friction::StoredSegment;
use tread_api::ids::{BootId, RobotId};
use tread_api::mission::MissionState;
use tread_api::robot::LinkState;
use tread_tests::fleet::{Fleet, SITE};
use tread_tests::wait::{DRIVE, SHORT, eventually};

use crate::{arc, bend, fleet, slalom};

/// Waits until a robot's outbox is empty.
async fn everything_is_uploaded(fleet: &Fleet, robot: &RobotId) {
    let look = || async { fleet.rest.robot(robot).await.and_then(|robot| robot.live) };
    eventually("the outbox is empty", DRIVE, look, |live| {
        live.as_ref()
            .is_some_and(|live| live.state_age_ms < 1_000 && live.outbox.pending == 0)
    })
    .await;
}

/// The thread that closes a dead link stands still for up to ten seconds; others have to send.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_link_that_is_dead_does_not_hold_up_the_next_one() {
    let mut fleet = fleet().await;
    let robot: RobotId = "rover-1".parse().unwrap();
    fleet.start_agent(&robot, 0.0).await;
    let senders = || async {
        fleet
            .processes()
            .map(|process| process.threads("tx-"))
            .collect()
    };
    eventually(
        "both sides have threads to send with",
        SHORT,
        senders,
        |counts: &Vec<usize>| counts.len() == 2 && counts.iter().all(|&count| count >= 4),
    )
    .await;
}

/// Every segment once, and none missing: the numbers of each boot have no gap but those that
/// mission reports took.
async fn each_record_is_stored_once(fleet: &Fleet, mission_reports: usize) -> usize {
    let segments: Vec<StoredSegment> = fleet.rest.all(&format!("/v1/sites/{SITE}/segments")).await;
    let mut by_boot: HashMap<BootId, Vec<u64>> = HashMap::new();
    for segment in &segments {
        by_boot.entry(segment.boot).or_default().push(segment.seq);
    }
    let mut numbers = 0;
    for (boot, mut seqs) in by_boot {
        seqs.sort_unstable();
        let count = seqs.len();
        seqs.dedup();
        assert_eq!(seqs.len(), count, "boot {boot} has a segment twice");
        let last = seqs.last().copied().unwrap_or(0);
        numbers += usize::try_from(last).expect("a small number") + 1 - count;
    }
    assert!(
        numbers <= mission_reports,
        "{numbers} numbers are missing, mission reports took only {mission_reports}"
    );
    segments.len()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_server_is_killed_during_a_mission_and_nothing_is_lost_or_doubled() {
    let mut fleet = fleet().await;
    let robot: RobotId = "rover-1".parse().unwrap();
    fleet.start_agent(&robot, 0.0).await;
    let driven = fleet.rest.send(&robot, slalom(0.0, 9)).await;
    // It begins near where the first one ends.
    let queued = fleet.rest.send(&robot, bend(16.0)).await;
    fleet
        .rest
        .mission_reaches(driven, &[MissionState::Active], SHORT)
        .await;
    let progressed = || async {
        fleet
            .rest
            .robot(&robot)
            .await
            .and_then(|robot| robot.live?.mission)
    };
    eventually("a few metres are driven", SHORT, progressed, |mission| {
        mission.is_some_and(|mission| mission.driven_m > 3.0)
    })
    .await;
    fleet.kill_server();
    // The robot drives on meanwhile; long enough for a cell or two to be measured.
    tokio::time::sleep(Duration::from_secs(3)).await;
    fleet.start_server().await;
    for mission in [driven, queued] {
        let ended = fleet
            .rest
            .mission_reaches(mission, &[MissionState::Succeeded], DRIVE)
            .await;
        let active = |state: &MissionState| *state == MissionState::Active;
        let times_active = ended
            .events
            .iter()
            .filter(|event| active(&event.to) && event.from.as_ref() != Some(&event.to))
            .count();
        assert_eq!(times_active, 1, "{ended:#?}");
    }
    everything_is_uploaded(&fleet, &robot).await;
    assert!(each_record_is_stored_once(&fleet, 4).await > 3);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_agent_is_killed_during_a_mission_and_its_measurements_survive() {
    let mut fleet = fleet().await;
    let robot: RobotId = "rover-1".parse().unwrap();
    fleet.start_agent(&robot, 0.0).await;
    let first_boot = fleet
        .rest
        .robot(&robot)
        .await
        .and_then(|robot| robot.live)
        .unwrap()
        .boot;
    let interrupted = fleet.rest.send(&robot, slalom(0.0, 40)).await;
    fleet
        .rest
        .mission_reaches(interrupted, &[MissionState::Active], SHORT)
        .await;
    let measured = || fleet.rest.all::<StoredSegment>("/v1/sites/yard/segments");
    let before = eventually("something is measured", DRIVE, measured, |list| {
        list.len() >= 3
    })
    .await;
    fleet.kill_agent(&robot);
    let link = || async { fleet.rest.robot(&robot).await.map(|robot| robot.link) };
    eventually("the robot is offline", SHORT, link, |link| {
        *link == Some(LinkState::Offline)
    })
    .await;

    fleet.start_agent(&robot, 0.0).await;
    let second_boot = fleet
        .rest
        .robot(&robot)
        .await
        .and_then(|robot| robot.live)
        .unwrap()
        .boot;
    assert_ne!(first_boot, second_boot);
    // The mission was in the hands of the run that died: it fails, and the robot is free again.
    let failed = fleet
        .rest
        .mission_reaches(interrupted, &[MissionState::Failed], SHORT)
        .await;
    assert!(
        failed.mission.reason.unwrap().contains("restart"),
        "the reason says what happened"
    );
    let next = fleet.rest.send(&robot, bend(0.0)).await;
    fleet
        .rest
        .mission_reaches(next, &[MissionState::Succeeded], DRIVE)
        .await;
    everything_is_uploaded(&fleet, &robot).await;
    assert!(each_record_is_stored_once(&fleet, 4).await >= before.len());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_is_measured_while_the_network_is_cut_arrives_exactly_once() {
    let mut fleet = fleet().await;
    let robot: RobotId = "rover-1".parse().unwrap();
    let relay = fleet.start_agent_behind_relay(&robot, 0.0).await;
    let mission = fleet.rest.send(&robot, slalom(0.0, 12)).await;
    fleet
        .rest
        .mission_reaches(mission, &[MissionState::Active], SHORT)
        .await;
    relay.cut();
    let link = || async { fleet.rest.robot(&robot).await.map(|robot| robot.link) };
    let silent = |link: &Option<LinkState>| link.is_some_and(|link| link != LinkState::Online);
    eventually("the server notices the silence", SHORT, link, silent).await;
    let at_cut: Vec<StoredSegment> = fleet.rest.all("/v1/sites/yard/segments").await;
    // Longer than the lease, so that both sides give the connection up.
    tokio::time::sleep(Duration::from_secs(8)).await;
    let during: Vec<StoredSegment> = fleet.rest.all("/v1/sites/yard/segments").await;
    assert_eq!(during.len(), at_cut.len(), "something passed the cut");
    let seen = fleet.rest.mission(mission).await;
    assert_eq!(
        seen.mission.state,
        MissionState::Active,
        "the mission waits for its robot"
    );
    relay.reset();
    relay.heal();
    fleet
        .rest
        .mission_reaches(mission, &[MissionState::Succeeded], DRIVE)
        .await;
    everything_is_uploaded(&fleet, &robot).await;
    assert!(each_record_is_stored_once(&fleet, 2).await > at_cut.len() + 2);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_robot_that_starts_before_the_server_finds_it() {
    let mut fleet = fleet().await;
    let robot: RobotId = "rover-1".parse().unwrap();
    fleet.kill_server();
    fleet.spawn_agent(&robot, 0.0);
    tokio::time::sleep(Duration::from_secs(1)).await;
    fleet.start_server().await;
    fleet.robot_is_online(&robot).await;
    let mission = fleet.rest.send(&robot, bend(0.0)).await;
    fleet
        .rest
        .mission_reaches(mission, &[MissionState::Succeeded], DRIVE)
        .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn everything_stops_politely_when_asked() {
    let mut fleet = fleet().await;
    let robot: RobotId = "rover-1".parse().unwrap();
    fleet.start_agent(&robot, 0.0).await;
    let mission = fleet.rest.send(&robot, arc(0.0, 20.0)).await;
    fleet
        .rest
        .mission_reaches(mission, &[MissionState::Active], SHORT)
        .await;
    let agent = fleet.stop_agent(&robot).await.unwrap();
    assert!(agent.success(), "the agent ended with {agent}");
    let server = fleet.stop_server().await.unwrap();
    assert!(server.success(), "the server ended with {server}");
    fleet.start_server().await;
    let detail: Value = fleet.rest.get(&format!("/v1/missions/{mission}")).await;
    assert_eq!(detail["id"], mission.to_string());
}
