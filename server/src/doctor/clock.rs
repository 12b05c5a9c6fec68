//! Examines whether the machine's clock is synchronised, and whether the database holds later
//! times.

use std::path::Path;
use std::process::{Command, Stdio};

use jiff::{SignedDuration, Timestamp};
use tread_api::diagnosis::{Finding, NextStep};

use super::DoctorInput;

/// File that systemd-timesyncd creates after its first synchronisation.
const TIMESYNC_FILE: &str = "/run/systemd/timesync/synchronized";
/// Time by which the database's newest time may be ahead of the clock; the server bridges such a
/// step within seconds.
const AHEAD_MAX: SignedDuration = SignedDuration::from_secs(5);
const SYNCHRONISE: &str = "set the clock, and have it synchronised: `apt-get install chrony`, or \
                           `timedatectl set-ntp true`";

pub(super) fn findings(examined: &DoctorInput, newest: Option<Timestamp>) -> Vec<Finding> {
    let now = examined.clock.machine_time();
    let mut findings = vec![match is_synchronised() {
        Some(true) => Finding::on("clock").ok(format!("it is synchronised, and says {now:.0}")),
        Some(false) => Finding::on("clock").warning(
            format!("it is not synchronised, and says {now:.0}"),
            NextStep(SYNCHRONISE),
        ),
        None => Finding::on("clock").skipped(format!(
            "it says {now:.0}; whether it is synchronised is not known here"
        )),
    }];
    findings.extend(newest.and_then(|newest| behind(now, newest.duration_since(now))));
    findings
}

/// Returns a finding if the database's newest time is ahead of the clock.
fn behind(now: Timestamp, ahead: SignedDuration) -> Option<Finding> {
    (ahead > AHEAD_MAX).then(|| {
        let newest = now + ahead;
        Finding::on("clock").problem(format!(
                "it says {now:.0}, {} s before the newest time in the database, {newest:.0}: it was \
                 set back, or was ahead before",
                ahead.as_secs()
            ),
            NextStep(SYNCHRONISE),
        )
    })
}

/// Returns whether the clock is synchronised; `None` if no program on this machine reports it.
fn is_synchronised() -> Option<bool> {
    if Path::new(TIMESYNC_FILE).exists() {
        return Some(true);
    }
    let words = ["show", "--property=NTPSynchronized", "--value"];
    let output = output_of("timedatectl", &words);
    match output.as_deref().map(str::trim) {
        Some("yes") => return Some(true),
        Some("no") => return Some(false),
        Some(_) | None => {}
    }
    // The last field of the table is the leap status.
    let output = output_of("chronyc", &["-c", "tracking"])?;
    let leap = output.trim().rsplit(',').next()?.to_owned();
    Some(leap != "Not synchronised")
}

fn output_of(program: &str, words: &[&str]) -> Option<String> {
    let output = Command::new(program)
        .args(words)
        .stdin(Stdio::null())
        .stderr(Stdio::null())
        .output()
        .ok()?;
    let is_done = output.status.success();
    is_done.then(|| String::from_utf8_lossy(&output.stdout).into_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_clock_behind_the_database_is_found_and_a_short_step_is_not() {
        let now: Timestamp = "2026-11-02T10:00:00Z".parse().unwrap();
        assert_eq!(behind(now, SignedDuration::from_secs(5)), None);
        assert_eq!(behind(now, -SignedDuration::from_hours(1)), None);
        let found = behind(now, SignedDuration::from_hours(1)).unwrap();
        assert!(found.text.contains("3600 s before"), "{found:?}");
        assert!(!found.holds());
    }
}
