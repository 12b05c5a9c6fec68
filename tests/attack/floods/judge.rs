//! What the floods did to the others: figures against their goals.

use std::collections::HashSet;
use std::fmt::Write as _;
use std::process::{Command, ExitCode};
use std::time::Duration;

use anyhow::Context as _;
use serde::Serialize;
use tread_api::friction::MU_PEAK_MAX;
use tread_api::identity::AuditEntry;
use tread_tests::fleet::{Fleet, SITE};
use tread_tests::process::tread;
use tread_tests::report::{self, Check, figure, quantile};

use super::Used;
use super::attackers::Done;
use super::honest::{Change, Worked};
use super::robots::Flood;

/// Longest time that 99 % of the stops over a new connection may take.
const STOP_P99_MAX_MS: f64 = 100.0;
/// Oldest that the state of another robot may be.
const STATE_AGE_MAX_MS: f64 = 1_000.0;
/// Longest wait for the answer to an introduction.
const HELLO_MAX_MS: f64 = 2_000.0;
/// Most memory of the server's process.
const MEMORY_MAX_MIB: f64 = 400.0;
/// Most that the server may log.
const LOG_MAX_MIB: f64 = 10.0;
/// Floods over HTTP.
const HTTP_FLOODS: usize = 6;
/// How long the audit log's writer may take.
const AUDIT_REST: Duration = Duration::from_secs(1);
/// Failures of one kind that are reported.
const REPORTED_MAX: usize = 5;

/// All that there is to judge.
#[derive(Debug, Serialize)]
pub(super) struct Facts {
    seconds: f64,
    floods: Vec<Done>,
    server: Used,
    /// Stops that took long: when, seconds, and how long, ms.
    slow_stops: Vec<(f64, f64)>,
    /// The first of what failed.
    failures: Vec<String>,
    #[serde(skip)]
    checks: Vec<Check>,
    #[serde(skip)]
    timed: Vec<Check>,
}

/// Runs `tread` as the admin: whether it succeeded, and its words.
async fn run_tread(fleet: &Fleet, arguments: &[&str]) -> anyhow::Result<(bool, String)> {
    let mut command = Command::new(tread()?);
    command
        .args(arguments)
        .env("TREAD_SERVER", format!("http://{}", fleet.http_address()))
        .env("TREAD_TOKEN", fleet.token());
    let ran = tokio::task::spawn_blocking(move || command.output()).await??;
    let words = String::from_utf8_lossy(&ran.stdout) + String::from_utf8_lossy(&ran.stderr);
    Ok((ran.status.success(), words.trim().to_owned()))
}

/// Changes that the exported log does not have.
fn missing(changes: &[Change], exported: &str) -> anyhow::Result<Vec<String>> {
    let mut entries = HashSet::new();
    for line in exported.lines() {
        let entry: AuditEntry = serde_json::from_str(line)?;
        let what = entry.what.unwrap_or_default();
        entries.insert(Change {
            method: entry.method,
            path: entry.path,
            status: entry.status,
            name: what["name"].as_str().map(str::to_owned),
        });
    }
    let is_missing = |change: &&Change| !entries.contains(*change);
    let missing = changes.iter().filter(is_missing);
    Ok(missing
        .map(|change| format!("not in the audit log: {change:?}"))
        .collect())
}

impl Facts {
    pub(super) async fn gather(
        fleet: &Fleet,
        worked: &Worked,
        server: Used,
        floods: Vec<Done>,
        seconds: f64,
    ) -> anyhow::Result<Self> {
        let mut failures: Vec<String> = [
            &worked.failed_stops,
            &worked.failed_looks,
            &worked.failed_hellos,
            &worked.failed_work,
            &worked.failed_changes,
        ]
        .into_iter()
        .flat_map(|failed| failed.iter().take(REPORTED_MAX).cloned())
        .collect();
        let mut checks = vec![
            Check::so("the server survived", !server.has_ended),
            Check::of_count(
                "floods that were sent",
                count(floods.iter().filter(|done| done.count > 0).count()),
            )
            .exactly(count(Flood::ALL.len() + HTTP_FLOODS)),
        ];
        if !server.has_ended {
            let (is_verified, missing) = audited(fleet, worked, &mut failures).await?;
            checks.push(Check::so("tread audit verify", is_verified));
            checks.push(
                Check::of_count("changes by the admin that the audit log lost", missing).exactly(0),
            );
            let path = format!("/v1/sites/{SITE}/friction/terrains");
            let mu_max = largest_mu(&fleet.rest.get(&path).await);
            checks.push(Check::of("largest mu in the map", mu_max).at_most(MU_PEAK_MAX));
        }
        checks.extend([
            Check::of(
                "stops by the operator",
                figure(count(worked.stops_ms.len())),
            )
            .at_least(1.0),
            Check::of_count("stops that failed", count(worked.failed_stops.len())).exactly(0),
            Check::of_count("looks that failed", count(worked.failed_looks.len())).exactly(0),
            Check::of_count(
                "introductions that failed",
                count(worked.failed_hellos.len()),
            )
            .exactly(0),
            Check::of_count(
                "work of the operator that failed",
                count(worked.failed_work.len()),
            )
            .exactly(0),
            Check::of_count(
                "changes by the admin that failed",
                count(worked.failed_changes.len()),
            )
            .exactly(0),
            Check::of("changes by the admin", figure(count(worked.changes.len()))).at_least(1.0),
            Check::of("memory of the server, MiB", server.memory_peak_mib).at_most(MEMORY_MAX_MIB),
            Check::of("log of the server, MiB", server.log_mib).at_most(LOG_MAX_MIB),
        ]);
        let timed = timed(worked);
        Ok(Self {
            seconds,
            floods,
            server,
            slow_stops: worked.slow_stops.clone(),
            failures,
            checks,
            timed,
        })
    }

    /// Prints all; figures of a time are only shown when they are not to be judged.
    pub(super) fn print(mut self, is_untimed: bool, json: bool) -> anyhow::Result<ExitCode> {
        let timed = std::mem::take(&mut self.timed).into_iter();
        let mut checks = std::mem::take(&mut self.checks);
        checks.extend(timed.map(|check| {
            if is_untimed {
                Check::shown(check.name, check.value)
            } else {
                check
            }
        }));
        let mut words = format!(
            "{:.0} s, server {:.1} s of CPU\n",
            self.seconds, self.server.cpu_s
        );
        for done in &self.floods {
            let wanted = done.wanted_per_s;
            let wanted = wanted.map_or_else(String::new, |hz| format!(" of {hz:.0}"));
            let _ = writeln!(
                words,
                "  {:<40}{:>10} {:<10}{:>10.0}/s{wanted} {}",
                done.flood, done.count, done.of, done.per_s, done.notes
            );
        }
        for failure in &self.failures {
            let _ = writeln!(words, "  ! {failure}");
        }
        report::print_with(json, &self, words, &checks)
    }
}

fn count(of: usize) -> u64 {
    u64::try_from(of).unwrap_or(u64::MAX)
}

/// The figures that depend on how fast the machine is.
fn timed(worked: &Worked) -> Vec<Check> {
    let sorted = |figures: &[f64], share| quantile(&mut figures.to_vec(), share);
    vec![
        Check::shown(
            "stop over a new connection p50, ms",
            sorted(&worked.stops_ms, 0.5),
        ),
        Check::of(
            "stop over a new connection p99, ms",
            sorted(&worked.stops_ms, 0.99),
        )
        .at_most(STOP_P99_MAX_MS),
        Check::shown(
            "stop over a new connection, longest, ms",
            sorted(&worked.stops_ms, 1.0),
        ),
        Check::of(
            "age of another robot's state, oldest, ms",
            sorted(&worked.ages_ms, 1.0),
        )
        .at_most(STATE_AGE_MAX_MS),
        Check::of(
            "introduction of another robot, longest, ms",
            sorted(&worked.hellos_ms, 1.0),
        )
        .at_most(HELLO_MAX_MS),
        Check::shown(
            "other work of the operator p99, ms",
            sorted(&worked.work_ms, 0.99),
        ),
    ]
}

/// Whether the chain holds, and how many of the admin's changes the log does not have.
async fn audited(
    fleet: &Fleet,
    worked: &Worked,
    failures: &mut Vec<String>,
) -> anyhow::Result<(bool, u64)> {
    tokio::time::sleep(AUDIT_REST).await;
    let (is_verified, said) = run_tread(fleet, &["audit", "verify"]).await?;
    if !is_verified {
        failures.push(said);
    }
    let file = fleet.file("audit.jsonl");
    let name = file.to_str().context("the folder has a name in UTF-8")?;
    let (is_exported, said) = run_tread(fleet, &["audit", "export", "--output", name]).await?;
    anyhow::ensure!(is_exported, "the audit log is not exported: {said}");
    let missing = missing(&worked.changes, &std::fs::read_to_string(&file)?)?;
    failures.extend(missing.iter().take(REPORTED_MAX).cloned());
    Ok((is_verified, count(missing.len())))
}

/// The largest number of any field whose name speaks of μ.
fn largest_mu(value: &serde_json::Value) -> f64 {
    use serde_json::Value;
    fn within(value: &Value, is_mu: bool) -> f64 {
        match value {
            Value::Object(fields) => fields
                .iter()
                .map(|(name, value)| within(value, is_mu || name.starts_with("mu")))
                .fold(0.0, f64::max),
            Value::Array(items) => items
                .iter()
                .map(|item| within(item, is_mu))
                .fold(0.0, f64::max),
            Value::Number(number) if is_mu => number.as_f64().unwrap_or(f64::INFINITY),
            Value::Number(_) | Value::Null | Value::Bool(_) | Value::String(_) => 0.0,
        }
    }
    within(value, false)
}
