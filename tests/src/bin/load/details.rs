//! The figures, the goals, and whether they hold.

use std::process::ExitCode;

use serde::Serialize;
use tread_lab::report::Table;
use tread_tests::report::{self, Check};

use crate::Arguments;
use crate::dispatch::Dispatch;
use crate::floor::QueryFloor;
use crate::ingest::Ingest;

/// Segments committed per second, at the least.
const SEGMENTS_PER_SECOND_MIN: f64 = 20_000.0;
/// Processor time of the server for each segment, at the most, microseconds.
const SERVER_CPU_US_PER_SEGMENT_MAX: f64 = 25.0;
/// 99 % of the receipts within this, milliseconds.
const ACK_P99_MAX_MS: f64 = 100.0;
/// Half of the missions move the wheels within this, milliseconds.
const DISPATCH_P50_MAX_MS: f64 = 8.0;
/// 99 % of the missions move the wheels within this, milliseconds.
const DISPATCH_P99_MAX_MS: f64 = 14.0;

/// Everything that was measured.
#[derive(Debug, Serialize)]
pub(crate) struct Details {
    pub(crate) robots: u32,
    pub(crate) ingest: Ingest,
    pub(crate) dispatch: Dispatch,
    pub(crate) query: QueryFloor,
}

impl Details {
    pub(crate) fn print(&self, arguments: &Arguments) -> anyhow::Result<ExitCode> {
        if arguments.markdown {
            let (ingest, dispatch) = (self.ingest.words(), self.dispatch_table().markdown());
            let tables = format!("{} light robots; {ingest}\n\n{dispatch}", self.robots);
            return report::print_markdown(&tables, &self.checks());
        }
        report::print_with(arguments.json, self, self.words(), &self.checks())
    }

    /// Returns the parts of the time of a dispatch, and what it cannot be shorter than.
    fn dispatch_table(&self) -> Table {
        let mut table = Table::new(["part of a dispatch", "p50, ms", "p99, ms"]);
        let dispatch = &self.dispatch;
        let mut row = |name: &str, p50_ms: f64, p99_ms: f64| {
            table.row([
                name.to_owned(),
                format!("{p50_ms:.2}"),
                format!("{p99_ms:.2}"),
            ]);
        };
        for part in &dispatch.parts {
            row(part.name, part.p50_ms, part.p99_ms);
        }
        row("all", dispatch.p50_ms, dispatch.p99_ms);
        row(
            "one write with fdatasync",
            dispatch.fsync_p50_ms,
            dispatch.fsync_p99_ms,
        );
        row(
            "one query through a bare router",
            self.query.p50_ms,
            self.query.p99_ms,
        );
        table
    }

    fn checks(&self) -> Vec<Check> {
        let Self {
            ingest, dispatch, ..
        } = self;
        let cpu = Check::of(
            "server CPU per segment, us",
            ingest.server_cpu_us_per_segment,
        );
        let rate = Check::of("segments committed per second", ingest.segments_per_second);
        let receipts = Check::of("ack p99, ms", ingest.ack_p99_ms);
        vec![
            cpu.at_most(SERVER_CPU_US_PER_SEGMENT_MAX),
            Check::of_count("uploads without a receipt", ingest.uploads_failed).exactly(0),
            Check::of_count("acknowledged but lost", ingest.acknowledged_but_lost).exactly(0),
            Check::of_count("counted twice", ingest.counted_twice).exactly(0),
            rate.at_least(SEGMENTS_PER_SECOND_MIN),
            receipts.at_most(ACK_P99_MAX_MS),
            Check::of("dispatch p50, ms", dispatch.p50_ms).at_most(DISPATCH_P50_MAX_MS),
            Check::of("dispatch p99, ms", dispatch.p99_ms).at_most(DISPATCH_P99_MAX_MS),
        ]
    }

    fn words(&self) -> String {
        format!(
            "{} light robots; {}\n{}; one query through a bare router {:.2} / {:.2}\n",
            self.robots,
            self.ingest.words(),
            self.dispatch.words(),
            self.query.p50_ms,
            self.query.p99_ms,
        )
    }
}
