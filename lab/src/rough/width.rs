//! Widths of distributions: the same population, with larger differences.

use std::ops::Range;

/// Factor by which distributions are wider than those of the rough world.
///
/// Half-ranges and standard deviations are this factor larger, and middles stay. What is drawn on a
/// logarithmic scale is widened on that scale.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Width(f64);

/// Middle of some values, which stays where it is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Middle(pub f64);

impl Default for Width {
    fn default() -> Self {
        Self(1.0)
    }
}

impl Width {
    /// Returns a width; `None` if the factor is not a number of at least 1.
    pub fn new(factor: f64) -> Option<Self> {
        (factor.is_finite() && factor >= 1.0).then_some(Self(factor))
    }

    /// Returns the factor.
    pub fn factor(self) -> f64 {
        self.0
    }

    /// Widens a range about its middle.
    #[must_use]
    pub fn range(self, range: Range<f64>) -> Range<f64> {
        let more = (self.0 - 1.0) * 0.5 * (range.end - range.start);
        range.start - more..range.end + more
    }

    /// Widens a range about its geometric middle; both bounds must be above zero.
    #[must_use]
    pub fn log_range(self, range: Range<f64>) -> Range<f64> {
        let more = (range.end / range.start).powf(0.5 * (self.0 - 1.0));
        range.start / more..range.end * more
    }

    /// Widens a standard deviation.
    #[must_use]
    pub fn std_dev(self, std_dev: f64) -> f64 {
        self.0 * std_dev
    }

    /// Moves one of some values away from their middle.
    #[must_use]
    pub fn value(self, value: f64, Middle(middle): Middle) -> f64 {
        value + (self.0 - 1.0) * (value - middle)
    }

    /// Moves one of some values away from their middle, on a logarithmic scale; both must be above
    /// zero.
    #[must_use]
    pub fn log_value(self, value: f64, Middle(middle): Middle) -> f64 {
        value * (value / middle).powf(self.0 - 1.0)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::super::sensors::SensorSpec;
    use super::super::spec::Deviations;
    use super::*;
    use crate::random::Random;

    proptest! {
        #[test]
        fn the_middle_stays_and_the_half_range_grows_by_the_factor(
            low in 0.01..1.0_f64, size in 0.01..10.0_f64, factor in 1.0..2.0_f64,
        ) {
            let width = Width::new(factor).unwrap();
            let range = width.range(low..low + size);
            prop_assert!((range.start + range.end - 2.0 * low - size).abs() < 1.0e-9);
            prop_assert!((range.end - range.start - factor * size).abs() < 1.0e-9);
            let high = low + size;
            let log = width.log_range(low..high);
            prop_assert!((log.start * log.end / (low * high) - 1.0).abs() < 1.0e-9);
            let of_log = (log.end / log.start).ln();
            prop_assert!((of_log - factor * (high / low).ln()).abs() < 1.0e-9);
            let middle = (low * high).sqrt();
            prop_assert!((width.log_value(high, Middle(middle)) / log.end - 1.0).abs() < 1.0e-9);
        }

        #[test]
        fn no_width_draws_what_physics_does_not_allow(seed in any::<u64>()) {
            let (mut random, width) = (Random::new(seed), Width::new(1.3).unwrap());
            let robot = Deviations::drawn_wider(&mut random, width);
            for positive in [
                1.0 + robot.payload_ratio, robot.inertia_ratio, robot.center_height_ratio,
                robot.relaxation_m, robot.rotor_ratio, robot.servo_lag_s, robot.motor_limit_mu,
                robot.curve.stiffness, robot.curve.mu_peak, robot.radius_ratio[0],
                robot.torque_scale[0],
            ] {
                prop_assert!(positive > 0.0, "{robot:?}");
            }
            prop_assert!(robot.gear_loss_ratio >= 0.0 && robot.rolling_resistance_ratio >= 0.0);
            let sensors = SensorSpec::drawn_wider(&mut random, true, width);
            prop_assert!((0.0..0.01).contains(&sensors.outlier_share));
        }
    }

    #[test]
    fn no_width_is_less_than_one_or_no_number() {
        for factor in [0.9, 0.0, -1.3, f64::NAN, f64::INFINITY] {
            assert_eq!(Width::new(factor), None);
        }
    }
}
