//! Whole agents against a real zenoh router: missions that are paused, replaced and left without a
//! server, and robots whose clocks are wrong.

use std::sync::Arc;
use std::time::Duration;

use tread_agent::Agent;
use tread_agent::clock::SystemClock;
use tread_api::ids::MissionId;
use tread_api::mission::LinkPolicy;
use tread_api::robot::MissionProgress;
use tread_api::wire::command::{Cancel, Offer, Pause, Resume};
use tread_api::wire::ingest::{MissionPhase, MissionReport, RecordContent};
use tread_api::wire::reply::{Acknowledgement, CommandRefusalCode, OfferReply};

use crate::code;
use crate::rig::Rig;
use crate::support::{FakeServer, offer};

const LONG: &str =
    r#"{"circle":{"center":{"x_m":7,"y_m":6},"radius_m":3,"speed_m_s":0.6,"turns":5}}"#;
const OTHER: &str = r#"{"waypoints":{"speed_m_s":0.8,
    "points":[{"x_m":5,"y_m":4},{"x_m":7,"y_m":4.5},{"x_m":8.5,"y_m":5.5}]}}"#;
const TOO_TIGHT: &str =
    r#"{"circle":{"center":{"x_m":7,"y_m":6},"radius_m":0.1,"speed_m_s":0.9,"turns":5}}"#;

/// The next revision of an offer.
fn revised(first: &Offer, asked: &str) -> Offer {
    let trajectory = serde_json::from_str(asked).unwrap();
    let revision = first.revision + 1;
    Offer {
        revision,
        plan_hash: Offer::plan_hash_of(first.mission, revision, &trajectory),
        trajectory,
        ..first.clone()
    }
}

async fn pause(
    server: &FakeServer,
    rig: &Rig,
    mission: MissionId,
    revision: u32,
) -> Acknowledgement {
    server.send(&rig.robot, &Pause { mission, revision }).await
}

async fn resume(
    server: &FakeServer,
    rig: &Rig,
    mission: MissionId,
    revision: u32,
) -> Acknowledgement {
    server.send(&rig.robot, &Resume { mission, revision }).await
}

async fn drives(rig: &Rig, mission: MissionId, from_m: f64) -> MissionProgress {
    rig.sees("it moves", |memory| {
        memory
            .states
            .last()?
            .mission
            .filter(|now| now.id == mission && now.driven_m > from_m)
    })
    .await
}

async fn end_report(rig: &Rig, mission: MissionId) -> MissionReport {
    rig.sees("the mission ends", |memory| {
        memory
            .records
            .values()
            .find_map(|(content, _)| match content {
                RecordContent::Mission(report)
                    if report.mission == mission && report.quality.is_some() =>
                {
                    Some(report.clone())
                }
                RecordContent::Mission(_) | RecordContent::Segment(_) => None,
            })
    })
    .await
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_mission_that_is_taken_on_hold_stands_at_its_start_until_it_is_resumed() {
    let rig = Rig::new();
    let server = rig.serve();
    let agent = rig.agent();
    rig.ready(agent.boot()).await;
    let first = Offer {
        on_hold: true,
        ..offer(1, LONG)
    };
    let mission = first.mission;
    let reply = server.offer(&rig.robot, &first).await;
    assert_eq!(code(reply.into_result()), None);
    rig.sees("it says that it is paused", |memory| {
        let paused = memory.phases(mission).contains(&MissionPhase::Paused);
        paused.then_some(())
    })
    .await;
    let stood_m = agent.state().mission.unwrap().driven_m;
    assert!(stood_m < 0.05, "it drove {stood_m} m");
    // The same offer again takes nothing back.
    assert_eq!(
        resume(&server, &rig, mission, 1).await,
        Acknowledgement::Done
    );
    server.offer(&rig.robot, &first).await;
    drives(&rig, mission, 0.3).await;
    agent.stop().await;
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_mission_is_paused_resumed_and_replaced_and_tells_how_it_went() {
    let rig = Rig::new();
    let server = rig.serve();
    let agent = rig.agent();
    rig.ready(agent.boot()).await;
    let first = offer(1, LONG);
    let mission = first.mission;
    assert_eq!(
        code(pause(&server, &rig, mission, 1).await.into_result()),
        Some(CommandRefusalCode::Unknown)
    );
    server.offer(&rig.robot, &first).await;
    drives(&rig, mission, 0.5).await;

    assert_eq!(
        pause(&server, &rig, mission, 1).await,
        Acknowledgement::Done
    );
    rig.sees("it stands paused", |memory| {
        memory
            .phases(mission)
            .contains(&MissionPhase::Paused)
            .then_some(())
    })
    .await;
    let stood_m = agent.state().mission.unwrap().driven_m;
    assert!(agent.state().mission.unwrap().paused);
    assert_eq!(
        code(pause(&server, &rig, mission, 2).await.into_result()),
        Some(CommandRefusalCode::Conflict)
    );
    assert_eq!(
        resume(&server, &rig, mission, 1).await,
        Acknowledgement::Done
    );
    drives(&rig, mission, stood_m + 0.3).await;

    // A revision that cannot be driven is refused, and the active one goes on.
    let impossible = server.offer(&rig.robot, &revised(&first, TOO_TIGHT)).await;
    assert_eq!(
        code(impossible.into_result()),
        Some(CommandRefusalCode::Impossible)
    );
    let before_m = agent.state().mission.unwrap().driven_m;
    let progress = drives(&rig, mission, before_m + 0.3).await;
    assert_eq!((progress.revision, progress.paused), (1, false));

    let second = revised(&first, OTHER);
    let accepted = server.offer(&rig.robot, &second).await;
    assert!(
        matches!(accepted, OfferReply::Accepted { .. }),
        "{accepted:?}"
    );
    assert_eq!(server.offer(&rig.robot, &second).await, accepted);
    let stale = server.offer(&rig.robot, &first).await;
    assert_eq!(
        code(stale.into_result()),
        Some(CommandRefusalCode::Conflict)
    );

    let end = end_report(&rig, mission).await;
    assert_eq!((end.phase, end.revision), (MissionPhase::Succeeded, 2));
    assert_eq!(end.plan_hash, second.plan_hash);
    let expected = [
        MissionPhase::Started,
        MissionPhase::Paused,
        MissionPhase::Resumed,
        MissionPhase::Replaced,
        MissionPhase::Succeeded,
    ];
    assert_eq!(rig.memory.lock().unwrap().phases(mission), expected);
    let quality = end.quality.unwrap();
    assert!(
        quality.paused_s > 0.0 && quality.distance_m > 4.0,
        "{quality:?}"
    );
    assert!(quality.cross_track_rms_m <= quality.cross_track_max_m);
    let driven = end.driven.unwrap();
    assert!(driven.points.len() > 5, "{driven:?}");
    assert_eq!(
        code(resume(&server, &rig, mission, 2).await.into_result()),
        Some(CommandRefusalCode::Ended)
    );
    agent.stop().await;
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_cancellation_overtakes_a_replacement() {
    let rig = Rig::new();
    let server = rig.serve();
    let agent = rig.agent();
    rig.ready(agent.boot()).await;
    let first = offer(1, LONG);
    server.offer(&rig.robot, &first).await;
    drives(&rig, first.mission, 0.5).await;
    let second = revised(&first, OTHER);
    let cancel = Cancel {
        mission: first.mission,
        reason: "test".to_owned(),
    };
    let (_, cancelled) = tokio::join!(
        server.offer(&rig.robot, &second),
        server.send(&rig.robot, &cancel)
    );
    assert_eq!(cancelled, Acknowledgement::Done);
    let end = end_report(&rig, first.mission).await;
    assert_eq!(end.phase, MissionPhase::Cancelled);
    assert_eq!(agent.state().mission, None);
    agent.stop().await;
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_mission_that_minds_silence_ends_without_the_server_and_another_goes_on() {
    let rig = Rig::new();
    let server = rig.serve();
    let pulse = server.pulse();
    let agent = rig.agent();
    rig.ready(agent.boot()).await;
    let minds = Offer {
        link_policy: LinkPolicy::StopAfter { silence_s: 1.0 },
        ..offer(1, LONG)
    };
    let impossible = Offer {
        link_policy: LinkPolicy::StopAfter { silence_s: 0.0 },
        ..offer(9, LONG)
    };
    let refused = server.offer(&rig.robot, &impossible).await;
    assert_eq!(
        code(refused.into_result()),
        Some(CommandRefusalCode::Impossible)
    );
    server.offer(&rig.robot, &minds).await;
    drives(&rig, minds.mission, 1.5).await;
    pulse.abort();
    let end = end_report(&rig, minds.mission).await;
    assert_eq!(end.phase, MissionPhase::Failed);
    assert!(end.reason.unwrap().contains("silent"));

    let goes_on = offer(2, LONG);
    server.offer(&rig.robot, &goes_on).await;
    server.stop().await;
    tokio::time::sleep(Duration::from_secs(3)).await;
    let progress = agent.state().mission.unwrap();
    assert!(progress.id == goes_on.mission && progress.driven_m > 0.5);
    agent.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_robot_whose_clock_is_wrong_by_years_starts_in_time_and_names_its_clock() {
    let rig = Rig::new();
    let server = rig.serve();
    let mut config = rig.config();
    config.drive.simulated_mut().unwrap().battery_charge_ratio = 0.1;
    let ahead = jiff::SignedDuration::from_hours(-24 * 365 * 20);
    let clock = Arc::new(SystemClock::new().ahead_by(ahead));
    let agent = Agent::start_with_clock(config, clock).unwrap();
    rig.ready(agent.boot()).await;
    // The latest start is a time from now, so the wrong clock does not matter to it.
    let short = Offer {
        start_within_ms: Some(2_000),
        ..offer(1, OTHER)
    };
    server.offer(&rig.robot, &short).await;
    let end = end_report(&rig, short.mission).await;
    assert_eq!(end.phase, MissionPhase::Succeeded);
    {
        let memory = rig.memory.lock().unwrap();
        let sent_at = memory.batch_times.last().unwrap().unwrap();
        let age = sent_at.duration_since(end.at);
        assert!(!age.is_negative() && age.as_secs() < 30, "{age}");
        assert!(
            memory.hellos[0].robot_time
                < jiff::Timestamp::UNIX_EPOCH + Duration::from_hours(24 * 365 * 40)
        );
        let state = memory.states.last().unwrap();
        let codes: Vec<_> = state
            .alerts
            .iter()
            .map(|alert| alert.code.as_str())
            .collect();
        assert_eq!(codes, ["battery-low"]);
        assert!(state.battery.unwrap().charge_ratio < 0.1);
        assert!(memory.hellos[0].capabilities.pause && memory.hellos[0].capabilities.replace);
    }
    agent.stop().await;
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_excitation_and_a_slower_approach_are_planned_as_asked() {
    let rig = Rig::new();
    let server = rig.serve();
    let agent = rig.agent();
    rig.ready(agent.boot()).await;
    let asked = |options: &str| LONG.replace(r#""turns":5"#, &format!(r#""turns":5{options}"#));
    let mut durations_s = Vec::new();
    for (number, options) in [
        (1, String::new()),
        (2, r#","options":{"excitation":{}}"#.to_owned()),
        (3, r#","options":{"approach_speed_m_s":0.1}"#.to_owned()),
    ] {
        let offer = offer(number, &asked(&options));
        let OfferReply::Accepted { plan: Some(plan) } = server.offer(&rig.robot, &offer).await
        else {
            panic!("offer {number} was not taken");
        };
        durations_s.push(plan.duration_s);
        let cancel = Cancel {
            mission: offer.mission,
            reason: "the next one".to_owned(),
        };
        let reply = server.send(&rig.robot, &cancel).await;
        assert_eq!(reply, Acknowledgement::Done);
        rig.sees("it is cancelled", |memory| {
            let phases = memory.phases(offer.mission);
            phases.contains(&MissionPhase::Cancelled).then_some(())
        })
        .await;
    }
    assert!(durations_s[1] > 1.05 * durations_s[0], "{durations_s:?}");
    assert!(durations_s[2] > 1.02 * durations_s[0], "{durations_s:?}");
    agent.stop().await;
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_agent_that_is_stopped_says_that_it_leaves_with_its_last_state() {
    let rig = Rig::new();
    let server = rig.serve();
    let agent = rig.agent();
    rig.ready(agent.boot()).await;
    rig.sees("it publishes", |memory| {
        (memory.states.len() > 3).then_some(())
    })
    .await;
    agent.stop().await;
    let last = rig
        .sees("its last state", |memory| {
            let last = memory.states.last().cloned();
            last.filter(|_| !memory.gone.is_empty())
        })
        .await;
    assert!(last.leaving, "{last:?}");
    let leaving = {
        let said = rig.memory.lock().unwrap();
        said.states.iter().filter(|state| state.leaving).count()
    };
    assert_eq!(leaving, 1, "it says so once, at the end");
    server.stop().await;
}
