//! As many segments as a server takes, in both encodings, and of the same records a plain server in
//! Python, one after the other in one run.

use std::path::Path;

use serde::Serialize;
use tread_api::wire::encoding::Encoding;
use tread_lab::report::Table;
use tread_tests::light_robot::LightRobot;
use tread_tests::report::Check;

use crate::ingest::{self, Ingest, Pace};
use crate::peers::{PythonService, SqliteFloor, sqlite_floor};
use crate::states::welcome_of;
use crate::{Arguments, connect_light_robots, start_fleet, start_light_robots};

/// Segments committed per second, at the least.
const PER_SECOND_MIN: f64 = 150_000.0;
/// Processor time of the server for each segment, at the most, microseconds.
const SERVER_CPU_US_PER_SEGMENT_MAX: f64 = 6.0;
/// Sums of each robot, at the least: the hardest case is measured.
const SUMS_PER_ROBOT_MIN: f64 = 1_600.0;
/// Part of the saturation at which receipts are measured.
const LOADED_RATIO: f64 = 0.6;
/// 99 % of the receipts at [`LOADED_RATIO`] of the saturation within this, milliseconds.
const LOADED_RECEIPT_P99_MAX_MS: f64 = 100.0;
/// Segments per second over those of the service in Python, at the least.
const OVER_PYTHON_MIN: f64 = 1.5;
/// Segments per second of the service in Python, at the least: below it the comparison is unfair.
const PYTHON_PER_SECOND_MIN: f64 = 75_000.0;

/// What was measured.
#[derive(Debug, Serialize)]
pub(crate) struct Saturation {
    robots: u32,
    cbor: Ingest,
    json: Ingest,
    /// Uploads in CBOR at [`LOADED_RATIO`] of the saturation.
    loaded: Ingest,
    /// The service in Python, with the same records in JSON.
    #[serde(skip_serializing_if = "Option::is_none")]
    python: Option<Ingest>,
    /// SQLite alone.
    #[serde(skip_serializing_if = "Option::is_none")]
    sqlite: Option<SqliteFloor>,
}

pub(crate) async fn measure(arguments: &Arguments, node: &Path) -> anyhow::Result<Saturation> {
    let cbor = tread(arguments, node, Encoding::Cbor, Pace::Saturating).await?;
    let json = tread(arguments, node, Encoding::Json, Pace::Saturating).await?;
    let (python, sqlite) = match &arguments.peers {
        Some(python) => (
            Some(peer(arguments, node, python).await?),
            Some(sqlite_floor(python, arguments.seconds)?),
        ),
        None => (None, None),
    };
    let pace = Pace::PerSecond(LOADED_RATIO * cbor.segments_per_second);
    let loaded = tread(arguments, node, Encoding::Cbor, pace).await?;
    Ok(Saturation {
        robots: arguments.robots,
        cbor,
        json,
        loaded,
        python,
        sqlite,
    })
}

/// Measures a server of its own.
async fn tread(
    arguments: &Arguments,
    node: &Path,
    encoding: Encoding,
    pace: Pace,
) -> anyhow::Result<Ingest> {
    let fleet = start_fleet(node, arguments.tls).await;
    let mut robots = start_light_robots(&fleet, arguments.robots, arguments.tls).await?;
    encode(&mut robots, encoding);
    ingest::measure(arguments, &fleet, robots, pace).await
}

async fn peer(arguments: &Arguments, node: &Path, python: &Path) -> anyhow::Result<Ingest> {
    let (welcome, site) = welcome_of(node).await?;
    let service = PythonService::start(python, &welcome).await?;
    let endpoint = service.zenoh_endpoint();
    let mut robots = connect_light_robots(&endpoint, &site, arguments.robots).await?;
    encode(&mut robots, Encoding::Json);
    ingest::measure(arguments, &service, robots, Pace::Saturating).await
}

fn encode(robots: &mut [LightRobot], encoding: Encoding) {
    for robot in robots {
        robot.encoding = encoding;
    }
}

impl Saturation {
    pub(crate) fn checks(&self) -> Vec<Check> {
        let mut checks = Vec::new();
        for (name, ingest) in [("CBOR", &self.cbor), ("JSON", &self.json)] {
            let rate = Check::of(
                format!("{name}: segments per second"),
                ingest.segments_per_second,
            );
            let cpu = Check::of(
                format!("{name}: server CPU per segment, us"),
                ingest.server_cpu_us_per_segment,
            );
            checks.extend([
                rate.at_least(PER_SECOND_MIN),
                cpu.at_most(SERVER_CPU_US_PER_SEGMENT_MAX),
            ]);
            if let Some(python) = &self.python {
                let ratio = ingest.segments_per_second / python.segments_per_second;
                let name = format!("{name}: segments per second over those of Python");
                checks.push(Check::of(name, ratio).at_least(OVER_PYTHON_MIN));
            }
            let sums = format!("{name}: sums of each robot");
            checks.push(Check::of(sums, ingest.sums_per_robot).at_least(SUMS_PER_ROBOT_MIN));
        }
        let receipt = "CBOR: receipt p99 at 60 % of the saturation, ms";
        checks.push(Check::of(receipt, self.loaded.ack_p99_ms).at_most(LOADED_RECEIPT_P99_MAX_MS));
        let own = [&self.cbor, &self.json, &self.loaded];
        let sum = |count: fn(&Ingest) -> u64| own.iter().map(|ingest| count(ingest)).sum::<u64>();
        checks.extend([
            Check::of_count("uploads without a receipt", sum(|of| of.uploads_failed)).exactly(0),
            Check::of_count("acknowledged but lost", sum(|of| of.acknowledged_but_lost)).exactly(0),
            Check::of_count("counted twice", sum(|of| of.counted_twice)).exactly(0),
            Check::so(
                "the databases are on a disk",
                own.iter().all(|ingest| ingest.is_on_disk),
            ),
        ]);
        if let Some(python) = &self.python {
            let rate = Check::of("Python: segments per second", python.segments_per_second);
            let cpu = "Python: CPU per segment, us";
            checks.extend([
                rate.at_least(PYTHON_PER_SECOND_MIN),
                Check::shown(cpu, python.server_cpu_us_per_segment),
            ]);
        }
        if let Some(sqlite) = &self.sqlite {
            let rate = Check::shown("SQLite alone: rows per second", sqlite.rows_per_second);
            let cpu = Check::shown("SQLite alone: CPU per row, us", sqlite.cpu_us_per_row);
            checks.extend([rate, cpu]);
        }
        checks
    }

    /// Returns the runs under their names.
    fn runs(&self) -> [(&'static str, Option<&Ingest>); 4] {
        [
            ("CBOR", Some(&self.cbor)),
            ("JSON", Some(&self.json)),
            ("CBOR at 60 %", Some(&self.loaded)),
            ("Python", self.python.as_ref()),
        ]
    }

    /// Returns what the servers and SQLite alone reached.
    pub(crate) fn table(&self) -> Table {
        let mut table = Table::new([
            "run",
            "segments/s",
            "over Python",
            "CPU per segment, us",
            "over SQLite alone",
            "receipt p50, ms",
            "receipt p99, ms",
        ]);
        let ratio = |value: f64, of: Option<f64>| {
            of.map_or_else(String::new, |of| format!("{:.2}", value / of))
        };
        let python = self
            .python
            .as_ref()
            .map(|python| python.segments_per_second);
        let floor = self.sqlite.as_ref().map(|sqlite| sqlite.cpu_us_per_row);
        for (name, ingest) in self.runs() {
            let Some(ingest) = ingest else { continue };
            table.row([
                name.to_owned(),
                format!("{:.0}", ingest.segments_per_second),
                ratio(ingest.segments_per_second, python),
                format!("{:.1}", ingest.server_cpu_us_per_segment),
                ratio(ingest.server_cpu_us_per_segment, floor),
                format!("{:.1}", ingest.ack_p50_ms),
                format!("{:.1}", ingest.ack_p99_ms),
            ]);
        }
        if let Some(sqlite) = &self.sqlite {
            table.row([
                "SQLite alone".to_owned(),
                format!("{:.0}", sqlite.rows_per_second),
                ratio(sqlite.rows_per_second, python),
                format!("{:.1}", sqlite.cpu_us_per_row),
                ratio(sqlite.cpu_us_per_row, floor),
            ]);
        }
        table
    }

    pub(crate) fn words(&self) -> String {
        let lines = self
            .runs()
            .into_iter()
            .filter_map(|(name, ingest)| Some(format!("{name}: {}\n", ingest?.words())));
        format!(
            "{} light robots\n{}",
            self.robots,
            lines.collect::<String>()
        )
    }
}
