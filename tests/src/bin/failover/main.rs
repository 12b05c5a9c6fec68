//! `failover`: how soon a standby has the robots of a server that was killed, frozen or cut off, and whether
//! anything is lost, doubled or driven twice.
//!
//! Two servers on one PostgreSQL database, and robots on missions that know both, while others upload. In each
//! trial the server that works is killed, or stopped in its tracks, or cut off from database and robots, and
//! woken up or connected again after the other has taken over. What is timed is what a client of the other
//! server's REST API sees, so the poll is in the figures. Afterwards every mission must have succeeded once,
//! and every record of the robots and every segment with a receipt must be there once.

mod uploads;

use std::process::ExitCode;
use std::time::Duration;

use clap::Parser;
use nix::sys::signal::Signal;
use reqwest::Method;
use serde::Serialize;
use serde_json::json;
use tokio::time::Instant;
use tread_api::ids::{MissionId, RobotId};
use tread_api::mission::MissionState;
use tread_api::robot::LinkState;
use tread_tests::fleet::Fleet;
use tread_tests::process::node;
use tread_tests::report::{self, Check, figure, quantile};
use tread_tests::stored::{self, lost_records};
use tread_tests::wait::{DRIVE, SHORT};

use self::uploads::Uploads;

/// Longest time until all robots are online at the other server.
const ONLINE_MAX_S: f64 = 2.0;
/// Smallest share of the segments that were to be uploaded a second.
const UPLOADED_MIN: f64 = 0.95;
/// Longest time until a server that was woken up, or connected again, has ended.
const WOKEN_MAX_S: f64 = 5.0;
/// Time between two looks.
const POLL_INTERVAL: Duration = Duration::from_millis(20);
/// Time that robots drive between two trials.
const DRIVING: Duration = Duration::from_secs(3);
/// Distance between two robots, metres.
const APART_M: f64 = 20.0;

/// Measures how soon a standby takes over, and looks for what was lost.
#[derive(Debug, Parser)]
#[command(name = "failover")]
struct Arguments {
    /// Trials of each kind
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u32).range(1..=100))]
    trials: u32,
    /// Robots
    #[arg(long, default_value_t = 50, value_parser = clap::value_parser!(u32).range(1..=100))]
    robots: u32,
    /// Segments that other robots upload meanwhile, a second
    #[arg(long, default_value_t = 5_000, value_parser = clap::value_parser!(u32).range(1..=50_000))]
    segments_per_s: u32,
    /// Print one JSON object instead of a table
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Serialize)]
struct Details {
    trials: u32,
    robots: u32,
    segments_per_s: u32,
    missions: usize,
    failures: Vec<String>,
}

/// What happens to the server that works.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Failure {
    Kill,
    Freeze,
    /// It reaches neither database nor robots, and runs.
    Cut,
}

/// Times from a failure, seconds.
#[derive(Debug, Default)]
struct Times {
    /// Until the other server was ready.
    ready: Vec<f64>,
    /// Until each robot was online there.
    online: Vec<f64>,
    /// From the waking of a frozen server, or the mending of its network, until it had ended.
    ended: Vec<f64>,
}

/// Waits until something is so, and returns how long that took, seconds.
async fn until(
    fleet: &Fleet,
    what: &str,
    began: Instant,
    mut is_so: impl AsyncFnMut() -> bool,
) -> anyhow::Result<f64> {
    while !is_so().await {
        anyhow::ensure!(
            began.elapsed() < DRIVE,
            "not within {DRIVE:?}: {what}: {:#?}",
            fleet.servers_log_tail()
        );
        tokio::time::sleep(POLL_INTERVAL).await;
    }
    Ok(began.elapsed().as_secs_f64())
}

async fn is_ready(fleet: &Fleet) -> bool {
    let ready = fleet.rest.call(Method::GET, "/readyz", None).await;
    ready.is_some_and(|(status, _)| status.is_success())
}

/// One failure of the server that works.
async fn fail(
    fleet: &mut Fleet,
    robots: &[RobotId],
    failure: Failure,
    times: &mut Times,
) -> anyhow::Result<()> {
    tokio::time::sleep(DRIVING).await;
    let began = Instant::now();
    match failure {
        Failure::Kill => fleet.signal_server(Signal::SIGKILL),
        Failure::Freeze => fleet.signal_server(Signal::SIGSTOP),
        Failure::Cut => fleet.cut_server_off(),
    }
    fleet.exchange_servers();
    let ready = until(fleet, "the standby is ready", began, async || {
        is_ready(fleet).await
    });
    times.ready.push(ready.await?);
    for robot in robots {
        let online = until(fleet, "the robot is online", began, async || {
            let seen = fleet.rest.robot(robot).await;
            seen.is_some_and(|seen| seen.link == LinkState::Online)
        });
        times.online.push(online.await?);
    }
    if failure != Failure::Kill {
        tokio::time::sleep(DRIVING).await;
        let began = Instant::now();
        match failure {
            Failure::Cut => fleet.reconnect_other_server(),
            Failure::Kill | Failure::Freeze => fleet.wake_other_server(),
        }
        let ended = until(fleet, "the server that is back ends", began, async || {
            fleet.has_other_server_ended()
        });
        times.ended.push(ended.await?);
    }
    fleet.start_other_server();
    Ok(())
}

/// Sends a robot on circles for about so many seconds.
async fn send(fleet: &Fleet, robot: &RobotId, number: u32, for_s: f64) -> MissionId {
    let (radius_m, speed_m_s) = (2.0, 0.8);
    let turns = (for_s * speed_m_s / (std::f64::consts::TAU * radius_m)).max(1.0);
    let x_m = f64::from(number) * APART_M;
    let circle = json!({"circle": {
        "center": {"x_m": x_m, "y_m": radius_m}, "radius_m": radius_m, "speed_m_s": speed_m_s,
        "turns": turns,
    }});
    fleet.rest.send(robot, circle).await
}

#[tokio::main]
async fn main() -> anyhow::Result<ExitCode> {
    let arguments = Arguments::parse();
    let node = node()?;
    let mut fleet = Fleet::start_pair_with(&node).await?;
    let mut robots = Vec::new();
    for number in 0..arguments.robots {
        let robot: RobotId = format!("rover-{number}").parse()?;
        fleet.start_agent(&robot, f64::from(number) * APART_M).await;
        robots.push(robot);
    }
    // Longer than all trials take.
    let for_s = f64::from(arguments.trials) * 60.0;
    let mut missions = Vec::new();
    for (number, robot) in (0..).zip(&robots) {
        missions.push(send(&fleet, robot, number, for_s).await);
        // It waits for the first one to end.
        missions.push(send(&fleet, robot, number, 1.0).await);
    }
    let uploads = Uploads::start(&fleet, arguments.segments_per_s);
    let [mut killed, mut frozen, mut cut] = <[Times; 3]>::default();
    for _ in 0..arguments.trials {
        fail(&mut fleet, &robots, Failure::Kill, &mut killed).await?;
        fail(&mut fleet, &robots, Failure::Freeze, &mut frozen).await?;
        fail(&mut fleet, &robots, Failure::Cut, &mut cut).await?;
    }
    let uploaded = uploads.end(&fleet).await?;
    let failures = judge(&mut fleet, &robots, &missions).await?;
    let lost = failures.len() as u64;
    let mut checks = vec![
        Check::of("all online after a kill, s", worst(&mut killed.online)).at_most(ONLINE_MAX_S),
        Check::shown("the same, median, s", quantile(&mut killed.online, 0.5)),
        Check::shown("standby ready after a kill, s", worst(&mut killed.ready)),
        Check::of("all online after a freeze, s", worst(&mut frozen.online)).at_most(ONLINE_MAX_S),
        Check::shown("the same, median, s", quantile(&mut frozen.online, 0.5)),
        Check::shown("standby ready after a freeze, s", worst(&mut frozen.ready)),
        Check::of("woken server has ended, s", worst(&mut frozen.ended)).at_most(WOKEN_MAX_S),
        Check::of("all online after a cut, s", worst(&mut cut.online)).at_most(ONLINE_MAX_S),
        Check::shown("the same, median, s", quantile(&mut cut.online, 0.5)),
        Check::of(
            "server that was cut off has ended, s",
            worst(&mut cut.ended),
        )
        .at_most(WOKEN_MAX_S),
    ];
    checks.push(
        Check::of_count(
            "missions that did not succeed once, robots with lost records",
            lost,
        )
        .exactly(0),
    );
    checks.push(Check::shown("missions", figure(missions.len() as u64)));
    let uploaded_min = UPLOADED_MIN * f64::from(arguments.segments_per_s);
    checks.extend([
        Check::of("segments uploaded a second", uploaded.per_s).at_least(uploaded_min),
        Check::shown("longest upload over a failure, s", uploaded.longest_s),
        Check::of_count("segments with a receipt that are lost", uploaded.lost).exactly(0),
        Check::of_count("segments that are stored twice", uploaded.doubled).exactly(0),
    ]);
    let words = format!("{failures:#?}\n");
    let details = Details {
        trials: arguments.trials,
        robots: arguments.robots,
        segments_per_s: arguments.segments_per_s,
        missions: missions.len(),
        failures,
    };
    report::print_with(arguments.json, &details, words, &checks)
}

fn worst(seen_s: &mut [f64]) -> f64 {
    quantile(seen_s, 1.0)
}

/// What is wrong with the missions and with the robots' records at the end.
async fn judge(
    fleet: &mut Fleet,
    robots: &[RobotId],
    missions: &[MissionId],
) -> anyhow::Result<Vec<String>> {
    let mut failures = Vec::new();
    for mission in missions {
        let bound = Duration::from_mins(10);
        let ended = [
            MissionState::Succeeded,
            MissionState::Failed,
            MissionState::Cancelled,
            MissionState::Expired,
            MissionState::Rejected,
        ];
        let detail = fleet.rest.mission_reaches(*mission, &ended, bound).await;
        let ends = detail.events.iter().filter(|event| {
            event.to.is_terminal() && event.from.is_none_or(|from| !from.is_terminal())
        });
        if (detail.mission.state, ends.count()) != (MissionState::Succeeded, 1) {
            failures.push(format!("{:?}: {:?}", detail.mission, detail.events));
        }
    }
    for robot in robots {
        let seen = until(
            fleet,
            "the robot has uploaded all",
            Instant::now(),
            async || {
                let live = fleet.rest.robot(robot).await.and_then(|robot| robot.live);
                live.is_some_and(|live| live.outbox.pending == 0 && live.mission.is_none())
            },
        );
        seen.await?;
        fleet.stop_agent(robot).await?;
    }
    tokio::time::sleep(SHORT / 10).await;
    let records = stored::records(fleet.database()).await?;
    let boots: Vec<(String, String)> = fleet
        .database()
        .rows("SELECT boots.id, robots.id FROM boots JOIN robots ON robots.pk = boots.robot_pk")
        .await?;
    for robot in robots {
        let is_own = |boot: &str| {
            let mut own = boots.iter().filter(|(_, of)| of == robot.as_str());
            own.any(|(known, _)| known == boot)
        };
        let own = records.iter().filter(|(boot, _)| is_own(boot)).cloned();
        let lost = lost_records(&fleet.robot_folder(robot), robot, own.collect());
        failures.extend(lost.map(|lost| format!("{robot}: {lost}")));
    }
    Ok(failures)
}
