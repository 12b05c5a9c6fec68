//! Whether the ground has changed under a robot that is identified.
//!
//! Both must hold: a two-sided CUSUM on what comparisons tell of ln K, over its standard deviation by
//! the scatter of the blocks; and within two seconds the mean square of the standardised residuals has
//! grown. The first alone is upset by what the model leaves out of turns that begin and end, the
//! second by all that is wrong at once.

/// Threshold of the CUSUM, and its drift.
const THRESHOLD: f64 = 20.0;
const DRIFT: f64 = 1.0;
/// Largest innovation that counts.
const INNOVATION_MAX: f64 = 8.0;
/// Growth of the mean square of the residuals, over its former value or 1.
const GROWTH_MIN: f64 = 0.7;
/// Comparisons over which it grows: two seconds.
const GROWS_OVER: usize = 40;
/// Comparisons after the start of motion before innovations count: one second.
const ROLLS_FOR: u32 = 20;

/// Detects the change.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct ChangeMonitor {
    above: f64,
    below: f64,
    /// Mean squares of the last comparisons, the oldest at `next`.
    squares: [f64; GROWS_OVER],
    next: usize,
    /// Comparisons since the robot rolls.
    rolling: u32,
}

impl Default for ChangeMonitor {
    fn default() -> Self {
        Self {
            above: 0.0,
            below: 0.0,
            squares: [f64::INFINITY; GROWS_OVER],
            next: 0,
            rolling: 0,
        }
    }
}

impl ChangeMonitor {
    /// Takes a comparison: the innovation of ln K and the mean square of the residuals, if they are known.
    /// Returns whether the ground has changed; then it begins anew.
    pub(super) fn update(&mut self, comparison: Option<(f64, f64)>, is_rolling: bool) -> bool {
        let Some((innovation, square)) = comparison.filter(|found| found.0.is_finite()) else {
            *self = Self::default();
            return false;
        };
        let before = std::mem::replace(&mut self.squares[self.next], square);
        self.next = (self.next + 1) % GROWS_OVER;
        if !is_rolling {
            (self.above, self.below, self.rolling) = (0.0, 0.0, 0);
            return false;
        }
        self.rolling = self.rolling.saturating_add(1);
        if self.rolling <= ROLLS_FOR {
            return false;
        }
        let bounded = innovation.clamp(-INNOVATION_MAX, INNOVATION_MAX);
        self.above = (self.above + bounded - DRIFT).max(0.0);
        self.below = (self.below - bounded - DRIFT).max(0.0);
        let has_grown = square - before > GROWTH_MIN * before.max(1.0);
        let changed = has_grown && self.above.max(self.below) > THRESHOLD;
        if changed {
            *self = Self::default();
        }
        changed
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Comparisons until an alarm, of at most 400 after 100 quiet ones.
    fn alarm(innovation: f64, square_step: f64) -> Option<u32> {
        let mut monitor = ChangeMonitor::default();
        for count in 0..100_u32 {
            let noise = if count % 2 == 0 { 1.0 } else { -1.0 };
            assert!(!monitor.update(Some((noise, 1.0)), true));
        }
        (0..400).find(|&count| {
            let square = 1.0 + square_step * f64::from(count + 1);
            monitor.update(Some((innovation, square)), true)
        })
    }

    #[test]
    fn innovations_to_one_side_with_growing_residuals_are_a_change_and_neither_alone_is() {
        assert!(alarm(4.0, 0.05).is_some_and(|count| count < 20));
        assert!(alarm(-4.0, 0.05).is_some_and(|count| count < 20));
        assert_eq!(alarm(4.0, 0.0), None);
        assert_eq!(alarm(0.9, 0.05), None);
    }

    #[test]
    fn a_robot_that_sets_off_or_stands_raises_no_alarm() {
        let mut monitor = ChangeMonitor::default();
        for count in 0..1_000_u32 {
            let square = 1.0 + f64::from(count);
            let is_rolling = count % 25 >= 6;
            assert!(!monitor.update(Some((8.0, square)), is_rolling));
        }
    }
}
