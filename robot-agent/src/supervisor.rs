//! Starts every task and thread of an agent, and detects those that end unexpectedly.
//!
//! A task that ends or panics before the agent is requested to stop is a failure of the whole agent:
//! [`Supervisor::failed`] names it, and the program ends with a code that makes systemd start it
//! again.

use std::panic::AssertUnwindSafe;
use std::thread::JoinHandle;

use tokio::sync::{Mutex, mpsc};
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

/// Number of failures that are kept; the first one ends the process.
const FAILURES_MAX: usize = 8;

/// A part of the agent has ended unexpectedly.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("the {part} has ended by itself: {reason}")]
pub struct PartEnded {
    /// Name of the part.
    pub part: &'static str,
    /// Reason: a return or a panic.
    pub reason: String,
}

/// The owner of all tasks and threads of one agent.
#[derive(Debug)]
pub(crate) struct Supervisor {
    tracker: TaskTracker,
    /// Cancelled when parts may end without a failure.
    stopping: CancellationToken,
    stop: CancellationToken,
    failures: mpsc::Sender<PartEnded>,
    first_failure: Mutex<mpsc::Receiver<PartEnded>>,
}

/// Reports a part's end when dropped before the stop, by a return or a panic.
struct EndReport {
    part: &'static str,
    stopping: CancellationToken,
    failures: mpsc::Sender<PartEnded>,
    reason: &'static str,
}

impl EndReport {
    fn record_return(&mut self) {
        self.reason = "it returned";
    }
}

impl Drop for EndReport {
    fn drop(&mut self) {
        if !self.stopping.is_cancelled() {
            let ended = PartEnded {
                part: self.part,
                reason: self.reason.to_owned(),
            };
            // A full channel has earlier failures, and only the first counts.
            let _ = self.failures.try_send(ended);
        }
    }
}

impl Supervisor {
    pub(crate) fn new() -> Self {
        let (failures, first_failure) = mpsc::channel(FAILURES_MAX);
        Self {
            tracker: TaskTracker::new(),
            stopping: CancellationToken::new(),
            stop: CancellationToken::new(),
            failures,
            first_failure: Mutex::new(first_failure),
        }
    }

    /// Returns the token that is cancelled when the tasks shall end.
    pub(crate) fn stop_token(&self) -> CancellationToken {
        self.stop.clone()
    }

    fn report(&self, part: &'static str) -> EndReport {
        EndReport {
            part,
            stopping: self.stopping.clone(),
            failures: self.failures.clone(),
            reason: "it panicked",
        }
    }

    /// Runs a task that shall live until the stop.
    pub(crate) fn spawn(
        &self,
        part: &'static str,
        task: impl Future<Output = ()> + Send + 'static,
    ) {
        let mut report = self.report(part);
        self.tracker.spawn(async move {
            task.await;
            report.record_return();
        });
    }

    /// Runs a thread that shall live until the stop.
    ///
    /// # Errors
    /// The operating system's error if the thread cannot be started.
    pub(crate) fn spawn_thread(
        &self,
        part: &'static str,
        body: impl FnOnce() + Send + 'static,
    ) -> std::io::Result<JoinHandle<()>> {
        let mut report = self.report(part);
        std::thread::Builder::new()
            .name(part.to_owned())
            .spawn(move || {
                // The panic hook has printed it; the drop reports it.
                if std::panic::catch_unwind(AssertUnwindSafe(body)).is_ok() {
                    report.record_return();
                }
            })
    }

    /// Waits for the first part that ends unexpectedly.
    pub(crate) async fn failed(&self) -> PartEnded {
        let ended = self.first_failure.lock().await.recv().await;
        // The supervisor keeps a sender, so the channel cannot close before.
        ended.unwrap_or(PartEnded {
            part: "supervisor",
            reason: "it lost its channel".to_owned(),
        })
    }

    /// From now on the end of a part is not a failure.
    pub(crate) fn begin_stop(&self) {
        self.stopping.cancel();
    }

    /// Requests all tasks to end, and waits until they have.
    pub(crate) async fn end_tasks(&self) {
        self.begin_stop();
        self.stop.cancel();
        self.tracker.close();
        self.tracker.wait().await;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
    async fn a_part_that_panics_or_returns_early_is_named() {
        let supervisor = Supervisor::new();
        supervisor.spawn("quitter", async {});
        assert_eq!(supervisor.failed().await.part, "quitter");
        let thread = supervisor
            .spawn_thread("jumper", || panic!("on purpose"))
            .unwrap();
        let ended = supervisor.failed().await;
        assert_eq!(
            (ended.part, ended.reason.as_str()),
            ("jumper", "it panicked")
        );
        thread.join().unwrap();
    }

    #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
    async fn a_part_that_ends_after_the_stop_is_no_failure() {
        let supervisor = Supervisor::new();
        let stop = supervisor.stop_token();
        supervisor.spawn("worker", async move { stop.cancelled().await });
        supervisor.end_tasks().await;
        assert!(supervisor.first_failure.lock().await.try_recv().is_err());
    }
}
