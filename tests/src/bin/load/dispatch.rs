//! Time from a request over REST to the robot's first wheel command.

use std::io::Write as _;
use std::path::Path;
use std::time::Duration;

use anyhow::Context;
use hdrhistogram::Histogram;
use jiff::Timestamp;
use serde::Serialize;
use serde_json::json;
use tokio::time::Instant;
use tread_api::ids::{MissionId, RobotId};
use tread_api::mission::MissionState;
use tread_api::robot::{RobotLive, RobotMode};
use tread_api::wire::trace::TraceParent;
use tread_tests::collector::Collector;
use tread_tests::fleet::Fleet;
use tread_tests::light_robot::now;
use tread_tests::random::Random;
use tread_tests::report::{figure, quantile};
use tread_tests::wait::{SHORT, eventually};

use crate::states::publish;
use crate::{Arguments, period_of, start_light_robots};

/// Period of the agents' control loops. Requests are spread over it.
const LOOP_PERIOD: Duration = Duration::from_millis(10);
/// Number of writes of which the time to the disk is measured, and the bytes of each.
const FSYNCS: usize = 100;
const FSYNC_BYTES: usize = 8 * 1024;
/// Part of the missions whose traces must have arrived.
const TRACED_MIN: f64 = 0.9;
/// Parts of the time from the request to the first wheel command, in their order.
const PARTS: [&str; 6] = [
    "HTTP and checks",
    "commit",
    "reconciler",
    "query to the robot",
    "planning",
    "loop tick",
];
/// Spans of server and agent between which the parts lie.
const SPANS: [&str; 4] = ["store", "offer", "plan", "drive"];

/// What the dispatch measurement found.
#[derive(Debug, Serialize)]
pub(crate) struct Dispatch {
    pub(crate) missions: u64,
    pub(crate) p50_ms: f64,
    pub(crate) p99_ms: f64,
    pub(crate) max_ms: f64,
    /// One write with `fdatasync` beside the database.
    pub(crate) fsync_p50_ms: f64,
    pub(crate) fsync_p99_ms: f64,
    /// The time by its parts, in their order; empty without a collector.
    pub(crate) parts: Vec<Part>,
}

/// A part of the time from the request to the first wheel command.
#[derive(Debug, Serialize)]
pub(crate) struct Part {
    pub(crate) name: &'static str,
    pub(crate) p50_ms: f64,
    pub(crate) p99_ms: f64,
}

impl Dispatch {
    /// Returns what is not among the checks, in a line.
    pub(crate) fn words(&self) -> String {
        let parts = self.parts.iter().map(|part| {
            let Part {
                name,
                p50_ms,
                p99_ms,
            } = part;
            format!("; {name} {p50_ms:.2} / {p99_ms:.2}")
        });
        format!(
            "dispatch of {} missions, ms p50 / p99: all {:.1} / {:.1}, at most {:.1}{}; one fsync \
             {:.2} / {:.2}",
            self.missions,
            self.p50_ms,
            self.p99_ms,
            self.max_ms,
            parts.collect::<String>(),
            self.fsync_p50_ms,
            self.fsync_p99_ms,
        )
    }
}

/// A mission that was sent.
struct Sent {
    mission: MissionId,
    asked_at: Timestamp,
    latency: Duration,
}

/// Sends missions while light robots publish their states.
pub(crate) async fn measure(
    arguments: &Arguments,
    fleet: &mut Fleet,
    collector: &Collector,
) -> anyhow::Result<Dispatch> {
    let robots = start_light_robots(fleet, arguments.robots, arguments.tls).await?;
    let _publishing = publish(robots, period_of(arguments.state_rate_hz));
    send_missions(arguments, fleet, Some(collector)).await
}

/// Sends missions one after the other to agents that it starts.
pub(crate) async fn send_missions(
    arguments: &Arguments,
    fleet: &mut Fleet,
    collector: Option<&Collector>,
) -> anyhow::Result<Dispatch> {
    let mut latencies_us = Histogram::<u64>::new(3)?;
    let mut agents = Vec::new();
    for number in 0..arguments.agents {
        let robot: RobotId = format!("driver-{number}").parse()?;
        if fleet.has_certificates() {
            fleet.join(&robot).await;
        }
        fleet.start_agent(&robot, f64::from(number) * 20.0).await;
        agents.push(robot);
    }
    let (mut sent, mut random) = (Vec::new(), Random::new(1));
    for robot in &agents {
        for _ in 0..arguments.missions {
            let mission = one_mission(fleet, robot, random.share()).await?;
            latencies_us.record(u64::try_from(mission.latency.as_micros())?)?;
            sent.push(mission);
        }
    }
    let parts = match collector {
        Some(collector) => parts(&sent, collector).await?,
        None => Vec::new(),
    };
    let mut fsyncs_ms = fsyncs_ms(&fleet.file("tread.db"))?;
    #[expect(clippy::cast_precision_loss, reason = "microseconds far below 2^53")]
    let quantile_ms = |quantile: f64| latencies_us.value_at_quantile(quantile) as f64 / 1e3;
    Ok(Dispatch {
        missions: latencies_us.len(),
        p50_ms: quantile_ms(0.5),
        p99_ms: quantile_ms(0.99),
        max_ms: quantile_ms(1.0),
        fsync_p50_ms: quantile(&mut fsyncs_ms, 0.5),
        fsync_p99_ms: quantile(&mut fsyncs_ms, 0.99),
        parts,
    })
}

/// Divides the time of each mission by its spans, which server and agent send to the collector.
async fn parts(sent: &[Sent], collector: &Collector) -> anyhow::Result<Vec<Part>> {
    let of_mission = |sent: &Sent| {
        let trace = TraceParent::of_mission(sent.mission);
        collector.of_trace(trace.trace_id)
    };
    // Server and agents send their spans in order, so those of the others have arrived too.
    if let Some(last) = sent.last() {
        let look = async || of_mission(last);
        eventually("the last spans have arrived", SHORT, look, |spans| {
            SPANS.iter().all(|name| spans.contains_key(*name))
        })
        .await;
    }
    let mut times_ms = vec![Vec::new(); PARTS.len()];
    for mission in sent {
        let spans = of_mission(mission);
        let ends_ns = |name: &str| {
            let (_, span) = spans.get(name)?.last()?;
            Some((span.start_time_unix_nano, span.end_time_unix_nano))
        };
        let found = SPANS.map(ends_ns);
        let [Some(store), Some(offer), Some(plan), Some(drive)] = found else {
            continue;
        };
        let asked_ns = u64::try_from(mission.asked_at.as_nanosecond())?;
        let marks_ns = [asked_ns, store.0, store.1, offer.0, plan.0, plan.1, drive.0];
        for (times_ms, pair) in times_ms.iter_mut().zip(marks_ns.windows(2)) {
            // The loop may take a plan before the span of planning ends.
            times_ms.push(figure(pair[1].saturating_sub(pair[0])) / 1e6);
        }
    }
    let traced = figure(times_ms[0].len() as u64) / figure(sent.len().max(1) as u64);
    anyhow::ensure!(
        traced >= TRACED_MIN,
        "only {:.0} % of the missions have all of their spans",
        100.0 * traced
    );
    let parts = PARTS.into_iter().zip(&mut times_ms);
    let part = |(name, times_ms): (&'static str, &mut Vec<f64>)| Part {
        name,
        p50_ms: quantile(times_ms, 0.5),
        p99_ms: quantile(times_ms, 0.99),
    };
    Ok(parts.map(part).collect())
}

/// Returns the times of writes with `fdatasync` to a file beside the database.
fn fsyncs_ms(database: &Path) -> anyhow::Result<Vec<f64>> {
    let mut file = std::fs::File::create(database.with_extension("fsync"))?;
    let bytes = [0x5a_u8; FSYNC_BYTES];
    let mut times_ms = Vec::new();
    for _ in 0..FSYNCS {
        let begin = Instant::now();
        file.write_all(&bytes)?;
        file.sync_data()?;
        times_ms.push(1e3 * begin.elapsed().as_secs_f64());
    }
    Ok(times_ms)
}

/// Sends a circle at this phase of the control loop, waits until the robot drives it, and cancels it.
async fn one_mission(fleet: &Fleet, robot: &RobotId, phase: f64) -> anyhow::Result<Sent> {
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
    tokio::time::sleep(LOOP_PERIOD.mul_f64(phase)).await;
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
    let latency = Duration::try_from(started_at.duration_since(asked_at));
    Ok(Sent {
        mission,
        asked_at,
        latency: latency.context("it started before it was sent")?,
    })
}
