//! Time and identifiers that grow with it, injected: nothing else here asks the machine.

use std::fmt;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use jiff::{SignedDuration, Timestamp};
use tread_api::ids::MissionId;
use uuid::{ContextV7, Uuid};

/// A clock: the machine's, that of a simulated site, or one that a test moves by hand.
#[derive(Debug, Clone)]
pub struct Clock {
    source: Source,
    context: Arc<Mutex<ContextV7>>,
}

#[derive(Clone)]
enum Source {
    System { origin: Instant },
    Site { origin: Instant, wall: SiteWall },
    Manual(Arc<Mutex<ManualTime>>),
}

/// Tells the wall time of a simulated site.
type SiteWall = Arc<dyn Fn() -> Timestamp + Send + Sync>;

impl fmt::Debug for Source {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(match self {
            Self::System { .. } => "System",
            Self::Site { .. } => "Site",
            Self::Manual(_) => "Manual",
        })
    }
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

    /// The wall clock of a simulated site, whose time may go faster than the machine's. What is
    /// reckoned with beside it, as the silence of robots, goes by the machine's.
    #[expect(
        clippy::disallowed_methods,
        reason = "this is where the time comes from"
    )]
    pub fn of_site(wall: impl Fn() -> Timestamp + Send + Sync + 'static) -> Self {
        let (origin, wall) = (Instant::now(), Arc::new(wall) as SiteWall);
        Self::of(Source::Site { origin, wall })
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
            Source::Site { wall, .. } => wall(),
            Source::Manual(time) => lock(time).wall,
        };
        Timestamp::from_microsecond(wall.as_microsecond()).unwrap_or(wall)
    }

    /// Time since an arbitrary origin; it never jumps. For ages and bounds.
    pub fn elapsed(&self) -> Duration {
        match &self.source {
            Source::System { origin } | Source::Site { origin, .. } => origin.elapsed(),
            Source::Manual(time) => lock(time).elapsed,
        }
    }

    /// Moves a manual clock forward; the others move by themselves.
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
    fn a_sites_clock_has_the_sites_wall_time_and_the_machines_ages() {
        let wall: Timestamp = "2031-05-01T00:00:00Z".parse().unwrap();
        let clock = Clock::of_site(move || wall);
        assert_eq!(clock.now(), wall);
        let before = clock.elapsed();
        std::thread::sleep(Duration::from_millis(2));
        assert!(clock.elapsed() > before && clock.now() == wall);
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
