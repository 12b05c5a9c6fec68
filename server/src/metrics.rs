//! What is measured of the server, as Prometheus reads it.
//!
//! Counters come from [`crate::counters`]; this adds histograms and what is looked up when it is
//! asked for. The text is written here: the format is a few lines, and nothing of it is dynamic
//! but the routes.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use crate::app::{App, AppError};
use crate::db;

/// Upper bounds of the buckets, seconds.
const BOUNDS_S: [f64; 10] = [0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.5, 1.0, 5.0];
/// Most routes, methods and statuses that are told apart.
const SERIES_MAX: usize = 1_000;

/// How long something took, in buckets.
#[derive(Debug, Default)]
pub struct Histogram {
    buckets: [AtomicU64; BOUNDS_S.len()],
    count: AtomicU64,
    sum_us: AtomicU64,
}

impl Histogram {
    /// Notes one.
    pub fn note(&self, took: Duration) {
        let took_s = took.as_secs_f64();
        for (bucket, bound_s) in self.buckets.iter().zip(BOUNDS_S) {
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
        for (bucket, bound_s) in self.buckets.iter().zip(BOUNDS_S) {
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

fn line(text: &mut String, what: &str) {
    // Writing to a string does not fail.
    let _ = writeln!(text, "{what}");
}

fn head(text: &mut String, name: &str, kind: &str, help: &str) {
    line(text, &format!("# HELP {name} {help}"));
    line(text, &format!("# TYPE {name} {kind}"));
}

impl App {
    /// All metrics as text.
    ///
    /// # Errors
    /// The database failed.
    pub async fn metrics(&self) -> Result<String, AppError> {
        let mut text = String::new();
        let mut tx = self.db().read().await?;
        let counts = db::missions::counts(&mut tx).await?;
        drop(tx);
        head(&mut text, "tread_missions", "gauge", "Missions by state.");
        for state in tread_api::mission::MissionState::ALL {
            let found = counts.iter().find(|(of, _)| *of == state);
            let (name, count) = (state.as_str(), found.map_or(0, |(_, count)| *count));
            line(
                &mut text,
                &format!("tread_missions{{state=\"{name}\"}} {count}"),
            );
        }
        head(&mut text, "tread_robots", "gauge", "Robots by link state.");
        for (link, count) in self.presences().link_counts(self.clock().elapsed()) {
            let name = link.as_str();
            line(
                &mut text,
                &format!("tread_robots{{link=\"{name}\"}} {count}"),
            );
        }
        let name = "tread_robots_reduced";
        let help = "Robots that are heard and slowed down, by the strictest cause.";
        head(&mut text, name, "gauge", help);
        for (cause, count) in self.presences().gate_causes(self.clock().elapsed()) {
            line(&mut text, &format!("{name}{{cause=\"{cause}\"}} {count}"));
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
            head(&mut text, name, "gauge", help);
            line(&mut text, &format!("{name} {value}"));
        }
        let name = "tread_event_clients_dropped_total";
        head(
            &mut text,
            name,
            "counter",
            "Event clients that read too slowly.",
        );
        line(&mut text, &format!("{name} {}", self.hub().dropped_count()));
        let name = "tread_uptime_seconds";
        head(&mut text, name, "gauge", "Time since the start.");
        line(
            &mut text,
            &format!("{name} {}", self.uptime().as_secs_f64()),
        );
        let counters = serde_json::to_value(self.counters().values()).unwrap_or_default();
        for (counter, value) in counters.as_object().into_iter().flatten() {
            let name = format!("tread_{counter}_total");
            head(&mut text, &name, "counter", "See GET /v1/server.");
            line(&mut text, &format!("{name} {value}"));
        }
        let name = "tread_db_write_wait_seconds";
        head(&mut text, name, "histogram", "Wait for the turn to write.");
        self.db().write_waits().write(&mut text, name, "");
        let name = "tread_http_request_seconds";
        head(&mut text, name, "histogram", "Requests by route.");
        let series = &self.requests().series;
        let series = series.lock().unwrap_or_else(PoisonError::into_inner);
        for ((method, route, status), histogram) in series.iter() {
            let labels = format!("method=\"{method}\",route=\"{route}\",status=\"{status}\"");
            histogram.write(&mut text, name, &labels);
        }
        Ok(text)
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
