//! Messages to the service manager (systemd) by its notification protocol: ready, stopping, what
//! the robot does, and the watchdog.
//!
//! ```text
//! READY=1      after the first tick of the control loop
//! WATCHDOG=1   each quarter of WATCHDOG_USEC, if the loop has ticked since the last one
//! STATUS=…     whenever it has changed
//! STOPPING=1   when the stop begins
//! ```
//!
//! Only the ticks of the loop feed the watchdog: a robot whose loop runs is not restarted because
//! its network, its disk or another thread is slow. Runs on its own thread, independent of a starved
//! async runtime. Without `NOTIFY_SOCKET` nothing is sent.

use std::fmt::Write as _;
use std::io;
use std::os::unix::net::UnixDatagram;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use sd_notify::NotifyState;
use tokio::sync::watch;
use tracing::warn;
use tread_api::robot::RobotMode;

use crate::clock::SharedClock;
use crate::control_loop::channels::{Fault, Shared};
use crate::fleet::Identity;

/// Messages to the watchdog in the time that it waits for one: some may be late.
const MESSAGES_PER_TIMEOUT: u32 = 4;
/// Checks of the loop for each message.
const POLLS_PER_MESSAGE: u32 = 4;
/// Longest interval between two checks.
const POLL_EVERY_MAX: Duration = Duration::from_millis(100);
/// Shortest interval between two checks.
const POLL_EVERY_MIN: Duration = Duration::from_millis(5);

/// Decides when the watchdog is fed. Pure.
#[derive(Debug, Clone, Copy)]
struct Feeding {
    every: Duration,
    /// Ticks of the loop at the last message.
    ticks: u64,
    at: Duration,
}

impl Feeding {
    /// Returns whether a message is due: the interval is over, and the loop has ticked in it.
    fn is_due(&mut self, ticks: u64, now: Duration) -> bool {
        let is_due = ticks != self.ticks && now.saturating_sub(self.at) >= self.every;
        if is_due {
            (self.ticks, self.at) = (ticks, now);
        }
        is_due
    }
}

/// State from which the messages to the service manager are made.
#[derive(Debug)]
pub(crate) struct NotifierInputs {
    pub(crate) identity: Identity,
    pub(crate) shared: Arc<Shared>,
    pub(crate) clock: SharedClock,
    pub(crate) has_connected: watch::Receiver<bool>,
}

/// Returns whether a service manager waits for messages.
pub(crate) fn is_present() -> bool {
    std::env::var_os("NOTIFY_SOCKET").is_some()
}

/// Sends messages; one that cannot be sent is logged.
fn notify(messages: &[NotifyState<'_>]) {
    if let Err(cause) = send(messages) {
        warn!("cannot notify the service manager: {cause}");
    }
}

/// Sends messages without waiting: a service manager that does not read must not block a thread.
fn send(messages: &[NotifyState<'_>]) -> io::Result<()> {
    let Some(path) = std::env::var_os("NOTIFY_SOCKET") else {
        return Ok(());
    };
    let mut text = String::new();
    for message in messages {
        // Writing to a string cannot fail.
        let _ = writeln!(text, "{message}");
    }
    let socket = UnixDatagram::unbound()?;
    socket.set_nonblocking(true)?;
    socket.send_to(text.as_bytes(), Path::new(&path))?;
    Ok(())
}

impl NotifierInputs {
    /// Tells the service manager until the loop is requested to stop.
    pub(crate) fn run(self) {
        let timeout = sd_notify::watchdog_enabled();
        let poll_every = timeout.map_or(POLL_EVERY_MAX, |timeout| {
            let poll_every = timeout / (MESSAGES_PER_TIMEOUT * POLLS_PER_MESSAGE);
            poll_every.clamp(POLL_EVERY_MIN, POLL_EVERY_MAX)
        });
        let mut feeding = timeout.map(|timeout| Feeding {
            every: timeout / MESSAGES_PER_TIMEOUT,
            ticks: 0,
            at: self.clock.monotonic(),
        });
        let mut sent_status = None;
        while !self.shared.stop.load(Ordering::Relaxed) {
            std::thread::sleep(poll_every);
            let ticks = self.shared.ticks.load(Ordering::Relaxed);
            if ticks == 0 {
                continue;
            }
            let status = self.status();
            let mut messages = Vec::new();
            if sent_status.is_none() {
                messages.push(NotifyState::Ready);
            }
            let now = self.clock.monotonic();
            if feeding
                .as_mut()
                .is_some_and(|feeding| feeding.is_due(ticks, now))
            {
                messages.push(NotifyState::Watchdog);
            }
            if sent_status.as_ref() != Some(&status) {
                messages.push(NotifyState::Status(&status));
            }
            if !messages.is_empty() {
                notify(&messages);
            }
            sent_status = Some(status);
        }
        notify(&[NotifyState::Stopping, NotifyState::Status("stopping")]);
    }

    /// Returns what the robot does, in one line.
    fn status(&self) -> String {
        let snapshot = self.shared.snapshot();
        let mode = match snapshot.mode {
            RobotMode::Idle => "idle",
            RobotMode::Tracking => "on a mission",
            RobotMode::Teleoperated => "teleoperated",
            RobotMode::Stopped => "stopped until a person clears it",
            RobotMode::Fault => snapshot.fault.map_or("out of order", Fault::text),
        };
        let link = if *self.has_connected.borrow() {
            ""
        } else {
            ", no server reached yet"
        };
        let Identity { site, robot, .. } = &self.identity;
        format!("`{robot}` of `{site}`: {mode}{link}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TIMEOUT: Duration = Duration::from_secs(4);

    /// Times, in milliseconds, of the messages to a watchdog, with a loop that ticks 100 times a
    /// second until it stands still.
    fn fed_at_ms(stands_from_ms: u64, stands_until_ms: u64, end_ms: u64) -> Vec<u64> {
        let mut feeding = Feeding {
            every: TIMEOUT / MESSAGES_PER_TIMEOUT,
            ticks: 0,
            at: Duration::ZERO,
        };
        let looks = (0..end_ms).step_by(50);
        let fed = looks.filter(|&now_ms| {
            let ticked_ms = if now_ms < stands_from_ms {
                now_ms
            } else {
                stands_from_ms + now_ms.saturating_sub(stands_until_ms)
            };
            feeding.is_due(ticked_ms / 10, Duration::from_millis(now_ms))
        });
        fed.collect()
    }

    #[test]
    fn a_loop_that_ticks_feeds_the_watchdog_four_times_within_its_timeout() {
        assert_eq!(fed_at_ms(9_000, 9_000, 4_500), [1_000, 2_000, 3_000, 4_000]);
    }

    #[test]
    fn a_loop_that_stands_still_feeds_nothing_until_it_ticks_again() {
        let fed = fed_at_ms(2_300, 9_000, 10_500);
        // The ticks between the last message and the stall give one more.
        assert_eq!(fed, [1_000, 2_000, 3_000, 9_050, 10_050]);
    }

    #[test]
    fn a_loop_that_never_ticks_feeds_nothing() {
        assert_eq!(fed_at_ms(0, 60_000, 60_000), Vec::<u64>::new());
    }
}
