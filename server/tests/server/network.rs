//! Messages that are not what they should be are refused with a reason and a counter.

use jiff::SignedDuration;
use tread_api::ids::RobotId;
use tread_api::keys;
use tread_api::wire;
use tread_api::wire::ingest::{BATCH_RECORDS_MAX, Batch, Receipt};
use tread_api::wire::state::{PULSE_PERIOD_MS, ServerPulse};
use tread_api::wire::{RefusalCode, hello::Welcome};
use zenoh::Wait as _;

use crate::harness::{PATIENCE, Yard, ask, eventually, measured, segment, site};
use crate::robot::{Robot, session};

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn lies_and_garbage_are_refused_with_a_reason_and_counted() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let key = || keys::ingest(&site(), &robot.id);
    let refused = async |key: String, payload: Vec<u8>| {
        let refusal = robot
            .ask::<Receipt>(key, payload)
            .await
            .unwrap_err()
            .unwrap();
        (refusal.code, refusal.detail)
    };
    let (code, _) = refused(key(), b"\xff{".to_vec()).await;
    assert_eq!(code, RefusalCode::Malformed);
    let (code, detail) = refused(key(), br#"{"v":7,"body":{}}"#.to_vec()).await;
    assert_eq!(code, RefusalCode::Version, "{detail}");
    let other: RobotId = "rover-2".parse().unwrap();
    let batch = Batch {
        robot: other.clone(),
        boot: robot.boot,
        robot_time: None,
        records: Vec::new(),
    };
    let (code, detail) = refused(key(), wire::encode(&batch).unwrap()).await;
    assert_eq!(code, RefusalCode::Impersonation);
    assert!(
        detail.contains("rover-1") && detail.contains("rover-2"),
        "{detail}"
    );
    let (code, _) = refused(keys::ingest(&site(), &other), wire::encode(&batch).unwrap()).await;
    assert_eq!(code, RefusalCode::Busy, "a robot says hello first");
    let long = Batch {
        robot: robot.id.clone(),
        boot: robot.boot,
        robot_time: None,
        records: (0..=BATCH_RECORDS_MAX as u64)
            .map(|seq| measured(seq, segment((0, 0), 0.2, 0)))
            .collect(),
    };
    let (code, _) = refused(key(), wire::encode(&long).unwrap()).await;
    assert_eq!(code, RefusalCode::Malformed);
    let counters = yard.counters().await;
    assert_eq!(counters.refused_malformed, 1);
    assert_eq!(counters.refused_version, 1);
    assert_eq!(counters.refused_impersonation, 1);
    assert_eq!(counters.segments_committed, 0);
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_state_that_lies_does_not_show_and_the_server_goes_on() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let stranger = session(&yard).await;
    let publish = async |key: String, payload: &'static [u8]| {
        let stranger = stranger.clone();
        tokio::task::spawn_blocking(move || stranger.put(key, payload).wait().unwrap())
            .await
            .unwrap();
    };
    publish(keys::state(&site(), &robot.id), b"[1,2").await;
    publish(keys::state(&site(), &robot.id), br#"{"v":9,"body":{}}"#).await;
    publish("tread/yard/robots/Not-One/state".to_owned(), b"{}").await;
    eventually("all three are counted", async || {
        let counters = yard.counters().await;
        let refused = (
            counters.refused_malformed,
            counters.refused_version,
            counters.refused_key,
        );
        if refused == (1, 1, 1) {
            Ok(())
        } else {
            Err(refused)
        }
    })
    .await;
    robot
        .upload(vec![measured(0, segment((0, 0), 0.2, 0))])
        .await
        .unwrap();
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_hello_to_an_unknown_site_or_of_an_impossible_robot_is_refused() {
    let yard = Yard::start().await;
    let stranger = session(&yard).await;
    let robot: RobotId = "rover-1".parse().unwrap();
    let mut hello = tread_api::wire::hello::Hello {
        robot: robot.clone(),
        boot: tread_api::ids::BootId::from_uuid(uuid::Uuid::from_u128(1)),
        agent_version: "0".to_owned(),
        model: crate::harness::model(),
        robot_time: crate::harness::time("2026-11-01T00:00:00Z"),
        capabilities: tread_api::robot::Capabilities::default(),
    };
    let nowhere = "nowhere".parse().unwrap();
    let key = keys::hello(&nowhere, &robot);
    let answer = ask::<Welcome>(&stranger, key, wire::encode(&hello).unwrap()).await;
    assert_eq!(answer.unwrap_err().unwrap().code, RefusalCode::UnknownSite);
    hello.model.mass_kg = -1.0;
    let key = keys::hello(&site(), &robot);
    let answer = ask::<Welcome>(&stranger, key, wire::encode(&hello).unwrap()).await;
    let refusal = answer.unwrap_err().unwrap();
    assert_eq!(refusal.code, RefusalCode::Malformed);
    assert!(refusal.detail.contains("mass_kg"), "{refusal:?}");
    let (status, _) = yard.get_value("/v1/sites/yard/robots/rover-1").await;
    assert_eq!(status, 404);
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_servers_pulse_beats_on_every_site_and_tells_its_time() {
    let yard = Yard::start().await;
    let session = session(&yard).await;
    let (beat, mut beats) = tokio::sync::mpsc::channel(64);
    session
        .declare_subscriber(keys::pulse(&site()))
        .callback(move |sample| {
            let pulse: ServerPulse = wire::decode(&sample.payload().to_bytes()).unwrap();
            let _ = beat.try_send(pulse.server_time);
        })
        .background()
        .wait()
        .unwrap();
    let mut times = Vec::new();
    for _ in 0..8 {
        let next = tokio::time::timeout(PATIENCE, beats.recv()).await;
        times.push(next.unwrap().unwrap());
    }
    let clock = yard.server.app().clock();
    let off = clock.now().duration_since(times[7]);
    assert!(off.abs() < SignedDuration::from_secs(2), "{off:#}");
    let span_ms = times[7].duration_since(times[0]).as_millis();
    let expected_ms = 7 * i128::from(PULSE_PERIOD_MS);
    // A busy machine may make it late, never early by a whole beat.
    assert!(
        span_ms > expected_ms - i128::from(PULSE_PERIOD_MS),
        "{span_ms}"
    );
    session.close().wait().unwrap();
    yard.server.stop().await.unwrap();
}
