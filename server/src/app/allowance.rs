//! Rate limits on what robots make the server store unasked.
//!
//! What is stored for one robot is bounded in number; the limits here bound its rate, each with a
//! burst and an interval. They are in memory, so a restart of the server resets them.

use std::collections::HashMap;
use std::hash::Hash;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tread_api::ids::AlertCode;

use crate::app::presence::RobotKey;
use crate::rate_limit::{Bucket, RateLimit};

/// Limit for alerts of one code: a robot that raises and clears one alert all the time leaves room
/// for its others.
const ALERTS_OF_ONE_CODE: RateLimit = RateLimit {
    burst: 10,
    interval: Duration::from_secs(30),
};

/// Number of entries (robot and kind) above which those with a full allowance are forgotten.
const KEPT_MAX: usize = 50_000;

/// Kind of record that a robot makes the server store.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) enum Kind {
    /// A run of its agent.
    Run,
    /// Another configuration than before.
    Configuration,
    /// An alert that the robot raises.
    Alert,
    /// A stop that the robot caused itself.
    Stop,
}

impl Kind {
    const fn limit(self) -> RateLimit {
        let (burst, interval) = match self {
            Self::Run => (100, Duration::from_secs(10)),
            Self::Configuration => (10, Duration::from_mins(1)),
            Self::Alert => (40, Duration::from_secs(5)),
            Self::Stop => (3, Duration::from_secs(10)),
        };
        RateLimit { burst, interval }
    }
}

#[derive(Debug, Default)]
struct UsedAllowances {
    by_kind: HashMap<(RobotKey, Kind), Bucket>,
    by_code: HashMap<(RobotKey, AlertCode), Bucket>,
}

/// Allowances used so far, by robot.
#[derive(Debug, Default)]
pub(super) struct Allowances(Mutex<UsedAllowances>);

impl Allowances {
    fn lock(&self) -> MutexGuard<'_, UsedAllowances> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes one unit of the robot's allowance of this kind; false if none is left at `now`.
    pub(super) fn take(&self, robot: &RobotKey, kind: Kind, now: Duration) -> bool {
        let key = (robot.clone(), kind);
        take_of(&mut self.lock().by_kind, key, kind.limit(), now)
    }

    /// Takes one alert of this code; false if the allowance of the robot's alerts or of this code
    /// is used up.
    pub(super) fn take_alert(&self, robot: &RobotKey, code: &AlertCode, now: Duration) -> bool {
        let mut taken = self.lock();
        let of_code = (robot.clone(), code.clone());
        let known = taken.by_code.get(&of_code).copied().unwrap_or_default();
        let kind = Kind::Alert;
        known.has_one(ALERTS_OF_ONE_CODE, now)
            && take_of(&mut taken.by_kind, (robot.clone(), kind), kind.limit(), now)
            && take_of(&mut taken.by_code, of_code, ALERTS_OF_ONE_CODE, now)
    }
}

fn take_of<K: Eq + Hash>(
    all: &mut HashMap<K, Bucket>,
    key: K,
    limit: RateLimit,
    now: Duration,
) -> bool {
    if all.len() >= KEPT_MAX {
        all.retain(|_, bucket| !bucket.is_full(now));
    }
    all.entry(key).or_default().take(limit, now)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn key(robot: &str) -> RobotKey {
        ("yard".parse().unwrap(), robot.parse().unwrap())
    }

    #[test]
    fn one_that_waits_gets_one_and_robots_and_kinds_have_their_own() {
        let allowances = Allowances::default();
        let RateLimit { burst, interval } = Kind::Stop.limit();
        let take = |robot, kind, now| allowances.take(&key(robot), kind, now);
        for _ in 0..burst {
            assert!(take("rover-1", Kind::Stop, Duration::ZERO));
        }
        let half = interval / 2;
        assert!(!take("rover-1", Kind::Stop, half));
        assert!(take("rover-1", Kind::Run, half) && take("rover-2", Kind::Stop, half));
        assert!(take("rover-1", Kind::Stop, interval) && !take("rover-1", Kind::Stop, interval));
    }

    #[test]
    fn an_alert_that_comes_and_goes_leaves_room_for_others() {
        let allowances = Allowances::default();
        let code = |code: &str| code.parse::<AlertCode>().unwrap();
        let take = |code: &AlertCode, now| allowances.take_alert(&key("rover-1"), code, now);
        let flapping = code("loop-overrun");
        let raised = (0..1_000).filter(|_| take(&flapping, Duration::ZERO));
        assert_eq!(raised.count(), 10);
        assert!(take(&code("standstill-not-reached"), Duration::ZERO));
        // Alerts of ever new codes are limited by the allowance of all alerts of the robot.
        let others = (0..1_000).map(|number| code(&format!("code-{number}")));
        let raised = others.filter(|code| take(code, Duration::ZERO)).count();
        assert_eq!(raised, 40 - 11);
        assert!(!take(&flapping, Duration::from_secs(29)));
        assert!(take(&flapping, Duration::from_secs(30)));
    }
}
