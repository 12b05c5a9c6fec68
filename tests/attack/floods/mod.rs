//! All floods at once for some time, while honest people and robots work: the acceptance of the
//! server's hardening.
//!
//! ```text
//!  attackers (a process) ──┐
//!  honest operator, admin ─┼─► server (a process): its memory, its log, its answers
//!  honest robots ──────────┘
//! ```

pub(crate) mod attackers;
mod honest;
mod http;
mod judge;
mod robots;

use std::path::Path;
use std::process::ExitCode;
use std::time::Duration;

use anyhow::Context as _;
use clap::Args;
use serde::Serialize;
use serde_json::json;
use tokio::time::Instant;
use tread_api::ids::{BootId, RobotId};
use tread_tests::fleet::Fleet;
use tread_tests::light_robot::{introduce, open_session};
use tread_tests::process::{Process, node};
use tread_tests::report;
use uuid::Uuid;

use self::attackers::{Done, Plan};
use self::honest::Honest;

/// Robots that have said hello once and are not there.
const ABSENT_ROBOTS: u32 = 200;
/// How long a robot's certificate is good for, seconds.
const CERTIFICATE_S: u32 = 86_400;
/// Time between two looks at the server.
const POLL_INTERVAL: Duration = Duration::from_millis(250);
/// How long the attackers may take beyond the floods: to connect, and to end.
const BEYOND_MAX: Duration = Duration::from_mins(2);
/// The robot that drives, or would.
pub(crate) const HONEST_ROBOT: &str = "honest";
/// The robot whose introductions are measured.
const QUIET_ROBOT: &str = "quiet";

/// All floods at once.
#[derive(Debug, Args)]
pub(crate) struct Arguments {
    /// How long, seconds
    #[arg(long, default_value_t = 60, value_parser = clap::value_parser!(u64).range(5..=3_600))]
    seconds: u64,
    /// How much the attackers give way to the server on this machine, as `nice` takes it. They would
    /// have machines of their own
    #[arg(long, default_value_t = 0, value_parser = clap::value_parser!(u8).range(0..=19))]
    nice: u8,
    /// Leave out floods whose names have this in them, to see what each one costs
    #[arg(long, value_name = "PART")]
    without: Vec<String>,
    /// Judge what does not depend on the machine's speed alone: a short run, built for debugging
    #[arg(long)]
    untimed: bool,
}

/// What the server was seen to use.
#[derive(Debug, Clone, Copy, Default, Serialize)]
struct Used {
    memory_peak_mib: f64,
    cpu_s: f64,
    log_mib: f64,
    has_ended: bool,
}

fn mib(bytes: u64) -> f64 {
    report::figure(bytes) / f64::from(1 << 20)
}

/// Makes robots known that are not there.
async fn introduce_absent_robots(fleet: &Fleet) -> anyhow::Result<()> {
    let session = open_session(&fleet.zenoh_endpoint()).await?;
    for number in 0..ABSENT_ROBOTS {
        let robot: RobotId = format!("absent-{number}").parse()?;
        let boot = BootId::from_uuid(Uuid::new_v4());
        introduce(&session, &fleet.site(), &robot, boot).await?;
    }
    let closed = session.close().await;
    closed.map_err(|error| anyhow::anyhow!("the session did not close: {error}"))
}

/// A token of that role.
pub(crate) async fn token(fleet: &Fleet, role: &str) -> anyhow::Result<String> {
    let request = json!({"name": format!("the {role}"), "role": role});
    let created = fleet.rest.post("/v1/tokens", &request).await;
    let secret = created["secret"].as_str().context("a token has a secret")?;
    Ok(secret.to_owned())
}

/// Starts the attackers as a process of their own; what each flood has done.
async fn attack(fleet: &Fleet, plan: &Plan, nice: u8) -> anyhow::Result<Vec<Done>> {
    let file = fleet.file("plan.json");
    std::fs::write(&file, serde_json::to_vec(plan)?)?;
    let text = |path: &Path| path.to_str().map(str::to_owned).context("a name in UTF-8");
    let arguments = [
        "-n".to_owned(),
        nice.to_string(),
        text(&std::env::current_exe()?)?,
        "attackers".to_owned(),
        text(&file)?,
    ];
    let log = fleet.file("attackers.log");
    let mut attackers = Process::start("attackers", Path::new("nice"), &arguments, &log)?;
    let bound = Instant::now() + Duration::from_secs(plan.seconds) + BEYOND_MAX;
    let status = loop {
        if let Some(status) = attackers.ended() {
            break status;
        }
        anyhow::ensure!(Instant::now() < bound, "the attackers do not end");
        tokio::time::sleep(POLL_INTERVAL).await;
    };
    let said = || std::fs::read_to_string(&log).unwrap_or_default();
    anyhow::ensure!(status.success(), "the attackers failed: {}", said());
    let done = std::fs::read(&plan.report).context("the attackers left no report")?;
    Ok(serde_json::from_slice(&done)?)
}

/// Looks at the server until it is dropped or has ended.
async fn watch(fleet: &Fleet, used: &mut Used) {
    while !fleet.has_server_ended() {
        if let Some(usage) = fleet.server_usage() {
            used.memory_peak_mib = mib(usage.memory_peak_bytes);
            used.cpu_s = usage.cpu_s;
        }
        used.log_mib = mib(fleet.log_bytes("server"));
        tokio::time::sleep(POLL_INTERVAL).await;
    }
    used.has_ended = true;
}

pub(crate) async fn run(arguments: &Arguments, json: bool) -> anyhow::Result<ExitCode> {
    let mut fleet = Fleet::start_secure_with(&node()?, CERTIFICATE_S).await;
    fleet.without_certificates(introduce_absent_robots).await?;
    let honest_robot: RobotId = HONEST_ROBOT.parse()?;
    fleet.join(&honest_robot).await;
    fleet.start_agent(&honest_robot, 0.0).await;
    let quiet = fleet.membership(&QUIET_ROBOT.parse()?).await;
    let mut memberships = Vec::new();
    for number in 0..robots::Flood::ALL.len() {
        memberships.push(fleet.membership(&format!("flood-{number}").parse()?).await);
    }
    let plan = Plan {
        http: fleet.http_address(),
        endpoint: fleet.zenoh_endpoint(),
        viewer: token(&fleet, "viewer").await?,
        watched: HONEST_ROBOT.to_owned(),
        robots: memberships,
        seconds: arguments.seconds,
        report: fleet.file("floods.json"),
        without: arguments.without.clone(),
    };
    let operator = token(&fleet, "operator").await?;
    let honest = Honest::begin(&fleet, &operator, &quiet, arguments.seconds).await?;
    let mut used = Used::default();
    let begun = Instant::now();
    let attacking = attack(&fleet, &plan, arguments.nice);
    let done = tokio::select! {
        done = attacking => done?,
        () = watch(&fleet, &mut used) => Vec::new(),
    };
    let worked = honest.end().await?;
    let seconds = begun.elapsed().as_secs_f64();
    used.has_ended = fleet.has_server_ended();
    if used.has_ended {
        eprintln!("{}", fleet.log_tail("server").join("\n"));
    }
    let facts = judge::Facts::gather(&fleet, &worked, used, done, seconds).await?;
    facts.print(arguments.untimed, json)
}
