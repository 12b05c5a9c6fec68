//! Starts all tasks of the server and supervises them.
//!
//! A *vital* task has to run as long as the process. If it ends early or panics, the server stops,
//! and the process exits with a failure code so that its service manager restarts it. A *passing*
//! task (a connection, a command to a robot) ends by itself; its panic is logged and does not
//! affect other tasks.

use std::future::Future;
use std::panic::AssertUnwindSafe;
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use futures_util::FutureExt as _;
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;
use tokio_util::task::task_tracker::TaskTrackerToken;
use tracing::{debug, error};

use crate::liveness::Liveness;

/// Maximum time for tasks to end after a stop was requested; later [`Supervisor::stop`] fails.
pub const STOP_TIMEOUT: Duration = Duration::from_secs(10);

/// Cause of an unrequested or incomplete stop.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Stopped {
    /// A vital task returned before the stop.
    #[error("task `{0}` ended early")]
    EndedEarly(&'static str),
    /// A vital task panicked.
    #[error("task `{0}` panicked")]
    Panicked(&'static str),
    /// Tasks did not end within [`STOP_TIMEOUT`].
    #[error("tasks did not end within {} s", STOP_TIMEOUT.as_secs())]
    StopTimeout,
}

/// Handle of the task supervisor; clones refer to the same supervisor.
#[derive(Debug, Clone, Default)]
pub struct Supervisor {
    tracker: TaskTracker,
    stop: CancellationToken,
    failure: Arc<OnceLock<Stopped>>,
    liveness: Liveness,
}

impl Supervisor {
    /// Creates a supervisor without tasks.
    pub fn new() -> Self {
        Self::default()
    }

    /// Returns the token that is cancelled when all tasks have to stop.
    pub fn stop_token(&self) -> CancellationToken {
        self.stop.clone()
    }

    /// Returns the liveness of the vital tasks.
    pub fn liveness(&self) -> Liveness {
        self.liveness.clone()
    }

    /// Starts a vital task, whose end before the stop stops the server. It must not block its thread:
    /// the watchdog of the service manager watches its polls.
    pub fn spawn_vital(&self, name: &'static str, task: impl Future<Output = ()> + Send + 'static) {
        let task = self.liveness.watch(name, task);
        self.spawn_vital_unwatched(name, task);
    }

    /// Starts a vital task that reads files in its polls, so that they may last as long as a disk
    /// hangs. The watchdog does not watch it.
    pub fn spawn_vital_unwatched(
        &self,
        name: &'static str,
        task: impl Future<Output = ()> + Send + 'static,
    ) {
        let (stop, failure) = (self.stop.clone(), Arc::clone(&self.failure));
        self.tracker.spawn(async move {
            let ended = AssertUnwindSafe(task).catch_unwind().await;
            let stopped = match ended {
                Ok(()) if stop.is_cancelled() => return debug!("task `{name}` ended"),
                Ok(()) => Stopped::EndedEarly(name),
                Err(_panic) => Stopped::Panicked(name),
            };
            error!("{stopped}: the server stops");
            // Only the first failure is recorded; later ones are consequences.
            let _ = failure.set(stopped);
            stop.cancel();
        });
    }

    /// Starts a passing task, which ends by itself.
    pub fn spawn_passing(
        &self,
        name: &'static str,
        task: impl Future<Output = ()> + Send + 'static,
    ) {
        self.tracker.spawn(async move {
            if AssertUnwindSafe(task).catch_unwind().await.is_err() {
                error!("task `{name}` panicked");
            }
        });
    }

    /// Returns a token for a task spawned elsewhere, such as a `WebSocket` by axum. [`Self::stop`]
    /// waits until the token is dropped.
    pub fn task_token(&self) -> TaskTrackerToken {
        self.tracker.token()
    }

    /// Runs blocking `work` on the thread pool for blocking tasks; `None` if it panicked.
    pub async fn blocking<T: Send + 'static>(
        &self,
        work: impl FnOnce() -> T + Send + 'static,
    ) -> Option<T> {
        self.tracker.spawn_blocking(work).await.ok()
    }

    /// Waits until a vital task fails or a stop is requested.
    pub async fn stopping(&self) {
        self.stop.cancelled().await;
    }

    /// Requests all tasks to stop and waits for them.
    ///
    /// # Errors
    /// The first failure of a vital task, or [`Stopped::StopTimeout`] if tasks do not end in time.
    pub async fn stop(&self) -> Result<(), Stopped> {
        self.stop.cancel();
        self.tracker.close();
        let in_time = tokio::time::timeout(STOP_TIMEOUT, self.tracker.wait()).await;
        match (self.failure.get(), in_time) {
            (Some(failure), _) => Err(failure.clone()),
            (None, Err(_elapsed)) => Err(Stopped::StopTimeout),
            (None, Ok(())) => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_vital_task_that_panics_or_ends_stops_the_rest_and_is_named() {
        let supervisor = Supervisor::new();
        let stop = supervisor.stop_token();
        supervisor.spawn_vital("patient", async move { stop.cancelled().await });
        supervisor.spawn_vital("broken", async { panic!("on purpose") });
        supervisor.stopping().await;
        assert_eq!(supervisor.stop().await, Err(Stopped::Panicked("broken")));

        let supervisor = Supervisor::new();
        supervisor.spawn_vital("hasty", async {});
        supervisor.stopping().await;
        assert_eq!(supervisor.stop().await, Err(Stopped::EndedEarly("hasty")));
    }

    #[tokio::test]
    async fn the_stop_waits_for_tasks_that_others_have_spawned_and_what_they_spawn_last() {
        let supervisor = Supervisor::new();
        let (attended, ending) = (supervisor.task_token(), supervisor.clone());
        let (done, mut is_done) = tokio::sync::oneshot::channel();
        let mut foreign = tokio::task::JoinSet::new();
        foreign.spawn(async move {
            ending.stop_token().cancelled().await;
            for _ in 0..100 {
                tokio::task::yield_now().await;
            }
            ending.spawn_passing("last", async move { done.send(()).unwrap() });
            drop(attended);
        });
        assert_eq!(supervisor.stop().await, Ok(()));
        assert_eq!(is_done.try_recv(), Ok(()));
    }

    #[tokio::test]
    async fn a_passing_task_may_end_or_panic_without_harm() {
        let supervisor = Supervisor::new();
        supervisor.spawn_passing("short", async {});
        supervisor.spawn_passing("broken", async { panic!("on purpose") });
        let answer = supervisor.blocking(|| 7).await;
        assert_eq!(answer, Some(7));
        assert_eq!(supervisor.stop().await, Ok(()));
    }
}
