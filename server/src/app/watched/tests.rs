//! When the agents of watched robots are asked.

use std::collections::BTreeMap;

use uuid::Uuid;

use super::*;

/// How often the task looks, in these tests.
const STEP: Duration = Duration::from_millis(500);

fn key(number: usize) -> RobotKey {
    let robot = format!("rover-{number}").parse().unwrap();
    ("yard".parse().unwrap(), robot)
}

fn boot(number: u128) -> BootId {
    BootId::from_uuid(Uuid::from_u128(number))
}

/// All robots are online with this run, and every request gets the same answer at once.
struct Fleet {
    watched: Watched,
    now: Duration,
    boot: BootId,
    answer: Outcome,
    asked: BTreeMap<RobotKey, usize>,
}

impl Fleet {
    fn new(answer: Outcome) -> Self {
        Self {
            watched: Watched::default(),
            now: Duration::from_secs(1),
            boot: boot(1),
            answer,
            asked: BTreeMap::new(),
        }
    }

    fn pass(&mut self, span: Duration) {
        let end = self.now + span;
        while self.now < end {
            let (due, _) = self
                .watched
                .due(|_| Some(self.boot), self.now, REQUESTS_AT_ONCE_MAX);
            for asked in due {
                self.watched.record_outcome(&asked, self.answer, self.now);
                *self.asked.entry(asked.0).or_default() += 1;
            }
            self.now += STEP;
        }
    }

    fn asked(&self, number: usize) -> usize {
        self.asked.get(&key(number)).copied().unwrap_or(0)
    }
}

#[test]
fn several_watchers_of_a_robot_cost_one_request_and_others_none() {
    let mut fleet = Fleet::new(Outcome::Done);
    let watchers: Vec<Watch> = (0..40).map(|_| fleet.watched.begin(key(1))).collect();
    fleet.pass(10 * REQUEST_PERIOD);
    assert_eq!((fleet.asked(1), fleet.asked(2)), (10, 0));
    assert_eq!(fleet.watched.count(), 1);
    drop(watchers);
    fleet.pass(10 * REQUEST_PERIOD);
    assert_eq!(fleet.asked(1), 10, "nobody watches it any more");
    assert_eq!(fleet.watched.count(), 0);
    assert!(fleet.watched.lock().is_empty());
}

#[test]
fn a_request_outlasts_two_that_are_lost() {
    assert!(REQUEST_DURATION > 3 * REQUEST_PERIOD);
    let for_ms = u64::try_from(REQUEST_DURATION.as_millis()).unwrap();
    assert!(for_ms <= tread_api::wire::state::STATE_RATE_FOR_MAX_MS);
}

#[test]
fn a_run_that_never_answers_is_left_alone_also_when_it_is_watched_again_and_again() {
    let mut fleet = Fleet::new(Outcome::NoAnswer);
    for _ in 0..100 {
        let watch = fleet.watched.begin(key(1));
        fleet.pass(REQUEST_PERIOD);
        drop(watch);
        fleet.pass(REQUEST_PERIOD);
    }
    assert_eq!(fleet.asked(1), TRIES_MAX as usize);
    let _watch = fleet.watched.begin(key(1));
    // Another run may be of a newer release.
    fleet.boot = boot(2);
    fleet.answer = Outcome::Done;
    fleet.pass(2 * REQUEST_PERIOD);
    assert_eq!(fleet.asked(1), TRIES_MAX as usize + 2);
}

#[test]
fn a_run_that_has_answered_is_asked_on_after_an_outage() {
    let mut fleet = Fleet::new(Outcome::Done);
    let _watch = fleet.watched.begin(key(1));
    fleet.pass(REQUEST_PERIOD);
    fleet.answer = Outcome::NoAnswer;
    fleet.pass(10 * REQUEST_PERIOD);
    assert_eq!(fleet.asked(1), 11);
}

#[test]
fn a_refusal_is_final_for_a_while() {
    let mut fleet = Fleet::new(Outcome::Refused);
    let _watch = fleet.watched.begin(key(1));
    fleet.pass(REQUEST_PAUSE);
    assert_eq!(fleet.asked(1), 1);
    fleet.pass(REQUEST_PERIOD);
    assert_eq!(fleet.asked(1), 2);
}

#[test]
fn robots_that_are_not_online_are_not_asked() {
    let watched = Watched::default();
    let _watch = watched.begin(key(1));
    let (due, has_more) = watched.due(|_| None, Duration::from_secs(1), REQUESTS_AT_ONCE_MAX);
    assert!(due.is_empty() && !has_more);
}

#[test]
fn five_hundred_watched_robots_are_asked_in_turn_and_never_too_many_at_once() {
    let watched = Watched::default();
    let watchers: Vec<Watch> = (0..500).map(|number| watched.begin(key(number))).collect();
    let now = Duration::from_secs(1);
    let online = |_: &RobotKey| Some(boot(1));
    let (first, has_more) = watched.due(online, now, REQUESTS_AT_ONCE_MAX);
    assert_eq!((first.len(), has_more), (REQUESTS_AT_ONCE_MAX, true));
    // While these are under way there is no room for others.
    assert_eq!(watched.due(online, now, 0), (Vec::new(), true));
    let mut asked: BTreeMap<RobotKey, usize> = BTreeMap::new();
    let mut under_way = first;
    while !under_way.is_empty() {
        for one in under_way {
            watched.record_outcome(&one, Outcome::Done, now);
            *asked.entry(one.0).or_default() += 1;
        }
        under_way = watched.due(online, now, REQUESTS_AT_ONCE_MAX).0;
    }
    assert_eq!(asked.len(), 500);
    assert!(asked.values().all(|&times| times == 1), "{asked:?}");
    drop(watchers);
    watched.due(online, now + REQUEST_PERIOD, REQUESTS_AT_ONCE_MAX);
    assert!(watched.lock().is_empty());
}

#[test]
fn what_is_remembered_of_robots_that_nobody_watches_is_bounded() {
    let watched = Watched::default();
    let now = Duration::from_secs(1);
    let online = |_: &RobotKey| Some(boot(1));
    for number in 0..REMEMBERED_MAX + 100 {
        let watch = watched.begin(key(number));
        let (due, _) = watched.due(online, now, REQUESTS_AT_ONCE_MAX);
        for asked in due {
            watched.record_outcome(&asked, Outcome::Refused, now);
        }
        drop(watch);
    }
    watched.due(online, now, REQUESTS_AT_ONCE_MAX);
    assert_eq!(watched.lock().len(), REMEMBERED_MAX);
}
