//! What is measured of the server, as Prometheus reads it.
//!
//! Counters come from [`crate::counters`]; this adds histograms and what is looked up when it is
//! asked for. The text is written here: the format is a few lines, and nothing of it is dynamic
//! but the routes.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::panic::Location;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use tokio::sync::mpsc;
use tread_api::mission::Mission;
use tread_api::problem::ProblemType;

use crate::app::friction::KnownGround;
use crate::app::{App, AppError};
use crate::db;
use crate::db::failure::{self, StorageFailure};

/// Upper bounds of the buckets, seconds.
const BOUNDS_S: [f64; 10] = [0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.5, 1.0, 5.0];
/// Most routes, methods and statuses that are told apart.
const SERIES_MAX: usize = 1_000;
/// Most terrains and robot models that have series of their own.
pub const TERRAIN_SERIES_MAX: usize = 500;

/// Upper bounds of the buckets of missions, seconds.
const MISSION_BOUNDS_S: [f64; 10] = [
    5.0, 15.0, 30.0, 60.0, 120.0, 300.0, 600.0, 1_800.0, 3_600.0, 14_400.0,
];

/// How long something took, in buckets.
#[derive(Debug)]
pub struct Histogram {
    bounds_s: [f64; BOUNDS_S.len()],
    buckets: [AtomicU64; BOUNDS_S.len()],
    count: AtomicU64,
    sum_us: AtomicU64,
}

impl Default for Histogram {
    fn default() -> Self {
        Self::of(BOUNDS_S)
    }
}

impl Histogram {
    fn of(bounds_s: [f64; BOUNDS_S.len()]) -> Self {
        Self {
            bounds_s,
            buckets: Default::default(),
            count: AtomicU64::default(),
            sum_us: AtomicU64::default(),
        }
    }

    /// Notes one.
    pub fn note(&self, took: Duration) {
        let took_s = took.as_secs_f64();
        for (bucket, bound_s) in self.buckets.iter().zip(self.bounds_s) {
            if took_s <= bound_s {
                bucket.fetch_add(1, Ordering::Relaxed);
            }
        }
        let micros = u64::try_from(took.as_micros()).unwrap_or(u64::MAX);
        self.sum_us.fetch_add(micros, Ordering::Relaxed);
        self.count.fetch_add(1, Ordering::Relaxed);
    }

    fn write(&self, text: &mut String, name: &str, labels: &str) {
        let comma = if labels.is_empty() { "" } else { "," };
        let count = self.count.load(Ordering::Relaxed);
        for (bucket, bound_s) in self.buckets.iter().zip(self.bounds_s) {
            let value = bucket.load(Ordering::Relaxed);
            line(
                text,
                &format!("{name}_bucket{{{labels}{comma}le=\"{bound_s}\"}} {value}"),
            );
        }
        line(
            text,
            &format!("{name}_bucket{{{labels}{comma}le=\"+Inf\"}} {count}"),
        );
        #[expect(clippy::cast_precision_loss, reason = "a sum of times, for people")]
        let sum_s = self.sum_us.load(Ordering::Relaxed) as f64 * 1e-6;
        line(text, &format!("{name}_sum{{{labels}}} {sum_s}"));
        line(text, &format!("{name}_count{{{labels}}} {count}"));
    }
}

/// Requests by route.
#[derive(Debug, Default)]
pub struct Requests {
    series: Mutex<BTreeMap<(String, String, u16), Histogram>>,
}

impl Requests {
    /// Notes one request: its method, the pattern of its route, and its answer's status.
    pub fn note(&self, method: &str, route: &str, status: u16, took: Duration) {
        let mut series = self.series.lock().unwrap_or_else(PoisonError::into_inner);
        let key = (method.to_owned(), route.to_owned(), status);
        if series.len() < SERIES_MAX || series.contains_key(&key) {
            series.entry(key).or_default().note(took);
        }
    }
}

/// Transactions by kind: by the use case that began them, and whether they write.
#[derive(Debug, Default)]
pub struct Transactions {
    series: Mutex<BTreeMap<(&'static str, bool), Histogram>>,
}

impl Transactions {
    /// Notes one, from its turn to its end: where it was begun, and whether it writes.
    pub fn note(&self, begun: &'static Location<'static>, writes: bool, took: Duration) {
        let file = begun.file();
        let kind = file.rsplit_once("src/").map_or(file, |(_, file)| file);
        let kind = kind.trim_start_matches("app/").trim_end_matches(".rs");
        let mut series = self.series.lock().unwrap_or_else(PoisonError::into_inner);
        // As many as there are source files.
        series.entry((kind, writes)).or_default().note(took);
    }
}

/// Answers that refuse, by the type of their problem.
#[derive(Debug, Default)]
pub struct Refusals {
    series: Mutex<BTreeMap<String, u64>>,
}

impl Refusals {
    /// Counts one.
    pub fn note(&self, kind: ProblemType) {
        let named = serde_json::to_value(kind).unwrap_or_default();
        let reason = named.as_str().unwrap_or_default();
        let reason = reason.trim_start_matches("/problems/").to_owned();
        let mut series = self.series.lock().unwrap_or_else(PoisonError::into_inner);
        *series.entry(reason).or_default() += 1;
    }
}

/// How long missions took from their start on the robot to their end, by the end.
#[derive(Debug, Default)]
pub struct MissionDurations {
    series: Mutex<BTreeMap<&'static str, Histogram>>,
}

impl MissionDurations {
    /// Notes a mission that has ended; one that never began has no duration.
    pub fn note(&self, mission: &Mission) {
        let (Some(began), Some(ended)) = (mission.started_at, mission.ended_at) else {
            return;
        };
        let took = Duration::try_from(ended.duration_since(began)).unwrap_or_default();
        let mut series = self.series.lock().unwrap_or_else(PoisonError::into_inner);
        let histogram = series.entry(mission.state.as_str());
        histogram
            .or_insert_with(|| Histogram::of(MISSION_BOUNDS_S))
            .note(took);
    }
}

/// One number of what is known of a terrain.
type NumberOf = fn(&KnownGround) -> f64;

type Depth = Box<dyn Fn() -> usize + Send + Sync>;

/// The server's queues, looked at when somebody asks.
#[derive(Default)]
pub struct Queues {
    depths: Mutex<Vec<(&'static str, Depth)>>,
}

impl std::fmt::Debug for Queues {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Queues").finish_non_exhaustive()
    }
}

impl Queues {
    /// Shows a queue under a name, for as long as somebody can still send into it.
    pub fn show<T: Send + 'static>(&self, name: &'static str, queue: &mpsc::Sender<T>) {
        let queue = queue.downgrade();
        let depth = move || {
            let waiting = |queue: mpsc::Sender<T>| queue.max_capacity() - queue.capacity();
            queue.upgrade().map_or(0, waiting)
        };
        let mut depths = self.depths.lock().unwrap_or_else(PoisonError::into_inner);
        depths.push((name, Box::new(depth)));
    }

    fn write(&self, text: &mut String) {
        let name = "tread_queue_depth";
        head(text, name, "gauge", "What waits in each queue.");
        let depths = self.depths.lock().unwrap_or_else(PoisonError::into_inner);
        for (queue, depth) in depths.iter() {
            line(text, &format!("{name}{{queue=\"{queue}\"}} {}", depth()));
        }
    }
}

fn line(text: &mut String, what: &str) {
    // Writing to a string does not fail.
    let _ = writeln!(text, "{what}");
}

fn head(text: &mut String, name: &str, kind: &str, help: &str) {
    line(text, &format!("# HELP {name} {help}"));
    line(text, &format!("# TYPE {name} {kind}"));
}

/// Reasons to refuse whoever asks over HTTP, before the request is looked at.
const OF_CLIENTS: [&str; 10] = [
    "host",
    "locked",
    "no_token",
    "origin",
    "role",
    "token_expired",
    "token_malformed",
    "token_revoked",
    "token_unknown",
    "too_long",
];

impl App {
    /// All metrics as text; those that come from the database are missing while it cannot be read.
    pub async fn metrics(&self) -> String {
        let mut text = String::new();
        self.write_storage(&mut text);
        // What is in memory is shown also while the database cannot be read.
        for written in [
            self.write_fleet(&mut text).await,
            self.write_ground(&mut text).await,
        ] {
            if let Err(error) = written {
                self.log_failure("read metrics", &error);
            }
        }
        self.write_clients(&mut text);
        let name = "tread_uptime_seconds";
        head(&mut text, name, "gauge", "Time since the start.");
        line(
            &mut text,
            &format!("{name} {}", self.uptime().as_secs_f64()),
        );
        self.write_clock(&mut text);
        let counters = serde_json::to_value(self.counters().values()).unwrap_or_default();
        for (counter, value) in counters.as_object().into_iter().flatten() {
            let name = format!("tread_{counter}_total");
            head(&mut text, &name, "counter", "See GET /v1/server.");
            line(&mut text, &format!("{name} {value}"));
        }
        self.queues().write(&mut text);
        self.write_refusals(&mut text, counters.as_object());
        self.write_durations(&mut text);
        text
    }

    /// What the storage was found to be.
    fn write_storage(&self, text: &mut String) {
        let condition = self.storage_condition();
        let gauges = [
            (
                "tread_storage_writable",
                Some(u64::from(condition.unwritable.is_none())),
                "Whether the database takes writes.",
            ),
            (
                "tread_storage_damaged",
                Some(u64::from(condition.damaged.is_some())),
                "Whether the database is known to be damaged.",
            ),
            (
                "tread_storage_disk_low",
                Some(u64::from(condition.is_disk_low)),
                "Whether less is free on the disk of the database than configured.",
            ),
            (
                "tread_storage_disk_free_bytes",
                condition.disk_free_bytes,
                "Free bytes on the disk of the database.",
            ),
        ];
        for (name, value, help) in gauges {
            if let Some(value) = value {
                head(text, name, "gauge", help);
                line(text, &format!("{name} {value}"));
            }
        }
        let name = "tread_storage_failures_total";
        head(text, name, "counter", "Failures of the storage, by kind.");
        for failure in StorageFailure::ALL {
            let (kind, count) = (failure.as_str(), failure::count(failure));
            line(text, &format!("{name}{{kind=\"{kind}\"}} {count}"));
        }
    }

    /// What the machine's clock did.
    fn write_clock(&self, text: &mut String) {
        // So that a step shows although nothing else asked for the time.
        self.clock().now();
        let steps = self.clock().steps();
        let name = "tread_clock_steps_total";
        head(text, name, "counter", "Steps of the machine's clock.");
        for (direction, count) in [("back", steps.back), ("forward", steps.forward)] {
            line(
                text,
                &format!("{name}{{direction=\"{direction}\"}} {count}"),
            );
        }
        let name = "tread_clock_ahead_seconds";
        let help = "How far the server's time is ahead of the machine's clock, which was set back.";
        head(text, name, "gauge", help);
        line(text, &format!("{name} {}", steps.ahead.as_secs_f64()));
    }

    /// Missions, robots and stops.
    async fn write_fleet(&self, text: &mut String) -> Result<(), AppError> {
        let mut tx = self.db().read().await?;
        let counts = db::missions::counts(&mut tx).await?;
        drop(tx);
        head(text, "tread_missions", "gauge", "Missions by state.");
        for state in tread_api::mission::MissionState::ALL {
            let found = counts.iter().find(|(of, _)| *of == state);
            let (name, count) = (state.as_str(), found.map_or(0, |(_, count)| *count));
            line(text, &format!("tread_missions{{state=\"{name}\"}} {count}"));
        }
        head(text, "tread_robots", "gauge", "Robots by link state.");
        for (link, count) in self.presences().link_counts(self.clock().elapsed()) {
            let name = link.as_str();
            line(text, &format!("tread_robots{{link=\"{name}\"}} {count}"));
        }
        let name = "tread_robots_reduced";
        let help = "Robots that are heard and slowed down, by the strictest cause.";
        head(text, name, "gauge", help);
        for (cause, count) in self.presences().gate_causes(self.clock().elapsed()) {
            line(text, &format!("{name}{{cause=\"{cause}\"}} {count}"));
        }
        let stops = self.stops_in_force().await?;
        let open = stops.iter().filter(|stop| stop.unconfirmed).count();
        let gauges = [
            (
                "tread_stops_in_force",
                stops.len(),
                "Stops that are not cleared.",
            ),
            (
                "tread_stops_unconfirmed",
                open,
                "Stops that their robots have not confirmed within 300 ms.",
            ),
        ];
        for (name, value, help) in gauges {
            head(text, name, "gauge", help);
            line(text, &format!("{name} {value}"));
        }
        Ok(())
    }

    /// What is known of terrains.
    async fn write_ground(&self, text: &mut String) -> Result<(), AppError> {
        let (known, left_out) = self.known_of_terrains(TERRAIN_SERIES_MAX).await?;
        let gauges: [(&str, NumberOf, &str); 3] = [
            (
                "tread_terrain_theta",
                |known| known.theta,
                "Slip per friction coefficient of each terrain that was measured, by robot model.",
            ),
            (
                "tread_terrain_theta_std_dev",
                |known| known.std_dev,
                "Its standard deviation.",
            ),
            (
                "tread_terrain_age_seconds",
                |known| known.age_s,
                "Age of its newest measurement.",
            ),
        ];
        for (name, value_of, help) in gauges {
            head(text, name, "gauge", help);
            for known in &known {
                let KnownGround {
                    site,
                    terrain,
                    configuration,
                    ..
                } = known;
                let labels = format!(
                    "site=\"{site}\",terrain=\"{terrain}\",configuration=\"{configuration}\""
                );
                line(text, &format!("{name}{{{labels}}} {}", value_of(known)));
            }
        }
        let name = "tread_terrain_series_left_out";
        let help = "Terrains and robot models beyond those that have series of their own.";
        head(text, name, "gauge", help);
        line(text, &format!("{name} {left_out}"));
        Ok(())
    }

    /// Those who drive by hand and those who read events.
    fn write_clients(&self, text: &mut String) {
        let gauges = [
            (
                "tread_drive_clients",
                self.drive_clients(),
                "Drive sockets that are open.",
            ),
            (
                "tread_event_clients",
                self.hub().client_count(),
                "Event clients.",
            ),
            (
                "tread_event_buffer_longest",
                self.hub().longest_buffer(),
                "Most events that wait for one client.",
            ),
        ];
        for (name, value, help) in gauges {
            head(text, name, "gauge", help);
            line(text, &format!("{name} {value}"));
        }
        let name = "tread_event_clients_dropped_total";
        head(text, name, "counter", "Event clients that read too slowly.");
        line(text, &format!("{name} {}", self.hub().dropped_count()));
    }

    /// How long things took.
    fn write_durations(&self, text: &mut String) {
        let name = "tread_mission_seconds";
        head(
            text,
            name,
            "histogram",
            "Missions from start to end, by end.",
        );
        let series = &self.mission_durations().series;
        let series = series.lock().unwrap_or_else(PoisonError::into_inner);
        for (state, histogram) in series.iter() {
            histogram.write(text, name, &format!("state=\"{state}\""));
        }
        drop(series);
        let name = "tread_db_transaction_seconds";
        head(text, name, "histogram", "Transactions by use case.");
        let series = &self.db().transactions().series;
        let series = series.lock().unwrap_or_else(PoisonError::into_inner);
        for ((kind, writes), histogram) in series.iter() {
            let labels = format!("kind=\"{kind}\",writes=\"{writes}\"");
            histogram.write(text, name, &labels);
        }
        drop(series);
        let name = "tread_db_write_wait_seconds";
        head(text, name, "histogram", "Wait for the turn to write.");
        self.db().write_waits().write(text, name, "");
        let name = "tread_http_request_seconds";
        head(text, name, "histogram", "Requests by route.");
        let series = &self.requests().series;
        let series = series.lock().unwrap_or_else(PoisonError::into_inner);
        for ((method, route, status), histogram) in series.iter() {
            let labels = format!("method=\"{method}\",route=\"{route}\",status=\"{status}\"");
            histogram.write(text, name, &labels);
        }
    }

    /// What was refused, by reason: of robots by the counters that say so, of clients by those of
    /// identity, of requests by the problem.
    fn write_refusals(
        &self,
        text: &mut String,
        counters: Option<&serde_json::Map<String, serde_json::Value>>,
    ) {
        let name = "tread_refusals_total";
        head(text, name, "counter", "What was refused, by reason.");
        for (counter, value) in counters.into_iter().flatten() {
            let of_message = counter.strip_prefix("refused_");
            let of_record = ["records_refused", "reports_foreign", "missions_disowned"];
            let listed = of_record
                .contains(&counter.as_str())
                .then_some(counter.as_str());
            if let Some(reason) = of_message.or(listed) {
                let of = if OF_CLIENTS.contains(&reason) {
                    "client"
                } else {
                    "robot"
                };
                let labels = format!("of=\"{of}\",reason=\"{reason}\"");
                line(text, &format!("{name}{{{labels}}} {value}"));
            }
        }
        let series = &self.refusals().series;
        let series = series.lock().unwrap_or_else(PoisonError::into_inner);
        for (reason, count) in series.iter() {
            let labels = format!("of=\"request\",reason=\"{reason}\"");
            line(text, &format!("{name}{{{labels}}} {count}"));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn buckets_count_what_is_at_most_their_bound() {
        let histogram = Histogram::default();
        for took_ms in [1, 4, 400] {
            histogram.note(Duration::from_millis(took_ms));
        }
        let mut text = String::new();
        histogram.write(&mut text, "t", "");
        for said in [
            "t_bucket{le=\"0.001\"} 1\n",
            "t_bucket{le=\"0.005\"} 2\n",
            "t_bucket{le=\"0.5\"} 3\n",
            "t_bucket{le=\"+Inf\"} 3\n",
            "t_count{} 3\n",
        ] {
            assert!(text.contains(said), "{text}");
        }
    }
}
