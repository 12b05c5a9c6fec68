//! A robot joins a fleet that drives.

use std::time::Duration;

use tokio::time::Instant;
use tread_api::ids::RobotId;
use tread_api::mission::MissionState;
use tread_api::robot::LinkState;
use tread_tests::fleet::Fleet;
use tread_tests::report::{Check, figure};
use tread_tests::wait::{DRIVE, SHORT};

use crate::Arguments;

/// Longest time until the server hears a robot that joins, seconds.
const JOIN_MAX_S: f64 = 5.0;
/// Time between two looks at the others.
const POLL_INTERVAL: Duration = Duration::from_millis(20);
/// What an agent logs each time that it connects.
const CONNECTED: &str = "connected to";

fn circle(x_m: f64) -> serde_json::Value {
    serde_json::json!({"circle": {
        "center": {"x_m": x_m, "y_m": 1.5}, "radius_m": 1.5, "speed_m_s": 0.5, "turns": 2.0,
    }})
}

pub(crate) async fn measure(
    arguments: &Arguments,
    fleet: &mut Fleet,
) -> anyhow::Result<Vec<Check>> {
    let mut robots: Vec<RobotId> = Vec::new();
    for number in 0..arguments.robots {
        let robot: RobotId = format!("rover-{number}").parse()?;
        fleet.join(&robot).await;
        fleet.start_agent(&robot, 10.0 * f64::from(number)).await;
        robots.push(robot);
    }
    let mut missions = Vec::new();
    for (number, robot) in (0..arguments.robots).zip(&robots) {
        missions.push(
            fleet
                .rest
                .send(robot, circle(10.0 * f64::from(number)))
                .await,
        );
    }
    for mission in &missions {
        fleet
            .rest
            .mission_reaches(*mission, &[MissionState::Active], SHORT)
            .await;
    }
    let connections = |fleet: &Fleet| -> usize {
        let times = |robot: &RobotId| fleet.log(robot.as_str()).matches(CONNECTED).count();
        robots.iter().map(times).sum()
    };
    let before = connections(fleet);
    let newcomer: RobotId = "newcomer".parse()?;
    let token = fleet.join_token(None).await;
    let began = Instant::now();
    let (status, said) = fleet.enroll(&newcomer, &token).await;
    anyhow::ensure!(status.success(), "the newcomer was not let in: {said}");
    fleet.spawn_agent(&newcomer, -10.0);
    let mut looks_away = 0;
    let joined_s = loop {
        for robot in &robots {
            let seen = fleet.rest.robot(robot).await;
            looks_away += u64::from(seen.is_none_or(|seen| seen.link != LinkState::Online));
        }
        let seen = fleet.rest.robot(&newcomer).await;
        let is_online = seen.is_some_and(|seen| seen.link == LinkState::Online);
        let took = began.elapsed();
        if is_online || took > DRIVE {
            break took.as_secs_f64();
        }
        tokio::time::sleep(POLL_INTERVAL).await;
    };
    let mut disturbed = 0;
    for mission in missions {
        let ends = [
            MissionState::Succeeded,
            MissionState::Failed,
            MissionState::Cancelled,
            MissionState::Expired,
        ];
        let ended = fleet.rest.mission_reaches(mission, &ends, 2 * DRIVE).await;
        let mut passed: Vec<_> = ended.events.iter().map(|event| event.to).collect();
        passed.dedup();
        let straight = [
            MissionState::Queued,
            MissionState::Offered,
            MissionState::Active,
            MissionState::Succeeded,
        ];
        disturbed += u64::from(passed != straight);
    }
    let again = u64::try_from(connections(fleet) - before)?;
    Ok(vec![
        Check::of("from its token to the server hearing it, s", joined_s).at_most(JOIN_MAX_S),
        Check::of("missions of others disturbed", figure(disturbed)).at_most(0.0),
        Check::of("looks at which another was not online", figure(looks_away)).at_most(0.0),
        Check::of("times that another had to connect again", figure(again)).at_most(0.0),
    ])
}
