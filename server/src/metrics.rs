//! Prometheus metrics that are recorded during operation: durations, refusals, queue depths.
//! [`crate::app::metrics`] adds those that are computed at each scrape.
//!
//! Every metric is a handle, whose clones record into the same series. Labels have fixed sets of
//! values, so the number of series is bounded.

use std::fmt;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use prometheus_client::encoding::EncodeLabelSet;
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::{Family, MetricConstructor};
use prometheus_client::metrics::histogram::Histogram;
use prometheus_client::registry::{Registry, Unit};
use tokio::sync::mpsc;
use tread_api::mission::MissionState;
use tread_api::problem::ProblemType;
use tread_store::metrics::BOUNDS_S;
pub use tread_store::metrics::{DatabaseMetrics, SLOW_AFTER, SlowUseCase};

/// Upper bounds of the histogram buckets of missions, in seconds.
const MISSION_BOUNDS_S: [f64; 10] = [
    5.0, 15.0, 30.0, 60.0, 120.0, 300.0, 600.0, 1_800.0, 3_600.0, 14_400.0,
];
/// HTTP methods with a label of their own; others have the label `other`.
const METHODS: [&str; 7] = ["DELETE", "GET", "HEAD", "OPTIONS", "PATCH", "POST", "PUT"];

/// Constructor of a family's histograms, with upper bounds of their buckets in seconds.
#[derive(Debug, Clone, Copy)]
struct Bounds([f64; 10]);

impl MetricConstructor<Histogram> for Bounds {
    fn new_metric(&self) -> Histogram {
        Histogram::new(self.0)
    }
}

/// Histograms of durations in seconds, by labels.
type Durations<L> = Family<L, Histogram, Bounds>;

/// An answered HTTP request.
#[derive(Debug, Clone, Copy)]
pub struct AnsweredRequest<'request> {
    /// Its method.
    pub method: &'request str,
    /// Pattern of its route.
    pub route: &'request str,
    /// Status of the response.
    pub status: u16,
    /// Time until the response.
    pub took: Duration,
}

/// Labels of an HTTP request.
#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct RequestLabels {
    method: &'static str,
    route: String,
    status: u16,
}

/// Labels of a refusal.
#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
pub struct Refusal {
    /// Refused party: `client`, `request` or `robot`.
    pub of: &'static str,
    /// Reason: the name of a counter, or the type of a problem without `/problems/`.
    pub reason: String,
}

/// Metrics of the use cases and of the REST API.
#[derive(Debug, Clone)]
pub struct Metrics {
    requests: Durations<RequestLabels>,
    missions: Durations<[(&'static str, &'static str); 1]>,
    refusals: Family<Refusal, Counter>,
    queues: Queues,
}

impl Default for Metrics {
    fn default() -> Self {
        let missions = Durations::new_with_constructor(Bounds(MISSION_BOUNDS_S));
        // Create a series for each final state, so that one that has not occurred is zero, not
        // absent.
        for end in MissionState::ALL
            .into_iter()
            .filter(|state| state.is_terminal())
        {
            drop(missions.get_or_create(&[("state", end.as_str())]));
        }
        Self {
            requests: Family::new_with_constructor(Bounds(BOUNDS_S)),
            missions,
            refusals: Family::default(),
            queues: Queues::default(),
        }
    }
}

impl Metrics {
    /// Records a request.
    pub fn request(&self, answered: &AnsweredRequest<'_>) {
        let of = RequestLabels {
            // Clients choose the method, so unknown ones share a label.
            method: METHODS
                .into_iter()
                .find(|known| *known == answered.method)
                .unwrap_or("other"),
            route: answered.route.to_owned(),
            status: answered.status,
        };
        let histogram = self.requests.get_or_create(&of);
        histogram.observe(answered.took.as_secs_f64());
    }

    /// Records a refused request by the type of its problem.
    pub fn request_refused(&self, kind: ProblemType) {
        self.refusals.get_or_create(&of_request(kind)).inc();
    }

    /// Records a mission that ended: its final state, and the time from its start on the robot to
    /// its end.
    pub fn mission(&self, ended: MissionState, took: Duration) {
        let histogram = self.missions.get_or_create(&[("state", ended.as_str())]);
        histogram.observe(took.as_secs_f64());
    }

    /// Returns the queues whose depths are exported.
    pub fn queues(&self) -> &Queues {
        &self.queues
    }

    /// Adds these metrics to a registry. `others` are further refusals with their counts.
    pub fn register(&self, registry: &mut Registry, others: Vec<(Refusal, u64)>) {
        let mission = self.missions.clone();
        let help = "Missions from start to end, by end";
        registry.register_with_unit("tread_mission", help, Unit::Seconds, mission);
        let requests = self.requests.clone();
        let help = "Requests by route";
        registry.register_with_unit("tread_http_request", help, Unit::Seconds, requests);
        let refusals = Family::<Refusal, Counter>::default();
        let of_requests = ProblemType::ALL.map(of_request).into_iter();
        let of_requests = of_requests.filter_map(|of| {
            let count = self.refusals.get(&of)?.get();
            Some((of, count))
        });
        for (of, count) in of_requests.chain(others) {
            refusals.get_or_create(&of).inc_by(count);
        }
        let help = "What was refused, by reason";
        registry.register("tread_refusals", help, refusals);
    }
}

/// Returns the labels of a request that was refused with a problem of this type.
fn of_request(kind: ProblemType) -> Refusal {
    let named = serde_json::to_value(kind).unwrap_or_default();
    let reason = named.as_str().unwrap_or_default();
    Refusal {
        of: "request",
        reason: reason.trim_start_matches("/problems/").to_owned(),
    }
}

type Depth = Box<dyn Fn() -> usize + Send + Sync>;

/// Depths of the server's queues, read at each scrape; clones share the list of queues.
#[derive(Clone, Default)]
pub struct Queues {
    depths: Arc<Mutex<Vec<(&'static str, Depth)>>>,
}

impl fmt::Debug for Queues {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Queues").finish_non_exhaustive()
    }
}

impl Queues {
    /// Exports the depth of a queue under `name`; it is 0 once all senders are dropped.
    pub fn show<T: Send + 'static>(&self, name: &'static str, queue: &mpsc::Sender<T>) {
        let queue = queue.downgrade();
        let depth = move || {
            let waiting = |queue: mpsc::Sender<T>| queue.max_capacity() - queue.capacity();
            queue.upgrade().map_or(0, waiting)
        };
        let mut depths = self.depths.lock().unwrap_or_else(PoisonError::into_inner);
        depths.push((name, Box::new(depth)));
    }

    /// Exports a depth under `name` that its owner stores in the returned number.
    pub fn show_count(&self, name: &'static str) -> Arc<AtomicUsize> {
        let count = Arc::new(AtomicUsize::new(0));
        let shown = Arc::clone(&count);
        let mut depths = self.depths.lock().unwrap_or_else(PoisonError::into_inner);
        depths.push((name, Box::new(move || shown.load(Ordering::Relaxed))));
        count
    }

    /// Returns the depth of each queue, by its name.
    pub fn depths(&self) -> Vec<(&'static str, usize)> {
        let depths = self.depths.lock().unwrap_or_else(PoisonError::into_inner);
        depths
            .iter()
            .map(|(name, depth)| (*name, depth()))
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use prometheus_client::encoding::text::encode;

    use super::*;

    #[test]
    fn whoever_asks_does_not_choose_how_many_series_there_are() {
        let metrics = Metrics::default();
        for method in ["GET", "BREW", "WHEN"] {
            metrics.request(&AnsweredRequest {
                method,
                route: "/v1/robots",
                status: 200,
                took: Duration::from_millis(4),
            });
        }
        let mut registry = Registry::default();
        metrics.register(&mut registry, Vec::new());
        let mut text = String::new();
        encode(&mut text, &registry).unwrap();
        for line in [
            "tread_http_request_seconds_count{method=\"GET\",route=\"/v1/robots\",status=\"200\"} 1",
            "tread_http_request_seconds_count{method=\"other\",route=\"/v1/robots\",status=\"200\"} 2",
        ] {
            assert!(
                text.lines().any(|said| said == line),
                "{line} is not in {text}"
            );
        }
    }
}
