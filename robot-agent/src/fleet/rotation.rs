//! Which of several servers the agent connects to next.
//!
//! The agent stays with the server that it reached. When that one falls silent, or an attempt to reach
//! it fails, the next of the list is tried, and after the last one the first. There is no way back to a
//! preferred server while the present one answers: robots would move twice for each restart.

use std::time::Duration;

/// First and longest pause after no server could be reached.
const PAUSE_FIRST: Duration = Duration::from_millis(100);
const PAUSE_MAX: Duration = Duration::from_millis(300);
/// Longest pause while the robot trusts the authority of none of them. A server counts each attempt
/// as a failure of its address, which other robots may share.
const DISTRUSTED_PAUSE_MAX: Duration = Duration::from_secs(10);

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
    at: usize,
    /// Number of attempts that have failed since a server was reached.
    failed: usize,
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
            at: 0,
            failed: 0,
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
        self.begin_round();
        self.failed = 0;
        self.pause = PAUSE_FIRST;
    }

    /// Goes on to the next server, since the present one fell silent.
    pub fn leave(&mut self) {
        self.at = (self.at + 1) % self.endpoints.len();
    }

    /// Goes on to the next server after a failed attempt. Returns the pause before that one is tried:
    /// none until all have been.
    pub fn failed(&mut self, is_distrusted: bool) -> Duration {
        self.is_distrusted &= is_distrusted;
        self.failed += 1;
        self.leave();
        if !self.failed.is_multiple_of(self.endpoints.len()) {
            return Duration::ZERO;
        }
        let longest = if self.is_distrusted {
            DISTRUSTED_PAUSE_MAX
        } else {
            PAUSE_MAX
        };
        let pause = self.pause.min(longest);
        self.pause = (2 * pause).min(longest);
        self.begin_round();
        pause
    }

    fn begin_round(&mut self) {
        self.is_distrusted = true;
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn servers(count: usize) -> Rotation {
        let endpoints: Vec<_> = (0..count).map(|at| format!("tls/s{at}:7447")).collect();
        Rotation::new(&endpoints)
    }

    #[test]
    fn the_first_is_preferred_and_the_next_follows_without_a_pause() {
        let mut rotation = servers(3);
        let mut tried = Vec::new();
        let mut pauses = Vec::new();
        for _ in 0..6 {
            tried.push(rotation.endpoint().to_owned());
            pauses.push(rotation.failed(false).as_millis());
        }
        let names = ["tls/s0:7447", "tls/s1:7447", "tls/s2:7447"];
        assert_eq!(tried, [names, names].concat());
        assert_eq!(pauses, [0, 0, 100, 0, 0, 200]);
    }

    #[test]
    fn servers_of_a_foreign_authority_are_tried_rarely() {
        let mut rotation = servers(2);
        let pauses = |rotation: &mut Rotation, distrusted: [bool; 2]| {
            let mut longest = Duration::ZERO;
            for _ in 0..20 {
                for is_distrusted in distrusted {
                    longest = longest.max(rotation.failed(is_distrusted));
                }
            }
            longest
        };
        assert_eq!(pauses(&mut rotation, [true, true]), DISTRUSTED_PAUSE_MAX);
        rotation.reached();
        assert_eq!(pauses(&mut rotation, [true, false]), PAUSE_MAX);
    }

    proptest! {
        #[test]
        fn each_server_is_tried_in_each_round_and_each_round_ends_with_a_pause(
            count in 1_usize..=8,
            before in proptest::collection::vec(any::<Option<bool>>(), 0..20),
        ) {
            let mut rotation = servers(count);
            for step in before {
                match step {
                    Some(is_distrusted) => {
                        rotation.failed(is_distrusted);
                    }
                    None => rotation.leave(),
                }
            }
            rotation.reached();
            let mut tried = std::collections::BTreeSet::new();
            for attempt in 1..=count {
                tried.insert(rotation.endpoint().to_owned());
                prop_assert_eq!(rotation.failed(false).is_zero(), attempt < count);
            }
            prop_assert_eq!(tried.len(), count);
        }
    }
}
