//! `tread doctor` examines a server and its robots over the REST API. It checks the connection and
//! its certificate, the rights of the token, the clocks, and the state of each robot.

mod robots;

use std::process::ExitCode;
use std::time::{Duration, Instant};

use jiff::fmt::rfc2822;
use jiff::{SignedDuration, Timestamp, Zoned};
use reqwest::{Method, header};
use serde::Serialize;
use serde_json::Value;
use tread_api::diagnosis::{Finding, NextStep};
use tread_api::ids::SiteId;
use tread_api::robot::{Alert, Severity};

use self::robots::of_robot;
use crate::client::{Client, ClientError};
use crate::output::{Output, joined};

/// Maximum difference between two clocks; a larger one affects certificates and end times.
const CLOCK_DIFFERENCE_MAX: SignedDuration = SignedDuration::from_secs(10);
/// Remaining time below which the doctor warns that a token expires soon.
const EXPIRING_BEFORE: SignedDuration = SignedDuration::from_hours(7 * 24);
/// Maximum number of alerts that the doctor reads.
const ALERTS_MAX: u32 = 100;

/// The printed report.
#[derive(Debug, Serialize)]
struct Report {
    ok: bool,
    checks: Vec<Finding>,
}

/// Examines the server and the robots of a site, and prints the findings. The exit code is 1 if
/// there is a problem.
pub(super) async fn run(
    site: &SiteId,
    client: &Client,
    output: Output,
) -> anyhow::Result<ExitCode> {
    let checks = examine(site, client).await;
    let ok = checks.iter().all(Finding::holds);
    output.show(&Report { ok, checks }, |report| describe(&report.checks))?;
    Ok(if ok {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    })
}

fn describe(checks: &[Finding]) -> String {
    let mut lines = Vec::new();
    for finding in checks {
        lines.push(format!(
            "{} {}: {}",
            finding.mark(),
            finding.name,
            finding.text
        ));
        lines.extend(
            finding
                .next_step
                .iter()
                .map(|step| format!("      do: {step}")),
        );
    }
    lines.join("\n")
}

/// Converts an error to a finding.
fn failed(name: &str, error: &ClientError) -> Finding {
    let text = match std::error::Error::source(error) {
        Some(cause) => format!("{error}: {}", root(cause)),
        None => error.to_string(),
    };
    let next_step = error.next_step();
    let next_step = next_step.unwrap_or("correct what the message names, and ask again");
    Finding::on(name).problem(text, NextStep(next_step))
}

fn root<'a>(
    mut cause: &'a (dyn std::error::Error + 'static),
) -> &'a (dyn std::error::Error + 'static) {
    while let Some(deeper) = cause.source() {
        cause = deeper;
    }
    cause
}

async fn examine(site: &SiteId, client: &Client) -> Vec<Finding> {
    let mut findings = match reach(client).await {
        Ok(findings) => findings,
        Err(error) => return vec![failed("server", &error)],
    };
    if client.token().is_none() {
        findings.push(Finding::on("token").problem(
            "there is none for this server",
            NextStep(
                "sign in with `tread login`, or give a token with --token-file or TREAD_TOKEN",
            ),
        ));
        return findings;
    }
    match client.session().await {
        Ok(session) => findings.push(token(&session, now())),
        Err(error) => {
            findings.push(failed("token", &error));
            return findings;
        }
    }
    let mut version = None;
    match client.status().await {
        Ok(status) => {
            version = status["version"].as_str().map(str::to_owned);
            findings.extend(of_server(&status));
        }
        Err(error) => findings.push(failed("server", &error)),
    }
    match client.robots(site, false).await {
        Ok(robots) if robots.is_empty() => findings.push(
            Finding::on("robots").skipped(format!("no robot has connected to site `{site}` yet")),
        ),
        Ok(robots) => findings.extend(
            robots
                .iter()
                .flat_map(|robot| of_robot(robot, version.as_deref())),
        ),
        Err(error) => findings.push(failed("robots", &error)),
    }
    match client.alerts(site, (None, None), true, ALERTS_MAX).await {
        Ok(page) => findings.push(alerts(&page.items)),
        Err(error) => findings.push(failed("alerts", &error)),
    }
    findings
}

#[expect(
    clippy::disallowed_methods,
    reason = "the clock of this machine is what is examined"
)]
fn now() -> Timestamp {
    Timestamp::now()
}

/// Connects to the server, and compares its clock with that of this machine.
///
/// # Errors
/// No server answers, or its certificate is not accepted.
async fn reach(client: &Client) -> Result<Vec<Finding>, ClientError> {
    #[expect(
        clippy::disallowed_methods,
        reason = "the time of the answer is measured"
    )]
    let sent_at = Instant::now();
    let answer = client.request(Method::GET, "/healthz").send().await;
    let answer = answer.map_err(|cause| client.lost(cause))?;
    let round_trip = sent_at.elapsed();
    if !answer.status().is_success() {
        return Err(client.refusal(answer).await);
    }
    let is_tls = client.address().starts_with("https:");
    let by = if is_tls { "by TLS" } else { "without TLS" };
    let text = format!(
        "{} answers {by}, after {} ms",
        client.address(),
        round_trip.as_millis()
    );
    let server_time = answer.headers().get(header::DATE);
    let server_time = server_time
        .and_then(|date| date.to_str().ok())
        .and_then(|date| rfc2822::parse(date).ok());
    let mut findings = vec![Finding::on("server").ok(text)];
    findings.extend(server_time.map(|server_time| clock(&server_time, now(), round_trip)));
    findings.extend(readiness(client).await);
    Ok(findings)
}

async fn readiness(client: &Client) -> Option<Finding> {
    let answer = client.request(Method::GET, "/readyz").send().await.ok()?;
    if answer.status().is_success() {
        return Some(Finding::on("readiness").ok("the server can work"));
    }
    let why = client.refusal(answer).await;
    Some(Finding::on("readiness").problem(
        format!("the server cannot work: {why}"),
        NextStep("run `tread-server doctor` on its machine"),
    ))
}

/// Compares the server's clock with that of this machine.
fn clock(server_time: &Zoned, now: Timestamp, round_trip: Duration) -> Finding {
    let server_time = server_time.timestamp();
    // The header has whole seconds, and the server wrote it during the request.
    let slack = SignedDuration::try_from(round_trip).unwrap_or(SignedDuration::ZERO)
        + SignedDuration::from_secs(1);
    let difference = server_time.duration_since(now);
    if difference.abs() <= CLOCK_DIFFERENCE_MAX + slack {
        return Finding::on("clock").ok("the server's and this machine's agree");
    }
    let (seconds, which) = (
        difference.abs().as_secs(),
        if difference.is_negative() {
            "behind"
        } else {
            "ahead of"
        },
    );
    Finding::on("clock").problem(
        format!(
            "the server's is {seconds} s {which} this machine's: it says {server_time}, and this machine \
             {now:.0}"
        ),
        NextStep(
            "find out which is right, and have the other synchronised (chrony, systemd-timesyncd)",
        ),
    )
}

fn token(session: &tread_api::identity::Session, now: Timestamp) -> Finding {
    let left = session.expires_at.duration_since(now);
    let text = format!(
        "`{}` may {} for {}, until {:.0}",
        session.name, session.rights, session.sites, session.expires_at
    );
    if left < EXPIRING_BEFORE {
        return Finding::on("token").warning(
            text,
            NextStep("it expires soon: an admin makes another with `tread tokens create`"),
        );
    }
    Finding::on("token").ok(text)
}

/// Examines the server's own status. The server may be of any version.
fn of_server(status: &Value) -> Vec<Finding> {
    let mut findings = Vec::new();
    let version = status["version"].as_str().unwrap_or("unknown");
    let own = env!("CARGO_PKG_VERSION");
    findings.push(if version == own {
        Finding::on("version").ok(format!("server and `tread` are of {own}"))
    } else {
        Finding::on("version").warning(
            format!("the server is of {version}, and `tread` of {own}"),
            NextStep(
                "install the same version of both: they may not know all of each other's commands",
            ),
        )
    });
    let storage = &status["storage"];
    for (field, text) in [
        ("damaged", "is damaged"),
        ("unwritable", "cannot be written"),
    ] {
        if let Some(why) = storage[field].as_str() {
            findings.push(Finding::on("storage").problem(
                format!("the database {text}: {why}"),
                NextStep(
                    "run `tread-server doctor` on its machine; docs/runbook.md says what to do",
                ),
            ));
        }
    }
    if storage["disk_low"] == true {
        findings.push(Finding::on("storage").warning(
            "less is free on the server's disk than storage.disk_free_min_mib",
            NextStep("make room there"),
        ));
    }
    if let Some(slow) = status["slow_transactions"]["count"]
        .as_u64()
        .filter(|count| *count > 0)
    {
        let slowest = &status["slow_transactions"]["slowest"][0];
        let kind = slowest["kind"].as_str().unwrap_or("unknown");
        let longest_ms = slowest["longest_ms"].as_u64().unwrap_or_default();
        findings.push(Finding::on("database").warning(
            format!("{slow} transactions were slow; the slowest, `{kind}`, took {longest_ms} ms"),
            NextStep(
                "see whether other programs use the server's disk; docs/runbook.md, \
                 TreadDatabaseSlow",
            ),
        ));
    }
    findings
}

fn alerts(alerts: &[Alert]) -> Finding {
    let critical = alerts
        .iter()
        .filter(|alert| alert.severity == Severity::Critical);
    let named: Vec<String> = critical
        .clone()
        .map(|alert| format!("{} of {}", alert.code, alert.about()))
        .collect();
    let step = "`tread alerts` lists them; docs/runbook.md has a section for each";
    match (named.as_slice(), alerts.len()) {
        ([], 0) => Finding::on("alerts").ok("there are none"),
        ([], count) => {
            Finding::on("alerts").warning(format!("{count} warnings are active"), NextStep(step))
        }
        (named, count) => Finding::on("alerts").problem(
            format!("{count} are active; critical: {}", joined(named)),
            NextStep(step),
        ),
    }
}

#[cfg(test)]
mod tests {
    use jiff::tz::TimeZone;
    use serde_json::json;
    use tread_api::diagnosis::Verdict;

    use super::*;

    #[test]
    fn a_clock_an_hour_off_is_found_in_either_direction() {
        let now: Timestamp = "2026-11-02T10:00:00Z".parse().unwrap();
        let took = Duration::from_millis(20);
        let hour = SignedDuration::from_hours(1);
        let at = |said: Timestamp| clock(&said.to_zoned(TimeZone::UTC), now, took);
        assert_eq!(at(now).verdict, Verdict::Ok);
        assert!(at(now + hour).text.contains("3600 s ahead of"));
        assert!(at(now - hour).text.contains("3600 s behind"));
    }

    #[test]
    fn a_server_says_what_is_wrong_with_its_storage() {
        let status = json!({
            "version": "9.9.9",
            "storage": {"damaged": "page 7", "unwritable": null, "disk_low": true},
            "slow_transactions": {"count": 3, "slowest": [{"kind": "ingest", "longest_ms": 900}]},
        });
        let said = describe(&of_server(&status));
        for part in [
            "9.9.9",
            "page 7",
            "disk_free_min_mib",
            "`ingest`, took 900 ms",
        ] {
            assert!(said.contains(part), "`{part}` in {said}");
        }
        // An earlier server reports less.
        let earlier = json!({"version": env!("CARGO_PKG_VERSION")});
        assert_eq!(of_server(&earlier).len(), 1);
    }
}
