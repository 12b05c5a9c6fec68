//! Whole agents against a real zenoh router: introduction, missions, and records that come exactly
//! once whatever happens to the network, the server or the agent.

#![expect(
    clippy::unwrap_used,
    reason = "what the helpers of a test cannot do fails the test"
)]

mod commands;
mod control;
mod recording;
mod rig;
mod safety;
mod servers;
mod service_manager;
mod state_rate;
mod support;

use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::atomic::Ordering;

use rig::Rig;
use support::{eventually, offer};
use tread_api::keys::Verb;
use tread_api::wire::RefusalCode;
use tread_api::wire::command::Cancel;
use tread_api::wire::encoding::Encoding;
use tread_api::wire::ingest::MissionPhase;
use tread_api::wire::reply::{Acknowledgement, CommandRefusal, CommandRefusalCode, OfferReply};
use tread_api::wire::{self};

const SHORT: &str = r#"{"waypoints":{"speed_m_s":0.8,
    "points":[{"x_m":4,"y_m":3},{"x_m":6,"y_m":3.2},{"x_m":7.5,"y_m":4.5}]}}"#;
const LONG: &str =
    r#"{"circle":{"center":{"x_m":7,"y_m":6},"radius_m":3,"speed_m_s":0.6,"turns":5}}"#;

/// The code of a refusal, if it is one.
fn code<T>(decided: Result<T, CommandRefusal>) -> Option<CommandRefusalCode> {
    decided.err().map(|refusal| refusal.code)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_agent_introduces_itself_publishes_and_leaves() {
    let rig = Rig::new();
    let server = rig.serve();
    let agent = rig.agent();
    let boot = agent.boot();
    rig.ready(boot).await;
    rig.sees("friction is published", |memory| {
        memory.frictions.last().map(|_| ())
    })
    .await;
    {
        let memory = rig.memory.lock().unwrap();
        assert_eq!(memory.hellos[0].boot, boot);
        assert_eq!(memory.hellos[0].robot, rig.robot);
        assert_eq!(memory.alive, [boot]);
    }
    agent.stop().await;
    rig.sees("its token goes", |memory| {
        memory.gone.contains(&boot).then_some(())
    })
    .await;
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_mission_is_driven_reported_and_answered_the_same_twice() {
    let rig = Rig::new();
    let server = rig.serve();
    let agent = rig.agent();
    rig.ready(agent.boot()).await;

    let first = offer(1, SHORT);
    let asked_at = agent.state().robot_time;
    let reply = server.offer(&rig.robot, &first).await;
    let OfferReply::Accepted { plan: Some(plan) } = reply else {
        panic!("{reply:?}");
    };
    assert!(plan.length_m > 3.0 && plan.duration_s > 3.0, "{plan:?}");
    assert_eq!(server.offer(&rig.robot, &first).await, reply);
    let mut other_content = first.clone();
    other_content.trajectory = offer(1, LONG).trajectory;
    other_content.plan_hash = offer(1, LONG).plan_hash;
    let conflict = server.offer(&rig.robot, &other_content).await;
    assert_eq!(
        code(conflict.into_result()),
        Some(CommandRefusalCode::Conflict)
    );
    let busy = server.offer(&rig.robot, &offer(2, SHORT)).await;
    assert_eq!(code(busy.into_result()), Some(CommandRefusalCode::Busy));

    rig.sees("the mission ends", |memory| {
        let phases = memory.phases(first.mission);
        (phases == [MissionPhase::Started, MissionPhase::Succeeded]).then_some(())
    })
    .await;
    let started_at = {
        let memory = rig.memory.lock().unwrap();
        let started = memory
            .records
            .values()
            .find_map(|(content, _)| match content {
                wire::ingest::RecordContent::Mission(report)
                    if report.phase == MissionPhase::Started =>
                {
                    Some(report.at)
                }
                wire::ingest::RecordContent::Mission(_)
                | wire::ingest::RecordContent::Segment(_) => None,
            });
        started.unwrap()
    };
    let latency_ms = started_at.duration_since(asked_at).as_millis();
    assert!(
        latency_ms < 500,
        "{latency_ms} ms from the offer to the first wheel command"
    );
    let late = server.offer(&rig.robot, &first).await;
    assert_eq!(code(late.into_result()), Some(CommandRefusalCode::Ended));
    agent.stop().await;
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_cannot_be_understood_or_driven_is_refused_with_a_reason() {
    let rig = Rig::new();
    let server = rig.serve();
    let agent = rig.agent();
    rig.ready(agent.boot()).await;
    let cases = [
        (&b"\xff\xfe"[..], RefusalCode::Malformed),
        (br#"{"v":1,"body":{}}"#, RefusalCode::Version),
        (br#"{"v":2,"body":{"mission":7}}"#, RefusalCode::Malformed),
    ];
    for (payload, code) in cases {
        for verb in Verb::ALL {
            let refused = server
                .ask(&rig.robot, verb, payload.to_vec())
                .await
                .unwrap();
            assert_eq!(refused.unwrap_err().code, code, "{verb:?}");
        }
    }
    let counted = agent.state().control_loop.commands_refused;
    let sent = u64::try_from(cases.len() * Verb::ALL.len()).unwrap();
    assert_eq!(counted, sent, "every payload to every verb");
    let too_fast = offer(3, &SHORT.replace("0.8", "20.0"));
    let refused = server.offer(&rig.robot, &too_fast).await;
    let refused = code(refused.into_result());
    assert_eq!(refused, Some(CommandRefusalCode::Impossible));
    let mut too_late = offer(4, SHORT);
    too_late.start_within_ms = Some(0);
    let refused = server.offer(&rig.robot, &too_late).await;
    let refused = code(refused.into_result());
    assert_eq!(refused, Some(CommandRefusalCode::TooLate));
    let cancel = Cancel {
        mission: offer(5, SHORT).mission,
        reason: "test".to_owned(),
    };
    let unknown = server.send(&rig.robot, &cancel).await.into_result();
    assert_eq!(code(unknown), Some(CommandRefusalCode::Unknown));
    let after_all = server.offer(&rig.robot, &offer(5, SHORT)).await;
    assert_eq!(
        code(after_all.into_result()),
        Some(CommandRefusalCode::Ended),
        "cancelled before it came"
    );
    assert!(rig.memory.lock().unwrap().records.is_empty());
    agent.stop().await;
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_new_definition_of_the_site_reaches_the_loop() {
    let rig = Rig::new();
    let server = rig.serve();
    let agent = rig.agent();
    rig.ready(agent.boot()).await;
    let mut definition = support::site_of(&rig.scenario);
    definition.terrain_revision = 6;
    for _ in 0..2 {
        let done = server.send(&rig.robot, &definition).await;
        assert_eq!(done, Acknowledgement::Done);
    }
    rig.sees("the robot reports the new revision", |memory| {
        (memory.states.last()?.terrain_revision == Some(6)).then_some(())
    })
    .await;
    rig.sees("friction names cell and terrain", |memory| {
        let report = memory.frictions.last()?;
        report.cell.zip(report.terrain.clone())
    })
    .await;
    agent.stop().await;
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_cancelled_mission_ends_cancelled() {
    let rig = Rig::new();
    let server = rig.serve();
    let agent = rig.agent();
    rig.ready(agent.boot()).await;
    let long = offer(1, LONG);
    server.offer(&rig.robot, &long).await;
    rig.sees("it moves", |memory| {
        let moving = memory
            .states
            .last()?
            .mission
            .filter(|mission| mission.driven_m > 0.5);
        moving.map(|_| ())
    })
    .await;
    let cancel = Cancel {
        mission: long.mission,
        reason: "test".to_owned(),
    };
    for _ in 0..2 {
        let done = server.send(&rig.robot, &cancel).await;
        assert_eq!(done, Acknowledgement::Done);
    }
    rig.sees("the mission ends", |memory| {
        let phases = memory.phases(long.mission);
        (phases == [MissionPhase::Started, MissionPhase::Cancelled]).then_some(())
    })
    .await;
    let again = server.send(&rig.robot, &cancel).await;
    assert_eq!(again, Acknowledgement::Done);
    agent.stop().await;
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_lost_receipt_makes_duplicates_and_nothing_is_lost() {
    let rig = Rig::new();
    let server = rig.serve();
    server.receipts_to_lose.store(3, Ordering::SeqCst);
    let agent = rig.agent();
    rig.ready(agent.boot()).await;
    let short = offer(1, SHORT);
    server.offer(&rig.robot, &short).await;
    rig.sees("the mission ends", |memory| {
        memory
            .phases(short.mission)
            .contains(&MissionPhase::Succeeded)
            .then_some(())
    })
    .await;
    eventually("the outbox is empty", || {
        let status = agent.outbox_status();
        if status.pending == 0 {
            Ok(())
        } else {
            Err(format!("{status:?}"))
        }
    })
    .await;
    {
        let memory = rig.memory.lock().unwrap();
        let most = memory
            .records
            .values()
            .map(|(_, times)| *times)
            .max()
            .unwrap();
        assert!(
            most >= 4,
            "three receipts were lost, yet nothing came more than {most} times"
        );
    }
    rig.assert_every_record_came_once_per_name();
    agent.stop().await;
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn uploads_are_in_cbor_where_the_server_reads_it_and_in_json_when_an_older_one_takes_over() {
    let rig = Rig::new();
    let server = rig.serve();
    let agent = rig.agent();
    rig.ready(agent.boot()).await;
    let short = offer(1, SHORT);
    server.offer(&rig.robot, &short).await;
    rig.sees("the first mission ends", |memory| {
        let phases = memory.phases(short.mission);
        phases.contains(&MissionPhase::Succeeded).then_some(())
    })
    .await;
    let first = rig.memory.lock().unwrap().encodings.clone();
    assert!(!first.is_empty());
    assert!(first.iter().all(|&of| of == Encoding::Cbor), "{first:?}");

    server.reads_json_alone.store(true, Ordering::SeqCst);
    let next = offer(2, SHORT);
    server.offer(&rig.robot, &next).await;
    rig.sees("the second mission ends", |memory| {
        let phases = memory.phases(next.mission);
        phases.contains(&MissionPhase::Succeeded).then_some(())
    })
    .await;
    let all = rig.memory.lock().unwrap().encodings.clone();
    assert_eq!(all.last(), Some(&Encoding::Json), "{all:?}");
    assert_eq!(agent.outbox_status().refused, 0, "no record was given up");
    rig.assert_every_record_came_once_per_name();
    agent.stop().await;
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_record_that_the_server_cannot_read_becomes_a_dead_letter_and_the_others_pass() {
    let rig = Rig::new();
    let server = rig.serve();
    server.refuses_starts.store(true, Ordering::SeqCst);
    let agent = rig.agent();
    rig.ready(agent.boot()).await;
    let short = offer(1, SHORT);
    server.offer(&rig.robot, &short).await;
    rig.sees("the mission ends", |memory| {
        (memory.phases(short.mission) == [MissionPhase::Succeeded]).then_some(())
    })
    .await;
    eventually("all but the bad one are settled", || {
        let status = agent.outbox_status();
        match (status.pending, status.refused) {
            (0, 1) => Ok(()),
            _ => Err(format!("{status:?}")),
        }
    })
    .await;
    let letters = rig.folder.path().join("outbox/dead-letters.jsonl");
    let letters = std::fs::read_to_string(letters).unwrap();
    assert!(letters.contains("started"), "{letters}");
    agent.stop().await;
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_robot_drives_on_without_the_server_and_brings_everything_when_it_is_back() {
    let rig = Rig::new();
    let server = rig.serve();
    let agent = rig.agent();
    rig.ready(agent.boot()).await;
    let short = offer(1, SHORT);
    server.offer(&rig.robot, &short).await;
    rig.sees("it has started", |memory| {
        (memory.phases(short.mission) == [MissionPhase::Started]).then_some(())
    })
    .await;
    server.stop().await;
    eventually("the mission ends unseen", || {
        let state = agent.state();
        match (state.mission, state.outbox.pending) {
            (None, 1..) => Ok(()),
            other => Err(format!("{other:?}")),
        }
    })
    .await;
    let hellos = rig.memory.lock().unwrap().hellos.len();

    let server = rig.serve();
    rig.sees("it says hello again", |memory| {
        (memory.hellos.len() > hellos).then_some(())
    })
    .await;
    rig.sees("the end is reported", |memory| {
        let phases = memory.phases(short.mission);
        (phases == [MissionPhase::Started, MissionPhase::Succeeded]).then_some(())
    })
    .await;
    eventually("the outbox is empty", || {
        match agent.outbox_status().pending {
            0 => Ok(()),
            pending => Err(format!("{pending} wait")),
        }
    })
    .await;
    rig.assert_every_record_came_once_per_name();
    // Commands find the robot again, too.
    let late = server.offer(&rig.robot, &short).await;
    assert_eq!(code(late.into_result()), Some(CommandRefusalCode::Ended));
    agent.stop().await;
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_agent_without_a_server_stops_in_an_orderly_way() {
    let rig = Rig::new();
    let agent = rig.agent();
    eventually("the loop runs", || match agent.state().control_loop.ticks {
        0 => Err("no tick".to_owned()),
        _ => Ok(()),
    })
    .await;
    tokio::time::timeout(support::WAIT_MAX, agent.stop())
        .await
        .expect("stopped in time");
}

#[test]
fn a_log_filter_that_cannot_be_read_is_refused() {
    let output = Command::new(env!("CARGO_BIN_EXE_tread-agent"))
        .args(["--log", "info,zenoh=loud", "--site", "yard"])
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{said}");
    assert!(
        said.contains("the log filter `info,zenoh=loud` is invalid"),
        "{said}"
    );
}

fn spawn_process(rig: &Rig, folder: &Path) -> Child {
    Command::new(env!("CARGO_BIN_EXE_tread-agent"))
        .args([
            "--site",
            "yard",
            "--robot",
            "rover-1",
            "--server",
            &rig.endpoint(),
        ])
        .arg("--data-dir")
        .arg(folder)
        .stderr(Stdio::null())
        .spawn()
        .unwrap()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_killed_agent_loses_nothing_and_resumes_nothing_and_sigterm_ends_it_well() {
    let rig = Rig::new();
    let server = rig.serve();
    let mut process = spawn_process(&rig, rig.folder.path());
    let first_boot = rig
        .sees("its token", |memory| memory.alive.first().copied())
        .await;
    rig.ready(first_boot).await;
    let long = offer(1, LONG);
    server.offer(&rig.robot, &long).await;
    rig.sees("it has measured something", |memory| {
        (memory.segments() > 0).then_some(())
    })
    .await;
    process.kill().unwrap();
    process.wait().unwrap();
    rig.sees("its token goes", |memory| {
        memory.gone.contains(&first_boot).then_some(())
    })
    .await;

    let mut process = spawn_process(&rig, rig.folder.path());
    let second_boot = rig
        .sees("the next token", |memory| memory.alive.get(1).copied())
        .await;
    assert_ne!(first_boot, second_boot);
    rig.ready(second_boot).await;
    rig.sees("the end of the mission", |memory| {
        let phases = memory.phases(long.mission);
        (phases == [MissionPhase::Started, MissionPhase::Failed]).then_some(())
    })
    .await;
    rig.assert_every_record_came_once_per_name();
    let again = server.offer(&rig.robot, &long).await;
    assert_eq!(code(again.into_result()), Some(CommandRefusalCode::Ended));

    let second = offer(2, LONG);
    server.offer(&rig.robot, &second).await;
    rig.sees("it moves", |memory| {
        memory
            .states
            .last()?
            .mission
            .filter(|mission| mission.driven_m > 0.3)
            .map(|_| ())
    })
    .await;
    let terminated = Command::new("kill")
        .arg("-TERM")
        .arg(process.id().to_string())
        .status();
    assert!(terminated.unwrap().success());
    let ended = tokio::task::spawn_blocking(move || process.wait().unwrap());
    let ended = tokio::time::timeout(support::WAIT_MAX, ended)
        .await
        .expect("in time")
        .unwrap();
    assert_eq!(ended.code(), Some(0));
    rig.sees("the second mission's end", |memory| {
        let phases = memory.phases(second.mission);
        (phases == [MissionPhase::Started, MissionPhase::Failed]).then_some(())
    })
    .await;
    server.stop().await;
}
