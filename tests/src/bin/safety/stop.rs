//! From the REST call of a stop until every robot has confirmed.
//!
//! In the field every robot has a disk of its own. Here they would all wait for one: a hundred
//! latches at once, each made safe. So their folders are in memory where that is possible: what
//! one disk takes comes on top.

use anyhow::Context;
use reqwest::Method;
use serde_json::{Value, json};
use tokio::time::Instant;
use tread_agent::RunningAgent;
use tread_api::ids::{MissionId, RobotId};
use tread_api::robot::RobotMode;
use tread_api::stop::{FleetStop, Stop};
use tread_tests::fleet::{Fleet, SITE};
use tread_tests::report::{Check, figure, quantile};
use tread_tests::wait::{DRIVE, SHORT, eventually};

use crate::Arguments;
use crate::robots::{APART_M, name, start};

/// From the call to a target of zero, 99 % of them, at the most.
const STOP_MAX_MS: f64 = 50.0;
/// From the call until all of a fleet have confirmed, at the most.
const FLEET_MAX_MS: f64 = 200.0;
/// Agents that are started at a time.
const AT_ONCE: u32 = 10;

pub(crate) async fn measure(arguments: &Arguments, fleet: &Fleet) -> anyhow::Result<Vec<Check>> {
    let in_memory = tempfile::tempdir_in("/dev/shm");
    let folder = in_memory.or_else(|_none| tempfile::tempdir())?;
    let mut agents = Vec::new();
    for first in (0..arguments.robots).step_by(AT_ONCE as usize) {
        let numbers = first..arguments.robots.min(first + AT_ONCE);
        for number in numbers.clone() {
            agents.push(start(number, &fleet.zenoh_endpoint(), folder.path())?);
        }
        for number in numbers {
            fleet.robot_is_online(&name(number)?).await;
        }
    }
    let mut missions = Vec::new();
    for number in 0..arguments.robots {
        let center = json!({"x_m": APART_M * f64::from(number), "y_m": 2.0});
        let circle = json!({"circle": {"center": center, "radius_m": 2.0, "speed_m_s": 0.5,
                                       "turns": 900.0}});
        missions.push(fleet.rest.send(&name(number)?, circle).await);
    }
    let (mut single_ms, mut fleet_ms) = (Vec::new(), Vec::new());
    let (mut unconfirmed, mut not_zero) = (0, 0);
    let mut moving = 0;
    for _ in 0..arguments.rounds {
        all_drive(fleet, &agents, &missions).await;
        for (number, agent) in (0..).zip(&agents) {
            moving += u64::from(is_moving(agent));
            let path = format!("/v1/sites/{SITE}/robots/{}/stop", name(number)?);
            let called_at = Instant::now();
            let stop: Stop = serde_json::from_value(fleet.rest.post(&path, &json!({})).await)?;
            single_ms.push(called_at.elapsed().as_secs_f64() * 1e3);
            unconfirmed += u64::from(stop.confirmed_at.is_none());
            not_zero += u64::from(agent.state().mode != RobotMode::Stopped);
        }
        go_on(fleet, &agents, &missions).await?;
        all_drive(fleet, &agents, &missions).await;
        let called_at = Instant::now();
        let answer = fleet.rest.post("/v1/stop", &json!({"site": SITE})).await;
        fleet_ms.push(called_at.elapsed().as_secs_f64() * 1e3);
        let stopped: FleetStop = serde_json::from_value(answer)?;
        unconfirmed += stopped.unconfirmed as u64;
        let runs_on = |agent: &&RunningAgent| agent.state().mode != RobotMode::Stopped;
        not_zero += agents.iter().filter(runs_on).count() as u64;
        go_on(fleet, &agents, &missions).await?;
    }
    for agent in agents {
        agent.stop().await;
    }
    let p50_ms = quantile(&mut single_ms, 0.5);
    let p99_ms = quantile(&mut single_ms, 0.99);
    Ok(vec![
        Check::of("stop: robots", f64::from(arguments.robots)).at_least(1.0),
        Check::of("stop: robots that moved", figure(moving)).at_least(1.0),
        Check::of("stop: call to confirmed, p50, ms", p50_ms).at_most(STOP_MAX_MS),
        Check::of("stop: call to confirmed, p99, ms", p99_ms).at_most(STOP_MAX_MS),
        Check::of(
            "stop: whole fleet confirmed, worst, ms",
            quantile(&mut fleet_ms, 1.0),
        )
        .at_most(FLEET_MAX_MS),
        Check::of("stop: not confirmed in 300 ms", figure(unconfirmed)).at_most(0.0),
        Check::of("stop: confirmed and not stopped", figure(not_zero)).at_most(0.0),
    ])
}

fn is_moving(agent: &RunningAgent) -> bool {
    let twist = agent.state().twist;
    twist.is_some_and(|twist| twist.value.linear_m_s > 0.1)
}

/// Waits until all drive; names the robots that do not, with what they and the server say.
async fn all_drive(fleet: &Fleet, agents: &[RunningAgent], missions: &[MissionId]) {
    let look = || async {
        let mut standing = Vec::new();
        for (agent, mission) in agents.iter().zip(missions) {
            if !is_moving(agent) {
                let state = agent.state();
                let robot = (state.robot, state.mode, state.fault, state.mission);
                let sent = fleet.rest.mission(*mission).await;
                standing.push((robot, state.safety.gate.cause, sent));
            }
        }
        standing
    };
    eventually("all robots drive", DRIVE, look, Vec::is_empty).await;
}

/// Clears every stop and lets every mission go on.
async fn go_on(
    fleet: &Fleet,
    agents: &[RunningAgent],
    missions: &[MissionId],
) -> anyhow::Result<()> {
    for (number, (agent, mission)) in (0..).zip(agents.iter().zip(missions)) {
        let robot = name(number)?;
        clear(fleet, agent, &robot).await?;
        let path = format!("/v1/missions/{mission}/resume");
        let look = || fleet.rest.call(Method::POST, &path, Some(&Value::Null));
        eventually("the mission may go on", SHORT, look, |answer| {
            answer
                .as_ref()
                .is_some_and(|(status, _)| status.is_success())
        })
        .await;
    }
    Ok(())
}

async fn clear(fleet: &Fleet, agent: &RunningAgent, robot: &RobotId) -> anyhow::Result<()> {
    let latch = agent.state().safety.stop;
    let latch = latch.context("a stopped robot shows its stop")?;
    let path = format!("/v1/sites/{SITE}/robots/{robot}/stop/clear");
    let body = json!({"stop": latch.id, "by": "safety"});
    // It is refused while the robot still brakes.
    let look = || fleet.rest.call(Method::POST, &path, Some(&body));
    eventually("the stop is cleared", SHORT, look, |answer| {
        answer
            .as_ref()
            .is_some_and(|(status, _)| status.is_success())
    })
    .await;
    Ok(())
}
