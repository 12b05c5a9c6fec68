//! Time, injected: monotonic for ages and deadlines, wall for records.
//!
//! Nothing else in the agent reads the machine's clocks, so that a test can hand in its own.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant, SystemTime};

use jiff::{SignedDuration, Timestamp};

/// A source of both times. Monotonic time counts from the clock's own origin.
pub trait Clock: std::fmt::Debug + Send + Sync {
    /// Time since the clock's origin; never falls.
    fn monotonic(&self) -> Duration;
    /// The wall clock; it may jump.
    fn wall(&self) -> Timestamp;
    /// The machine's own wall clock as it stands now, nanoseconds since 1970: other programs of the
    /// machine stamp their messages by it, and it may be put right at any time.
    fn host_wall_ns(&self) -> i64 {
        i64::try_from(self.wall().as_nanosecond()).unwrap_or(i64::MAX)
    }

    /// Blocks a loop until that monotonic time.
    fn sleep_until(&self, deadline: Duration) {
        std::thread::sleep(deadline.saturating_sub(self.monotonic()));
    }
}

/// A clock as it is handed around.
pub type SharedClock = Arc<dyn Clock>;

/// The machine's clocks; the origin is when this was made.
///
/// The wall time is that of the origin and the monotonic time since: it never jumps during a run,
/// even if the machine's clock is put right by days meanwhile. How far it is off is for the
/// server to measure, and then holds for every record of the run.
#[derive(Debug)]
pub struct SystemClock {
    origin: Instant,
    wall_origin: Timestamp,
}

impl SystemClock {
    /// A clock whose origin is now.
    pub fn new() -> Self {
        #[expect(
            clippy::disallowed_methods,
            reason = "this is the clock that others inject"
        )]
        let (origin, now) = (Instant::now(), SystemTime::now());
        // A machine whose clock stands outside the years that RFC 3339 knows reads as 1970.
        let wall_origin = Timestamp::try_from(now).unwrap_or(Timestamp::UNIX_EPOCH);
        Self {
            origin,
            wall_origin,
        }
    }

    /// The same, with a wall clock that is ahead by so much; a simulated fault.
    #[must_use]
    pub fn ahead_by(mut self, offset: SignedDuration) -> Self {
        self.wall_origin = self
            .wall_origin
            .checked_add(offset)
            .unwrap_or(Timestamp::UNIX_EPOCH);
        self
    }

    /// The same, ready to be handed around.
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
        // Saturates at the last year that RFC 3339 knows.
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
        // Before 1970 nothing has a stamp.
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
    /// A clock that stands at zero, and at `wall_origin`.
    pub fn new(wall_origin: Timestamp) -> Self {
        Self {
            elapsed: Mutex::new(Duration::ZERO),
            wall_origin,
        }
    }

    /// Moves both times on.
    pub fn advance(&self, step: Duration) {
        *self.elapsed.lock().unwrap_or_else(PoisonError::into_inner) += step;
    }
}

impl Clock for ManualClock {
    fn monotonic(&self) -> Duration {
        *self.elapsed.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn wall(&self) -> Timestamp {
        // Saturates at the last year that RFC 3339 knows.
        self.wall_origin
            .checked_add(self.monotonic())
            .unwrap_or(Timestamp::MAX)
    }
}
