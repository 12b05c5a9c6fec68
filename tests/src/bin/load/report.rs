//! The figures, the goals, and whether they hold.

use std::io::Write;

use serde::Serialize;

use crate::Arguments;
use crate::dispatch::Dispatch;
use crate::ingest::Ingest;

/// Segments committed per second, at the least.
const SEGMENTS_PER_SECOND_MIN: f64 = 20_000.0;
/// Processor time of the server for each segment, at the most, microseconds.
const SERVER_CPU_US_PER_SEGMENT_MAX: f64 = 25.0;
/// 99 % of the receipts within this, milliseconds.
const ACK_P99_MAX_MS: f64 = 100.0;
/// Half of the missions move the wheels within this, milliseconds.
const DISPATCH_P50_MAX_MS: f64 = 15.0;
/// 99 % of the missions move the wheels within this, milliseconds.
const DISPATCH_P99_MAX_MS: f64 = 40.0;

/// One figure against its goal.
#[derive(Debug, Serialize)]
struct Check {
    name: &'static str,
    goal: String,
    value: f64,
    holds: bool,
}

fn at_least(name: &'static str, goal: f64, value: f64) -> Check {
    Check {
        name,
        goal: format!(">= {goal}"),
        value,
        holds: value >= goal,
    }
}

fn at_most(name: &'static str, goal: f64, value: f64) -> Check {
    Check {
        name,
        goal: format!("<= {goal}"),
        value,
        holds: value <= goal,
    }
}

/// Everything that was measured.
#[derive(Debug, Serialize)]
pub(crate) struct Report {
    robots: u32,
    ingest: Ingest,
    dispatch: Dispatch,
    checks: Vec<Check>,
}

impl Report {
    pub(crate) fn new(arguments: &Arguments, ingest: Ingest, dispatch: Dispatch) -> Self {
        #[expect(clippy::cast_precision_loss, reason = "small counts")]
        let checks = vec![
            at_least(
                "segments committed per second",
                SEGMENTS_PER_SECOND_MIN,
                ingest.segments_per_second,
            ),
            at_most(
                "server CPU per segment, us",
                SERVER_CPU_US_PER_SEGMENT_MAX,
                ingest.server_cpu_us_per_segment,
            ),
            at_most("ack p99, ms", ACK_P99_MAX_MS, ingest.ack_p99_ms),
            at_most(
                "uploads without a receipt",
                0.0,
                ingest.uploads_failed as f64,
            ),
            at_most(
                "acknowledged but lost",
                0.0,
                ingest.acknowledged_but_lost as f64,
            ),
            at_most("counted twice", 0.0, ingest.counted_twice as f64),
            at_most("dispatch p50, ms", DISPATCH_P50_MAX_MS, dispatch.p50_ms),
            at_most("dispatch p99, ms", DISPATCH_P99_MAX_MS, dispatch.p99_ms),
        ];
        Self {
            robots: arguments.robots,
            ingest,
            dispatch,
            checks,
        }
    }

    pub(crate) fn holds(&self) -> bool {
        self.checks.iter().all(|check| check.holds)
    }

    pub(crate) fn print(&self, json: bool) -> anyhow::Result<()> {
        let mut output = std::io::stdout().lock();
        if json {
            writeln!(output, "{}", serde_json::to_string(self)?)?;
            return Ok(());
        }
        let memory_mb = |bytes: u64| bytes / 1_000_000;
        let Ingest {
            server, generator, ..
        } = &self.ingest;
        writeln!(
            output,
            "{} light robots, {:.0} states/s; server {:.1} s CPU, {} MB at most; generator {:.1} s \
             CPU, {} MB at most",
            self.robots,
            self.ingest.states_published_per_second,
            server.cpu_s,
            memory_mb(server.memory_peak_bytes),
            generator.cpu_s,
            memory_mb(generator.memory_peak_bytes),
        )?;
        writeln!(
            output,
            "ack p50 {:.1} ms, max {:.1} ms; dispatch max {:.1} ms over {} missions",
            self.ingest.ack_p50_ms,
            self.ingest.ack_max_ms,
            self.dispatch.max_ms,
            self.dispatch.missions
        )?;
        for check in &self.checks {
            let verdict = if check.holds {
                "holds"
            } else {
                "DOES NOT HOLD"
            };
            writeln!(
                output,
                "{:32} {:>10.2}  {:>9}  {verdict}",
                check.name, check.value, check.goal
            )?;
        }
        Ok(())
    }
}
