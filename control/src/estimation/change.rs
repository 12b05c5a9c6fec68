//! Detects a change of the ground by a two-sided CUSUM test on standardised innovations.

/// Threshold h of the sums, in standard deviations.
const THRESHOLD: f64 = 12.0;
/// Drift k that each innovation subtracts from the sums, in standard deviations.
const DRIFT: f64 = 0.75;
/// Limit of a single innovation, so that one outlier does not signal a change.
const INNOVATION_MAX: f64 = 8.0;

/// State of the CUSUM test: the sums for increase and decrease.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct ChangeDetector {
    above: f64,
    below: f64,
}

impl ChangeDetector {
    /// Adds a standardised innovation. Returns whether the ground has changed.
    pub(super) fn update(&mut self, innovation: f64) -> bool {
        let bounded = innovation.clamp(-INNOVATION_MAX, INNOVATION_MAX);
        self.above = (self.above + bounded - DRIFT).max(0.0);
        self.below = (self.below - bounded - DRIFT).max(0.0);
        self.above > THRESHOLD || self.below > THRESHOLD
    }

    /// Returns whether both sums are zero.
    pub(super) fn is_quiet(&self) -> bool {
        self.above <= 0.0 && self.below <= 0.0
    }
}
