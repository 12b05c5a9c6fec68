//! Robots join, show certificates, renew them while they drive, and are put out.

use std::path::Path;

use tread_api::ids::RobotId;
use tread_api::mission::MissionState;
use tread_api::robot::LinkState;
use tread_tests::fleet::Fleet;
use tread_tests::wait::{DRIVE, SHORT, eventually};

use crate::{arc, bend};

/// Short enough that a robot renews within a test.
const CERTIFICATE_S: u32 = 9;

async fn secure_fleet(certificate_s: u32) -> Fleet {
    Fleet::start_secure_with(Path::new(env!("CARGO_BIN_EXE_node")), certificate_s).await
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_robot_joins_drives_a_circle_renews_on_the_way_and_is_put_out() {
    let mut fleet = secure_fleet(CERTIFICATE_S).await;
    let robot: RobotId = "rover-1".parse().unwrap();
    fleet.join(&robot).await;
    fleet.start_agent(&robot, 0.0).await;
    let circle = fleet.rest.send(&robot, arc(0.0, 1.0)).await;
    let driven = fleet
        .rest
        .mission_reaches(circle, &[MissionState::Succeeded], DRIVE)
        .await;
    let renewed = fleet.counter("certificates_renewed").await;
    assert!(renewed >= 2, "renewed {renewed} times in {driven:#?}");
    let states: Vec<_> = driven.events.iter().map(|event| event.to).collect();
    assert!(!states.contains(&MissionState::Failed), "{driven:#?}");

    fleet.revoke(&robot).await;
    let seen = || fleet.rest.robot(&robot);
    eventually("it is offline, and people are told", SHORT, seen, |seen| {
        seen.as_ref().is_some_and(|seen| {
            let told = seen
                .alerts
                .iter()
                .any(|alert| alert.code.as_str() == "revoked-robot");
            seen.link == LinkState::Offline && told
        })
    })
    .await;

    // It comes back by a token that names it, and by nothing else.
    let any = fleet.join_token(None).await;
    let (ended, said) = fleet.enroll(&robot, &any).await;
    assert!(!ended.success() && said.contains("401"), "{said}");
    fleet.stop_agent(&robot).await.unwrap();
    fleet.join(&robot).await;
    fleet.start_agent(&robot, 0.0).await;
    let look = || fleet.rest.robot(&robot);
    eventually("the alert is over", SHORT, look, |seen| {
        seen.as_ref().is_some_and(|seen| seen.alerts.is_empty())
    })
    .await;
    let next = fleet.rest.send(&robot, bend(0.0)).await;
    fleet
        .rest
        .mission_reaches(next, &[MissionState::Succeeded], DRIVE)
        .await;
}
