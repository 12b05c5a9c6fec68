//! Injected clocks: monotonic time for ages and deadlines, wall time for records.
//!
//! No other module of the agent reads the machine's clocks, so that a test can inject its own.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant, SystemTime};

use jiff::{SignedDuration, Timestamp};

/// A source of both times. Monotonic time counts from the clock's own origin.
pub trait Clock: std::fmt::Debug + Send + Sync {
    /// Returns the time since the clock's origin; never decreases.
    fn monotonic(&self) -> Duration;
    /// Returns the wall time; it may jump.
    fn wall(&self) -> Timestamp;
    /// Returns the machine's present wall time, nanoseconds since the Unix epoch, by which other
    /// programs of the machine stamp their messages; it may be adjusted at any time.
    fn host_wall_ns(&self) -> i64 {
        i64::try_from(self.wall().as_nanosecond()).unwrap_or(i64::MAX)
    }

    /// Blocks the thread until that monotonic time.
    fn sleep_until(&self, deadline: Duration) {
        std::thread::sleep(deadline.saturating_sub(self.monotonic()));
    }
}

/// A shared clock.
pub type SharedClock = Arc<dyn Clock>;

/// The machine's clocks, with the origin at the clock's creation.
///
/// The wall time is the one at the origin plus the monotonic time since, so that it never jumps
/// during a run, even if the machine's clock is adjusted. The server measures its offset, which
/// holds for every record of the run.
#[derive(Debug)]
pub struct SystemClock {
    origin: Instant,
    wall_origin: Timestamp,
}

impl SystemClock {
    /// Creates a clock whose origin is now.
    pub fn new() -> Self {
        #[expect(
            clippy::disallowed_methods,
            reason = "this is the clock that others inject"
        )]
        let (origin, now) = (Instant::now(), SystemTime::now());
        // A wall clock outside the years of RFC 3339 reads as 1970.
        let wall_origin = Timestamp::try_from(now).unwrap_or(Timestamp::UNIX_EPOCH);
        Self {
            origin,
            wall_origin,
        }
    }

    /// Adds an offset to the wall time; a simulated fault.
    #[must_use]
    pub fn ahead_by(mut self, offset: SignedDuration) -> Self {
        self.wall_origin = self
            .wall_origin
            .checked_add(offset)
            .unwrap_or(Timestamp::UNIX_EPOCH);
        self
    }

    /// Creates a shared clock.
    pub fn shared() -> SharedClock {
        Arc::new(Self::new())
    }
}

impl Default for SystemClock {
    fn default() -> Self {
        Self::new()
    }
}

impl Clock for SystemClock {
    fn monotonic(&self) -> Duration {
        self.origin.elapsed()
    }

    fn wall(&self) -> Timestamp {
        // Saturates at the last year of RFC 3339.
        self.wall_origin
            .checked_add(self.monotonic())
            .unwrap_or(Timestamp::MAX)
    }

    fn host_wall_ns(&self) -> i64 {
        #[expect(
            clippy::disallowed_methods,
            reason = "this is the clock that others inject"
        )]
        let since_1970 = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
        // A time before 1970 reads as zero.
        since_1970.map_or(0, |since| {
            i64::try_from(since.as_nanos()).unwrap_or(i64::MAX)
        })
    }
}

/// A clock that moves only when advanced.
#[derive(Debug)]
pub struct ManualClock {
    elapsed: Mutex<Duration>,
    wall_origin: Timestamp,
}

impl ManualClock {
    /// Creates a clock at monotonic time zero and wall time `wall_origin`.
    pub fn new(wall_origin: Timestamp) -> Self {
        Self {
            elapsed: Mutex::new(Duration::ZERO),
            wall_origin,
        }
    }

    /// Advances both times.
    pub fn advance(&self, step: Duration) {
        *self.elapsed.lock().unwrap_or_else(PoisonError::into_inner) += step;
    }
}

impl Clock for ManualClock {
    fn monotonic(&self) -> Duration {
        *self.elapsed.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn wall(&self) -> Timestamp {
        // Saturates at the last year of RFC 3339.
        self.wall_origin
            .checked_add(self.monotonic())
            .unwrap_or(Timestamp::MAX)
    }
}
