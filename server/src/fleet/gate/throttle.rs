//! Limits the rate at which a robot's bytes are read, over all its links together.
//!
//! Excess bytes are not lost and end no link: they are read later. The buffers on the way fill, and
//! the robot's TCP waits.

use std::io;
use std::pin::Pin;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll, ready};
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::time::Sleep;

use crate::clock::Clock;
use crate::rate_limit::{Bucket, RateLimit};

/// Bytes read from one robot per second. State, friction report and measurements need some tens of
/// KiB per second; the outbox after an outage is sent as fast as receipts arrive.
pub(in crate::fleet) const BYTES_PER_S: u32 = 8 * 1024 * 1024;
/// Bytes read from one robot in a burst: two of the largest payloads.
const BURST_BYTES: u32 = 32 * 1024 * 1024;
/// Byte rate of all links of one robot together.
pub(in crate::fleet) const BYTE_RATE: RateLimit = RateLimit {
    burst: BURST_BYTES,
    interval: Duration::from_nanos(1_000_000_000 / BYTES_PER_S as u64),
};
/// Minimum pause, so that reading small chunks does not pause after each.
const PAUSE_MIN: Duration = Duration::from_millis(10);
/// Minimum interval between two log entries about one robot's pauses.
const LOG_EVERY: Duration = Duration::from_secs(10);

/// Used part of one robot's byte rate.
#[derive(Debug)]
pub(super) struct ByteRate {
    limit: RateLimit,
    used: Mutex<Used>,
}

#[derive(Debug, Default)]
struct Used {
    bucket: Bucket,
    logged_at: Option<Duration>,
}

impl ByteRate {
    /// Creates a rate of which nothing is used.
    pub(super) fn new(limit: RateLimit) -> Self {
        Self {
            limit,
            used: Mutex::default(),
        }
    }

    fn lock(&self) -> MutexGuard<'_, Used> {
        self.used.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes bytes that were read; returns the time to wait before reading on.
    fn take(&self, bytes: usize, now: Duration) -> Duration {
        let bytes = u32::try_from(bytes).unwrap_or(u32::MAX);
        self.lock().bucket.charge(self.limit, now, bytes)
    }

    /// Returns whether a log entry about pauses is due.
    pub(super) fn should_log(&self, now: Duration) -> bool {
        let mut used = self.lock();
        let is_due = |at| now.saturating_sub(at) >= LOG_EVERY;
        let is_due = used.logged_at.is_none_or(is_due);
        if is_due {
            used.logged_at = Some(now);
        }
        is_due
    }
}

/// A stream whose reading is limited to a rate; writing is not limited.
pub(super) struct Throttled<'rate, S, P> {
    stream: S,
    rate: &'rate ByteRate,
    clock: &'rate Clock,
    /// Called with the duration of each pause.
    paused: P,
    pause: Option<Pin<Box<Sleep>>>,
}

impl<'rate, S, P: Fn(Duration)> Throttled<'rate, S, P> {
    /// Wraps a stream of the robot with this rate.
    pub(super) fn new(stream: S, rate: &'rate ByteRate, clock: &'rate Clock, paused: P) -> Self {
        Self {
            stream,
            rate,
            clock,
            paused,
            pause: None,
        }
    }
}

impl<S: AsyncRead + Unpin, P: Fn(Duration) + Unpin> AsyncRead for Throttled<'_, S, P> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        if let Some(pause) = &mut self.pause {
            ready!(pause.as_mut().poll(context));
            self.pause = None;
        }
        let before = buffer.filled().len();
        ready!(Pin::new(&mut self.stream).poll_read(context, buffer))?;
        let now = self.clock.elapsed();
        let delay = self.rate.take(buffer.filled().len() - before, now);
        if !delay.is_zero() {
            self.pause = Some(Box::pin(tokio::time::sleep(delay.max(PAUSE_MIN))));
            (self.paused)(now);
        }
        Poll::Ready(Ok(()))
    }
}

impl<S: AsyncWrite + Unpin, P: Unpin> AsyncWrite for Throttled<'_, S, P> {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.stream).poll_write(context, bytes)
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(context)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicUsize, Ordering};

    use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _, duplex};

    use super::*;

    /// 4 KiB at once, then 64 KiB a second.
    const SLOW: RateLimit = RateLimit {
        burst: 4 * 1024,
        interval: Duration::from_nanos(1_000_000_000 / (64 * 1024)),
    };
    const BUFFER_BYTES: usize = 1024;

    #[tokio::test]
    async fn two_links_of_a_robot_share_its_rate_and_lose_nothing_and_are_written_meanwhile() {
        let (rate, clock) = (ByteRate::new(SLOW), Clock::system());
        let pauses = AtomicUsize::new(0);
        let one = async |byte: u8| {
            let (mut robot, link) = duplex(BUFFER_BYTES);
            let count = |_now| {
                pauses.fetch_add(1, Ordering::Relaxed);
            };
            let mut link = Throttled::new(link, &rate, &clock, count);
            let sent = vec![byte; 10 * 1024];
            let sending = async {
                robot.write_all(&sent).await.unwrap();
                // Writing to the robot is not delayed.
                assert_eq!(robot.read_u8().await.unwrap(), byte);
                robot.shutdown().await.unwrap();
            };
            let reading = async {
                link.write_u8(byte).await.unwrap();
                let mut read = Vec::new();
                link.read_to_end(&mut read).await.unwrap();
                read
            };
            let ((), read) = tokio::join!(sending, reading);
            assert_eq!(read, sent);
        };
        let begun = clock.elapsed();
        tokio::join!(one(1), one(2));
        // 16 KiB exceed the burst; the last chunk is read before its bytes are counted.
        let took = clock.elapsed().saturating_sub(begun);
        assert!(took >= Duration::from_millis(200), "{took:?}");
        let pauses = pauses.load(Ordering::Relaxed);
        assert!((2..=40).contains(&pauses), "{pauses}");
    }

    #[test]
    fn pauses_are_logged_now_and_then() {
        let rate = ByteRate::new(SLOW);
        let at = Duration::from_secs;
        let logged = [0, 1, 9, 10, 15, 20].map(|second| rate.should_log(at(second)));
        assert_eq!(logged, [true, false, false, true, false, true]);
    }
}
