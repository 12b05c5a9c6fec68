//! Which of several servers the agent connects to next.
//!
//! The agent stays connected to the server that it has reached. If that server falls silent, or an attempt to
//! reach it fails, the agent tries the next one of the list, and the first after the last. It does not return
//! to a preferred server while the present one answers: otherwise it would move twice for each restart.
//!
//! A server that is not running refuses a connection at once; an attempt to reach one that is frozen or cut off
//! takes seconds. The agent therefore tries the others in parallel with a slow attempt, and uses the server
//! that it reaches first (as RFC 8305 does for the addresses of a host). It skips a server that fell silent, or
//! failed slowly, for some time.

use std::ops::Range;
use std::time::Duration;

/// First and longest pause after no server could be reached.
const PAUSE_FIRST: Duration = Duration::from_millis(100);
const PAUSE_MAX: Duration = Duration::from_millis(300);
/// Longest pause while the robot trusts the authority of none of them. A server counts each attempt
/// as a failure of its address, which other robots may share.
const DISTRUSTED_PAUSE_MAX: Duration = Duration::from_secs(10);

/// Time for which a server is passed over that fell silent: it may be a gap of the radio alone.
const SKIP_AFTER_SILENCE: Duration = Duration::from_millis(300);
/// Time for which a server is passed over that took long to fail.
const SKIP_AFTER_SLOW_FAILURE: Duration = Duration::from_secs(5);
/// Duration of an attempt from which it counts as long.
const LONG: Duration = Duration::from_secs(1);
/// Duration of an attempt after which the next server is tried in parallel (the connection attempt delay of RFC 8305), and the pause between two attempts
/// to reach that one.
const ATTEMPT_DELAY: Duration = Duration::from_millis(200);

/// Problems that were logged about a server since it was reached last.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Logged {
    /// That the robot does not trust its authority.
    pub(super) distrusted: bool,
    /// That a certificate is not valid.
    pub(super) invalid: bool,
}

/// A server that the agent may connect to.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Server {
    pub(super) endpoint: String,
    pub(super) logged: Logged,
    /// Until when it is passed over.
    skipped_until: Duration,
}

impl Server {
    /// Notes an attempt that failed, from its begin to its failure.
    fn failed(&mut self, attempt: &Range<Duration>, is_distrusted: bool) {
        if is_distrusted {
            self.skipped_until = attempt.end + DISTRUSTED_PAUSE_MAX;
        } else if attempt.end.saturating_sub(attempt.start) >= LONG {
            self.skipped_until = attempt.end + SKIP_AFTER_SLOW_FAILURE;
        }
    }
}

/// A server that is tried in parallel with the one whose turn it is.
#[derive(Debug)]
pub struct ParallelAttempt<'rotation> {
    /// Its place in the list.
    pub at: usize,
    /// The server.
    pub server: &'rotation mut Server,
    /// Time until the next attempt to reach it.
    pub pause: Duration,
}

impl ParallelAttempt<'_> {
    /// Notes an attempt that failed, from its begin to its failure.
    pub fn failed(&mut self, attempt: &Range<Duration>, is_distrusted: bool) {
        self.server.failed(attempt, is_distrusted);
        let passed_over = self.server.skipped_until.saturating_sub(attempt.end);
        self.pause = passed_over.max(ATTEMPT_DELAY);
    }
}

/// The server that is connected to, among those that the agent knows.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Rotation {
    servers: Vec<Server>,
    at: usize,
    /// Whether all of the present round failed since the robot trusts no authority of theirs.
    is_distrusted: bool,
    pause: Duration,
}

impl Rotation {
    /// Begins with the first endpoint, of which there must be one.
    pub fn new(endpoints: &[String]) -> Self {
        let server = |endpoint: &String| Server {
            endpoint: endpoint.clone(),
            ..Server::default()
        };
        Self {
            servers: endpoints.iter().map(server).collect(),
            at: 0,
            is_distrusted: true,
            pause: PAUSE_FIRST,
        }
    }

    /// Returns whether there is more than one server.
    pub fn has_others(&self) -> bool {
        self.servers.len() > 1
    }

    /// Returns the endpoint to connect to.
    pub fn endpoint(&self) -> &str {
        let server = self.servers.get(self.at);
        server.map_or("", |server| &server.endpoint)
    }

    /// Returns the server to connect to at `now`, and those to try in parallel if that takes long, the next ones
    /// first.
    pub fn attempts(&mut self, now: Duration) -> (&mut Server, Vec<ParallelAttempt<'_>>) {
        let (before, rest) = self.servers.split_at_mut(self.at);
        let [present, after @ ..] = rest else {
            unreachable!("a rotation has a server, and is at one of them");
        };
        let after = after.iter_mut().enumerate();
        let after = after.map(|(step, server)| (self.at + 1 + step, server));
        let others = after.chain(before.iter_mut().enumerate());
        let parallel = others.zip(1..).map(|((at, server), turn)| {
            let passed_over = server.skipped_until.saturating_sub(now);
            let pause = passed_over.max(turn * ATTEMPT_DELAY);
            ParallelAttempt { at, server, pause }
        });
        (present, parallel.collect())
    }

    /// Goes to a server that was reached in parallel with the one whose turn it was.
    pub fn select(&mut self, at: usize) {
        self.at = at;
    }

    /// Notes that the present server was reached: its failures are forgotten, and pauses begin anew.
    pub fn reached(&mut self) {
        let server = &mut self.servers[self.at];
        server.logged = Logged::default();
        server.skipped_until = Duration::ZERO;
        self.is_distrusted = true;
        self.pause = PAUSE_FIRST;
    }

    /// Goes on to the next server, since the present one fell silent before `now`.
    pub fn leave(&mut self, now: Duration) {
        self.servers[self.at].skipped_until = now + SKIP_AFTER_SILENCE;
        self.next(now);
    }

    /// Forgets what was wrong with the servers, since the robot has another certificate.
    pub fn reset_failures(&mut self) {
        for server in &mut self.servers {
            server.logged = Logged::default();
            server.skipped_until = Duration::ZERO;
        }
    }

    /// Goes on to the next server after an attempt that failed, from its begin to its failure. Returns the
    /// pause before that one is tried: none until all have been.
    pub fn failed(&mut self, attempt: &Range<Duration>, is_distrusted: bool) -> Duration {
        self.is_distrusted &= is_distrusted;
        self.servers[self.at].failed(attempt, is_distrusted);
        if !self.next(attempt.end) {
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
        let (count, before) = (self.servers.len(), self.at);
        let following = (1..=count).map(|step| (before + step) % count);
        let remaining = |at: &usize| self.servers[*at].skipped_until.saturating_sub(now);
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
            let pause = rotation.failed(&(began..*now), false);
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
        now += SKIP_AFTER_SLOW_FAILURE;
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

    /// Servers to try in parallel with the one whose turn it is, and the pauses before, milliseconds.
    fn parallel(rotation: &mut Rotation, now: Duration) -> Vec<(usize, u128)> {
        let (_, others) = rotation.attempts(now);
        let of = |attempt: &ParallelAttempt<'_>| (attempt.at, attempt.pause.as_millis());
        others.iter().map(of).collect()
    }

    #[test]
    fn the_others_are_tried_in_parallel_with_an_attempt_that_takes_long() {
        let (mut rotation, now) = (servers(3), Duration::ZERO);
        assert_eq!(parallel(&mut rotation, now), [(1, 200), (2, 400)]);
        rotation.leave(now);
        assert_eq!(rotation.endpoint(), "tls/s1:7447");
        assert_eq!(parallel(&mut rotation, now), [(2, 200), (0, 400)]);
        let (_, mut others) = rotation.attempts(now);
        others[0].failed(&(now..now), true);
        others[1].failed(&(now..now + LONG), false);
        let pauses = others.iter().map(|attempt| attempt.pause);
        let pauses: Vec<_> = pauses.collect();
        assert_eq!(pauses, [DISTRUSTED_PAUSE_MAX, SKIP_AFTER_SLOW_FAILURE]);
        assert_eq!(parallel(&mut rotation, now), [(2, 10_000), (0, 6_000)]);
        rotation.select(2);
        rotation.reached();
        assert_eq!(rotation.endpoint(), "tls/s2:7447");
        assert_eq!(parallel(&mut rotation, now + LONG), [(0, 5_000), (1, 400)]);
        assert!(parallel(&mut servers(1), now).is_empty());
    }

    #[test]
    fn servers_of_a_foreign_authority_are_tried_rarely() {
        let mut rotation = servers(2);
        let now = Duration::ZERO;
        let longest = |rotation: &mut Rotation, distrusted: [bool; 2]| {
            let mut longest = Duration::ZERO;
            for _ in 0..20 {
                for is_distrusted in distrusted {
                    longest = longest.max(rotation.failed(&(now..now), is_distrusted));
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
                        rotation.failed(&(now..now), is_distrusted);
                    }
                    None => rotation.leave(now),
                }
            }
            rotation.reached();
            now += 2 * SKIP_AFTER_SLOW_FAILURE;
            let mut tried = BTreeSet::new();
            let mut pauses = 0;
            for _ in 0..count {
                tried.insert(rotation.endpoint().to_owned());
                pauses += usize::from(!rotation.failed(&(now..now), false).is_zero());
            }
            prop_assert_eq!((tried.len(), pauses), (count, 1));
        }
    }
}
