//! State machine of missions: one pure table with a cause on every transition; the database applies
//! it by compare-and-set.
//!
//! ```text
//!                      offer               accept                 pause
//!          ┌─ queued ◄────────► offered ──────────► active ◄────────────────► paused
//!          │    │      return     │ │ └─ pause ───────┼──────────────────────►  │
//!          │    │                 │ └──── reject ───► rejected     resume       │
//!          │    │                 │                   │                         │
//!          │    │                 └─ cancel wanted ─► cancelling ◄──────────────┤
//!          │    │                                     │                         │
//!          │    └──── expire ───────────────────────► │ ◄────── expire ─────────┤
//!          │                                          ▼                         ▼
//!          └─ cancel wanted ──► cancelled    succeeded | failed | cancelled | expired
//! ```
//!
//! * An end that the *robot* reports (`succeed`, `fail`, `cancel`, `expire`) is accepted in every
//!   open state, also in `queued`: a robot may have driven what the server recorded as returned.
//! * *Cancel wanted*, by a person, by another mission that replaces it or by the robot's
//!   retirement, ends a waiting mission at once; an active one becomes `cancelling` until the robot
//!   has answered or is lost.
//! * An active mission fails when its robot is *lost*, when its agent *restarted* without it, or
//!   when the robot *forgot* it. One that was being cancelled ends as cancelled then, unless it was
//!   lost.
//!
//! The states in the last row are terminal: no transition leaves them.

use tread_api::mission::{Cause, MissionState};

/// What moves a mission.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Change {
    /// The server offers it to its robot.
    Offer,
    /// The robot cannot take it now; it is queued again.
    Return,
    /// The robot has accepted it, or has begun to drive.
    Accept,
    /// The robot rejects it for ever.
    Reject,
    /// The robot has paused it and is stopped.
    Pause,
    /// The robot drives it again.
    Resume,
    /// A client requests its end.
    RequestCancel,
    /// Another mission replaces it.
    Supersede,
    /// Its robot is retired.
    Retire,
    /// It ended on request.
    Cancel,
    /// It was driven to its end.
    Succeed,
    /// It failed.
    Fail,
    /// Its latest start passed before it began.
    Expire,
    /// Its robot was not heard for longer than the limit.
    LoseRobot,
    /// Its agent was restarted without it.
    LoseRun,
    /// Its robot is heard, does not have it, and has not reported how it ended.
    Forget,
}

impl Change {
    /// Every change.
    pub const ALL: [Self; 16] = [
        Self::Offer,
        Self::Return,
        Self::Accept,
        Self::Reject,
        Self::Pause,
        Self::Resume,
        Self::RequestCancel,
        Self::Supersede,
        Self::Retire,
        Self::Cancel,
        Self::Succeed,
        Self::Fail,
        Self::Expire,
        Self::LoseRobot,
        Self::LoseRun,
        Self::Forget,
    ];

    /// Returns the cause that is recorded with this change.
    pub const fn cause(self) -> Cause {
        match self {
            Self::Offer => Cause::Offered,
            Self::Return => Cause::Returned,
            Self::Accept => Cause::Accepted,
            Self::Reject => Cause::Rejected,
            Self::Pause => Cause::Paused,
            Self::Resume => Cause::Resumed,
            Self::RequestCancel => Cause::CancelRequested,
            Self::Supersede => Cause::Superseded,
            Self::Retire => Cause::RobotRetired,
            Self::Cancel => Cause::Cancelled,
            Self::Succeed => Cause::Succeeded,
            Self::Fail => Cause::Failed,
            Self::Expire => Cause::Expired,
            Self::LoseRobot => Cause::RobotLost,
            Self::LoseRun => Cause::AgentRestarted,
            Self::Forget => Cause::RobotLostMission,
        }
    }

    /// Returns the reason shown to people if none was given.
    pub const fn reason(self) -> &'static str {
        match self {
            Self::Offer => "offered to the robot",
            Self::Return => "the robot cannot take it now",
            Self::Accept => "the robot has taken it",
            Self::Reject => "the robot will not take it",
            Self::Pause => "the robot holds it, at rest",
            Self::Resume => "the robot drives it again",
            Self::RequestCancel => "cancelled by request",
            Self::Supersede => "another mission was asked for in its place",
            Self::Retire => "the robot was retired",
            Self::Cancel => "the robot has ended it by request",
            Self::Succeed => "driven to its end",
            Self::Fail => "the robot gave it up",
            Self::Expire => "its latest start passed before it began",
            Self::LoseRobot => "the robot stayed away too long",
            Self::LoseRun => "agent restarted during the mission",
            Self::Forget => "the robot has ended it without saying how",
        }
    }
}

/// Returns the state after a change; `None` if the change is not allowed in this state.
pub const fn next(state: MissionState, change: Change) -> Option<MissionState> {
    use MissionState as S;
    match (state, change) {
        (S::Queued, Change::Offer) => Some(S::Offered),
        (S::Offered, Change::Return) => Some(S::Queued),
        (S::Offered, Change::Accept) | (S::Paused, Change::Resume) => Some(S::Active),
        (S::Offered, Change::Reject) => Some(S::Rejected),
        (S::Offered | S::Active, Change::Pause) => Some(S::Paused),
        (
            S::Offered | S::Active | S::Paused,
            Change::RequestCancel | Change::Supersede | Change::Retire,
        ) => Some(S::Cancelling),
        (S::Queued, Change::RequestCancel | Change::Supersede | Change::Retire)
        | (S::Cancelling, Change::LoseRun | Change::Forget) => Some(S::Cancelled),
        (S::Offered | S::Active | S::Paused | S::Cancelling, Change::LoseRobot)
        | (S::Active | S::Paused, Change::LoseRun)
        | (S::Queued | S::Offered | S::Active | S::Paused, Change::Forget) => Some(S::Failed),
        (open, Change::Cancel) if !open.is_terminal() => Some(S::Cancelled),
        (open, Change::Succeed) if !open.is_terminal() => Some(S::Succeeded),
        (open, Change::Fail) if !open.is_terminal() => Some(S::Failed),
        (open, Change::Expire) if !open.is_terminal() => Some(S::Expired),
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
    fn every_state_is_reached_and_every_open_one_can_end() {
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
            assert!(reached.contains(&state), "{state:?}");
            let ends = Change::ALL
                .into_iter()
                .filter_map(|change| next(state, change))
                .any(MissionState::is_terminal);
            assert_eq!(ends, !state.is_terminal(), "{state:?}");
        }
    }

    #[test]
    fn every_edge_has_a_cause_and_a_reason_of_its_own() {
        let mut causes: Vec<Cause> = Change::ALL.into_iter().map(Change::cause).collect();
        causes.sort_by_key(|cause| cause.as_str());
        causes.dedup();
        assert_eq!(causes.len(), Change::ALL.len());
        for change in Change::ALL {
            assert!(!change.reason().is_empty());
            let leads = |state| next(state, change).is_some();
            assert!(MissionState::ALL.into_iter().any(leads), "{change:?}");
        }
    }

    #[test]
    fn no_edge_stays_where_it_is() {
        for state in MissionState::ALL {
            for change in Change::ALL {
                assert_ne!(next(state, change), Some(state), "{state:?} {change:?}");
            }
        }
    }

    #[test]
    fn a_mission_that_waits_is_cancelled_at_once_and_one_in_progress_when_the_robot_says_so() {
        use MissionState as S;
        for wanted in [Change::RequestCancel, Change::Supersede, Change::Retire] {
            assert_eq!(next(S::Queued, wanted), Some(S::Cancelled));
            for in_progress in [S::Offered, S::Active, S::Paused] {
                assert_eq!(next(in_progress, wanted), Some(S::Cancelling));
            }
        }
        assert_eq!(next(S::Cancelling, Change::Accept), None);
        assert_eq!(next(S::Cancelling, Change::Succeed), Some(S::Succeeded));
        assert_eq!(next(S::Cancelling, Change::LoseRobot), Some(S::Failed));
    }
}
