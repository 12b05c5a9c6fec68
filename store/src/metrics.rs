//! Prometheus metrics of the store's transactions.

use std::fmt;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use prometheus_client::encoding::{EncodeLabelSet, EncodeLabelValue, LabelValueEncoder};
use prometheus_client::metrics::counter::ConstCounter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::histogram::Histogram;
use prometheus_client::registry::{Registry, Unit};

/// Upper bounds of the histogram buckets of requests and transactions, in seconds.
pub const BOUNDS_S: [f64; 10] = [0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.5, 1.0, 5.0];
/// Duration from which a transaction of the database counts as slow.
pub const SLOW_AFTER: Duration = Duration::from_millis(500);

/// Labels of a database transaction: the use case, and whether it writes.
#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct TransactionLabels {
    kind: &'static str,
    writes: BoolLabel,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
struct BoolLabel(bool);

impl EncodeLabelValue for BoolLabel {
    fn encode(&self, encoder: &mut LabelValueEncoder<'_>) -> fmt::Result {
        fmt::Write::write_str(encoder, if self.0 { "true" } else { "false" })
    }
}

/// Slow transactions of one use case.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SlowUseCase {
    /// Name of the use case.
    pub kind: &'static str,
    /// Whether its transactions write.
    pub writes: bool,
    /// Number of slow ones.
    pub count: u64,
    /// Duration of the longest.
    pub longest: Duration,
}

/// Slow transactions by use case: one entry for each name in the code, so their number is bounded.
type Slow = Arc<Mutex<Vec<SlowUseCase>>>;

/// Metrics of the database.
#[derive(Debug, Clone)]
pub struct DatabaseMetrics {
    transactions: Family<TransactionLabels, Histogram, fn() -> Histogram>,
    write_waits: Histogram,
    slow: Slow,
}

impl Default for DatabaseMetrics {
    fn default() -> Self {
        Self {
            transactions: Family::new_with_constructor(|| Histogram::new(BOUNDS_S)),
            write_waits: Histogram::new(BOUNDS_S),
            slow: Slow::default(),
        }
    }
}

impl DatabaseMetrics {
    /// Records a transaction: its use case, whether it writes, and its duration from begin to end.
    pub fn transaction(&self, kind: &'static str, writes: bool, took: Duration) {
        let of = TransactionLabels {
            kind,
            writes: BoolLabel(writes),
        };
        let histogram = self.transactions.get_or_create(&of);
        histogram.observe(took.as_secs_f64());
        if took >= SLOW_AFTER {
            self.record_slow(kind, writes, took);
        }
    }

    fn record_slow(&self, kind: &'static str, writes: bool, took: Duration) {
        let mut slow = self.slow.lock().unwrap_or_else(PoisonError::into_inner);
        let is_same = |of: &&mut SlowUseCase| (of.kind, of.writes) == (kind, writes);
        match slow.iter_mut().find(is_same) {
            Some(of) => {
                of.count += 1;
                of.longest = of.longest.max(took);
            }
            None => slow.push(SlowUseCase {
                kind,
                writes,
                count: 1,
                longest: took,
            }),
        }
    }

    /// Returns the use cases with slow transactions, the slowest first.
    pub fn slow(&self) -> Vec<SlowUseCase> {
        let slow = self.slow.lock().unwrap_or_else(PoisonError::into_inner);
        let mut slow = slow.clone();
        slow.sort_by_key(|of| std::cmp::Reverse(of.longest));
        slow
    }

    /// Records the time that a write transaction waited for the writer's lock.
    pub fn write_wait(&self, took: Duration) {
        self.write_waits.observe(took.as_secs_f64());
    }

    /// Adds these metrics to a registry.
    pub fn register(&self, registry: &mut Registry) {
        let help = "Transactions by use case";
        let metric = self.transactions.clone();
        registry.register_with_unit("tread_db_transaction", help, Unit::Seconds, metric);
        let help = "Wait for the turn to write";
        let metric = self.write_waits.clone();
        registry.register_with_unit("tread_db_write_wait", help, Unit::Seconds, metric);
        let slow = self.slow().iter().map(|of| of.count).sum::<u64>();
        let help = "Transactions that took half a second or longer";
        registry.register("tread_db_slow_transactions", help, ConstCounter::new(slow));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn slow_transactions_are_listed_by_use_case_the_slowest_first() {
        let metrics = DatabaseMetrics::default();
        for (kind, took_ms) in [("a", 499), ("b", 500), ("c", 900), ("b", 700)] {
            metrics.transaction(kind, true, Duration::from_millis(took_ms));
        }
        let listed: Vec<_> = metrics
            .slow()
            .into_iter()
            .map(|of| (of.kind, of.count, of.longest.as_millis()))
            .collect();
        assert_eq!(listed, [("c", 1, 900), ("b", 2, 700)]);
    }
}
