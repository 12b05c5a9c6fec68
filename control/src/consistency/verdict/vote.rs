//! Majority vote: decides which of two channels of the body's motion is right, by wheels and
//! command.

use super::axis::NEARER;

/// Ratio of the two channels' distances from the wheels below which the wheels favour the nearer
/// one, if both are within the wheels' tolerance.
const NEARER_OF_BOTH: f64 = 0.35;

/// Channel that a vote favours.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Favoured {
    /// The fast channel: gyro or odometry.
    Fast,
    /// Position fixes.
    Fixes,
}

/// Differences of the two channels of the body from one other channel, magnitudes in m/s or rad/s.
#[derive(Clone, Copy)]
pub(super) struct Differences {
    pub(super) fast: f64,
    pub(super) fixes: f64,
}

/// Differences of two channels of the body from wheels and command.
pub(super) struct Vote {
    /// Differences from the wheels; None if the wheels are not compared.
    pub(super) by_wheels: Option<Differences>,
    /// Tolerated difference from the wheels.
    pub(super) slack: f64,
    /// Noise of the fixes, tolerated in addition.
    pub(super) noise: f64,
    /// Differences from the command; None if motors may be saturated: then the command is no
    /// evidence.
    pub(super) by_command: Option<Differences>,
}

impl Vote {
    /// Returns the channel that is right; None if wheels and command do not distinguish them.
    pub(super) fn favoured(&self) -> Option<Favoured> {
        let by_command = self.by_command.and_then(|off| nearer(off, NEARER));
        let Some(by_wheels) = self.by_wheels else {
            return by_command;
        };
        let agrees = (
            by_wheels.fast <= self.slack,
            by_wheels.fixes <= self.slack + self.noise,
        );
        let favoured = match agrees {
            (true, false) => Some(Favoured::Fast),
            (false, true) => Some(Favoured::Fixes),
            (true, true) => nearer(by_wheels, NEARER_OF_BOTH),
            (false, false) => by_command,
        };
        // Wheels and command that support different channels give no result.
        favoured.filter(|channel| by_command.is_none_or(|other| other == *channel))
    }
}

/// Returns the channel whose difference is the smaller by the ratio `share`.
fn nearer(off: Differences, share: f64) -> Option<Favoured> {
    if off.fast < share * off.fixes {
        Some(Favoured::Fast)
    } else if off.fixes < share * off.fast {
        Some(Favoured::Fixes)
    } else {
        None
    }
}
