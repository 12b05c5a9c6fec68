//! Signals that ask a command to end.

use anyhow::Context as _;
use tokio::signal::unix::{Signal, SignalKind, signal};
use tread_api::startup::ignores_hangup;

/// Listens to SIGINT, SIGTERM and SIGHUP from its creation on. One that comes while nobody waits is kept for
/// the next wait; a new listener would miss it.
pub(crate) struct ShutdownSignals {
    interrupt: Signal,
    terminate: Signal,
    hangup: Signal,
    /// The command was started with SIGHUP ignored, as `nohup` does.
    ignores_hangup: bool,
}

impl ShutdownSignals {
    /// # Errors
    /// The system refuses it.
    pub(crate) fn listen() -> anyhow::Result<Self> {
        let ignores_hangup = ignores_hangup();
        let listen = |kind| signal(kind).context("cannot wait for Ctrl-C and other signals");
        Ok(Self {
            interrupt: listen(SignalKind::interrupt())?,
            terminate: listen(SignalKind::terminate())?,
            hangup: listen(SignalKind::hangup())?,
            ignores_hangup,
        })
    }

    /// Returns when the command is asked to end.
    pub(crate) async fn next(&mut self) {
        tokio::select! {
            _ = self.interrupt.recv() => {}
            _ = self.terminate.recv() => {}
            _ = self.hangup.recv(), if !self.ignores_hangup => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use nix::sys::signal::{Signal, raise};

    use super::*;

    /// One test, because signals reach every listener of the process.
    #[tokio::test]
    async fn a_signal_between_two_waits_ends_the_second() {
        let mut signals = ShutdownSignals::listen().unwrap();
        // As by `nohup`.
        let hangup = (!signals.ignores_hangup).then_some(Signal::SIGHUP);
        for sent in [Signal::SIGINT, Signal::SIGTERM].into_iter().chain(hangup) {
            // The first wait is given up, as by the end of what a command did meanwhile.
            let given_up = tokio::time::timeout(Duration::from_millis(1), signals.next()).await;
            assert!(given_up.is_err(), "{sent} has not been sent");
            raise(sent).unwrap();
            let waited = tokio::time::timeout(Duration::from_secs(10), signals.next()).await;
            assert!(waited.is_ok(), "{sent} is missed");
        }
    }
}
