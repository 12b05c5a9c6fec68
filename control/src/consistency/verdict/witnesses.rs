//! Decides which of two channels of the body wheels and command support.

use super::axis::NEARER;

/// Ratio of distances below which one is nearer, where the wheels tolerate both.
const NEARER_OF_BOTH: f64 = 0.35;

/// One of two channels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Nearer {
    First,
    Second,
}

/// Distances of two channels of the body from wheels and command: a fast channel first, position
/// fixes second.
pub(super) struct Witnesses {
    /// None if a finding names the wheels.
    pub(super) by_wheels: Option<(f64, f64)>,
    /// Tolerated difference of the wheels, and noise of the fixes in addition.
    pub(super) slack: f64,
    pub(super) noise: f64,
    /// None if motors may be saturated: then the command is no evidence.
    pub(super) by_command: Option<(f64, f64)>,
}

impl Witnesses {
    /// Returns the channel that is right; None if wheels and command do not distinguish them.
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
        // Wheels and command that support different channels give no result.
        side.filter(|side| by_command.is_none_or(|other| other == *side))
    }
}

/// Returns which of two distances is the smaller by the ratio `share`.
fn nearer((first, second): (f64, f64), share: f64) -> Option<Nearer> {
    if first < share * second {
        Some(Nearer::First)
    } else if second < share * first {
        Some(Nearer::Second)
    } else {
        None
    }
}
