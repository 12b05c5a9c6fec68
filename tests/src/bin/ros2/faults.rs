//! A base that is dead, late, lying or restarting, in the middle of a mission.

use std::time::Duration;

use serde_json::json;
use tokio::time::Instant;
use tread_api::ids::RobotId;
use tread_api::mission::MissionState;
use tread_api::robot::Robot;
use tread_tests::fleet::Fleet;
use tread_tests::wait::{SHORT, eventually};

use crate::observer::Observer;
use crate::python_robot::PythonRobot;
use tread_tests::report::Check;

/// Longest from the last good word of the base to a zero command.
const ZERO_MAX_MS: f64 = 150.0;
/// The same for a base whose words are good but not true.
const ZERO_OF_A_LIE_MAX_MS: f64 = 900.0;
/// How long a fault lasts.
const LASTS: Duration = Duration::from_millis(1_500);
/// Longest until the robot moves again.
const AGAIN_MAX: Duration = Duration::from_secs(10);
/// How long it must have moved before the next fault.
const MOVES_FOR: Duration = Duration::from_secs(2);

/// A fault, what the agent must say of it, and how soon the robot must be told to rest.
struct Fault {
    name: &'static str,
    value: &'static str,
    /// Part of an alert's text.
    said: &'static str,
    zero_max_ms: f64,
}

const fn fault(name: &'static str, value: &'static str, said: &'static str) -> Fault {
    Fault {
        name,
        value,
        said,
        zero_max_ms: ZERO_MAX_MS,
    }
}

const FAULTS: [Fault; 9] = [
    fault("silent", "on", "has not been heard"),
    fault("late", "0.3", "came late"),
    fault("stamp", "3600", "time stamp leapt"),
    fault("nan", "on", "impossible values"),
    fault("hash", "on", "another definition"),
    fault("bare", "on", "without attachment"),
    fault("short", "on", "not what their type says"),
    fault("restart", "1.0", "has not been heard"),
    Fault {
        name: "stuck",
        value: "on",
        said: "do not do what they are told",
        zero_max_ms: ZERO_OF_A_LIE_MAX_MS,
    },
];

/// Breaks the base in every way and mends it again.
pub(crate) async fn measure(
    fleet: &Fleet,
    robot: &RobotId,
    base: &mut PythonRobot,
    observer: &Observer,
) -> anyhow::Result<Vec<Check>> {
    let circle = json!({"circle": {
        "center": {"x_m": 0.0, "y_m": 1.5}, "radius_m": 1.5, "speed_m_s": 0.5, "turns": 40.0
    }});
    let mission = fleet.rest.send(robot, circle).await;
    let active = [MissionState::Active];
    fleet.rest.mission_reaches(mission, &active, SHORT).await;
    let mut checks = Vec::new();
    for fault in &FAULTS {
        if !moves(observer, AGAIN_MAX).await {
            checks.push(Check::so(
                format!("{}: the robot moves before it", fault.name),
                false,
            ));
            break;
        }
        tokio::time::sleep(MOVES_FOR).await;
        checks.extend(try_fault(fleet, robot, base, observer, fault).await?);
    }
    let goes_on = moves(observer, AGAIN_MAX).await;
    let detail = fleet.rest.mission(mission).await;
    let is_active = detail.mission.state == MissionState::Active;
    if !is_active {
        eprintln!("{:#?}", detail.events);
    }
    checks.push(Check::so(
        "faults: the same mission is driven on at the end",
        goes_on && is_active,
    ));
    Ok(checks)
}

async fn try_fault(
    fleet: &Fleet,
    robot: &RobotId,
    base: &mut PythonRobot,
    observer: &Observer,
    fault: &Fault,
) -> anyhow::Result<Vec<Check>> {
    let name = fault.name;
    observer.forget_commands();
    let switched_at = Instant::now();
    base.switch(name, fault.value)?;
    let path = format!("{name}: it says so");
    let is_said = eventually(
        &path,
        SHORT,
        || fleet.rest.robot(robot),
        |seen| {
            seen.as_ref().is_some_and(|seen| says(seen, fault.said))
                || switched_at.elapsed() > LASTS.mul_f64(0.9)
        },
    )
    .await
    .is_some_and(|seen| says(&seen, fault.said));
    tokio::time::sleep(LASTS.saturating_sub(switched_at.elapsed())).await;
    // The last good word: the last of all, if the base fell silent, or the one before the fault.
    let last_word = observer.sensor_at().unwrap_or(switched_at);
    let fell_silent = name == "silent" || name == "restart";
    let is_of_pause = last_word.duration_since(switched_at) < Duration::from_millis(100);
    let since = if fell_silent && is_of_pause {
        last_word
    } else {
        switched_at
    };
    let (zero_ms, last_ms) =
        observer
            .zero_after(since)
            .map_or((f64::INFINITY, 0.0), |(first, last)| {
                let ms = |span: Duration| 1.0e3 * span.as_secs_f64();
                (ms(first), last.map_or(0.0, ms))
            });
    if name != "restart" {
        base.switch(name, "off")?;
    }
    Ok(vec![
        Check::at_most(
            format!("{name}: first zero command, ms"),
            fault.zero_max_ms,
            zero_ms,
        ),
        Check::at_most(
            format!("{name}: last command that was none, ms"),
            fault.zero_max_ms,
            last_ms,
        ),
        Check::so(path, is_said),
        Check::so(
            format!("{name}: the robot moves again"),
            moves(observer, AGAIN_MAX).await,
        ),
    ])
}

/// Whether the robot says this of itself.
fn says(seen: &Robot, words: &str) -> bool {
    let fault = seen.live.as_ref().and_then(|live| live.fault.as_ref());
    fault.is_some_and(|fault| fault.contains(words))
        || seen.alerts.iter().any(|alert| alert.text.contains(words))
}

/// Waits until the robot is told to move.
async fn moves(observer: &Observer, bound: Duration) -> bool {
    let until = Instant::now() + bound;
    while Instant::now() < until {
        if observer.is_moving() {
            return true;
        }
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    false
}
