//! Decides what to do about a robot's open stop, from the stop that the robot shows. Pure.
//!
//! ```text
//!          asked for, in place of what was open        confirmed
//!  none ─────────────────────────────► unconfirmed ─────────────► confirmed
//!   ▲  ▲                                 ▲  │ sent again            │ │ │
//!   │  └──────── over, says the robot ───┼──┘    shown no more      │ │ │
//!   │                                    └──────────────────────────┘ │ │
//!   │             clear asked for, and shown no more                  │ │
//!   └─────────────────────────────────────────────────────────────────┘ │
//!  another one is shown, in place of what was open: confirmed ◄─────────┘
//! ```
//!
//! Until the robot has confirmed it, the newest requested stop counts; afterwards the order in
//! which stops reached the robot does.

use jiff::{SignedDuration, Timestamp};
use tread_api::ids::StopId;

/// Minimum age of a confirmation before a state without the stop contradicts it: states may
/// overtake answers.
pub(super) const SHOWN_GRACE: SignedDuration = SignedDuration::from_secs(2);

/// A robot's open stop.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Open {
    pub(super) id: StopId,
    /// Whether the robot's time to confirm has passed.
    pub(super) is_overdue: bool,
    pub(super) confirmed_at: Option<Timestamp>,
    pub(super) clear_requested_at: Option<Timestamp>,
}

/// The stop that a robot reported last.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct ReportedStop {
    pub(super) latch: Option<StopId>,
    /// Time at which the shown latch was cleared, as far as the server knows.
    pub(super) ended_at: Option<Timestamp>,
    /// Time at which the robot's state arrived.
    pub(super) at: Timestamp,
}

/// Next action for a robot's stop.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum StopDecision {
    Nothing,
    /// Send the stop.
    Send,
    /// Send the stop again: the robot does not show what it confirmed.
    Resend,
    /// Record that the robot has cleared it, as requested.
    Cleared,
    /// Make the stop that the robot shows its open one.
    Adopt,
}

pub(super) fn decide(open: Option<Open>, shown: Option<ReportedStop>) -> StopDecision {
    let is_later =
        |shown: &ReportedStop, than: Timestamp| shown.at.duration_since(than) > SHOWN_GRACE;
    let Some(open) = open else {
        let counts = |shown: &ReportedStop| {
            let is_new = shown.ended_at.is_none_or(|ended| is_later(shown, ended));
            shown.latch.is_some() && is_new
        };
        return if shown.as_ref().is_some_and(counts) {
            StopDecision::Adopt
        } else {
            StopDecision::Nothing
        };
    };
    let Some(confirmed_at) = open.confirmed_at else {
        return if open.is_overdue {
            StopDecision::Send
        } else {
            StopDecision::Nothing
        };
    };
    let since = open.clear_requested_at.unwrap_or(confirmed_at);
    let Some(shown) = shown.filter(|shown| is_later(shown, since)) else {
        return StopDecision::Nothing;
    };
    match (shown.latch, open.clear_requested_at) {
        (None, None) => StopDecision::Resend,
        (None, Some(_)) => StopDecision::Cleared,
        (Some(latch), _) if latch != open.id => StopDecision::Adopt,
        (Some(_), _) => StopDecision::Nothing,
    }
}

#[cfg(test)]
mod tests {
    use std::collections::{HashMap, HashSet};

    use proptest::prelude::*;
    use uuid::Uuid;

    use super::*;

    /// What may happen, each some time after the one before.
    #[derive(Debug, Clone, Copy)]
    enum Step {
        Ask,
        /// The robot latches one of its own.
        Own,
        /// Somebody clears what is open.
        Clear,
        /// One of the messages under way arrives, twice perhaps.
        Deliver(usize, bool),
        Lose(usize),
        /// The robot's state comes.
        Show,
        Pass,
    }

    #[derive(Debug, Clone, Copy)]
    enum Message {
        Stop(StopId),
        Confirmed(StopId),
        Over(StopId),
        Clear(StopId),
        Cleared(StopId),
        Refused(StopId),
    }

    #[derive(Debug, Default)]
    struct World {
        now_ms: i64,
        next: u128,
        open: Option<Open>,
        ended: HashMap<StopId, Timestamp>,
        shown: Option<(Option<StopId>, Timestamp)>,
        latch: Option<StopId>,
        seen: HashSet<StopId>,
        under_way: Vec<Message>,
        /// A stop was asked for, and no clear was under way then or asked for since.
        must_hold: bool,
    }

    impl World {
        fn now(&self) -> Timestamp {
            Timestamp::from_millisecond(self.now_ms).unwrap()
        }

        fn new_id(&mut self) -> StopId {
            self.next += 1;
            StopId::from_uuid(Uuid::from_u128(self.next))
        }

        fn end(&mut self, id: StopId) {
            self.ended.insert(id, self.now());
            self.open = self.open.filter(|open| open.id != id);
        }

        fn step(&mut self, step: Step) {
            match step {
                Step::Ask => {
                    let id = self.new_id();
                    self.open = Some(Open {
                        id,
                        is_overdue: false,
                        confirmed_at: None,
                        clear_requested_at: None,
                    });
                    self.under_way.push(Message::Stop(id));
                    let clears = |message: &Message| matches!(message, Message::Clear(_));
                    self.must_hold = !self.under_way.iter().any(clears);
                }
                Step::Own => {
                    let id = self.new_id();
                    self.seen.insert(id);
                    self.latch = Some(id);
                }
                Step::Clear => {
                    let now = self.now();
                    if let Some(open) = &mut self.open {
                        open.clear_requested_at = Some(now.max(open.confirmed_at.unwrap_or(now)));
                        self.under_way.push(Message::Clear(open.id));
                        self.must_hold = false;
                    }
                }
                Step::Deliver(index, twice) if !self.under_way.is_empty() => {
                    let index = index % self.under_way.len();
                    let message = if twice {
                        self.under_way[index]
                    } else {
                        self.under_way.remove(index)
                    };
                    self.deliver(message);
                }
                Step::Lose(index) if !self.under_way.is_empty() => {
                    let index = index % self.under_way.len();
                    self.under_way.remove(index);
                }
                Step::Deliver(..) | Step::Lose(_) => {}
                Step::Show => self.shown = Some((self.latch, self.now())),
                Step::Pass => self.pass(),
            }
        }

        fn deliver(&mut self, message: Message) {
            let now = self.now();
            match message {
                Message::Stop(id) => {
                    if self.seen.insert(id) {
                        self.latch = Some(id);
                    }
                    let answer = match self.latch {
                        Some(_) => Message::Confirmed(id),
                        None => Message::Over(id),
                    };
                    self.under_way.push(answer);
                }
                Message::Confirmed(id) => {
                    if let Some(open) = self.open.as_mut().filter(|open| open.id == id) {
                        open.confirmed_at.get_or_insert(now);
                    }
                }
                Message::Over(id) | Message::Cleared(id) => self.end(id),
                Message::Clear(id) => {
                    if self.latch == Some(id) {
                        self.latch = None;
                    }
                    let has_ended = self.latch.is_none() && self.seen.contains(&id);
                    self.under_way.push(if has_ended {
                        Message::Cleared(id)
                    } else {
                        Message::Refused(id)
                    });
                }
                Message::Refused(id) => {
                    if let Some(open) = self.open.as_mut().filter(|open| open.id == id) {
                        open.clear_requested_at = None;
                    }
                }
            }
        }

        fn pass(&mut self) {
            let now = self.now();
            let open = self.open.map(|open| Open {
                is_overdue: true,
                ..open
            });
            let shown = self.shown.map(|(latch, at)| ReportedStop {
                latch,
                ended_at: latch.and_then(|latch| self.ended.get(&latch).copied()),
                at,
            });
            match decide(open, shown) {
                StopDecision::Nothing => {}
                StopDecision::Send | StopDecision::Resend => {
                    if let Some(open) = &mut self.open {
                        open.confirmed_at = None;
                        self.under_way.push(Message::Stop(open.id));
                    }
                }
                StopDecision::Cleared => self.end(open.unwrap().id),
                StopDecision::Adopt => {
                    let id = shown.unwrap().latch.unwrap();
                    self.ended.remove(&id);
                    self.open = Some(Open {
                        id,
                        is_overdue: true,
                        confirmed_at: Some(now),
                        clear_requested_at: None,
                    });
                }
            }
        }
    }

    fn steps() -> impl Strategy<Value = Vec<(Step, i64)>> {
        let step = prop_oneof![
            2 => Just(Step::Ask),
            1 => Just(Step::Own),
            2 => Just(Step::Clear),
            6 => (any::<usize>(), prop::bool::weighted(0.2))
                .prop_map(|(index, twice)| Step::Deliver(index, twice)),
            2 => any::<usize>().prop_map(Step::Lose),
            4 => Just(Step::Show),
            4 => Just(Step::Pass),
        ];
        prop::collection::vec((step, 0..1_500_i64), 0..80)
    }

    proptest! {
        #[test]
        fn once_the_network_is_calm_server_and_robot_agree_and_no_stop_that_was_asked_for_is_gone(
            steps in steps(),
        ) {
            let mut world = World::default();
            for (step, wait_ms) in steps {
                world.now_ms += wait_ms;
                world.step(step);
            }
            for _ in 0..12 {
                while !world.under_way.is_empty() {
                    world.step(Step::Deliver(0, false));
                }
                world.now_ms += 3_000;
                world.step(Step::Show);
                world.step(Step::Pass);
            }
            prop_assert_eq!(world.open.map(|open| open.id), world.latch);
            prop_assert!(!world.must_hold || world.latch.is_some(), "{:?}", world);
        }
    }
}
