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
    let appeared: Vec<TokenVerdict> = (0..23_000).map(|number| appear(number, ms(0))).collect();
    let count = |which| appeared.iter().filter(|&&one| one == which).count();
    assert_eq!(count(TokenVerdict::Accepted), TOKENS_MAX);
    assert_eq!(
        count(TokenVerdict::Excessive),
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
    assert_eq!(other, TokenVerdict::Accepted);
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
            prop_assert_ne!(appeared, TokenVerdict::Excessive);
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
            prop_assert_eq!(appeared == TokenVerdict::Excessive, is_beyond);
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
    assert_eq!(last, Some(TokenVerdict::Excessive), "it came too fast");
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
        assert_eq!(appeared, TokenVerdict::Refused);
    }
    assert!(limits.late_tokens(ms(60_000)).is_empty());
    let present = limits.token_appeared(&rover, ("present".to_owned(), 1), ms(60_000));
    assert_eq!(present, TokenVerdict::Accepted);
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
    for number in 0..=TRACKED_ROBOTS_MAX {
        drop(limits.admit(robot(&format!("r{number}")), Kind::State, ms(0)));
    }
    assert_eq!(limits.lock().len(), TRACKED_ROBOTS_MAX);
    let later = Duration::from_mins(2);
    assert!(limits.admit(robot("late"), Kind::State, later).is_some());
    assert_eq!(limits.lock().len(), 1);
}
