//! Rate limits of each robot on what all robots go through: queues, answers, the log.
//!
//! A robot that sends more than its limit loses its own messages, before they take room from
//! anybody else's. A limit is a rate with a burst, and a number of messages that may wait or be
//! answered at the same time. Liveliness tokens are bounded in number too; of those that come too
//! fast the newest few are taken up later, so that a robot that calms down is seen. The router keeps
//! every token all the same, and thousands of them slow every robot's messages down: a robot with
//! far too many loses its link.

use std::collections::{HashMap, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use crate::app::presence::RobotKey;
use crate::rate_limit::{Bucket, RateLimit};

/// Robots that are kept track of; those that have been quiet are forgotten first.
const ROBOTS_MAX: usize = 50_000;
/// Tokens of one robot that are known on all routers: a few runs of its agent.
const TOKENS_MAX: usize = 16;
/// Tokens of one robot that are taken up later.
const LATE_TOKENS_MAX: usize = 4;
/// Tokens of one robot that one router may have, and that may appear at once; one more each second.
/// An agent declares one each time it connects.
const DECLARED_TOKENS_MAX: u32 = 128;
const DECLARED_TOKENS_RATE: RateLimit = RateLimit {
    burst: DECLARED_TOKENS_MAX,
    interval: Duration::from_secs(1),
};
/// Least time between two log lines on one robot's refused messages.
const LOG_EVERY: Duration = Duration::from_secs(10);

/// What a robot sends.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    /// Its state.
    State,
    /// Its friction report.
    Friction,
    /// Its introduction.
    Hello,
    /// A batch of records.
    Upload,
    /// A liveliness token.
    Token,
}

/// The limit of one kind.
#[derive(Debug, Clone, Copy)]
struct Limit {
    rate: RateLimit,
    waiting_max: u32,
}

impl Limit {
    const fn new(burst: u32, interval_ms: u64, waiting_max: u32) -> Self {
        Self {
            rate: RateLimit {
                burst,
                interval: Duration::from_millis(interval_ms),
            },
            waiting_max,
        }
    }
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
            Self::State | Self::Friction => Limit::new(200, 10, 32),
            Self::Hello => Limit::new(20, 200, 4),
            // An agent sends the next batch when it has the receipt for the one before.
            Self::Upload => Limit::new(400, 5, 8),
            Self::Token => Limit::new(40, 1_000, u32::MAX),
        }
    }
}

/// What one robot uses of its limit of one kind.
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

/// A token on a router.
pub(super) type TokenPlace = (String, u64);

/// What becomes of a token that appeared.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Appeared {
    /// It is taken up.
    Taken,
    /// It is not, or later.
    Refused,
    /// It is not, and its robot has so many that others suffer: its links are to be cut.
    Excessive,
}

#[derive(Debug, Default)]
struct Robot {
    used: [Used; Kind::COUNT],
    tokens: Vec<TokenPlace>,
    /// How many each router has, whether taken up or not.
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

    /// Whether all is as if it had never been heard.
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

    /// Counts a token that is on a router, and says whether that is more than others can bear.
    fn declared(&mut self, router: u64, now: Duration) -> bool {
        let there = self.declared.entry(router).or_default();
        *there += 1;
        *there > DECLARED_TOKENS_MAX || !self.appearing.take(DECLARED_TOKENS_RATE, now)
    }

    /// Takes a token up, if there is room and it does not come too fast.
    fn take_token(&mut self, place: &TokenPlace, now: Duration) -> bool {
        let is_taken = self.tokens.len() < TOKENS_MAX && self.take(Kind::Token, now);
        if is_taken {
            self.tokens.push(place.clone());
        }
        is_taken
    }
}

/// Closed routers that are remembered: what was on its way is there long before so many more close.
const CLOSED_MAX: usize = 64;

/// All robots' limits.
#[derive(Debug, Clone, Default)]
pub(super) struct RateLimits {
    robots: Arc<Mutex<HashMap<RobotKey, Robot>>>,
    /// Routers that were closed; held before the robots.
    closed: Arc<Mutex<VecDeque<u64>>>,
}

/// A message's place among those of its robot that wait or are being answered; free when dropped.
#[derive(Debug)]
pub(super) struct Place {
    limits: RateLimits,
    robot: RobotKey,
    kind: Kind,
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

    /// Does something with what a robot uses; nothing if too many others are busy.
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
        if robots.len() >= ROBOTS_MAX {
            robots.retain(|_, robot| !robot.is_quiet(now));
        }
        if robots.len() >= ROBOTS_MAX {
            return None;
        }
        let robot = robots.entry(key.clone()).or_default();
        Some(act(robot))
    }

    /// Takes a place for a message of a robot; `None` if that is more than its limit.
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

    /// A token of a robot appeared.
    pub(super) fn token_appeared(
        &self,
        robot: &RobotKey,
        place: TokenPlace,
        now: Duration,
    ) -> Appeared {
        let closed = self.closed.lock().unwrap_or_else(PoisonError::into_inner);
        if closed.contains(&place.1) {
            // It was on its way when the router closed, and would keep its place for ever.
            return Appeared::Refused;
        }
        let appeared = self.with(robot, now, |known| {
            let is_excessive = known.declared(place.1, now);
            if known.tokens.contains(&place) || known.take_token(&place, now) {
                return Appeared::Taken;
            }
            if known.late.len() >= LATE_TOKENS_MAX {
                known.late.pop_front();
            }
            known.late.push_back(place);
            if is_excessive {
                Appeared::Excessive
            } else {
                Appeared::Refused
            }
        });
        appeared.unwrap_or(Appeared::Refused)
    }

    /// A token of a robot is gone; whether it had been taken up.
    pub(super) fn token_gone(&self, robot: &RobotKey, place: &TokenPlace) -> bool {
        let mut robots = self.lock();
        let Some(known) = robots.get_mut(robot) else {
            return false;
        };
        known.late.retain(|late| late != place);
        if let Some(there) = known.declared.get_mut(&place.1) {
            *there -= 1;
            if *there == 0 {
                known.declared.remove(&place.1);
            }
        }
        let before = known.tokens.len();
        known.tokens.retain(|token| token != place);
        known.tokens.len() < before
    }

    /// A router is closed, and with it the tokens on it.
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

    /// Tokens that came too fast and are taken up now.
    pub(super) fn late_tokens(&self, now: Duration) -> Vec<TokenPlace> {
        let mut taken = Vec::new();
        for known in self.lock().values_mut() {
            while let Some(newest) = known.late.back().cloned() {
                if !known.take_token(&newest, now) {
                    break;
                }
                known.late.pop_back();
                taken.push(newest);
            }
        }
        taken
    }

    /// Whether a refused message of a robot is to be logged: with how many were not, before it.
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
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn robot(name: &str) -> RobotKey {
        ("yard".parse().unwrap(), name.parse().unwrap())
    }

    fn ms(ms: u64) -> Duration {
        Duration::from_millis(ms)
    }

    const KINDS: [Kind; 4] = [Kind::State, Kind::Friction, Kind::Hello, Kind::Upload];

    proptest! {
        #[test]
        fn whatever_one_robot_sends_it_gets_no_more_than_its_limit_and_another_all_it_needs(
            gaps_us in prop::collection::vec(0_u64..4_000, 1..4_000),
            kind in prop::sample::select(&KINDS[..]),
        ) {
            let limits = RateLimits::default();
            let mut places = VecDeque::new();
            let (mut now, mut admitted) = (Duration::ZERO, 0);
            for (index, gap_us) in gaps_us.into_iter().enumerate() {
                now += Duration::from_micros(gap_us);
                if let Some(place) = limits.admit(robot("loud"), kind, now) {
                    admitted += 1_u128;
                    places.push_back(place);
                }
                let limit = kind.limit();
                prop_assert!(u32::try_from(places.len()).unwrap() <= limit.waiting_max);
                if index % 3 == 0 {
                    places.pop_front();
                }
                let earned = now.as_millis() / limit.rate.interval.as_millis();
                prop_assert!(admitted <= u128::from(limit.rate.burst) + earned);
                if index % 500 == 0 {
                    prop_assert!(limits.admit(robot("quiet"), kind, now).is_some());
                }
            }
        }
    }

    #[test]
    fn a_message_waits_until_its_place_is_free_again() {
        let limits = RateLimits::default();
        let hello = || limits.admit(robot("rover-1"), Kind::Hello, ms(0));
        let waiting: Vec<_> = (0..Kind::Hello.limit().waiting_max)
            .map(|_| hello())
            .collect();
        assert!(waiting.iter().all(Option::is_some));
        assert!(hello().is_none());
        drop(waiting);
        assert!(hello().is_some());
    }

    #[test]
    fn of_a_flood_of_tokens_few_are_taken_up_and_the_newest_later() {
        let limits = RateLimits::default();
        let rover = robot("rover-1");
        let place = |number: u32| (number.to_string(), 0);
        let appear = |number, at| limits.token_appeared(&rover, place(number), at);
        let appeared: Vec<Appeared> = (0..23_000).map(|number| appear(number, ms(0))).collect();
        let count = |which| appeared.iter().filter(|&&one| one == which).count();
        assert_eq!(count(Appeared::Taken), TOKENS_MAX);
        assert_eq!(
            count(Appeared::Excessive),
            23_000 - DECLARED_TOKENS_MAX as usize
        );
        assert!(
            limits.late_tokens(ms(60_000)).is_empty(),
            "there is no room"
        );
        for number in 0..22_990 {
            assert_eq!(limits.token_gone(&rover, &place(number)), number < 16);
        }
        assert_eq!(limits.late_tokens(ms(60_001)).len(), LATE_TOKENS_MAX);
        assert!(limits.token_gone(&rover, &place(22_999)));
        let other = limits.token_appeared(&robot("rover-2"), place(1), ms(0));
        assert_eq!(other, Appeared::Taken);
    }

    proptest! {
        #[test]
        fn a_robot_that_reconnects_once_a_second_is_never_cut_however_its_tokens_come_and_go(
            lives in prop::collection::vec((0_u64..2, 1_u64..90), 1..600),
        ) {
            let limits = RateLimits::default();
            let rover = robot("rover-1");
            let mut there = VecDeque::new();
            for (number, (router, seconds)) in lives.into_iter().enumerate() {
                let now = ms(1_000 * number as u64);
                while there.front().is_some_and(|&(until, _)| until <= number as u64) {
                    let (_, place) = there.pop_front().unwrap();
                    limits.token_gone(&rover, &place);
                }
                let place = (number.to_string(), router);
                let appeared = limits.token_appeared(&rover, place.clone(), now);
                prop_assert_ne!(appeared, Appeared::Excessive);
                let latest = there.back().map_or(0, |&(until, _)| until);
                there.push_back((latest.max(number as u64 + seconds), place));
            }
        }

        #[test]
        fn tokens_that_stay_are_excessive_beyond_their_bound_however_slowly_they_come(
            gap_s in 1_u64..100,
        ) {
            let limits = RateLimits::default();
            for number in 0..=u64::from(DECLARED_TOKENS_MAX) {
                let place = (number.to_string(), 0);
                let appeared = limits.token_appeared(&robot("rover-1"), place, ms(1_000 * gap_s * number));
                let is_beyond = number == u64::from(DECLARED_TOKENS_MAX);
                prop_assert_eq!(appeared == Appeared::Excessive, is_beyond);
            }
        }
    }

    #[test]
    fn a_run_that_starts_over_and_over_is_seen_when_it_calms_down() {
        let limits = RateLimits::default();
        let rover = robot("rover-1");
        let mut last = None;
        for number in 0..200_u32 {
            let place = (number.to_string(), 0);
            last = Some(limits.token_appeared(&rover, place.clone(), ms(0)));
            if number < 199 {
                limits.token_gone(&rover, &place);
            }
        }
        assert_eq!(last, Some(Appeared::Excessive), "it came too fast");
        assert!(limits.late_tokens(ms(500)).is_empty());
        assert_eq!(limits.late_tokens(ms(1_500)), [("199".to_owned(), 0)]);
        assert!(limits.token_gone(&rover, &("199".to_owned(), 0)));
        limits.router_closed(0);
    }

    #[test]
    fn tokens_that_come_after_their_router_has_closed_take_no_place() {
        let limits = RateLimits::default();
        let rover = robot("rover-1");
        limits.router_closed(0);
        for number in 0..100 {
            let appeared = limits.token_appeared(&rover, (number.to_string(), 0), ms(0));
            assert_eq!(appeared, Appeared::Refused);
        }
        assert!(limits.late_tokens(ms(60_000)).is_empty());
        let present = limits.token_appeared(&rover, ("present".to_owned(), 1), ms(60_000));
        assert_eq!(present, Appeared::Taken);
    }

    #[test]
    fn refused_messages_are_logged_now_and_then_with_their_count() {
        let limits = RateLimits::default();
        let rover = robot("rover-1");
        let logged: Vec<u64> = (0..100_000)
            .filter_map(|number| limits.log_refused(&rover, ms(number / 4)))
            .collect();
        assert_eq!(logged, [0, 39_999, 39_999]);
    }

    #[test]
    fn robots_that_are_kept_track_of_are_bounded_and_quiet_ones_make_room() {
        let limits = RateLimits::default();
        for number in 0..=ROBOTS_MAX {
            drop(limits.admit(robot(&format!("r{number}")), Kind::State, ms(0)));
        }
        assert_eq!(limits.lock().len(), ROBOTS_MAX);
        let later = Duration::from_mins(2);
        assert!(limits.admit(robot("late"), Kind::State, later).is_some());
        assert_eq!(limits.lock().len(), 1);
    }
}
