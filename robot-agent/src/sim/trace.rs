//! Records the true state of a simulated base, for reports on a run; the agent does not read it.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tread_control::measured::WheelSpeeds;
use tread_control::plant::PlantState;

/// True state at one time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TruthSample {
    /// Time, by the agent's monotonic clock.
    pub at: Duration,
    /// The true state of the base.
    pub state: PlantState,
    /// Commanded wheel speeds.
    pub command: WheelSpeeds,
    /// True θ under its centre, with its own tyres.
    pub theta: f64,
}

#[derive(Debug)]
struct Store {
    every: Duration,
    samples: Vec<TruthSample>,
    missed: u64,
}

/// Shared store of samples. All its memory is allocated at the start; samples beyond it are
/// counted.
#[derive(Debug, Clone)]
pub struct Trace {
    store: Arc<Mutex<Store>>,
}

impl Trace {
    /// Creates an empty store with one sample per `every`, at most `samples_max`.
    pub fn new(every: Duration, samples_max: usize) -> Self {
        let store = Store {
            every,
            samples: Vec::with_capacity(samples_max),
            missed: 0,
        };
        Self {
            store: Arc::new(Mutex::new(store)),
        }
    }

    fn store(&self) -> MutexGuard<'_, Store> {
        self.store.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Whether a sample is due at `at`.
    pub(crate) fn is_due(&self, at: Duration) -> bool {
        let store = self.store();
        let last = store.samples.last();
        last.is_none_or(|last| at.saturating_sub(last.at) >= store.every)
    }

    /// Adds a sample, or counts it as missed if the store is full.
    pub(crate) fn add(&self, sample: TruthSample) {
        let mut store = self.store();
        if store.samples.len() < store.samples.capacity() {
            store.samples.push(sample);
        } else {
            store.missed += 1;
        }
    }

    /// Returns the samples so far, oldest first.
    pub fn samples(&self) -> Vec<TruthSample> {
        self.store().samples.clone()
    }

    /// Returns the newest sample.
    pub fn last(&self) -> Option<TruthSample> {
        self.store().samples.last().copied()
    }

    /// Returns the number of samples that found the store full.
    pub fn missed(&self) -> u64 {
        self.store().missed
    }
}

/// Two traces are equal if they share their samples.
impl PartialEq for Trace {
    fn eq(&self, other: &Self) -> bool {
        Arc::ptr_eq(&self.store, &other.store)
    }
}
