//! The injected clock: wall time, monotonic time and time-ordered identifiers. No other module of
//! the server reads the machine's clocks.
//!
//! The wall time of [`Clock::now`] does not decrease while the process runs, except after a large
//! step. When the machine's clock steps back by up to [`STEP_BACK_HELD_MAX`], this clock advances
//! at half the rate from the last time returned until the machine's clock has caught up. It follows
//! a larger step back at once, because a clock that was more than a day ahead was wrong. Over
//! restarts, SQL also keeps the order of the times within one history.

mod floor;

use std::fmt;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use jiff::{SignedDuration, Timestamp};
use tracing::{info, warn};
use uuid::{ContextV7, Uuid};

pub use self::floor::{ClockSteps, STEP_BACK_HELD_MAX, STEP_NOTED_MIN};
use self::floor::{Floor, Mark, Step};

/// A clock with one of three sources: the machine, a simulated site, or a test that sets the time.
#[derive(Debug, Clone)]
pub struct Clock {
    source: Source,
    floor: Arc<Mutex<Floor>>,
    identifiers: Arc<Mutex<Identifiers>>,
}

/// State that keeps identifiers in the order of their creation.
#[derive(Debug)]
struct Identifiers {
    /// Keeps the order within this process, even for equal or decreasing times.
    context: ContextV7,
    /// Earliest time of a new identifier.
    not_before: Timestamp,
}

#[derive(Clone)]
enum Source {
    System { origin: Instant },
    Site { origin: Instant, wall: SiteWall },
    Manual(Arc<Mutex<ManualTime>>),
}

/// Function that returns the wall time of a simulated site.
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

impl Source {
    #[expect(
        clippy::disallowed_methods,
        reason = "this is where the time comes from"
    )]
    fn wall(&self) -> Timestamp {
        match self {
            Self::System { .. } => Timestamp::now(),
            Self::Site { wall, .. } => wall(),
            Self::Manual(time) => lock(time).wall,
        }
    }

    fn elapsed(&self) -> Duration {
        match self {
            Self::System { origin } | Self::Site { origin, .. } => origin.elapsed(),
            Self::Manual(time) => lock(time).elapsed,
        }
    }

    /// Returns whether wall time and monotonic time advance at the same rate, so that a step
    /// forward can be detected.
    const fn has_one_pace(&self) -> bool {
        match self {
            Self::System { .. } | Self::Manual(_) => true,
            Self::Site { .. } => false,
        }
    }
}

#[derive(Debug)]
struct ManualTime {
    wall: Timestamp,
    elapsed: Duration,
}

impl Clock {
    /// Returns the machine's clock.
    #[expect(
        clippy::disallowed_methods,
        reason = "this is where the time comes from"
    )]
    pub fn system() -> Self {
        let origin = Instant::now();
        Self::of(Source::System { origin })
    }

    /// Returns the clock of a simulated site, whose wall time may advance faster than the
    /// machine's. Ages and timeouts, such as those of silent robots, still use the machine's
    /// monotonic clock.
    #[expect(
        clippy::disallowed_methods,
        reason = "this is where the time comes from"
    )]
    pub fn of_site(wall: impl Fn() -> Timestamp + Send + Sync + 'static) -> Self {
        let (origin, wall) = (Instant::now(), Arc::new(wall) as SiteWall);
        Self::of(Source::Site { origin, wall })
    }

    /// Returns a clock whose time changes only by [`Clock::advance`] and [`Clock::step`].
    pub fn manual(wall: Timestamp) -> Self {
        let elapsed = Duration::ZERO;
        Self::of(Source::Manual(Arc::new(Mutex::new(ManualTime {
            wall,
            elapsed,
        }))))
    }

    fn of(source: Source) -> Self {
        Self {
            source,
            floor: Arc::default(),
            identifiers: Arc::new(Mutex::new(Identifiers {
                context: ContextV7::new(),
                not_before: Timestamp::UNIX_EPOCH,
            })),
        }
    }

    /// Returns the wall time, UTC, in whole microseconds, the resolution of the database. Steps
    /// back of the machine's clock of up to [`STEP_BACK_HELD_MAX`] do not make it decrease.
    pub fn now(&self) -> Timestamp {
        let (issued_us, step) = {
            // Read under the lock, so that threads cannot overtake each other.
            let mut floor = lock(&self.floor);
            let (wall, elapsed) = (self.source.wall(), self.source.elapsed());
            floor.issue(wall.as_microsecond(), elapsed, self.source.has_one_pace())
        };
        if let Some(step) = step {
            log_step(step);
        }
        Timestamp::from_microsecond(issued_us).unwrap_or(Timestamp::MAX)
    }

    /// Returns the source's wall time, which may decrease. It serves the validity of certificates,
    /// which other machines check with their own clocks.
    pub fn machine_time(&self) -> Timestamp {
        let wall = self.source.wall();
        Timestamp::from_microsecond(wall.as_microsecond()).unwrap_or(wall)
    }

    /// Continues after an earlier run of the server, whose newest time and identifier the database
    /// holds. New identifiers sort after `newest_id`. Times continue after `newest` if the
    /// machine's clock is at most [`STEP_BACK_HELD_MAX`] behind it; otherwise `newest` is ignored
    /// and a warning is logged.
    pub fn continue_after(&self, newest: Option<Timestamp>, newest_id: Option<Uuid>) {
        let id_time = newest_id.and_then(|id| id.get_timestamp());
        let id_time = id_time.and_then(|time| {
            let (seconds, nanos) = time.to_unix();
            Timestamp::new(i64::try_from(seconds).ok()?, i32::try_from(nanos).ok()?).ok()
        });
        // Identifiers of one millisecond differ by a counter with a random start, so skip to the
        // next.
        let after = id_time.and_then(|time| time.checked_add(Duration::from_millis(1)).ok());
        if let Some(after) = after {
            let mut identifiers = lock(&self.identifiers);
            identifiers.not_before = identifiers.not_before.max(after);
        }
        let Some(newest) = newest else { return };
        let step = {
            let mut floor = lock(&self.floor);
            let machine = Mark {
                wall_us: self.source.wall().as_microsecond(),
                elapsed: self.source.elapsed(),
            };
            floor.continue_after(newest.as_microsecond(), machine)
        };
        if let Some(step) = step {
            log_step(step);
        }
    }

    /// Returns the steps of the machine's clock that were detected so far.
    pub fn steps(&self) -> ClockSteps {
        lock(&self.floor).steps()
    }

    /// Returns the monotonic time since an arbitrary origin, for ages and timeouts.
    pub fn elapsed(&self) -> Duration {
        self.source.elapsed()
    }

    /// Advances wall time and monotonic time of a manual clock; has no effect on other clocks.
    pub fn advance(&self, span: Duration) {
        if let Source::Manual(time) = &self.source {
            let mut time = lock(time);
            time.elapsed += span;
            time.wall += SignedDuration::try_from(span).unwrap_or(SignedDuration::MAX);
        }
    }

    /// Steps the wall time of a manual clock forward or back, as an operator or NTP may step a
    /// machine's clock. The monotonic time does not change. Has no effect on other clocks.
    pub fn step(&self, by: SignedDuration) {
        if let Source::Manual(time) = &self.source {
            let mut time = lock(time);
            time.wall += by;
        }
    }

    /// Returns a new identifier, a version 7 UUID. Identifiers sort by creation, also within one
    /// microsecond and after the machine's clock stepped back.
    pub fn new_id<T: From<Uuid>>(&self) -> T {
        let now = self.now();
        let identifiers = lock(&self.identifiers);
        let now = now.max(identifiers.not_before);
        let seconds = u64::try_from(now.as_second()).unwrap_or(0);
        let nanos = u32::try_from(now.subsec_nanosecond()).unwrap_or(0);
        let timestamp = uuid::Timestamp::from_unix(&identifiers.context, seconds, nanos);
        T::from(Uuid::new_v7(timestamp))
    }
}

/// Logs a step of the machine's clock.
fn log_step(step: Step) {
    let seconds = |span_us: i64| SignedDuration::from_micros(span_us).as_secs_f64();
    match step {
        Step::BackHeld { by_us } => warn!(
            "the machine's clock has gone back: it is {:.3} s behind the server's times, which \
             advance at half the pace until it has caught up; have the clock synchronised (chrony, \
             systemd-timesyncd)",
            seconds(by_us)
        ),
        Step::BackFollowed { by_us } => warn!(
            "the machine's clock has gone back by {:.3} s, more than is waited for; the server \
             follows it, and keeps the order within each history",
            seconds(by_us)
        ),
        Step::Forward { by_us } => warn!(
            "the machine's clock was set forward by {:.3} s, or the machine was suspended",
            seconds(by_us)
        ),
        Step::CaughtUp => info!("the machine's clock has caught up with the server's times"),
        Step::DatabaseAhead { by_us } => warn!(
            "the database holds times that are {:.3} s ahead of the machine's clock, more than is \
             waited for: set the clock, and have it synchronised (chrony, systemd-timesyncd)",
            seconds(by_us)
        ),
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use tread_api::ids::MissionId;

    use super::*;

    #[test]
    fn a_manual_clock_moves_only_when_advanced_and_moves_both_times() {
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
    fn neither_time_nor_identifiers_go_back_when_the_machines_clock_does() {
        let clock = Clock::manual("2026-11-01T00:00:00Z".parse().unwrap());
        let before = (clock.now(), clock.new_id::<MissionId>());
        clock.step(SignedDuration::from_hours(-1));
        let held = (clock.now(), clock.new_id::<MissionId>());
        assert!(held > before, "{held:?} {before:?}");
        assert_eq!(
            clock.machine_time(),
            before.0 - SignedDuration::from_hours(1)
        );
        clock.advance(Duration::from_secs(10));
        assert_eq!(clock.now(), before.0 + SignedDuration::from_secs(5));
        assert_eq!(clock.steps().back, 1);
        // The clock follows a step back of two days at once; identifiers keep their order.
        clock.step(SignedDuration::from_hours(-48));
        assert!(clock.now() < before.0);
        assert!(clock.new_id::<MissionId>() > held.1);
    }

    #[test]
    fn a_new_run_takes_up_after_the_newest_time_and_identifier() {
        let wall: Timestamp = "2026-11-01T00:00:00Z".parse().unwrap();
        let last = Clock::manual(wall + SignedDuration::from_hours(100)).new_id::<MissionId>();
        let clock = Clock::manual(wall);
        let newest = wall + SignedDuration::from_mins(5);
        clock.continue_after(Some(newest), Some(last.as_uuid()));
        assert_eq!(clock.now(), newest);
        assert!(clock.new_id::<MissionId>() > last);
    }

    #[test]
    fn mission_ids_sort_by_creation_even_while_the_clock_stands() {
        let clock = Clock::manual("2026-11-01T00:00:00Z".parse().unwrap());
        let ids: Vec<String> = (0..1_000)
            .map(|_| clock.new_id::<MissionId>().to_string())
            .collect();
        assert!(ids.is_sorted());
        assert_eq!(
            ids.iter().collect::<std::collections::BTreeSet<_>>().len(),
            1_000
        );
    }
}
