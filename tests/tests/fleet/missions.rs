//! Robots drive what was asked for, and measure the ground while they do.

use tread_api::friction::{StoredSegment, TerrainFriction};
use tread_api::ids::RobotId;
use tread_api::mission::{Actor, MissionDetail, MissionState};
use tread_api::trajectory::PlannedPath;
use tread_tests::fleet::{Fleet, GROUND, GROUND_THETA, SITE};
use tread_tests::wait::{DRIVE, SHORT, eventually};

use crate::{arc, bend, fleet};

fn states_of(detail: &MissionDetail) -> Vec<MissionState> {
    let mut states: Vec<_> = detail.events.iter().map(|event| event.to).collect();
    states.dedup();
    states
}

/// Farthest that the path shown may be longer or shorter than the one planned on the robot, metres.
const LENGTH_TOLERANCE_M: f64 = 0.001;

/// The path that the server shows is as long as the robot's own, and everything that the robot
/// drove is as near to it as the robot says.
async fn assert_the_path_shown_was_driven(fleet: &Fleet, ended: &MissionDetail) {
    let id = ended.mission.id;
    let path: PlannedPath = fleet.rest.get(&format!("/v1/missions/{id}/path")).await;
    let plan = ended.mission.plan.expect("the robot reported its plan");
    let steps = u32::try_from(path.points.len() - 1).expect("at most a thousand");
    let length_m = path.step_m * f64::from(steps);
    assert!(
        (length_m - plan.length_m).abs() < LENGTH_TOLERANCE_M,
        "{length_m} m are shown of {plan:?}"
    );
    let driven = ended.driven.as_ref().expect("the robot reported its path");
    let quality = ended.quality.as_ref().expect("and how well it drove it");
    assert!(plan.begin.is_some(), "and from where it planned");
    let near_m = quality.cross_track_max_m + driven.tolerance_m + path.step_m;
    for point in &driven.points {
        let distances = path.points.iter().map(|shown| shown.distance_m(*point));
        let off_m = distances.fold(f64::INFINITY, f64::min);
        assert!(off_m < near_m, "{point:?} is {off_m} m off, not {near_m} m");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_circle_and_waypoints_reach_their_ends_and_the_ground_is_measured() {
    let mut fleet = fleet().await;
    let robot: RobotId = "rover-1".parse().unwrap();
    fleet.start_agent(&robot, 0.0).await;
    // Both at once: the second waits in the robot's queue.
    let circle = fleet.rest.send(&robot, arc(0.0, 1.0)).await;
    let path = fleet.rest.send(&robot, bend(0.0)).await;
    for mission in [circle, path] {
        let ended = fleet
            .rest
            .mission_reaches(mission, &[MissionState::Succeeded], DRIVE)
            .await;
        let expected = [
            MissionState::Queued,
            MissionState::Offered,
            MissionState::Active,
            MissionState::Succeeded,
        ];
        assert_eq!(states_of(&ended), expected, "{ended:#?}");
        let plan = ended.mission.plan.expect("the robot reported its plan");
        let progress = ended
            .mission
            .progress
            .expect("the robot reported its progress");
        assert!(plan.length_m > 2.0, "{plan:?}");
        assert!(progress.driven_m > 0.95 * progress.length_m, "{progress:?}");
        assert_eq!(
            ended.events.last().map(|event| event.actor),
            Some(Actor::Robot)
        );
        assert_the_path_shown_was_driven(&fleet, &ended).await;
    }

    // The last segment of a mission may still be on its way when the mission
    // has ended, and may arrive between the two requests.
    let friction = format!("/v1/sites/{SITE}/friction/terrains/{GROUND}");
    let (terrain, segments) = eventually(
        "the ground is measured, from every segment that is stored",
        SHORT,
        || async {
            let terrain: TerrainFriction = fleet.rest.get(&friction).await;
            let segments: Vec<StoredSegment> =
                fleet.rest.all(&format!("/v1/sites/{SITE}/segments")).await;
            (terrain, segments)
        },
        |(terrain, segments)| {
            terrain.models.iter().any(|model| {
                let fused = model.friction.as_ref();
                fused.is_some_and(|fused| fused.segments == segments.len() as u64)
            })
        },
    )
    .await;
    let fused = terrain.models[0].friction.expect("it was just seen");
    assert!(
        (fused.theta - GROUND_THETA).abs() < 0.25 * GROUND_THETA,
        "θ {} measured on ground of θ {GROUND_THETA}",
        fused.theta
    );
    assert!(segments.iter().all(|segment| segment.robot == robot));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn two_robots_drive_at_once() {
    let mut fleet = fleet().await;
    let robots: [RobotId; 2] = ["rover-1".parse().unwrap(), "rover-2".parse().unwrap()];
    for (robot, x_m) in robots.iter().zip([0.0, 10.0]) {
        fleet.start_agent(robot, x_m).await;
    }
    let first = fleet.rest.send(&robots[0], arc(0.0, 0.7)).await;
    let second = fleet.rest.send(&robots[1], arc(10.0, 0.7)).await;
    let both_active = eventually(
        "both missions are active at once",
        SHORT,
        || async {
            let (first, second) = (
                fleet.rest.mission(first).await,
                fleet.rest.mission(second).await,
            );
            (first.mission.state, second.mission.state)
        },
        |states| *states == (MissionState::Active, MissionState::Active),
    );
    both_active.await;
    for mission in [first, second] {
        fleet
            .rest
            .mission_reaches(mission, &[MissionState::Succeeded], DRIVE)
            .await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_cancelled_mission_ends_and_the_next_one_starts() {
    let mut fleet = fleet().await;
    let robot: RobotId = "rover-1".parse().unwrap();
    fleet.start_agent(&robot, 0.0).await;
    let long = fleet.rest.send(&robot, arc(0.0, 20.0)).await;
    let waiting = fleet.rest.send(&robot, arc(0.0, 20.0)).await;
    let next = fleet.rest.send(&robot, bend(0.0)).await;
    fleet
        .rest
        .mission_reaches(long, &[MissionState::Active], SHORT)
        .await;
    for mission in [waiting, long] {
        let cancel = format!("/v1/missions/{mission}/cancel");
        fleet.rest.post(&cancel, &serde_json::Value::Null).await;
        fleet
            .rest
            .mission_reaches(mission, &[MissionState::Cancelled], SHORT)
            .await;
    }
    fleet
        .rest
        .mission_reaches(next, &[MissionState::Succeeded], DRIVE)
        .await;
}
