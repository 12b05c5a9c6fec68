//! The figures, the goals, and whether they hold.

use std::process::ExitCode;

use serde::Serialize;
use tread_tests::report::{self, Check};

use crate::dispatch::Dispatch;
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
}

impl Details {
    pub(crate) fn tell(&self, json: bool) -> anyhow::Result<ExitCode> {
        report::tell_with(json, self, self.words(), &self.checks())
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
            "{} light robots; {}\n{}\n",
            self.robots,
            self.ingest.words(),
            self.dispatch.words(),
        )
    }
}
