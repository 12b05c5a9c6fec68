//! Time from a request over REST to the robot's first wheel command.

use std::time::Duration;

use anyhow::Context;
use hdrhistogram::Histogram;
use serde::Serialize;
use serde_json::json;
use tokio::task::JoinSet;
use tokio::time::MissedTickBehavior;
use tread_api::ids::RobotId;
use tread_api::mission::MissionState;
use tread_api::robot::{RobotLive, RobotMode};
use tread_tests::fleet::Fleet;
use tread_tests::light_robot::now;
use tread_tests::wait::{SHORT, eventually};

use crate::{Arguments, period_of, start_light_robots};

/// What the dispatch measurement found.
#[derive(Debug, Serialize)]
pub(crate) struct Dispatch {
    pub(crate) missions: u64,
    pub(crate) p50_ms: f64,
    pub(crate) p99_ms: f64,
    pub(crate) max_ms: f64,
}

pub(crate) async fn measure(arguments: &Arguments, fleet: &mut Fleet) -> anyhow::Result<Dispatch> {
    let background = publish_states(arguments, fleet).await?;
    let mut latencies_us = Histogram::<u64>::new(3)?;
    let mut agents = Vec::new();
    for number in 0..arguments.agents {
        let robot: RobotId = format!("driver-{number}").parse()?;
        if arguments.tls {
            fleet.join(&robot).await;
        }
        fleet.start_agent(&robot, f64::from(number) * 20.0).await;
        agents.push(robot);
    }
    for robot in &agents {
        for _ in 0..arguments.missions {
            let latency = one_mission(fleet, robot).await?;
            latencies_us.record(u64::try_from(latency.as_micros())?)?;
        }
    }
    drop(background);
    #[expect(clippy::cast_precision_loss, reason = "microseconds far below 2^53")]
    let quantile_ms = |quantile: f64| latencies_us.value_at_quantile(quantile) as f64 / 1e3;
    Ok(Dispatch {
        missions: latencies_us.len(),
        p50_ms: quantile_ms(0.5),
        p99_ms: quantile_ms(0.99),
        max_ms: quantile_ms(1.0),
    })
}

/// Sends a circle, waits until the robot drives it, and cancels it.
async fn one_mission(fleet: &Fleet, robot: &RobotId) -> anyhow::Result<Duration> {
    let (look, since) = (|| fleet.rest.robot(robot), now());
    // What it said before may be from before the last mission, from which it still brakes.
    let seen = eventually("the robot is idle", SHORT, look, |seen| {
        let live = seen.as_ref().and_then(|robot| robot.live.as_ref());
        let idle = |live: &RobotLive| live.mode == RobotMode::Idle && live.pose.is_some();
        live.is_some_and(|live| live.robot_time > since && idle(live))
    })
    .await;
    let pose = seen.and_then(|robot| robot.live?.pose);
    let pose = pose.context("an idle robot says where it is")?.value;
    // A circle that the robot stands on and points along, so that it starts without turning.
    let radius_m = 2.0;
    let circle = json!({"circle": {
        "center": {
            "x_m": pose.x_m - radius_m * pose.heading_rad.sin(),
            "y_m": pose.y_m + radius_m * pose.heading_rad.cos(),
        },
        "radius_m": radius_m, "speed_m_s": 0.5,
    }});
    let asked_at = now();
    let mission = fleet.rest.send(robot, circle).await;
    let look = || fleet.rest.mission(mission);
    eventually("the robot has started", SHORT, look, |seen| {
        seen.mission.started_at.is_some()
    })
    .await;
    let cancel = format!("/v1/missions/{mission}/cancel");
    fleet.rest.post(&cancel, &serde_json::Value::Null).await;
    let ended = fleet
        .rest
        .mission_reaches(mission, &[MissionState::Cancelled], SHORT)
        .await;
    // Robot and generator share this machine's clock, so their times may be subtracted.
    let started_at = ended
        .mission
        .started_at
        .context("an active mission has started")?;
    Duration::try_from(started_at.duration_since(asked_at)).context("it started before it was sent")
}

/// Light robots that publish their states until the result is dropped.
async fn publish_states(arguments: &Arguments, fleet: &Fleet) -> anyhow::Result<JoinSet<()>> {
    let period = period_of(arguments.state_rate_hz);
    let mut publishing = JoinSet::new();
    for mut robot in start_light_robots(fleet, arguments.robots, arguments.tls).await? {
        publishing.spawn(async move {
            let mut states = tokio::time::interval(period);
            states.set_missed_tick_behavior(MissedTickBehavior::Skip);
            loop {
                states.tick().await;
                if robot.publish_state().await.is_err() {
                    return;
                }
            }
        });
    }
    Ok(publishing)
}
