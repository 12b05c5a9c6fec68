//! What the law is given about the ground.

/// How many standard deviations apart two words contradict each other.
const CONTRADICTION: f64 = 3.0;

/// What is known about θ: a map's prior or the robot's own measurement.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ThetaKnowledge {
    /// θ = 1/K.
    pub theta: f64,
    /// Its standard deviation.
    pub std_dev: f64,
}

impl ThetaKnowledge {
    /// Whether both cannot well be true of one ground.
    pub(super) fn contradicts(self, other: Self) -> bool {
        let apart = (self.theta - other.theta).abs();
        apart > CONTRADICTION * self.std_dev.hypot(other.std_dev)
    }

    /// How much of it to believe, 0 to 1: falls with the relative standard deviation.
    pub fn confidence(&self) -> f64 {
        let relative = self.std_dev / self.theta;
        if self.theta > 0.0 && relative.is_finite() && relative >= 0.0 {
            1.0 / (1.0 + (3.0 * relative).powi(2))
        } else {
            0.0
        }
    }

    /// Two independent words on the same ground, weighed by their standard deviations; one that is
    /// not usable is left out.
    #[must_use]
    pub fn fused(self, other: Self) -> Self {
        let weight = |known: &Self| {
            if known.confidence() > 0.0 {
                // A standard deviation of zero would silence the other word for good.
                known.std_dev.max(1.0e-3 * known.theta).powi(-2)
            } else {
                0.0
            }
        };
        let (mine, its) = (weight(&self), weight(&other));
        if mine <= 0.0 {
            return other;
        }
        Self {
            theta: (mine * self.theta + if its > 0.0 { its * other.theta } else { 0.0 })
                / (mine + its),
            std_dev: (mine + its).sqrt().recip(),
        }
    }
}
