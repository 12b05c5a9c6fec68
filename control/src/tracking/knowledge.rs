//! Prior knowledge of θ that the tracking law uses.

/// Number of standard deviations of the difference above which two values contradict each other.
const CONTRADICTION: f64 = 3.0;
/// Ratio of two values up to which they do not contradict each other, whatever their standard
/// deviations: ground differs by more, and estimates are biased by less.
const SAME_GROUND_RATIO: f64 = 1.5;

/// Slip compliance θ with its standard deviation, from the map or measured by this robot.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ThetaKnowledge {
    /// Slip compliance θ = 1/K, without a unit, above 0.
    pub theta: f64,
    /// Standard deviation of θ, without a unit, at least 0.
    pub std_dev: f64,
}

impl ThetaKnowledge {
    /// Returns whether this θ and `other` are unlikely to be of the same ground: they differ by
    /// more than [`CONTRADICTION`] standard deviations and by more than [`SAME_GROUND_RATIO`].
    pub(super) fn contradicts(self, other: Self) -> bool {
        let apart = (self.theta - other.theta).abs();
        apart > CONTRADICTION * self.std_dev.hypot(other.std_dev) && self.differs_by_ground(other)
    }

    /// Returns whether the larger value is above [`SAME_GROUND_RATIO`] times the smaller one.
    pub(super) fn differs_by_ground(self, other: Self) -> bool {
        self.theta.max(other.theta) > SAME_GROUND_RATIO * self.theta.min(other.theta)
    }

    /// Returns the confidence c = 1/(1 + (3σ/θ)²), 0 to 1; 0 for values out of range.
    pub fn confidence(&self) -> f64 {
        let relative = self.std_dev / self.theta;
        if self.theta > 0.0 && relative.is_finite() && relative >= 0.0 {
            1.0 / (1.0 + (3.0 * relative).powi(2))
        } else {
            0.0
        }
    }

    /// Returns the mean of two independent values for the same ground, weighted by 1/σ². A value
    /// with zero confidence is left out.
    #[must_use]
    pub fn fused(self, other: Self) -> Self {
        let weight = |known: &Self| {
            if known.confidence() > 0.0 {
                // A standard deviation of zero would override the other value for ever.
                known.std_dev.max(1.0e-3 * known.theta).powi(-2)
            } else {
                0.0
            }
        };
        let (own_weight, other_weight) = (weight(&self), weight(&other));
        if own_weight <= 0.0 {
            return other;
        }
        Self {
            theta: (own_weight * self.theta
                + if other_weight > 0.0 {
                    other_weight * other.theta
                } else {
                    0.0
                })
                / (own_weight + other_weight),
            std_dev: (own_weight + other_weight).sqrt().recip(),
        }
    }
}
