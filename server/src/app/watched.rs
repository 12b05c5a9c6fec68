//! Requests states of watched robots at a higher rate.
//!
//! A robot is watched while a drive socket of it is open. Its agent gets a request for
//! [`WATCHED_STATE_RATE_HZ`] that lasts [`REQUEST_DURATION`], again every [`REQUEST_PERIOD`]; when no socket is
//! left, the agent returns to its own rate by itself.
//!
//! ```text
//! watched, online ──► asked ──done──► due after REQUEST_PERIOD
//!                       ├──no answer──► due after REQUEST_PERIOD; after TRIES_MAX of a run that never
//!                       │               answered, due after REQUEST_PAUSE
//!                       └──refused, not understood──► due after REQUEST_PAUSE
//! ```
//!
//! An agent of an older release does not answer the command. Another run of an agent is asked anew.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use futures_util::StreamExt as _;
use futures_util::stream::FuturesUnordered;
use tokio::sync::Notify;
use tokio_util::sync::CancellationToken;
use tracing::debug;
use tread_api::ids::BootId;
use tread_api::wire::state::{StateRate, WATCHED_STATE_RATE_HZ};

use super::App;
use super::presence::RobotKey;
use super::robot_link::Undelivered;

/// Duration of one request: two of them may be lost without an effect.
pub const REQUEST_DURATION: Duration = Duration::from_secs(5);
/// Interval of the requests to one robot.
pub const REQUEST_PERIOD: Duration = Duration::from_millis(1_500);
/// Number of unanswered requests after which a run that never answered gets none for [`REQUEST_PAUSE`].
pub const TRIES_MAX: u32 = 3;
/// Time without requests to a run that refused, or that never answered.
pub const REQUEST_PAUSE: Duration = Duration::from_mins(10);
/// Maximum number of requests under way.
pub const REQUESTS_AT_ONCE_MAX: usize = 32;
/// Interval of checks for robots that are due.
const CHECK_PERIOD: Duration = Duration::from_millis(250);
/// Maximum number of unwatched robots whose last answer is kept.
pub const REMEMBERED_MAX: usize = 4_096;

/// State of the requests to one run of an agent.
#[derive(Debug, Clone, Copy)]
struct Run {
    boot: BootId,
    due: Duration,
    is_pending: bool,
    /// Whether it has answered a request.
    has_answered: bool,
    /// Number of requests without an answer since the last answer.
    unanswered: u32,
}

/// A robot that somebody watches, or watched a short time ago.
#[derive(Debug, Default)]
struct Robot {
    watchers: usize,
    run: Option<Run>,
}

/// Outcome of a request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Outcome {
    Done,
    NoAnswer,
    /// Refused, or not understood.
    Refused,
}

/// Robots that are watched.
#[derive(Debug, Clone, Default)]
pub(super) struct Watched {
    robots: Arc<Mutex<HashMap<RobotKey, Robot>>>,
    begun: Arc<Notify>,
}

/// Somebody who watches a robot, until it is dropped.
#[derive(Debug)]
pub(super) struct Watch {
    watched: Watched,
    key: RobotKey,
}

impl Drop for Watch {
    fn drop(&mut self) {
        if let Some(robot) = self.watched.lock().get_mut(&self.key) {
            robot.watchers = robot.watchers.saturating_sub(1);
        }
    }
}

impl Watched {
    fn lock(&self) -> MutexGuard<'_, HashMap<RobotKey, Robot>> {
        self.robots.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns the number of robots that somebody watches.
    pub(super) fn count(&self) -> usize {
        let robots = self.lock();
        robots.values().filter(|robot| robot.watchers > 0).count()
    }

    /// Begins to watch a robot.
    pub(super) fn begin(&self, key: RobotKey) -> Watch {
        let mut robots = self.lock();
        let robot = robots.entry(key.clone()).or_default();
        robot.watchers += 1;
        if robot.watchers == 1 {
            self.begun.notify_one();
        }
        Watch {
            watched: self.clone(),
            key,
        }
    }

    /// Returns the robots to ask now, those that wait longest first, at most `room`; and whether
    /// there are more. `online` gives the present run of a robot that is online.
    fn due(
        &self,
        online: impl Fn(&RobotKey) -> Option<BootId>,
        now: Duration,
        room: usize,
    ) -> (Vec<(RobotKey, BootId)>, bool) {
        let mut robots = self.lock();
        evict_idle(&mut robots, now);
        let mut due: Vec<(Duration, RobotKey, &mut Run)> = Vec::new();
        for (key, robot) in robots.iter_mut().filter(|(_, robot)| robot.watchers > 0) {
            let Some(boot) = online(key) else {
                continue;
            };
            let is_same = robot.run.is_some_and(|run| run.boot == boot);
            if !is_same {
                robot.run = Some(Run {
                    boot,
                    due: now,
                    is_pending: false,
                    has_answered: false,
                    unanswered: 0,
                });
            }
            if let Some(run) = robot.run.as_mut()
                && !run.is_pending
                && run.due <= now
            {
                due.push((run.due, key.clone(), run));
            }
        }
        due.sort_by_key(|(since, ..)| *since);
        let has_more = due.len() > room;
        let requests = due.into_iter().take(room).map(|(_, key, run)| {
            run.is_pending = true;
            (key, run.boot)
        });
        (requests.collect(), has_more)
    }

    /// Records the outcome of a request, and schedules the next one.
    fn record_outcome(&self, (key, boot): &(RobotKey, BootId), outcome: Outcome, now: Duration) {
        let mut robots = self.lock();
        let run = robots.get_mut(key).and_then(|robot| robot.run.as_mut());
        // An answer of an earlier run says nothing about the present one.
        let Some(run) = run.filter(|run| run.boot == *boot) else {
            return;
        };
        run.is_pending = false;
        let rests = match outcome {
            Outcome::Done => {
                run.has_answered = true;
                run.unanswered = 0;
                false
            }
            Outcome::NoAnswer => {
                run.unanswered += 1;
                !run.has_answered && run.unanswered >= TRIES_MAX
            }
            Outcome::Refused => true,
        };
        if rests {
            run.unanswered = 0;
        }
        run.due = now + if rests { REQUEST_PAUSE } else { REQUEST_PERIOD };
    }
}

impl Run {
    /// Returns whether dropping this state would change nothing: a new state would be due now too.
    fn is_disposable(&self, now: Duration) -> bool {
        let forgotten_at = if self.unanswered > 0 {
            self.due.saturating_add(REQUEST_PAUSE)
        } else {
            self.due
        };
        !self.is_pending && forgotten_at <= now
    }
}

/// Drops the state of unwatched robots whose run needs no state. Keeps at most [`REMEMBERED_MAX`]
/// other unwatched robots, and drops those that are due first.
fn evict_idle(robots: &mut HashMap<RobotKey, Robot>, now: Duration) {
    robots.retain(|_, robot| {
        robot.watchers > 0
            || robot
                .run
                .as_ref()
                .is_some_and(|run| !run.is_disposable(now))
    });
    let unwatched = robots.values().filter(|robot| robot.watchers == 0).count();
    if unwatched <= REMEMBERED_MAX {
        return;
    }
    let mut left: Vec<(Duration, RobotKey)> = robots
        .iter()
        .filter(|(_, robot)| robot.watchers == 0)
        .filter_map(|(key, robot)| Some((robot.run?.due, key.clone())))
        .collect();
    left.sort();
    for (_, key) in left.drain(..left.len().saturating_sub(REMEMBERED_MAX)) {
        robots.remove(&key);
    }
}

impl App {
    /// Returns the number of robots that somebody watches by a drive socket.
    pub(crate) fn watched_robots(&self) -> usize {
        self.watched().count()
    }

    async fn ask_state_rate(&self, run: (RobotKey, BootId)) {
        let (key, boot) = &run;
        let command = StateRate {
            rate_hz: WATCHED_STATE_RATE_HZ,
            for_ms: u64::try_from(REQUEST_DURATION.as_millis()).unwrap_or(u64::MAX),
        };
        self.counters().state_rates_requested.one();
        let answer = self.commands().send_to(key, Some(*boot), &command).await;
        let outcome = match answer.map(|answer| answer.reply.into_result()) {
            Ok(Ok(())) => Outcome::Done,
            Ok(Err(refusal)) => {
                let detail = refusal.detail;
                debug!(robot.id = %key.1, "a higher state rate was refused: {detail}");
                Outcome::Refused
            }
            Err(Undelivered::Unreadable) => Outcome::Refused,
            Err(Undelivered::Unreachable | Undelivered::NoAnswer) => Outcome::NoAnswer,
        };
        self.watched()
            .record_outcome(&run, outcome, self.clock().elapsed());
    }
}

/// Requests the higher rate from the agents of watched robots until the stop.
pub async fn run(app: App, stop: CancellationToken) {
    let watched = app.watched().clone();
    let mut requests = FuturesUnordered::new();
    let mut looks = tokio::time::interval(CHECK_PERIOD);
    looks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    loop {
        let has_more = {
            let room = REQUESTS_AT_ONCE_MAX.saturating_sub(requests.len());
            let now = app.clock().elapsed();
            let online = |key: &RobotKey| app.presences().online_run(key, now);
            let (due, has_more) = watched.due(online, now, room);
            requests.extend(due.into_iter().map(|run| app.ask_state_rate(run)));
            has_more
        };
        loop {
            tokio::select! {
                biased;
                () = stop.cancelled() => return,
                _ = looks.tick() => break,
                () = watched.begun.notified() => break,
                Some(()) = requests.next(), if !requests.is_empty() => {
                    if has_more {
                        break;
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests;
