//! The stop latch: stops the robot until an operator clears it. Pure.
//!
//! ```text
//!          stop                     clear of the newest stop, at zero velocity
//! free ─────────► latched ──────────────────────────────────────────────► free
//!                  │    ▲
//!                  └────┘ another stop: it is the newest now
//! ```
//! A stop with an identifier seen before changes nothing, even after it was cleared: it is a
//! repetition by a sender that missed the answer.

use std::collections::VecDeque;

use serde::{Deserialize, Serialize};
use tread_api::ids::StopId;
use tread_api::mission::REASON_LENGTH_MAX;
use tread_api::safety::{BY_LENGTH_MAX, StopLatch};
use tread_api::wire::safety::Stop;

/// Number of stops remembered as seen, in force or cleared; the oldest is dropped first.
pub(crate) const SEEN_MAX: usize = 256;

/// The stop in force and the identifiers of those seen.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub(crate) struct StopState {
    /// `None` is written as such; a file without this field is rejected.
    #[serde(deserialize_with = "Option::deserialize")]
    latch: Option<StopLatch>,
    seen: VecDeque<StopId>,
}

/// Why a stop is not cleared.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum ClearRefusal {
    /// A newer stop is in force.
    Newer(StopLatch),
    /// A stop with this identifier was never seen here, or is no longer remembered.
    Unknown,
}

fn shortened(text: &str, most: usize) -> String {
    text.chars().take(most).collect()
}

impl StopState {
    /// Creates a state stopped by the agent itself.
    pub(crate) fn latched(latch: StopLatch) -> Self {
        Self {
            seen: VecDeque::from([latch.id]),
            latch: Some(latch),
        }
    }

    /// Returns the stop in force.
    pub(crate) fn latch(&self) -> Option<&StopLatch> {
        self.latch.as_ref()
    }

    /// Applies a stop; false if it was seen before and changes nothing.
    pub(crate) fn stop(&mut self, stop: &Stop, now: jiff::Timestamp) -> bool {
        if self.seen.contains(&stop.stop) {
            return false;
        }
        if self.seen.len() >= SEEN_MAX {
            self.seen.pop_front();
        }
        self.seen.push_back(stop.stop);
        self.latch = Some(StopLatch {
            id: stop.stop,
            by: shortened(&stop.by, BY_LENGTH_MAX),
            reason: shortened(&stop.reason, REASON_LENGTH_MAX),
            since: now,
        });
        true
    }

    /// Returns the state without this stop; `None` if no stop is in force and this one was seen
    /// before.
    ///
    /// # Errors
    /// [`ClearRefusal`]: another stop is in force, or this one is unknown.
    pub(crate) fn cleared(&self, stop: StopId) -> Result<Option<Self>, ClearRefusal> {
        match &self.latch {
            Some(latch) if latch.id == stop => Ok(Some(Self {
                latch: None,
                seen: self.seen.clone(),
            })),
            Some(latch) => Err(ClearRefusal::Newer(latch.clone())),
            None if self.seen.contains(&stop) => Ok(None),
            None => Err(ClearRefusal::Unknown),
        }
    }
}

#[cfg(test)]
mod tests {
    use jiff::Timestamp;
    use proptest::prelude::*;
    use uuid::Uuid;

    use super::*;

    fn id(number: u128) -> StopId {
        StopId::from_uuid(Uuid::from_u128(number))
    }

    fn stop(number: u128) -> Stop {
        Stop {
            stop: id(number),
            by: "an operator".to_owned(),
            reason: "a person on the way".to_owned(),
            at: Timestamp::UNIX_EPOCH,
        }
    }

    #[derive(Debug, Clone, Copy)]
    enum Step {
        Stop(u128),
        Clear(u128),
    }

    proptest! {
        #[test]
        fn only_a_clear_of_the_newest_stop_ends_it_and_doubles_change_nothing(
            steps in prop::collection::vec(
                prop_oneof![(0..6_u128).prop_map(Step::Stop), (0..6_u128).prop_map(Step::Clear)],
                0..60,
            ),
        ) {
            let mut state = StopState::default();
            let mut seen: Vec<u128> = Vec::new();
            for step in steps {
                let before = state.clone();
                match step {
                    Step::Stop(number) => {
                        let is_new = !seen.contains(&number);
                        prop_assert_eq!(state.stop(&stop(number), Timestamp::UNIX_EPOCH), is_new);
                        if is_new {
                            seen.push(number);
                            prop_assert_eq!(state.latch().map(|latch| latch.id), Some(id(number)));
                        } else {
                            prop_assert_eq!(&state, &before);
                        }
                    }
                    Step::Clear(number) => match state.cleared(id(number)) {
                        Ok(Some(next)) => {
                            prop_assert_eq!(before.latch().map(|latch| latch.id), Some(id(number)));
                            prop_assert!(next.latch().is_none());
                            state = next;
                        }
                        Ok(None) => {
                            prop_assert!(before.latch().is_none() && seen.contains(&number));
                        }
                        Err(ClearRefusal::Newer(latch)) => prop_assert!(latch.id != id(number)),
                        Err(ClearRefusal::Unknown) => prop_assert!(!seen.contains(&number)),
                    },
                }
            }
        }
    }

    #[test]
    fn long_words_are_cut() {
        let mut state = StopState::default();
        let mut long = stop(1);
        long.by = "x".repeat(1_000);
        assert!(state.stop(&long, Timestamp::UNIX_EPOCH));
        assert_eq!(state.latch().unwrap().by.len(), BY_LENGTH_MAX);
    }
}
