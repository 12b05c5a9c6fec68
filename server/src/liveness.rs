//! Liveness of the server's tasks: whether one of them blocks the thread that runs it.
//!
//! A poll of a task that waits (for a disk, a client, a robot) returns at once, however long the
//! task waits. A poll that does not return is a defect: an endless loop, or a lock that is never
//! released. The watchdog of the service manager is fed only while no poll lasts that long, so
//! it depends on neither the storage nor the network.
//!
//! Time is counted in rounds, which the watchdog begins at a fixed interval. No clock is read in a
//! poll.

use std::pin::pin;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

/// Rounds that may begin during one poll of a task. A poll that began just before a round has
/// lasted one interval less.
pub const ROUNDS_MAX: u64 = 2;

/// Value of [`Polls::began_in`] between two polls.
const IDLE: u64 = 0;

/// Polls of one task.
#[derive(Debug)]
struct Polls {
    task: &'static str,
    /// Round in which the present poll began, or [`IDLE`].
    began_in: AtomicU64,
}

/// Polls of all watched tasks; clones refer to the same tasks.
#[derive(Debug, Clone)]
pub struct Liveness {
    round: Arc<AtomicU64>,
    tasks: Arc<Mutex<Vec<Arc<Polls>>>>,
}

impl Default for Liveness {
    fn default() -> Self {
        Self {
            round: Arc::new(AtomicU64::new(IDLE + 1)),
            tasks: Arc::default(),
        }
    }
}

impl Liveness {
    /// Watches the polls of a task that lives as long as the server.
    pub(crate) fn watch<T, F: Future<Output = T>>(
        &self,
        task: &'static str,
        future: F,
    ) -> impl Future<Output = T> + use<T, F> {
        let polls = Arc::new(Polls {
            task,
            began_in: AtomicU64::new(IDLE),
        });
        let mut tasks = self.tasks.lock().unwrap_or_else(PoisonError::into_inner);
        tasks.push(Arc::clone(&polls));
        drop(tasks);
        let round = Arc::clone(&self.round);
        async move {
            let mut future = pin!(future);
            std::future::poll_fn(move |context| {
                let now = round.load(Ordering::Relaxed);
                polls.began_in.store(now, Ordering::Relaxed);
                let polled = future.as_mut().poll(context);
                polls.began_in.store(IDLE, Ordering::Relaxed);
                polled
            })
            .await
        }
    }

    /// Begins a round, and returns the first task whose present poll has lasted for more than
    /// [`ROUNDS_MAX`] of them.
    pub fn begin_round(&self) -> Option<&'static str> {
        let round = self.round.fetch_add(1, Ordering::Relaxed) + 1;
        let tasks = self.tasks.lock().unwrap_or_else(PoisonError::into_inner);
        let blocks = |polls: &&Arc<Polls>| {
            let began_in = polls.began_in.load(Ordering::Relaxed);
            began_in != IDLE && round.saturating_sub(began_in) > ROUNDS_MAX
        };
        tasks.iter().find(blocks).map(|polls| polls.task)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::supervisor::Supervisor;

    #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
    async fn a_task_that_blocks_its_thread_is_named_until_it_goes_on() {
        let supervisor = Supervisor::new();
        let (began, has_begun) = tokio::sync::oneshot::channel();
        let (let_go, is_let_go) = std::sync::mpsc::channel::<()>();
        let (passed, has_passed) = tokio::sync::oneshot::channel();
        let stop = supervisor.stop_token();
        supervisor.spawn_vital("blocked", async move {
            began.send(()).unwrap();
            is_let_go.recv().unwrap();
            passed.send(()).unwrap();
            stop.cancelled().await;
        });
        has_begun.await.unwrap();
        let liveness = supervisor.liveness();
        for _ in 0..ROUNDS_MAX {
            assert_eq!(liveness.begin_round(), None);
        }
        assert_eq!(liveness.begin_round(), Some("blocked"));
        assert_eq!(liveness.begin_round(), Some("blocked"));
        let_go.send(()).unwrap();
        has_passed.await.unwrap();
        // The poll returns soon after its last statement.
        while liveness.begin_round().is_some() {
            tokio::task::yield_now().await;
        }
        assert_eq!(supervisor.stop().await, Ok(()));
    }

    #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
    async fn a_task_that_waits_for_something_that_never_comes_is_alive() {
        let supervisor = Supervisor::new();
        let stop = supervisor.stop_token();
        let (began, has_begun) = tokio::sync::oneshot::channel();
        supervisor.spawn_vital("waiting", async move {
            began.send(()).unwrap();
            tokio::select! {
                () = stop.cancelled() => {}
                () = std::future::pending() => {}
            }
        });
        has_begun.await.unwrap();
        let liveness = supervisor.liveness();
        // The poll that sent the message returns soon.
        tokio::task::yield_now().await;
        while liveness.begin_round().is_some() {}
        for _ in 0..1_000 {
            assert_eq!(liveness.begin_round(), None);
        }
        assert_eq!(supervisor.stop().await, Ok(()));
    }
}
