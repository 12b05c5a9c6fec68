//! What a simulated base truly did, for reports on a run: nothing in the agent may look.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tread_control::measured::WheelSpeeds;
use tread_control::plant::PlantState;

/// The truth at one moment.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TruthSample {
    /// When, by the agent's monotonic clock.
    pub at: Duration,
    /// The true state of the base.
    pub state: PlantState,
    /// What its wheels were commanded.
    pub command: WheelSpeeds,
    /// True θ under its middle, with its own tyres.
    pub theta: f64,
}

#[derive(Debug)]
struct Store {
    every: Duration,
    samples: Vec<TruthSample>,
    missed: u64,
}

/// A store of samples, shared by the base that fills it and whoever reads it. All its room is taken
/// at the start; what comes beyond is counted.
#[derive(Debug, Clone)]
pub struct Trace {
    store: Arc<Mutex<Store>>,
}

impl Trace {
    /// An empty one for a sample each `every`, `samples_max` at the most.
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

    /// Whether a sample is due at that time.
    pub(crate) fn is_due(&self, at: Duration) -> bool {
        let store = self.store();
        let last = store.samples.last();
        last.is_none_or(|last| at.saturating_sub(last.at) >= store.every)
    }

    /// Adds a sample, or counts that there was no room.
    pub(crate) fn add(&self, sample: TruthSample) {
        let mut store = self.store();
        if store.samples.len() < store.samples.capacity() {
            store.samples.push(sample);
        } else {
            store.missed += 1;
        }
    }

    /// The samples so far, oldest first.
    pub fn samples(&self) -> Vec<TruthSample> {
        self.store().samples.clone()
    }

    /// The newest sample.
    pub fn last(&self) -> Option<TruthSample> {
        self.store().samples.last().copied()
    }

    /// Samples for which there was no room.
    pub fn missed(&self) -> u64 {
        self.store().missed
    }
}

/// Two are the same if they share their samples.
impl PartialEq for Trace {
    fn eq(&self, other: &Self) -> bool {
        Arc::ptr_eq(&self.store, &other.store)
    }
}
