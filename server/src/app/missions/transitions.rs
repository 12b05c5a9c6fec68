//! Where a mission can go. One pure table; the database enforces it by compare-and-set.
//!
//! ```text
//!            expire                 cancel
//!   expired ◄────── queued ───────────────────────► cancelled
//!      ▲             │  ▲                               ▲
//!      │       offer │  │ return (busy, not ready)      │
//!      │ expire      ▼  │            robot cancelled    │
//!      ├────────── offered ─────────────────────────────┤
//!      │            │ │ └─────────────── cancel ──┐     │
//!      │     accept │ │ reject                    ▼     │ robot cancelled
//!      │            ▼ └─────► rejected        cancelling┤
//!      ├────────── active ─────────── cancel ─────▲     │
//!      │            │ │ └───────────────────────────────┘
//!      │            │ └── succeed ──► succeeded ◄── from offered, cancelling too
//!      │            └──── fail ─────► failed    ◄── from offered, cancelling too
//! ```
//!
//! `paused` is a name that no edge leads to yet. Terminal states never reopen.

use tread_api::mission::MissionState;

/// What moves a mission.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Change {
    /// The server offers it to its robot.
    Offer,
    /// The robot cannot take it now; it waits again.
    Return,
    /// The robot has taken it, or has begun to drive.
    Accept,
    /// The robot will never take it.
    Reject,
    /// Somebody wants it to end.
    RequestCancel,
    /// It ended by request.
    Cancel,
    /// It was driven to its end.
    Succeed,
    /// Something went wrong.
    Fail,
    /// Its latest start passed before it began.
    Expire,
}

impl Change {
    /// Every change.
    pub const ALL: [Self; 9] = [
        Self::Offer,
        Self::Return,
        Self::Accept,
        Self::Reject,
        Self::RequestCancel,
        Self::Cancel,
        Self::Succeed,
        Self::Fail,
        Self::Expire,
    ];
}

/// Where a change leads; `None` if it is not for this state.
pub const fn next(state: MissionState, change: Change) -> Option<MissionState> {
    use MissionState as S;
    match (state, change) {
        (S::Queued, Change::Offer) => Some(S::Offered),
        (S::Offered, Change::Return) => Some(S::Queued),
        (S::Offered, Change::Accept) => Some(S::Active),
        (S::Offered, Change::Reject) => Some(S::Rejected),
        (S::Offered | S::Active, Change::RequestCancel) => Some(S::Cancelling),
        (S::Queued, Change::RequestCancel)
        | (S::Offered | S::Active | S::Cancelling, Change::Cancel) => Some(S::Cancelled),
        (S::Offered | S::Active | S::Cancelling, Change::Succeed) => Some(S::Succeeded),
        (S::Offered | S::Active | S::Cancelling, Change::Fail) => Some(S::Failed),
        (S::Queued | S::Offered | S::Active | S::Cancelling, Change::Expire) => Some(S::Expired),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn change() -> impl Strategy<Value = Change> {
        prop::sample::select(Change::ALL.to_vec())
    }

    proptest! {
        #[test]
        fn whatever_arrives_a_terminal_state_never_reopens(
            changes in prop::collection::vec(change(), 0..60),
        ) {
            let mut state = MissionState::Queued;
            let mut ended = None;
            for change in changes {
                state = next(state, change).unwrap_or(state);
                if let Some(ended) = ended {
                    prop_assert_eq!(state, ended);
                }
                if state.is_terminal() {
                    ended = Some(state);
                }
            }
        }
    }

    #[test]
    fn every_state_but_paused_is_reached_and_every_open_one_can_end() {
        let mut reached = vec![MissionState::Queued];
        let mut index = 0;
        while let Some(&state) = reached.get(index) {
            for change in Change::ALL {
                if let Some(after) = next(state, change)
                    && !reached.contains(&after)
                {
                    reached.push(after);
                }
            }
            index += 1;
        }
        for state in MissionState::ALL {
            assert_eq!(
                reached.contains(&state),
                state != MissionState::Paused,
                "{state:?}"
            );
            let ends = Change::ALL
                .into_iter()
                .filter_map(|change| next(state, change))
                .any(MissionState::is_terminal);
            let open = !state.is_terminal() && state != MissionState::Paused;
            assert_eq!(ends, open, "{state:?}");
        }
    }

    #[test]
    fn a_mission_that_waits_is_cancelled_at_once_and_one_in_hand_when_the_robot_says_so() {
        use MissionState as S;
        assert_eq!(next(S::Queued, Change::RequestCancel), Some(S::Cancelled));
        assert_eq!(next(S::Active, Change::RequestCancel), Some(S::Cancelling));
        assert_eq!(next(S::Cancelling, Change::Accept), None);
        assert_eq!(next(S::Cancelling, Change::Succeed), Some(S::Succeeded));
    }
}
