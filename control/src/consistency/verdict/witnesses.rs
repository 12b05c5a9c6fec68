//! Two channels of the body disagree: which of both wheels and command support.

use super::axis::NEARER;

/// The same where both are as near as wheels can tell.
const NEARER_OF_BOTH: f64 = 0.35;

/// Which of two channels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Nearer {
    First,
    Second,
}

/// What wheels and command say of two channels of the body that disagree: how far each is from
/// them, a fast one first and position fixes second.
pub(super) struct Witnesses {
    /// None where the wheels are not believed.
    pub(super) by_wheels: Option<(f64, f64)>,
    /// What the wheels may differ by, and what noise of the fixes adds.
    pub(super) slack: f64,
    pub(super) noise: f64,
    /// None where motors may be at their limit: then the command says little.
    pub(super) by_command: Option<(f64, f64)>,
}

impl Witnesses {
    /// Which of both is right, if anything distinguishes them.
    pub(super) fn side(&self) -> Option<Nearer> {
        let by_command = self.by_command.and_then(|off| nearer(off, NEARER));
        let Some(by_wheels) = self.by_wheels else {
            return by_command;
        };
        let agrees = (
            by_wheels.0 <= self.slack,
            by_wheels.1 <= self.slack + self.noise,
        );
        let side = match agrees {
            (true, false) => Some(Nearer::First),
            (false, true) => Some(Nearer::Second),
            (true, true) => nearer(by_wheels, NEARER_OF_BOTH),
            (false, false) => by_command,
        };
        // Two witnesses that contradict each other name nobody.
        side.filter(|side| by_command.is_none_or(|other| other == *side))
    }
}

/// Which of two distances is clearly the smaller one.
fn nearer((first, second): (f64, f64), share: f64) -> Option<Nearer> {
    if first < share * second {
        Some(Nearer::First)
    } else if second < share * first {
        Some(Nearer::Second)
    } else {
        None
    }
}
