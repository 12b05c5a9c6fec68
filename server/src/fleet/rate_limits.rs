//! Limits of each robot's messages, which share queues, replies and the log with those of all
//! others.
//!
//! A robot that exceeds a limit loses its own messages, before they take room from others. A limit
//! is a rate with a burst, and a maximum number of messages that wait or are being answered. The
//! number of liveliness tokens is limited too; of those that come too fast the newest few are
//! processed later, so that a robot that calms down is seen. The router keeps every token
//! nevertheless, and thousands of them delay every robot's messages: a robot with far too many
//! loses its links.

use std::collections::{HashMap, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use super::tokens::CLOSED_MAX;
use crate::app::presence::RobotKey;
use crate::rate_limit::{Bucket, RateLimit};

/// Maximum number of robots tracked; idle ones are forgotten first.
const TRACKED_ROBOTS_MAX: usize = 50_000;
/// Maximum number of tokens processed per robot, on all routers: a few runs of its agent.
const TOKENS_MAX: usize = 16;
/// Maximum number of tokens per robot kept for later.
const LATE_TOKENS_MAX: usize = 4;
/// Maximum number of tokens of one robot on one router, and burst of appearing ones; one more per
/// second. An agent declares one each time it connects.
const DECLARED_TOKENS_MAX: u32 = 128;
const DECLARED_TOKENS_RATE: RateLimit = RateLimit {
    burst: DECLARED_TOKENS_MAX,
    interval: Duration::from_secs(1),
};
/// Minimum interval between two log entries about one robot's refused messages.
const LOG_EVERY: Duration = Duration::from_secs(10);

/// Kind of a robot's message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    /// Its state.
    State,
    /// Its friction report.
    Friction,
    /// Its hello.
    Hello,
    /// A batch of records.
    Upload,
    /// A liveliness token.
    Token,
}

/// Limit of one kind of message.
#[derive(Debug, Clone, Copy)]
struct Limit {
    rate: RateLimit,
    waiting_max: u32,
}

impl Kind {
    const COUNT: usize = 5;

    const fn index(self) -> usize {
        match self {
            Self::State => 0,
            Self::Friction => 1,
            Self::Hello => 2,
            Self::Upload => 3,
            Self::Token => 4,
        }
    }

    const fn limit(self) -> Limit {
        match self {
            // Agents publish states at 5 Hz and friction at 2 Hz by default.
            Self::State | Self::Friction => Limit {
                rate: RateLimit::new(200, Duration::from_millis(10)),
                waiting_max: 32,
            },
            Self::Hello => Limit {
                rate: RateLimit::new(20, Duration::from_millis(200)),
                waiting_max: 4,
            },
            // An agent sends the next batch after the receipt for the preceding one.
            Self::Upload => Limit {
                rate: RateLimit::new(400, Duration::from_millis(5)),
                waiting_max: 8,
            },
            Self::Token => Limit {
                rate: RateLimit::new(40, Duration::from_secs(1)),
                waiting_max: u32::MAX,
            },
        }
    }
}

/// Used part of one robot's limit of one kind.
#[derive(Debug, Clone, Copy, Default)]
struct Used {
    bucket: Bucket,
    waiting: u32,
}

impl Used {
    fn take(&mut self, limit: Limit, now: Duration) -> bool {
        self.waiting < limit.waiting_max && self.bucket.take(limit.rate, now)
    }
}

/// A token (its key) on a router (its number).
pub(super) type TokenPlace = (String, u64);

/// Decision on a liveliness token that appeared.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum TokenVerdict {
    /// Processed.
    Accepted,
    /// Not processed, or only later.
    Refused,
    /// Not processed, and its robot has so many that others are affected: its links must be cut.
    Excessive,
}

#[derive(Debug, Default)]
struct Robot {
    used: [Used; Kind::COUNT],
    tokens: Vec<TokenPlace>,
    /// Number of tokens by router, processed or not.
    declared: HashMap<u64, u32>,
    appearing: Bucket,
    late: VecDeque<TokenPlace>,
    logged_at: Option<Duration>,
    unlogged: u64,
}

impl Robot {
    fn take(&mut self, kind: Kind, now: Duration) -> bool {
        self.used[kind.index()].take(kind.limit(), now)
    }

    /// Returns whether the robot uses nothing of its limits.
    fn is_quiet(&self, now: Duration) -> bool {
        let is_idle = |used: &Used| used.waiting == 0 && used.bucket.is_full(now);
        let logs_again = |at| now.saturating_sub(at) >= LOG_EVERY;
        self.tokens.is_empty()
            && self.declared.is_empty()
            && self.appearing.is_full(now)
            && self.late.is_empty()
            && self.logged_at.is_none_or(logs_again)
            && self.used.iter().all(is_idle)
    }

    /// Counts a token on a router; returns whether there are too many.
    fn declared(&mut self, router: u64, now: Duration) -> bool {
        let count = self.declared.entry(router).or_default();
        *count += 1;
        *count > DECLARED_TOKENS_MAX || !self.appearing.take(DECLARED_TOKENS_RATE, now)
    }

    /// Processes a token if there is room and it does not come too fast; returns whether it did.
    fn handle_token(&mut self, place: &TokenPlace, now: Duration) -> bool {
        let is_taken = self.tokens.len() < TOKENS_MAX && self.take(Kind::Token, now);
        if is_taken {
            self.tokens.push(place.clone());
        }
        is_taken
    }
}

/// Limits of all robots.
#[derive(Debug, Clone, Default)]
pub(super) struct RateLimits {
    robots: Arc<Mutex<HashMap<RobotKey, Robot>>>,
    /// Routers that were closed; locked before the robots.
    closed: Arc<Mutex<VecDeque<u64>>>,
}

/// Place of one message that waits or is being answered; dropping it frees the place.
#[derive(Debug)]
pub(super) struct Place {
    limits: RateLimits,
    robot: RobotKey,
    kind: Kind,
}

impl Place {
    /// Returns the robot whose message it is.
    pub(super) fn robot(&self) -> &RobotKey {
        &self.robot
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        if let Some(robot) = self.limits.lock().get_mut(&self.robot) {
            let used = &mut robot.used[self.kind.index()];
            used.waiting = used.waiting.saturating_sub(1);
        }
    }
}

impl RateLimits {
    fn lock(&self) -> MutexGuard<'_, HashMap<RobotKey, Robot>> {
        self.robots.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Calls `act` with a robot's used limits; `None` if too many other robots are busy.
    fn with<T>(
        &self,
        key: &RobotKey,
        now: Duration,
        act: impl FnOnce(&mut Robot) -> T,
    ) -> Option<T> {
        let mut robots = self.lock();
        if let Some(robot) = robots.get_mut(key) {
            return Some(act(robot));
        }
        if robots.len() >= TRACKED_ROBOTS_MAX {
            robots.retain(|_, robot| !robot.is_quiet(now));
        }
        if robots.len() >= TRACKED_ROBOTS_MAX {
            return None;
        }
        let robot = robots.entry(key.clone()).or_default();
        Some(act(robot))
    }

    /// Takes a place for a message of a robot; `None` beyond its limit.
    pub(super) fn admit(&self, robot: RobotKey, kind: Kind, now: Duration) -> Option<Place> {
        let is_admitted = self.with(&robot, now, |known| {
            let is_admitted = known.take(kind, now);
            known.used[kind.index()].waiting += u32::from(is_admitted);
            is_admitted
        });
        is_admitted?.then(|| Place {
            limits: self.clone(),
            robot,
            kind,
        })
    }

    /// Handles a robot's token that appeared.
    pub(super) fn token_appeared(
        &self,
        robot: &RobotKey,
        place: TokenPlace,
        now: Duration,
    ) -> TokenVerdict {
        let closed = self.closed.lock().unwrap_or_else(PoisonError::into_inner);
        if closed.contains(&place.1) {
            // It was under way when the router closed, and would otherwise stay for ever.
            return TokenVerdict::Refused;
        }
        let appeared = self.with(robot, now, |known| {
            let is_excessive = known.declared(place.1, now);
            if known.tokens.contains(&place) || known.handle_token(&place, now) {
                return TokenVerdict::Accepted;
            }
            if known.late.len() >= LATE_TOKENS_MAX {
                known.late.pop_front();
            }
            known.late.push_back(place);
            if is_excessive {
                TokenVerdict::Excessive
            } else {
                TokenVerdict::Refused
            }
        });
        appeared.unwrap_or(TokenVerdict::Refused)
    }

    /// Handles a robot's token that vanished; returns whether it had been processed.
    pub(super) fn token_gone(&self, robot: &RobotKey, place: &TokenPlace) -> bool {
        let mut robots = self.lock();
        let Some(known) = robots.get_mut(robot) else {
            return false;
        };
        known.late.retain(|late| late != place);
        if let Some(count) = known.declared.get_mut(&place.1) {
            *count -= 1;
            if *count == 0 {
                known.declared.remove(&place.1);
            }
        }
        let before = known.tokens.len();
        known.tokens.retain(|token| token != place);
        known.tokens.len() < before
    }

    /// Forgets a closed router and the tokens on it.
    pub(super) fn router_closed(&self, router: u64) {
        let mut closed = self.closed.lock().unwrap_or_else(PoisonError::into_inner);
        if closed.len() >= CLOSED_MAX {
            closed.pop_front();
        }
        closed.push_back(router);
        for known in self.lock().values_mut() {
            known.tokens.retain(|(_, on)| *on != router);
            known.late.retain(|(_, on)| *on != router);
            known.declared.remove(&router);
        }
    }

    /// Returns tokens that came too fast and are processed now.
    pub(super) fn late_tokens(&self, now: Duration) -> Vec<TokenPlace> {
        let mut taken = Vec::new();
        for known in self.lock().values_mut() {
            while let Some(newest) = known.late.back().cloned() {
                if !known.handle_token(&newest, now) {
                    break;
                }
                known.late.pop_back();
                taken.push(newest);
            }
        }
        taken
    }

    /// Decides whether a refused message is logged; returns the number of those not logged before
    /// it.
    pub(super) fn log_refused(&self, robot: &RobotKey, now: Duration) -> Option<u64> {
        let due = self.with(robot, now, |known| {
            let is_due = known
                .logged_at
                .is_none_or(|at| now.saturating_sub(at) >= LOG_EVERY);
            if is_due {
                known.logged_at = Some(now);
                return Some(std::mem::take(&mut known.unlogged));
            }
            known.unlogged += 1;
            None
        });
        due.flatten()
    }
}

#[cfg(test)]
mod tests;
