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
const DISPATCH_P50_MAX_MS: f64 = 15.0;
/// 99 % of the missions move the wheels within this, milliseconds.
const DISPATCH_P99_MAX_MS: f64 = 40.0;

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

    fn checks(&self) -> [Check; 8] {
        let Self {
            ingest, dispatch, ..
        } = self;
        [
            Check::at_least(
                "segments committed per second",
                SEGMENTS_PER_SECOND_MIN,
                ingest.segments_per_second,
            ),
            Check::at_most(
                "server CPU per segment, us",
                SERVER_CPU_US_PER_SEGMENT_MAX,
                ingest.server_cpu_us_per_segment,
            ),
            Check::at_most("ack p99, ms", ACK_P99_MAX_MS, ingest.ack_p99_ms),
            Check::exactly("uploads without a receipt", 0, ingest.uploads_failed),
            Check::exactly("acknowledged but lost", 0, ingest.acknowledged_but_lost),
            Check::exactly("counted twice", 0, ingest.counted_twice),
            Check::at_most("dispatch p50, ms", DISPATCH_P50_MAX_MS, dispatch.p50_ms),
            Check::at_most("dispatch p99, ms", DISPATCH_P99_MAX_MS, dispatch.p99_ms),
        ]
    }

    fn words(&self) -> String {
        let memory_mb = |bytes: u64| bytes / 1_000_000;
        let Ingest {
            server, generator, ..
        } = &self.ingest;
        format!(
            "{} light robots, {:.0} states/s; server {:.1} s CPU, {} MB at most; generator {:.1} s \
             CPU, {} MB at most\nack p50 {:.1} ms, max {:.1} ms; dispatch max {:.1} ms over {} \
             missions\n",
            self.robots,
            self.ingest.states_published_per_second,
            server.cpu_s,
            memory_mb(server.memory_peak_bytes),
            generator.cpu_s,
            memory_mb(generator.memory_peak_bytes),
            self.ingest.ack_p50_ms,
            self.ingest.ack_max_ms,
            self.dispatch.max_ms,
            self.dispatch.missions
        )
    }
}
