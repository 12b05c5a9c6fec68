//! How many of something are due by now, at a rate.

use std::time::Duration;

use tokio::time::Instant;

/// Longest rest between two looks.
const REST: Duration = Duration::from_millis(5);
/// Most that are due at once, so that nobody who fell behind sends for seconds without a look at the end.
const DUE_MAX: u64 = 500;

/// A rate that is kept up with as far as the machine lets.
#[derive(Debug)]
pub(crate) struct Pace {
    hz: f64,
    begun: Instant,
    until: Instant,
    done: u64,
}

impl Pace {
    /// From now on until then.
    pub(crate) fn new(hz: f64, until: Instant) -> Self {
        Self {
            hz,
            begun: Instant::now(),
            until,
            done: 0,
        }
    }

    /// How many were done.
    pub(crate) fn done(&self) -> u64 {
        self.done
    }

    fn take_due(&mut self) -> Option<u64> {
        let now = Instant::now();
        if now >= self.until {
            return None;
        }
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "a count of some seconds"
        )]
        let wanted = (self.hz * (now - self.begun).as_secs_f64()) as u64;
        let due = wanted.saturating_sub(self.done).min(DUE_MAX);
        self.done += due;
        Some(due)
    }

    /// Waits until some are due; `None` when it is time to end.
    pub(crate) async fn due(&mut self) -> Option<u64> {
        loop {
            match self.take_due()? {
                0 => tokio::time::sleep(REST).await,
                due => return Some(due),
            }
        }
    }

    /// The same in a thread that may be blocked.
    pub(crate) fn due_blocking(&mut self) -> Option<u64> {
        loop {
            match self.take_due()? {
                0 => std::thread::sleep(REST),
                due => return Some(due),
            }
        }
    }
}
