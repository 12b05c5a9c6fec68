//! The figures, the goals, and whether they hold.

use std::process::ExitCode;

use serde::Serialize;
use tread_api::wire::encoding::Encoding;
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

/// Segments committed per second with `--saturate`, at the least.
const SATURATED_PER_SECOND_MIN: f64 = 150_000.0;
/// Processor time of the server for each segment with `--saturate`, at the most, microseconds.
const SATURATED_CPU_US_PER_SEGMENT_MAX: f64 = 6.0;
/// Sums of each robot with `--saturate`, at the least.
const SUMS_PER_ROBOT_MIN: f64 = 1_600.0;

/// Everything that was measured.
#[derive(Debug, Serialize)]
pub(crate) struct Details {
    pub(crate) robots: u32,
    pub(crate) encoding: Encoding,
    pub(crate) ingest: Ingest,
    /// Absent with `--saturate`.
    pub(crate) dispatch: Option<Dispatch>,
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
        let cpu_max = if dispatch.is_some() {
            SERVER_CPU_US_PER_SEGMENT_MAX
        } else {
            SATURATED_CPU_US_PER_SEGMENT_MAX
        };
        let mut checks = vec![
            cpu.at_most(cpu_max),
            Check::of_count("uploads without a receipt", ingest.uploads_failed).exactly(0),
            Check::of_count("acknowledged but lost", ingest.acknowledged_but_lost).exactly(0),
            Check::of_count("counted twice", ingest.counted_twice).exactly(0),
        ];
        let rate = Check::of("segments committed per second", ingest.segments_per_second);
        let receipts = Check::of("ack p99, ms", ingest.ack_p99_ms);
        if let Some(dispatch) = dispatch {
            checks.extend([
                rate.at_least(SEGMENTS_PER_SECOND_MIN),
                receipts.at_most(ACK_P99_MAX_MS),
                Check::of("dispatch p50, ms", dispatch.p50_ms).at_most(DISPATCH_P50_MAX_MS),
                Check::of("dispatch p99, ms", dispatch.p99_ms).at_most(DISPATCH_P99_MAX_MS),
            ]);
        } else {
            checks.extend([
                rate.at_least(SATURATED_PER_SECOND_MIN),
                // All robots wait for receipts all the time.
                receipts.shown(),
                Check::of("sums of each robot", ingest.sums_per_robot).at_least(SUMS_PER_ROBOT_MIN),
                Check::so("the database is on a disk", ingest.is_on_disk),
            ]);
        }
        checks
    }

    fn words(&self) -> String {
        let memory_mb = |bytes: u64| bytes / 1_000_000;
        let Ingest {
            server, generator, ..
        } = &self.ingest;
        let dispatch = self.dispatch.as_ref().map_or_else(String::new, |dispatch| {
            format!(
                "; dispatch max {:.1} ms over {} missions",
                dispatch.max_ms, dispatch.missions
            )
        });
        format!(
            "{} light robots, uploads in {}, {:.0} states/s; server {:.1} s CPU, {} MB at most; generator {:.1} s \
             CPU, {} MB at most\nack p50 {:.1} ms, max {:.1} ms{dispatch}\n",
            self.robots,
            self.encoding.media_type(),
            self.ingest.states_published_per_second,
            server.cpu_s,
            memory_mb(server.memory_peak_bytes),
            generator.cpu_s,
            memory_mb(generator.memory_peak_bytes),
            self.ingest.ack_p50_ms,
            self.ingest.ack_max_ms,
        )
    }
}
