//! Detects a change of the ground under a robot that is being identified.
//!
//! An alarm needs two conditions: a two-sided CUSUM (Page 1954) of the standardised innovations i
//! of ln K exceeds its threshold, `S ← max(0, S ± i − k) > h`; and the mean square of the
//! standardised residuals has grown over the last two seconds. The CUSUM alone raises false alarms
//! where turns begin and end, which the model describes less well; the residuals alone grow with
//! any error of the model or a sensor.

/// Threshold h of the CUSUM and its drift k, in standard deviations of an innovation.
const THRESHOLD: f64 = 20.0;
const DRIFT: f64 = 1.0;
/// Maximum magnitude of an innovation in the CUSUM; larger ones are clamped.
const INNOVATION_MAX: f64 = 8.0;
/// Minimum growth of the mean square of the residuals, relative to its former value or, if that is
/// below 1, to 1.
const GROWTH_MIN: f64 = 0.7;
/// Number of comparisons between the two mean squares: two seconds.
const GROWS_OVER: usize = 40;
/// Number of comparisons after the start of motion whose innovations are ignored: one second.
const ROLLS_FOR: u32 = 20;

/// State of the detector.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct ChangeMonitor {
    above: f64,
    below: f64,
    /// Mean squares of the last comparisons, the oldest at `next`.
    squares: [f64; GROWS_OVER],
    next: usize,
    /// Number of comparisons since the robot began to roll.
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
    /// Adds one comparison: the standardised innovation of ln K and the mean square of the
    /// standardised residuals. Without them the detector is reset; while the robot does not roll
    /// the CUSUM stays 0.
    ///
    /// Returns whether the ground has changed; after an alarm the detector is reset.
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
