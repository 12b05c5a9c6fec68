//! Missions on both robots.

use std::time::Duration;

use anyhow::Context;
use serde_json::{Value, json};
use tokio::time::Instant;
use tread_api::friction::TerrainFriction;
use tread_api::ids::RobotId;
use tread_api::mission::{MissionQuality, MissionState};
use tread_tests::fleet::{Fleet, GROUND, GROUND_THETA, SITE};
use tread_tests::wait::{SHORT, eventually};

use crate::judgement::Judgement;
use crate::observer::Observer;
use crate::python_robot::{Configuration, PythonRobot};
use tread_tests::report::{Check, quantile};

/// Longest that a mission may take.
const MISSION_MAX: Duration = Duration::from_mins(2);
/// Time between two looks at a mission.
const POLL_INTERVAL: Duration = Duration::from_millis(100);
/// Cross-track of the ROS 2 robot over that of the simulated one, at most.
const CROSS_TRACK_RATIO_MAX: f64 = 1.2;
/// Error of θ as a share of it, at most.
const THETA_ERROR_MAX: f64 = 0.1;
/// Longest delay from a sensor's message to its command, the 99th of 100, milliseconds.
const DELAY_P99_MS: f64 = 5.0;

/// Starts the agent of the ROS 2 robot.
pub(crate) async fn start_robot(fleet: &mut Fleet, base: &PythonRobot) -> anyhow::Result<RobotId> {
    let robot: RobotId = "rover-ros".parse()?;
    let folder = fleet.robot_folder(&robot);
    std::fs::create_dir_all(&folder)?;
    let file = folder.join("robot.toml");
    std::fs::write(&file, base.configuration(&Configuration::PLAIN))?;
    let flag = format!("--config={}", file.display());
    fleet.agents_get(&[&flag]);
    fleet.start_agent(&robot, 0.0).await;
    fleet.agents_get(&[]);
    Ok(robot)
}

fn circle() -> Value {
    json!({"circle": {
        "center": {"x_m": 0.0, "y_m": 1.5}, "radius_m": 1.5, "speed_m_s": 0.6, "turns": 2.0
    }})
}

fn waypoints() -> Value {
    let points = [
        (0.0, 0.0),
        (2.0, 0.6),
        (3.0, 2.0),
        (1.5, 3.2),
        (-0.5, 2.4),
        (0.0, 0.5),
    ];
    let points = points.map(|(x, y)| json!({"x_m": x, "y_m": y}));
    json!({"waypoints": {"speed_m_s": 0.6, "points": points}})
}

/// Drives one mission; how well.
async fn drive(
    fleet: &Fleet,
    robot: &RobotId,
    trajectory: Value,
) -> anyhow::Result<MissionQuality> {
    let mission = fleet.rest.send(robot, trajectory).await;
    let until = Instant::now() + MISSION_MAX;
    let ended = loop {
        let seen = fleet.rest.mission(mission).await;
        if seen.mission.state.is_terminal() || Instant::now() > until {
            break seen;
        }
        tokio::time::sleep(POLL_INTERVAL).await;
    };
    anyhow::ensure!(
        ended.mission.state == MissionState::Succeeded,
        "{robot}: {:#?} {:#?}",
        ended.events,
        fleet.rest.robot(robot).await
    );
    ended.quality.context("the robot says how well it drove")
}

/// Drives circle and waypoints on the ROS 2 robot, and on the simulated one where they are compared.
pub(crate) async fn measure(
    fleet: &mut Fleet,
    robot: &RobotId,
    observer: &Observer,
    judgement: Judgement,
) -> Vec<Check> {
    let mut checks = Vec::new();
    observer.take_delays_ms();
    let ours = match missions(fleet, robot).await {
        Ok(qualities) => qualities,
        Err(cause) => {
            eprintln!("{cause:#}");
            return vec![Check::so("missions: circle and waypoints succeed", false)];
        }
    };
    let mut delays_ms = observer.take_delays_ms();
    let theta = theta_of_fleet(fleet).await;
    match judgement {
        Judgement::Figures => match compared(fleet, &ours).await {
            Ok(ratios) => checks.extend(ratios),
            Err(cause) => {
                eprintln!("{cause:#}");
                return vec![Check::so("missions: the simulated robot succeeds", false)];
            }
        },
        Judgement::Behaviour => {
            checks.push(Check::so("missions: circle and waypoints succeed", true));
            let rms = |quality: &MissionQuality| 1.0e3 * quality.cross_track_rms_m;
            let [circle, waypoints] = [rms(&ours[0]), rms(&ours[1])];
            checks.push(Check::shown("missions: circle, RMS, mm", circle));
            checks.push(Check::shown("missions: waypoints, RMS, mm", waypoints));
        }
    }
    let error = (theta - GROUND_THETA).abs() / GROUND_THETA;
    checks.push(
        Check::of(
            format!("missions: θ {theta:.3} of the fleet, true {GROUND_THETA}, error"),
            error,
        )
        .at_most(THETA_ERROR_MAX),
    );
    let p50_ms = quantile(&mut delays_ms, 0.5);
    let times = delays_ms.len();
    let p99 = Check::of(
        format!("bus: sensor to command, {times} times, p50 {p50_ms:.2} ms, p99, ms"),
        quantile(&mut delays_ms, 0.99),
    );
    checks.push(judgement.at_most(p99, DELAY_P99_MS));
    checks
}

/// How far from the path beside the simulated robot.
async fn compared(fleet: &mut Fleet, ours: &[MissionQuality; 2]) -> anyhow::Result<[Check; 2]> {
    let simulated: RobotId = "rover-sim".parse()?;
    fleet.start_agent(&simulated, 0.0).await;
    let theirs = missions(fleet, &simulated).await?;
    fleet.kill_agent(&simulated);
    let ratio = |name: &str, index: usize| {
        let (own, other): (&MissionQuality, &MissionQuality) = (&ours[index], &theirs[index]);
        let (own_mm, other_mm) = (
            1.0e3 * own.cross_track_rms_m,
            1.0e3 * other.cross_track_rms_m,
        );
        let name =
            format!("missions: {name}, RMS {own_mm:.1} mm, simulated {other_mm:.1} mm, ratio");
        Check::of(name, own_mm / other_mm).at_most(CROSS_TRACK_RATIO_MAX)
    };
    Ok([ratio("circle", 0), ratio("waypoints", 1)])
}

async fn missions(fleet: &Fleet, robot: &RobotId) -> anyhow::Result<[MissionQuality; 2]> {
    let circle = drive(fleet, robot, circle()).await?;
    Ok([circle, drive(fleet, robot, waypoints()).await?])
}

/// θ of the ground as the fleet has it from this robot alone; infinite where it has none.
async fn theta_of_fleet(fleet: &Fleet) -> f64 {
    let path = format!("/v1/sites/{SITE}/friction/terrains/{GROUND}");
    let measured = eventually(
        "the fleet knows the ground",
        SHORT,
        || fleet.rest.get::<TerrainFriction>(&path),
        |terrain| terrain.models.iter().any(|model| model.friction.is_some()),
    )
    .await;
    let friction = measured.models.iter().find_map(|model| model.friction);
    friction.map_or(f64::INFINITY, |friction| friction.theta)
}
