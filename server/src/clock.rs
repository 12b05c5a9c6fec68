//! Time and identifiers that grow with it, injected: nothing else here asks the machine.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use jiff::{SignedDuration, Timestamp};
use tread_api::ids::MissionId;
use uuid::{ContextV7, Uuid};

/// A clock: the machine's, or one that a test moves by hand.
#[derive(Debug, Clone)]
pub struct Clock {
    source: Source,
    context: Arc<Mutex<ContextV7>>,
}

#[derive(Debug, Clone)]
enum Source {
    System { origin: Instant },
    Manual(Arc<Mutex<ManualTime>>),
}

#[derive(Debug)]
struct ManualTime {
    wall: Timestamp,
    elapsed: Duration,
}

impl Clock {
    /// The machine's clock.
    #[expect(
        clippy::disallowed_methods,
        reason = "this is where the time comes from"
    )]
    pub fn system() -> Self {
        let origin = Instant::now();
        Self::of(Source::System { origin })
    }

    /// A clock that stands still until [`Clock::advance`].
    pub fn manual(wall: Timestamp) -> Self {
        let elapsed = Duration::ZERO;
        Self::of(Source::Manual(Arc::new(Mutex::new(ManualTime {
            wall,
            elapsed,
        }))))
    }

    fn of(source: Source) -> Self {
        let context = Arc::new(Mutex::new(ContextV7::new()));
        Self { source, context }
    }

    /// Wall time, UTC, in whole microseconds: as fine as the database keeps it.
    #[expect(
        clippy::disallowed_methods,
        reason = "this is where the time comes from"
    )]
    pub fn now(&self) -> Timestamp {
        let wall = match &self.source {
            Source::System { .. } => Timestamp::now(),
            Source::Manual(time) => lock(time).wall,
        };
        Timestamp::from_microsecond(wall.as_microsecond()).unwrap_or(wall)
    }

    /// Time since an arbitrary origin; it never jumps. For ages and bounds.
    pub fn elapsed(&self) -> Duration {
        match &self.source {
            Source::System { origin } => origin.elapsed(),
            Source::Manual(time) => lock(time).elapsed,
        }
    }

    /// Moves a manual clock forward; the machine's clock moves by itself.
    pub fn advance(&self, span: Duration) {
        if let Source::Manual(time) = &self.source {
            let mut time = lock(time);
            time.elapsed += span;
            time.wall += SignedDuration::try_from(span).unwrap_or(SignedDuration::MAX);
        }
    }

    /// A new mission's identifier; they sort by creation, also within one microsecond.
    pub fn mission_id(&self) -> MissionId {
        let now = self.now();
        let seconds = u64::try_from(now.as_second()).unwrap_or(0);
        let nanos = u32::try_from(now.subsec_nanosecond()).unwrap_or(0);
        let context = lock(&self.context);
        let timestamp = uuid::Timestamp::from_unix(&*context, seconds, nanos);
        MissionId::from_uuid(Uuid::new_v7(timestamp))
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_manual_clock_moves_only_when_told_and_moves_both_times() {
        let clock = Clock::manual("2026-11-01T00:00:00Z".parse().unwrap());
        let (wall, elapsed) = (clock.now(), clock.elapsed());
        assert_eq!((clock.now(), clock.elapsed()), (wall, elapsed));
        clock.advance(Duration::from_millis(1_500));
        assert_eq!(
            clock.now().duration_since(wall),
            SignedDuration::from_millis(1_500)
        );
        assert_eq!(clock.elapsed(), elapsed + Duration::from_millis(1_500));
    }

    #[test]
    fn mission_ids_sort_by_creation_even_while_the_clock_stands() {
        let clock = Clock::manual("2026-11-01T00:00:00Z".parse().unwrap());
        let ids: Vec<String> = (0..1_000).map(|_| clock.mission_id().to_string()).collect();
        assert!(ids.is_sorted());
        assert_eq!(
            ids.iter().collect::<std::collections::BTreeSet<_>>().len(),
            1_000
        );
    }
}
