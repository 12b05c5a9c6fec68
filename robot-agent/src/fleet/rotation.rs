//! Which of several servers the agent connects to next.
//!
//! The agent stays with the server that it reached. When that one falls silent, or an attempt to reach
//! it fails, the next of the list is tried, and after the last one the first. There is no way back to a
//! preferred server while the present one answers: robots would move twice for each restart.
//!
//! A server that is gone refuses at once, while one that is frozen takes seconds of each attempt. So one
//! that fell silent, or took long to fail, is passed over for a while as long as there are others, and the first
//! attempts to reach one that fell silent are short.

use std::time::Duration;

/// First and longest pause after no server could be reached.
const PAUSE_FIRST: Duration = Duration::from_millis(100);
const PAUSE_MAX: Duration = Duration::from_millis(300);
/// Longest pause while the robot trusts the authority of none of them. A server counts each attempt
/// as a failure of its address, which other robots may share.
const DISTRUSTED_PAUSE_MAX: Duration = Duration::from_secs(10);

/// Time for which a server is passed over that fell silent: it may be a gap of the radio alone.
const LEFT_FOR: Duration = Duration::from_millis(300);
/// Time for which a server is passed over that took long to fail.
const PASSED_OVER: Duration = Duration::from_secs(5);
/// Maximum time of the first attempt to reach a server that fell silent; each further one may take twice as
/// long.
const SILENT_FIRST: Duration = Duration::from_millis(600);
/// Number of such attempts, after which one may take as long as any.
const SILENT_ATTEMPTS: u32 = 3;
/// Duration of an attempt from which it counts as long.
const LONG: Duration = Duration::from_secs(1);

/// What was logged about a server since it was reached last.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Logged {
    /// That the robot does not trust its authority.
    pub(super) distrusted: bool,
    /// That a certificate is not valid.
    pub(super) invalid: bool,
}

/// The server that is connected to, among those that the agent knows.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Rotation {
    endpoints: Vec<String>,
    logged: Vec<Logged>,
    /// Until when each is passed over.
    passed_over_until: Vec<Duration>,
    /// Number of attempts to reach each since it fell silent; `None` for one that has not.
    silent_attempts: Vec<Option<u32>>,
    at: usize,
    /// Whether all of the present round failed since the robot trusts no authority of theirs.
    is_distrusted: bool,
    pause: Duration,
}

impl Rotation {
    /// Begins with the first endpoint, of which there must be one.
    pub fn new(endpoints: &[String]) -> Self {
        Self {
            endpoints: endpoints.to_vec(),
            logged: vec![Logged::default(); endpoints.len()],
            passed_over_until: vec![Duration::ZERO; endpoints.len()],
            silent_attempts: vec![None; endpoints.len()],
            at: 0,
            is_distrusted: true,
            pause: PAUSE_FIRST,
        }
    }

    /// Returns whether there is more than one server.
    pub fn has_others(&self) -> bool {
        self.endpoints.len() > 1
    }

    /// Returns the endpoint to connect to.
    pub fn endpoint(&self) -> &str {
        self.endpoints.get(self.at).map_or("", String::as_str)
    }

    /// Returns what was logged about the server to connect to.
    pub fn logged(&mut self) -> &mut Logged {
        &mut self.logged[self.at]
    }

    /// Notes that the server was reached.
    pub fn reached(&mut self) {
        *self.logged() = Logged::default();
        self.passed_over_until[self.at] = Duration::ZERO;
        self.silent_attempts[self.at] = None;
        self.is_distrusted = true;
        self.pause = PAUSE_FIRST;
    }

    /// Returns the maximum time of the next attempt; `None` if it has no bound of its own. A server that is
    /// frozen takes connections, and says nothing.
    pub fn attempt_max(&self) -> Option<Duration> {
        let made = self.silent_attempts[self.at].filter(|made| *made < SILENT_ATTEMPTS)?;
        self.has_others().then(|| SILENT_FIRST * 2_u32.pow(made))
    }

    /// Goes on to the next server, since the present one fell silent before `now`.
    pub fn leave(&mut self, now: Duration) {
        self.passed_over_until[self.at] = now + LEFT_FOR;
        self.silent_attempts[self.at] = Some(0);
        self.next(now);
    }

    /// Forgets what was wrong with the servers, since the robot has another certificate.
    pub fn begin_anew(&mut self) {
        self.logged.fill(Logged::default());
        self.passed_over_until.fill(Duration::ZERO);
        self.silent_attempts.fill(None);
    }

    /// Goes on to the next server after an attempt that failed at `now`. Returns the pause before that one
    /// is tried: none until all have been.
    pub fn failed(&mut self, (began, now): (Duration, Duration), is_distrusted: bool) -> Duration {
        self.is_distrusted &= is_distrusted;
        if let Some(made) = &mut self.silent_attempts[self.at] {
            *made = made.saturating_add(1);
        }
        if is_distrusted {
            self.passed_over_until[self.at] = now + DISTRUSTED_PAUSE_MAX;
        } else if now.saturating_sub(began) >= LONG {
            self.passed_over_until[self.at] = now + PASSED_OVER;
        }
        if !self.next(now) {
            return Duration::ZERO;
        }
        let longest = if self.is_distrusted {
            DISTRUSTED_PAUSE_MAX
        } else {
            PAUSE_MAX
        };
        let pause = self.pause.min(longest);
        self.pause = (2 * pause).min(longest);
        self.is_distrusted = true;
        pause
    }

    /// Goes on to the next server that is not passed over, or to the one that will be so no longer first.
    /// Returns whether another round begins with it.
    fn next(&mut self, now: Duration) -> bool {
        let (count, before) = (self.endpoints.len(), self.at);
        let following = (1..=count).map(|step| (before + step) % count);
        let remaining = |at: &usize| self.passed_over_until[*at].saturating_sub(now);
        self.at = following.min_by_key(remaining).unwrap_or(before);
        self.at <= before
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use proptest::prelude::*;

    use super::*;

    fn servers(count: usize) -> Rotation {
        let endpoints: Vec<_> = (0..count).map(|at| format!("tls/s{at}:7447")).collect();
        Rotation::new(&endpoints)
    }

    /// Attempts that fail, of so many seconds: the servers, and the pauses in milliseconds.
    fn attempts(
        rotation: &mut Rotation,
        now: &mut Duration,
        took_s: &[f64],
    ) -> (String, Vec<u128>) {
        let (mut tried, mut pauses) = (String::new(), Vec::new());
        for took_s in took_s {
            tried.push_str(&rotation.endpoint()[5..6]);
            let began = *now;
            *now += Duration::from_secs_f64(*took_s);
            let pause = rotation.failed((began, *now), false);
            *now += pause;
            pauses.push(pause.as_millis());
        }
        (tried, pauses)
    }

    #[test]
    fn the_first_is_preferred_and_the_next_follows_without_a_pause() {
        let (mut rotation, mut now) = (servers(3), Duration::ZERO);
        let (tried, pauses) = attempts(&mut rotation, &mut now, &[0.0; 6]);
        assert_eq!(tried, "012012");
        assert_eq!(pauses, [0, 0, 100, 0, 0, 200]);
    }

    #[test]
    fn a_server_that_fell_silent_or_takes_long_is_passed_over_for_a_while() {
        let (mut rotation, mut now) = (servers(2), Duration::ZERO);
        rotation.reached();
        rotation.leave(now);
        let (tried, pauses) = attempts(&mut rotation, &mut now, &[0.1; 5]);
        assert_eq!(tried, "11010");
        assert_eq!(pauses, [100, 200, 0, 300, 0]);
        now += PASSED_OVER;
        // The first takes long, and then the other one does: the first will be tried again sooner.
        let (tried, _) = attempts(
            &mut rotation,
            &mut now,
            &[0.1, 2.5, 0.1, 0.1, 2.5, 0.1, 0.1],
        );
        assert_eq!(tried, "1011100");
        // One falls silent while the other is passed over for longer.
        rotation.reached();
        rotation.leave(now);
        let (tried, _) = attempts(&mut rotation, &mut now, &[0.1; 4]);
        assert_eq!(tried, "0000");
    }

    #[test]
    fn the_first_attempts_to_reach_a_server_that_fell_silent_are_short() {
        let mut rotation = servers(2);
        let now = Duration::ZERO;
        assert_eq!(rotation.attempt_max(), None);
        rotation.leave(now);
        assert_eq!(
            (rotation.endpoint(), rotation.attempt_max()),
            ("tls/s1:7447", None)
        );
        let mut bounds_ms = Vec::new();
        for _ in 0..5 {
            // The other one refuses, and this one has been silent for long enough.
            rotation.at = 0;
            bounds_ms.push(rotation.attempt_max().map(|max| max.as_millis()));
            rotation.failed((now, now), false);
        }
        assert_eq!(bounds_ms, [Some(600), Some(1_200), Some(2_400), None, None]);
        rotation.at = 0;
        rotation.reached();
        rotation.leave(now);
        rotation.at = 0;
        assert_eq!(rotation.attempt_max(), Some(SILENT_FIRST));
        let mut alone = servers(1);
        alone.leave(now);
        assert_eq!(alone.attempt_max(), None);
    }

    #[test]
    fn servers_of_a_foreign_authority_are_tried_rarely() {
        let mut rotation = servers(2);
        let now = Duration::ZERO;
        let longest = |rotation: &mut Rotation, distrusted: [bool; 2]| {
            let mut longest = Duration::ZERO;
            for _ in 0..20 {
                for is_distrusted in distrusted {
                    longest = longest.max(rotation.failed((now, now), is_distrusted));
                }
            }
            longest
        };
        assert_eq!(longest(&mut rotation, [true, true]), DISTRUSTED_PAUSE_MAX);
        rotation.reached();
        assert_eq!(longest(&mut rotation, [true, false]), PAUSE_MAX);
    }

    proptest! {
        #[test]
        fn each_server_is_tried_again_and_each_round_ends_with_a_pause(
            count in 1_usize..=8,
            before in proptest::collection::vec(any::<Option<bool>>(), 0..20),
        ) {
            let (mut rotation, mut now) = (servers(count), Duration::ZERO);
            for step in before {
                match step {
                    Some(is_distrusted) => {
                        rotation.failed((now, now), is_distrusted);
                    }
                    None => rotation.leave(now),
                }
            }
            rotation.reached();
            now += 2 * PASSED_OVER;
            let mut tried = BTreeSet::new();
            let mut pauses = 0;
            for _ in 0..count {
                tried.insert(rotation.endpoint().to_owned());
                pauses += usize::from(!rotation.failed((now, now), false).is_zero());
            }
            prop_assert_eq!((tried.len(), pauses), (count, 1));
        }
    }
}
