//! Stops over the death of an agent, fences, and teleoperation, with real servers and agents.

use std::time::Duration;

use futures_util::{SinkExt as _, StreamExt as _};
use reqwest::Method;
use serde_json::{Value, json};
use tokio_tungstenite::connect_async;
use tokio_tungstenite::tungstenite::{ClientRequestBuilder, Message};
use tread_api::drive::{Drive, DriveRequest, DriveUpdate, DriverName};
use tread_api::ids::RobotId;
use tread_api::mission::MissionState;
use tread_api::problem::ProblemType;
use tread_api::robot::{RobotLive, RobotMode};
use tread_api::stop::Stop;
use tread_tests::fleet::{Fleet, SITE};
use tread_tests::wait::{SHORT, eventually};

use crate::{arc, fleet};

fn robot() -> RobotId {
    "rover-1".parse().expect("it is an identifier")
}

async fn live(fleet: &Fleet, what: &str, is: impl Fn(&RobotLive) -> bool) -> RobotLive {
    let look = || async { fleet.rest.robot(&robot()).await?.live };
    let found = eventually(what, SHORT, look, |live| live.as_ref().is_some_and(&is)).await;
    found.expect("it was just seen")
}

fn speed_m_s(live: &RobotLive) -> f64 {
    live.twist.map_or(0.0, |twist| twist.value.linear_m_s)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stop_outlives_its_agent_and_its_clear_starts_nothing() {
    let mut fleet = fleet().await;
    fleet.start_agent(&robot(), 0.0).await;
    let driven = fleet.rest.send(&robot(), arc(0.0, 20.0)).await;
    let waiting = fleet.rest.send(&robot(), arc(0.0, 1.0)).await;
    live(&fleet, "it drives", |live| speed_m_s(live) > 0.3).await;
    let path = format!("/v1/sites/{SITE}/robots/{}/stop", robot());
    let stop = fleet.rest.post(&path, &json!({"by": "Ann"})).await;
    let stop: Stop = serde_json::from_value(stop).unwrap();
    assert!(stop.confirmed_at.is_some(), "{stop:?}");
    let before = live(&fleet, "it stands", |live| speed_m_s(live).abs() < 0.02).await;
    fleet
        .rest
        .mission_reaches(driven, &[MissionState::Paused], SHORT)
        .await;
    // A power cut of the robot does not clear it.
    fleet.kill_agent(&robot());
    fleet.start_agent(&robot(), 0.0).await;
    let back = live(&fleet, "it is stopped still", |live| {
        live.boot != before.boot && live.mode == RobotMode::Stopped
    })
    .await;
    assert_eq!(back.safety.stop.map(|latch| latch.id), Some(stop.id));
    let clear = format!("{path}/clear");
    let body = json!({"stop": stop.id, "by": "Bob"});
    fleet.rest.post(&clear, &body).await;
    let idle = live(&fleet, "it is idle", |live| live.mode == RobotMode::Idle).await;
    // The queue would have begun within a moment.
    tokio::time::sleep(Duration::from_secs(1)).await;
    let later = fleet.rest.robot(&robot()).await.unwrap().live.unwrap();
    assert_eq!(
        (later.mode, later.mission),
        (RobotMode::Idle, None),
        "{idle:?}"
    );
    let detail = fleet.rest.mission(waiting).await;
    assert_eq!(detail.mission.state, MissionState::Queued);
    assert!(detail.mission.pause_requested);
    let resume = format!("/v1/missions/{waiting}/resume");
    fleet.rest.post(&resume, &Value::Null).await;
    fleet
        .rest
        .mission_reaches(waiting, &[MissionState::Active], SHORT)
        .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_robot_is_teleoperated_within_its_fence_and_stands_when_its_driver_is_gone() {
    let mut fleet = fleet().await;
    fleet.start_agent(&robot(), 0.0).await;
    // The robot looks along x, at a fence 2.5 m ahead.
    let corner = |x_m: f64, y_m: f64| json!({"x_m": x_m, "y_m": y_m});
    let yard = [
        corner(-5.0, -5.0),
        corner(2.5, -5.0),
        corner(2.5, 5.0),
        corner(-5.0, 5.0),
    ];
    let fence = json!({"keep_in": [yard]});
    let path = format!("/v1/sites/{SITE}/geofence");
    let (status, answer) = fleet
        .rest
        .call(Method::PUT, &path, Some(&fence))
        .await
        .unwrap();
    assert!(status.is_success(), "{answer}");
    live(&fleet, "it knows the fence", |live| {
        live.safety.fence_revision == Some(1)
    })
    .await;
    let beyond = json!({"site": SITE, "robot": robot(), "trajectory": arc(2.0, 1.0)});
    let refused = fleet
        .rest
        .post_refused("/v1/missions", &beyond, ProblemType::CrossesGeofence)
        .await;
    assert!(
        refused["place"]["point"]["x_m"].as_f64().unwrap() > 1.5,
        "{refused}"
    );

    let address = fleet.http_address();
    let url = format!("ws://{address}/v1/sites/{SITE}/robots/{}/drive", robot());
    let request = ClientRequestBuilder::new(url.parse().unwrap())
        .with_header("authorization", format!("Bearer {}", fleet.token()));
    let (mut socket, _) = connect_async(request).await.unwrap();
    let say = |request: &DriveRequest| Message::text(serde_json::to_string(request).unwrap());
    let driver = DriverName {
        name: "Ann".to_owned(),
    };
    socket
        .send(say(&DriveRequest::Acquire(driver)))
        .await
        .unwrap();
    let drive = DriveRequest::Drive(Drive {
        linear_m_s: 0.6,
        angular_rad_s: 0.0,
        for_ms: Some(300),
    });
    let (mut fastest_m_s, mut farthest_m, mut mode) = (0.0_f64, 0.0_f64, None);
    let mut ticks = tokio::time::interval(Duration::from_millis(50));
    for _ in 0..200 {
        ticks.tick().await;
        socket.send(say(&drive)).await.unwrap();
        while let Ok(Some(Ok(frame))) =
            tokio::time::timeout(Duration::from_millis(1), socket.next()).await
        {
            if let Message::Text(text) = frame
                && let DriveUpdate::View(view) = serde_json::from_str(&text).unwrap()
            {
                mode = view.mode;
                let speed_m_s = view.twist.map_or(0.0, |twist| twist.value.linear_m_s);
                fastest_m_s = fastest_m_s.max(speed_m_s);
                farthest_m = farthest_m.max(view.pose.map_or(0.0, |pose| pose.value.x_m));
            }
        }
    }
    assert_eq!(mode, Some(RobotMode::Teleoperated));
    assert!(fastest_m_s > 0.3, "it hardly moved: {fastest_m_s} m/s");
    assert!(
        (1.0..2.5).contains(&farthest_m),
        "it went to x = {farthest_m} m"
    );
    // Back, and the driver's program dies on the way.
    let back = DriveRequest::Drive(Drive {
        linear_m_s: -0.5,
        angular_rad_s: 0.0,
        for_ms: Some(500),
    });
    for _ in 0..20 {
        ticks.tick().await;
        socket.send(say(&back)).await.unwrap();
    }
    live(&fleet, "it drives back", |live| speed_m_s(live) < -0.2).await;
    drop(socket);
    live(&fleet, "it stands, and nobody drives", |live| {
        speed_m_s(live).abs() < 0.02 && live.safety.lease.is_none() && live.mode == RobotMode::Idle
    })
    .await;
}
