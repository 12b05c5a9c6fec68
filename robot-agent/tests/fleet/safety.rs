//! Stops, leases, drive commands and limits over real zenoh.

use std::time::Duration;

use jiff::Timestamp;
use tread_api::geometry::{Point, Polygon, Twist};
use tread_api::ids::{BootId, StopId};
use tread_api::keys;
use tread_api::robot::{PauseCause, RobotMode};
use tread_api::safety::{Driver, FENCE_POLYGONS_MAX, GateCause, Geofence};
use tread_api::wire;
use tread_api::wire::ingest::MissionPhase;
use tread_api::wire::reply::{Acknowledgement, CommandRefusal, CommandRefusalCode};
use tread_api::wire::safety::{
    AcquireLease, ClearStop, DriveCommand, ExternalLimit, ReleaseLease, Stop,
};
use tread_api::wire::state::RobotState;
use uuid::Uuid;

use crate::code;
use crate::rig::Rig;
use crate::support::{FakeServer, offer, site_of};

const LONG: &str = r#"{"waypoints":{"speed_m_s":0.8,
    "points":[{"x_m":4,"y_m":3},{"x_m":8,"y_m":3.2},{"x_m":11,"y_m":4.5},{"x_m":11,"y_m":9}]}}"#;

fn stop_id(number: u128) -> StopId {
    StopId::from_uuid(Uuid::from_u128(number))
}

async fn stop(server: &FakeServer, rig: &Rig, number: u128) -> Acknowledgement {
    let stop = Stop {
        stop: stop_id(number),
        by: "an operator".to_owned(),
        reason: "a person on the way".to_owned(),
        at: Timestamp::UNIX_EPOCH,
    };
    server.send(&rig.robot, &stop).await
}

async fn clear(server: &FakeServer, rig: &Rig, number: u128) -> Acknowledgement {
    let clear = ClearStop {
        stop: stop_id(number),
        by: "an operator".to_owned(),
    };
    server.send(&rig.robot, &clear).await
}

fn driver(number: u128) -> Driver {
    Driver {
        client: Uuid::from_u128(number),
        name: format!("driver {number}"),
    }
}

async fn acquire(
    server: &FakeServer,
    rig: &Rig,
    request: u128,
    who: u128,
) -> Result<u64, CommandRefusal> {
    let command = AcquireLease {
        request: Uuid::from_u128(request),
        holder: driver(who),
        take: false,
    };
    server.send(&rig.robot, &command).await.into_result()
}

fn release(request: u128, who: u128) -> ReleaseLease {
    ReleaseLease {
        request: Uuid::from_u128(request),
        holder: driver(who),
    }
}

async fn state_of(
    rig: &Rig,
    boot: BootId,
    what: &str,
    is_so: impl Fn(&RobotState) -> bool,
) -> RobotState {
    rig.sees(what, |memory| {
        let last = memory.states.iter().rev().find(|state| state.boot == boot);
        last.filter(|state| is_so(state)).cloned()
    })
    .await
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stop_is_confirmed_survives_a_restart_and_is_cleared_only_by_its_newest_name() {
    let rig = Rig::new();
    let server = rig.serve();
    let agent = rig.agent();
    rig.ready(agent.boot()).await;
    let offered = offer(1, LONG);
    server.offer(&rig.robot, &offered).await;
    state_of(&rig, agent.boot(), "it drives", |state| {
        state.mission.is_some_and(|mission| mission.driven_m > 0.3)
    })
    .await;
    assert_eq!(stop(&server, &rig, 1).await, Acknowledgement::Done);
    assert_eq!(agent.state().mode, RobotMode::Stopped);
    assert_eq!(
        stop(&server, &rig, 1).await,
        Acknowledgement::Done,
        "doubled"
    );
    let moving = clear(&server, &rig, 1).await;
    assert_eq!(code(moving.into_result()), Some(CommandRefusalCode::Moving));
    assert_eq!(stop(&server, &rig, 2).await, Acknowledgement::Done);
    let stopped = state_of(&rig, agent.boot(), "the mission is paused", |state| {
        state.mission.is_some_and(|mission| mission.paused)
            && state
                .twist
                .is_some_and(|twist| twist.value.linear_m_s.abs() < 0.02)
    })
    .await;
    assert_eq!(stopped.mission.unwrap().paused_by, Some(PauseCause::Stop));
    assert_eq!(stopped.safety.stop.as_ref().unwrap().id, stop_id(2));
    assert!(stopped.monotonic_us.is_some());
    let older = clear(&server, &rig, 1).await;
    assert_eq!(
        code(older.into_result()),
        Some(CommandRefusalCode::Conflict)
    );
    rig.sees("the pause is reported", |memory| {
        let phases = memory.phases(offered.mission);
        phases.contains(&MissionPhase::Paused).then_some(())
    })
    .await;
    let other = server.offer(&rig.robot, &offer(2, LONG)).await;
    assert_eq!(code(other.into_result()), Some(CommandRefusalCode::Busy));
    agent.stop().await;

    let agent = rig.agent();
    assert_eq!(agent.state().safety.stop.unwrap().id, stop_id(2));
    rig.ready(agent.boot()).await;
    let refused = server.offer(&rig.robot, &offer(3, LONG)).await;
    assert_eq!(
        code(refused.into_result()),
        Some(CommandRefusalCode::NotReady)
    );
    assert_eq!(clear(&server, &rig, 2).await, Acknowledgement::Done);
    assert_eq!(
        clear(&server, &rig, 2).await,
        Acknowledgement::Done,
        "doubled"
    );
    for number in [1, 2] {
        let late = stop(&server, &rig, number).await;
        assert_eq!(code(late.into_result()), Some(CommandRefusalCode::Ended));
    }
    assert_eq!(
        agent.state().safety.stop,
        None,
        "a late double stops nobody"
    );
    let unknown = clear(&server, &rig, 9).await;
    assert_eq!(
        code(unknown.into_result()),
        Some(CommandRefusalCode::Unknown)
    );
    agent.stop().await;
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_agent_that_cannot_read_its_latch_starts_stopped() {
    let rig = Rig::new();
    std::fs::write(rig.folder.path().join("stop.json"), b"garbage").unwrap();
    let agent = rig.agent();
    assert!(agent.state().safety.stop.is_some());
    agent.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_agent_that_ran_before_and_misses_its_latch_starts_stopped() {
    let rig = Rig::new();
    for start in 0..2 {
        let agent = rig.agent();
        assert_eq!(agent.state().safety.stop, None, "start {start}");
        agent.stop().await;
    }
    std::fs::remove_file(rig.folder.path().join("stop.json")).unwrap();
    let agent = rig.agent();
    let stop = agent.state().safety.stop.expect("stopped");
    assert!(stop.reason.contains("missing"), "{stop:?}");
    agent.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_robot_is_teleoperated_by_one_driver_and_stops_with_its_silence() {
    let rig = Rig::new();
    let server = rig.serve();
    let agent = rig.agent();
    rig.ready(agent.boot()).await;
    let epoch = acquire(&server, &rig, 1, 1).await.unwrap();
    let refused = acquire(&server, &rig, 2, 2).await;
    assert_eq!(code(refused), Some(CommandRefusalCode::Leased));
    let site = "yard".parse().unwrap();
    let key = keys::teleop(&site, &rig.robot);
    let mut fastest_m_s: f64 = 0.0;
    for seq in 1..=30 {
        let now_us = agent.state().monotonic_us.unwrap();
        let command = DriveCommand {
            boot: agent.boot(),
            epoch,
            seq,
            sent_us: now_us,
            until_us: now_us + 300_000,
            twist: Twist {
                linear_m_s: 0.5,
                angular_rad_s: 0.0,
            },
        };
        server.publish(&key, wire::encode(&command).unwrap()).await;
        tokio::time::sleep(Duration::from_millis(50)).await;
        let speed = agent
            .state()
            .twist
            .map_or(0.0, |twist| twist.value.linear_m_s);
        fastest_m_s = fastest_m_s.max(speed);
    }
    assert!(fastest_m_s > 0.3, "{fastest_m_s}");
    let state = agent.state();
    assert_eq!(state.mode, RobotMode::Teleoperated);
    assert_eq!(state.safety.lease.unwrap().driver.name, "driver 1");
    assert!(state.safety.drive.unwrap().counts.accepted >= 25);
    server.publish(&key, b"nonsense".to_vec()).await;
    state_of(&rig, agent.boot(), "it stands", |state| {
        let stands = state
            .twist
            .is_some_and(|twist| twist.value.linear_m_s.abs() < 0.02);
        stands && state.safety.drive.unwrap().counts.malformed == 1
    })
    .await;
    let released = server.send(&rig.robot, &release(3, 1)).await;
    assert_eq!(released, Acknowledgement::Done);
    assert_eq!(agent.state().safety.lease, None);
    agent.stop().await;
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_program_outside_holds_the_robot_and_a_required_one_by_its_silence() {
    let rig = Rig::new();
    let server = rig.serve();
    let mut config = rig.config();
    config.required_owners = vec!["lidar".parse().unwrap()];
    let agent = tread_agent::Agent::start(config).unwrap();
    rig.ready(agent.boot()).await;
    let status = agent.state().safety;
    assert!(status.limits[0].required && status.limits[0].hold);
    let limit = |seq: u64, for_us: u64| ExternalLimit {
        owner: "lidar".parse().unwrap(),
        boot: agent.boot(),
        until_us: agent.state().monotonic_us.unwrap() + for_us,
        seq,
        hold: false,
        linear_max_m_s: Some(0.3),
    };
    let site = "yard".parse().unwrap();
    let key = keys::limit(&site, &rig.robot, &"lidar".parse().unwrap());
    server
        .publish(&key, wire::encode(&limit(1, 60_000_000)).unwrap())
        .await;
    let free = state_of(&rig, agent.boot(), "the limit is known", |state| {
        state.safety.limits.first().is_some_and(|limit| !limit.hold)
    })
    .await;
    assert_eq!(free.safety.limits[0].linear_max_m_s, Some(0.3));
    server.offer(&rig.robot, &offer(1, LONG)).await;
    state_of(&rig, agent.boot(), "it drives", |state| {
        state.mission.is_some_and(|mission| mission.driven_m > 0.3)
    })
    .await;
    assert!(agent.state().twist.unwrap().value.linear_m_s < 0.4);
    let mut hold = limit(2, 60_000_000);
    hold.hold = true;
    assert_eq!(server.send(&rig.robot, &hold).await, Acknowledgement::Done);
    state_of(&rig, agent.boot(), "it stands", |state| {
        state
            .twist
            .is_some_and(|twist| twist.value.linear_m_s.abs() < 0.02)
    })
    .await;
    let mut foreign = limit(3, 60_000_000);
    foreign.boot = BootId::from_uuid(Uuid::from_u128(3));
    let refused = server.send(&rig.robot, &foreign).await;
    assert_eq!(
        code(refused.into_result()),
        Some(CommandRefusalCode::Conflict)
    );
    assert_eq!(agent.state().safety.limits_refused, 1);
    agent.stop().await;
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_mission_that_would_leave_the_fence_is_refused_with_the_place() {
    let rig = Rig::new();
    let server = rig.serve();
    let agent = rig.agent();
    rig.ready(agent.boot()).await;
    let corners = [(2.0, 1.0), (9.0, 1.0), (9.0, 6.0), (2.0, 6.0)];
    let corners = corners.map(|(x_m, y_m)| Point { x_m, y_m });
    let mut site = site_of(&rig.scenario);
    site.geofence = Geofence {
        revision: 3,
        keep_in: vec![Polygon::new(corners.to_vec()).unwrap()],
        keep_out: Vec::new(),
    };
    assert_eq!(server.send(&rig.robot, &site).await, Acknowledgement::Done);
    state_of(&rig, agent.boot(), "it knows the fence", |state| {
        state.safety.fence_revision == Some(3)
    })
    .await;
    let refused = server.offer(&rig.robot, &offer(1, LONG)).await;
    let refusal = refused.into_result().unwrap_err();
    assert_eq!(refusal.code, CommandRefusalCode::Impossible);
    assert!(refusal.detail.contains("geofence at (8."), "{refusal:?}");
    site.geofence.keep_out = vec![site.geofence.keep_in[0].clone(); 64];
    let too_large = server.send(&rig.robot, &site).await;
    assert_eq!(
        code(too_large.into_result()),
        Some(CommandRefusalCode::Impossible)
    );
    agent.stop().await;
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_required_program_that_falls_silent_holds_the_robot_until_it_is_heard_again() {
    let rig = Rig::new();
    let server = rig.serve();
    let mut config = rig.config();
    config.required_owners = vec!["lidar".parse().unwrap()];
    let agent = tread_agent::Agent::start(config).unwrap();
    rig.ready(agent.boot()).await;
    let site = "yard".parse().unwrap();
    let key = keys::limit(&site, &rig.robot, &"lidar".parse().unwrap());
    let speak = async |seq: u64, for_us: u64| {
        let limit = ExternalLimit {
            owner: "lidar".parse().unwrap(),
            boot: agent.boot(),
            until_us: agent.state().monotonic_us.unwrap() + for_us,
            seq,
            hold: false,
            linear_max_m_s: None,
        };
        server.publish(&key, wire::encode(&limit).unwrap()).await;
    };
    speak(1, 60_000_000).await;
    state_of(&rig, agent.boot(), "it is heard", |state| {
        state.safety.limits.first().is_some_and(|limit| !limit.hold)
    })
    .await;
    server.offer(&rig.robot, &offer(1, LONG)).await;
    state_of(&rig, agent.boot(), "it drives", |state| {
        state.mission.is_some_and(|mission| mission.driven_m > 0.3)
    })
    .await;
    // Its last word ends in a moment, and nothing follows.
    speak(2, 200_000).await;
    let held = state_of(&rig, agent.boot(), "it stands for the silence", |state| {
        let stands = state
            .twist
            .is_some_and(|twist| twist.value.linear_m_s.abs() < 0.02);
        stands && state.safety.gate.cause == Some(GateCause::ExternalHold)
    })
    .await;
    assert!(held.safety.limits[0].required && held.safety.limits[0].hold);
    let driven_m = held.mission.unwrap().driven_m;
    speak(3, 60_000_000).await;
    state_of(&rig, agent.boot(), "it goes on", |state| {
        state
            .mission
            .is_some_and(|mission| mission.driven_m > driven_m + 0.3)
    })
    .await;
    agent.stop().await;
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_welcome_with_a_geofence_too_large_for_a_tick_leaves_the_robot_standing() {
    let rig = Rig::new();
    let corners = [(0.0, 0.0), (9.0, 0.0), (9.0, 9.0), (0.0, 9.0)];
    let corners = corners.map(|(x_m, y_m)| Point { x_m, y_m });
    let around = Polygon::new(corners.to_vec()).unwrap();
    let mut site = site_of(&rig.scenario);
    site.geofence = Geofence {
        revision: 3,
        keep_in: vec![around; FENCE_POLYGONS_MAX + 1],
        keep_out: Vec::new(),
    };
    let server = FakeServer::start_with_site(rig.port, &rig.scenario, &rig.memory, site.clone());
    let agent = rig.agent();
    rig.ready(agent.boot()).await;
    let refused = server.offer(&rig.robot, &offer(1, LONG)).await;
    assert_eq!(
        code(refused.into_result()),
        Some(CommandRefusalCode::Impossible)
    );
    let epoch = acquire(&server, &rig, 1, 1).await.unwrap();
    let key = keys::teleop(&"yard".parse().unwrap(), &rig.robot);
    for seq in 1..=20 {
        let now_us = agent.state().monotonic_us.unwrap();
        let command = DriveCommand {
            boot: agent.boot(),
            epoch,
            seq,
            sent_us: now_us,
            until_us: now_us + 300_000,
            twist: Twist {
                linear_m_s: 0.5,
                angular_rad_s: 0.0,
            },
        };
        server.publish(&key, wire::encode(&command).unwrap()).await;
        tokio::time::sleep(Duration::from_millis(50)).await;
        let twist = agent.state().twist.unwrap().value;
        assert!(twist.linear_m_s.abs() < 0.02, "{twist:?}");
    }
    assert_eq!(agent.state().safety.gate.cause, Some(GateCause::Fence));
    // One that it can keep is taken at once.
    site.geofence.keep_in.truncate(1);
    site.geofence.revision = 4;
    assert_eq!(server.send(&rig.robot, &site).await, Acknowledgement::Done);
    state_of(&rig, agent.boot(), "it knows the fence", |state| {
        state.safety.fence_revision == Some(4)
    })
    .await;
    agent.stop().await;
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stop_a_clear_and_a_lease_are_published_at_once() {
    let rig = Rig::new();
    let server = rig.serve();
    let mut config = rig.config();
    // The next periodic state is far away.
    config.state_rate_hz = 0.1;
    let agent = tread_agent::Agent::start(config).unwrap();
    rig.sees("its first state", |memory| {
        memory.states.first().map(|_| ())
    })
    .await;
    let within = Duration::from_secs(5);
    let began = tokio::time::Instant::now();
    assert_eq!(stop(&server, &rig, 1).await, Acknowledgement::Done);
    state_of(&rig, agent.boot(), "the stop is shown", |state| {
        state.safety.stop.is_some() && state.mode == RobotMode::Stopped
    })
    .await;
    assert_eq!(clear(&server, &rig, 1).await, Acknowledgement::Done);
    state_of(&rig, agent.boot(), "the clear is shown", |state| {
        state.safety.stop.is_none() && state.mode == RobotMode::Idle
    })
    .await;
    acquire(&server, &rig, 1, 1).await.unwrap();
    state_of(&rig, agent.boot(), "the lease is shown", |state| {
        state.safety.lease.is_some() && state.mode == RobotMode::Teleoperated
    })
    .await;
    server.send(&rig.robot, &release(2, 1)).await;
    state_of(&rig, agent.boot(), "its end is shown", |state| {
        state.safety.lease.is_none() && state.mode == RobotMode::Idle
    })
    .await;
    assert!(began.elapsed() < within, "{:?}", began.elapsed());
    agent.stop().await;
    server.stop().await;
}
