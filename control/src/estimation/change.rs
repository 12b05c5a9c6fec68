//! Whether the ground has changed: a two-sided CUSUM on standardised innovations.

/// Threshold h.
const THRESHOLD: f64 = 12.0;
/// Drift k.
const DRIFT: f64 = 0.75;
/// Largest innovation that counts, so that one wild block is no change.
const INNOVATION_MAX: f64 = 8.0;

/// The two sums.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct ChangeDetector {
    above: f64,
    below: f64,
}

impl ChangeDetector {
    /// Takes an innovation; true when the ground has changed.
    pub(super) fn update(&mut self, innovation: f64) -> bool {
        let bounded = innovation.clamp(-INNOVATION_MAX, INNOVATION_MAX);
        self.above = (self.above + bounded - DRIFT).max(0.0);
        self.below = (self.below - bounded - DRIFT).max(0.0);
        self.above > THRESHOLD || self.below > THRESHOLD
    }

    /// Whether neither sum has left zero.
    pub(super) fn is_quiet(&self) -> bool {
        self.above <= 0.0 && self.below <= 0.0
    }
}
