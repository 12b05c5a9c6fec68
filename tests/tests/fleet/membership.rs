//! Robots join, show certificates, renew them while they drive, and are put out.

use std::path::Path;
use std::time::Duration;

use serde_json::{Value, json};
use tread_agent::membership::Membership;
use tread_api::enrolment::{AuthorityRotation, FleetAuthority};
use tread_api::identity::AuditEntry;
use tread_api::ids::RobotId;
use tread_api::mission::MissionState;
use tread_api::problem::ProblemType;
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
    eventually(
        "it is offline, and an alert is raised",
        SHORT,
        seen,
        |seen| {
            seen.as_ref().is_some_and(|seen| {
                let is_raised = seen
                    .alerts
                    .iter()
                    .any(|alert| alert.code.as_str() == "revoked-robot");
                seen.link == LinkState::Offline && is_raised
            })
        },
    )
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

/// Long enough that no robot renews by the time of its certificate within a test.
const LONG_CERTIFICATE_S: u32 = 86_400;
const ROTATION: &str = "/v1/authority/rotation";
const FINISH: &str = "/v1/authority/rotation/finish";
const REPLACE: &str = "/v1/authority/replace";

/// How many authorities a robot trusts, as its file says.
fn trusted_by(fleet: &Fleet, robot: &RobotId) -> usize {
    let joined = Membership::load(&fleet.robot_folder(robot)).expect("the file reads");
    let joined = joined.expect("the robot has joined");
    joined.authority.matches("BEGIN CERTIFICATE").count()
}

/// What finishes the rotation that is under way.
async fn finish_of_rotation(fleet: &Fleet) -> Value {
    let authority: FleetAuthority = fleet.rest.get("/v1/authority").await;
    let rotation = authority.rotation.expect("a rotation is under way");
    json!({"rotation": rotation.id})
}

/// Waits until these robots must join again, and no others.
async fn must_join(fleet: &Fleet, expected: &[&RobotId]) {
    let look = || fleet.rest.get::<FleetAuthority>("/v1/authority");
    let what = format!("{expected:?} must join again");
    eventually(&what, SHORT, look, |seen| {
        seen.to_join
            .iter()
            .map(|robot| &robot.robot)
            .eq(expected.iter().copied())
            && seen.robots_to_join as usize == expected.len()
    })
    .await;
}

/// Waits until these robots are left of a rotation, and no others.
async fn robots_left_are(fleet: &Fleet, expected: &[&RobotId]) {
    let look = || fleet.rest.get::<FleetAuthority>("/v1/authority");
    let names = |rotation: &AuthorityRotation| {
        let left = rotation.left.iter().map(|left| left.robot.clone());
        left.collect::<Vec<_>>()
    };
    let expected: Vec<RobotId> = expected.iter().map(|&robot| robot.clone()).collect();
    let what = format!("{expected:?} are left");
    eventually(&what, SHORT, look, |seen| {
        seen.rotation.as_ref().map(names) == Some(expected.clone())
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_authority_is_rotated_under_a_robot_that_drives_and_one_that_comes_back_in_time() {
    let mut fleet = secure_fleet(LONG_CERTIFICATE_S).await;
    let [driving, away] = ["rover-1", "rover-2"].map(|name| name.parse::<RobotId>().unwrap());
    for (robot, x_m) in [(&away, 20.0), (&driving, 0.0)] {
        fleet.join(robot).await;
        fleet.start_agent(robot, x_m).await;
    }
    fleet.kill_agent(&away);
    let circle = fleet.rest.send(&driving, arc(0.0, 2.0)).await;
    let active = [MissionState::Active];
    fleet.rest.mission_reaches(circle, &active, SHORT).await;
    let refused = ProblemType::AuthorityRotation;
    let nothing = json!({"rotation": "0011223344556677"});
    fleet.rest.post_refused(FINISH, &nothing, refused).await;
    let before: FleetAuthority = fleet.rest.get("/v1/authority").await;
    assert_eq!(before.rotation, None);

    fleet.rest.post(ROTATION, &json!({})).await;
    let finish = finish_of_rotation(&fleet).await;
    let other = ProblemType::AuthorityRotation;
    let refused = fleet.rest.post_refused(FINISH, &nothing, other).await;
    let detail = refused["detail"].as_str().unwrap();
    assert!(
        detail.contains("`0011223344556677` is not the one that is under way"),
        "{detail}"
    );
    let refused = ProblemType::AuthorityRotation;
    fleet.rest.post_refused(ROTATION, &json!({}), refused).await;
    robots_left_are(&fleet, &[&away]).await;
    assert_eq!(trusted_by(&fleet, &driving), 2);
    assert_eq!(trusted_by(&fleet, &away), 1);

    // As a power cut would, in the middle of it.
    fleet.kill_server();
    fleet.start_server().await;
    robots_left_are(&fleet, &[&away]).await;
    let during: FleetAuthority = fleet.rest.get("/v1/authority").await;
    assert_ne!(during.signing, before.signing);
    assert_eq!(during.rotation.unwrap().retiring, before.signing);
    let refused = fleet
        .rest
        .post_refused(FINISH, &finish, ProblemType::RobotsLeft)
        .await;
    assert!(
        refused["detail"].as_str().unwrap().contains("rover-2"),
        "{refused}"
    );

    // It is brought over as soon as it is back, whenever it is cut off meanwhile.
    fleet.spawn_agent(&away, 20.0);
    let log = || async { fleet.log(away.as_str()) };
    eventually("it begins to renew", SHORT, log, |log| {
        log.contains("the server trusts other authorities")
    })
    .await;
    fleet.kill_agent(&away);
    fleet.start_agent(&away, 20.0).await;
    robots_left_are(&fleet, &[]).await;
    fleet.rest.post(FINISH, &finish).await;
    let after: FleetAuthority = fleet.rest.get("/v1/authority").await;
    assert_eq!((&after.signing, &after.rotation), (&during.signing, &None));
    let audit = || fleet.rest.all::<AuditEntry>("/v1/audit");
    eventually("both are in the audit log", SHORT, audit, |audit| {
        let is_there = |path| audit.iter().any(|entry| entry.path == path);
        is_there(ROTATION) && is_there(FINISH)
    })
    .await;
    let trusted = || async { [&driving, &away].map(|robot| trusted_by(&fleet, robot)) };
    eventually("nobody trusts the former", SHORT, trusted, |trusted| {
        *trusted == [1, 1]
    })
    .await;

    fleet.kill_server();
    fleet.start_server().await;
    for robot in [&driving, &away] {
        fleet.robot_is_online(robot).await;
    }
    let driven = fleet
        .rest
        .mission_reaches(circle, &[MissionState::Succeeded], DRIVE)
        .await;
    let states: Vec<_> = driven.events.iter().map(|event| event.to).collect();
    assert!(!states.contains(&MissionState::Failed), "{driven:#?}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_robot_that_comes_back_after_its_authority_was_retired_raises_an_alert_and_joins_again() {
    let mut fleet = secure_fleet(LONG_CERTIFICATE_S).await;
    let [there, late] = ["rover-1", "rover-2"].map(|name| name.parse::<RobotId>().unwrap());
    for (robot, x_m) in [(&late, 20.0), (&there, 0.0)] {
        fleet.join(robot).await;
        fleet.start_agent(robot, x_m).await;
    }
    fleet.kill_agent(&late);
    fleet.rest.post(ROTATION, &json!({})).await;
    robots_left_are(&fleet, &[&late]).await;
    let mut finish = finish_of_rotation(&fleet).await;
    finish["force"] = json!(true);
    fleet.rest.post(FINISH, &finish).await;
    must_join(&fleet, &[&late]).await;

    fleet.spawn_agent(&late, 20.0);
    let look = || fleet.rest.robot(&late);
    let is_notified = |robot: &tread_api::robot::Robot| {
        let mut alerts = robot.alerts.iter();
        alerts.any(|alert| alert.code.as_str() == "retired-authority")
    };
    eventually("an alert is raised", SHORT, look, |seen| {
        seen.as_ref()
            .is_some_and(|seen| is_notified(seen) && seen.link == LinkState::Offline)
    })
    .await;
    let log = || async { fleet.log(late.as_str()) };
    eventually("the robot says what to do", SHORT, log, |log| {
        log.contains("Join again, by `tread-agent enroll`")
    })
    .await;
    assert!(fleet.counter("gate_untrusted").await > 0);
    assert!(fleet.counter("renewals_retired").await > 0);
    fleet.robot_is_online(&there).await;

    fleet.stop_agent(&late).await.unwrap();
    fleet.join(&late).await;
    fleet.start_agent(&late, 20.0).await;
    let look = || fleet.rest.robot(&late);
    eventually("the alert is over", SHORT, look, |seen| {
        seen.as_ref().is_some_and(|seen| !is_notified(seen))
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn after_a_replacement_no_robot_of_before_gets_in_until_it_has_joined_again() {
    let mut fleet = secure_fleet(LONG_CERTIFICATE_S).await;
    let [first, second] = ["rover-1", "rover-2"].map(|name| name.parse::<RobotId>().unwrap());
    for (robot, x_m) in [(&first, 0.0), (&second, 20.0)] {
        fleet.join(robot).await;
        fleet.start_agent(robot, x_m).await;
    }
    let before: FleetAuthority = fleet.rest.get("/v1/authority").await;
    let replace = json!({"signing": before.signing});
    fleet.rest.post(REPLACE, &replace).await;
    for robot in [&first, &second] {
        let look = || fleet.rest.robot(robot);
        eventually(
            "its link is cut, and an alert is raised",
            SHORT,
            look,
            |seen| {
                seen.as_ref().is_some_and(|seen| {
                    let mut alerts = seen.alerts.iter();
                    let is_notified =
                        alerts.any(|alert| alert.code.as_str() == "retired-authority");
                    is_notified && seen.link == LinkState::Offline
                })
            },
        )
        .await;
    }
    must_join(&fleet, &[&first, &second]).await;
    let after: FleetAuthority = fleet.rest.get("/v1/authority").await;
    assert_ne!(after.signing, before.signing);
    assert!(after.rotation.is_none() && after.on_disk);
    assert!(fleet.counter("gate_untrusted").await > 0);
    assert!(fleet.counter("renewals_retired").await > 0);
    // Whoever has looked at the same does not replace the next one too.
    let refused = ProblemType::AuthorityRotation;
    fleet.rest.post_refused(REPLACE, &replace, refused).await;

    // As a power cut would.
    fleet.kill_server();
    fleet.start_server().await;
    fleet.stop_agent(&first).await.unwrap();
    fleet.join(&first).await;
    fleet.start_agent(&first, 0.0).await;
    must_join(&fleet, &[&second]).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_link_that_fails_on_the_robot_itself_is_tried_again_until_it_can_be_made() {
    let mut fleet = secure_fleet(LONG_CERTIFICATE_S).await;
    let robot: RobotId = "rover-1".parse().unwrap();
    fleet.join(&robot).await;
    let folder = fleet.robot_folder(&robot);
    let mut joined = Membership::load(&folder).unwrap().unwrap();
    // No link can be made with this; the renewal, which mends it, is due in a few seconds.
    "-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n"
        .clone_into(&mut joined.authority);
    let until_due = Duration::from_secs(u64::from(LONG_CERTIFICATE_S) * 2 / 3 - 4);
    joined.issued_at -= until_due;
    joined.save(&folder).unwrap();
    fleet.spawn_agent(&robot, 0.0);
    let log = || async { fleet.log(robot.as_str()) };
    eventually("the link is tried again", SHORT, log, |log| {
        log.matches("the fleet link failed; it is tried again")
            .count()
            >= 2
    })
    .await;
    fleet.robot_is_online(&robot).await;
}

/// Waits until a stop is in force on these robots.
async fn robots_are_stopped(fleet: &Fleet, robots: &[RobotId]) {
    for robot in robots {
        let seen = || fleet.rest.robot(robot);
        eventually("the robot is stopped", SHORT, seen, |seen| {
            let live = seen.as_ref().and_then(|seen| seen.live.as_ref());
            live.is_some_and(|live| live.safety.stop.is_some())
        })
        .await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn robots_of_several_routers_drive_come_back_after_a_restart_of_the_server_and_are_stopped() {
    let node = Path::new(env!("CARGO_BIN_EXE_node"));
    let config = "[robots]\nauthority = \"authority\"\nrobots_per_router = 2\n";
    let mut fleet = Fleet::start_in_environment(node, config, &[]).await;
    let robots: Vec<RobotId> = (1..=5)
        .map(|number| format!("rover-{number}").parse().unwrap())
        .collect();
    for (robot, x_m) in robots.iter().zip([0.0, 20.0, 40.0, 60.0, 80.0]) {
        fleet.join(robot).await;
        fleet.start_agent(robot, x_m).await;
    }
    let mut missions = Vec::new();
    for (robot, x_m) in robots.iter().zip([0.0, 20.0, 40.0, 60.0, 80.0]) {
        missions.push(fleet.rest.send(robot, bend(x_m)).await);
    }
    for mission in missions {
        let reached = [MissionState::Succeeded];
        fleet.rest.mission_reaches(mission, &reached, DRIVE).await;
    }

    fleet.kill_server();
    fleet.start_server().await;
    for robot in &robots {
        fleet.robot_is_online(robot).await;
    }
    fleet
        .rest
        .post("/v1/stop", &json!({"site": fleet.site()}))
        .await;
    robots_are_stopped(&fleet, &robots).await;
}
