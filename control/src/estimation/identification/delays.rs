//! Whether gyro and accelerometer are later than the estimate takes them to be.
//!
//! Delays up to [`IDENTIFIED_MAX_S`] are parameters of the model. A sensor that becomes late during a drive
//! moves them slowly, since earlier blocks outweigh new ones, and meanwhile K takes the rest, because a late
//! response looks like slip. The newest blocks alone show the delay at once: a sensor that is late by δ
//! leaves residuals of −δ times the rate of change of its output. Their delay is compared with the
//! identified one, and with that of about the last minute of earlier blocks.

use super::parameters::{Values, index};
use super::simulation::{DELAYED, delays_s};
use crate::estimation::{LateSensor, SensorDelays};

/// Magnitude of the identified delays, of the gyro relative to the wheel speeds and of the accelerometer
/// relative to the gyro, above which they are not accurate, seconds: outputs follow delays to second order.
const IDENTIFIED_MAX_S: f64 = 0.03;
/// Difference of the newest delay from the identified one above which the sensor is late, in seconds and in
/// standard deviations.
const UNIDENTIFIED: Difference = Difference {
    least_s: 0.02,
    least_std_devs: 3.0,
};
/// The same of the difference from earlier blocks.
const CHANGED: Difference = Difference {
    least_s: 0.012,
    least_std_devs: 2.0,
};
/// Number of newest blocks that are taken together.
const NEWEST: usize = 5;
/// Minimum number of earlier blocks, and the number above which older ones lose weight exponentially, so that
/// a delay that has changed for good becomes the usual one after about a minute.
const EARLIER_MIN: u32 = 5;
const EARLIER_MAX: u32 = 60;
/// Maximum magnitude of a standardised residual.
const RESIDUAL_MAX: f64 = 10.0;
/// Number of sensors: gyro and accelerometer.
const SENSORS: usize = 2;

/// Residual of one channel in one comparison, as far as delays matter.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct DelayResidual {
    /// Measurement minus output, over its standard deviation.
    pub(super) standardised: f64,
    /// Derivative of the output by its delay over the same standard deviation, per second.
    pub(super) slope_1_s: f64,
    /// Delay in the output, seconds.
    pub(super) delay_s: f64,
}

/// What two delays must differ by to count as different.
#[derive(Debug, Clone, Copy)]
struct Difference {
    least_s: f64,
    least_std_devs: f64,
}

/// A delay that residuals show.
#[derive(Debug, Clone, Copy)]
struct Delay {
    delay_s: f64,
    variance_s2: f64,
}

impl Delay {
    fn differs(self, other: Self, by: Difference) -> bool {
        let off_s = (self.delay_s - other.delay_s).abs();
        let std_dev_s = (self.variance_s2 + other.variance_s2).sqrt();
        off_s > by.least_s && off_s > by.least_std_devs * std_dev_s
    }
}

/// Normal equation of the delay of one sensor.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Sums {
    information: f64,
    /// Sum of the delays in the outputs, corrected by their residuals, weighted by their information.
    weighted_s: f64,
    squares: f64,
    count: f64,
}

impl Sums {
    const fn none() -> Self {
        Self {
            information: 0.0,
            weighted_s: 0.0,
            squares: 0.0,
            count: 0.0,
        }
    }

    fn add(&mut self, other: &Self) {
        self.information += other.information;
        self.weighted_s += other.weighted_s;
        self.squares += other.squares;
        self.count += other.count;
    }

    fn multiply(&mut self, ratio: f64) {
        self.information *= ratio;
        self.weighted_s *= ratio;
        self.squares *= ratio;
        self.count *= ratio;
    }

    /// Returns the delay; None where no output changed.
    fn delay(&self) -> Option<Delay> {
        (self.information > 0.0).then(|| Delay {
            delay_s: self.weighted_s / self.information,
            variance_s2: (self.squares / self.count).max(1.0) / self.information,
        })
    }
}

/// A block of the newest ones.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Block {
    sums: [Sums; SENSORS],
    /// Whether the estimate had converged, so that the block counts among the earlier ones later.
    has_converged: bool,
}

impl Block {
    const fn none() -> Self {
        Self {
            sums: [Sums::none(); SENSORS],
            has_converged: false,
        }
    }
}

/// Blocks of a converged estimate before the newest ones, of one sensor.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Earlier {
    sums: Sums,
    /// Their number, at most [`EARLIER_MAX`].
    blocks: u32,
}

impl Earlier {
    const fn none() -> Self {
        Self {
            sums: Sums::none(),
            blocks: 0,
        }
    }

    /// Adds a block in which the sensor measured.
    fn add(&mut self, block: &Sums) {
        if block.count <= 0.0 {
            return;
        }
        if self.blocks < EARLIER_MAX {
            self.blocks += 1;
        } else {
            self.sums.multiply(1.0 - f64::from(EARLIER_MAX).recip());
        }
        self.sums.add(block);
    }

    /// Returns the delay; None before [`EARLIER_MIN`] blocks.
    fn delay(&self) -> Option<Delay> {
        self.sums.delay().filter(|_| self.blocks >= EARLIER_MIN)
    }
}

/// Delays of gyro and accelerometer in the newest blocks and in earlier ones.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Delays {
    open: Block,
    /// Whether the model began in the open block, from an assumed state of motion.
    is_settling: bool,
    newest: [Block; NEWEST],
    earlier: [Earlier; SENSORS],
}

impl Delays {
    /// Creates the comparison without blocks.
    pub(super) const fn new() -> Self {
        Self {
            open: Block::none(),
            is_settling: true,
            newest: [Block::none(); NEWEST],
            earlier: [Earlier::none(); SENSORS],
        }
    }

    /// Adds the residual of a channel to the open block. Channels without a delay, and residuals that are not
    /// finite, are ignored.
    pub(super) fn add(&mut self, channel: usize, compared: DelayResidual) {
        let DelayResidual {
            standardised,
            slope_1_s,
            delay_s,
        } = compared;
        if channel >= DELAYED || !standardised.is_finite() || !slope_1_s.is_finite() {
            return;
        }
        let residual = standardised.clamp(-RESIDUAL_MAX, RESIDUAL_MAX);
        let sums = &mut self.open.sums[usize::from(channel > 0)];
        sums.add(&Sums {
            information: slope_1_s * slope_1_s,
            weighted_s: slope_1_s * (residual + slope_1_s * delay_s),
            squares: residual * residual,
            count: 1.0,
        });
    }

    /// Ends the open block of an estimate that `has_converged` or has not. One in which the model began is
    /// dropped.
    pub(super) fn end_block(&mut self, has_converged: bool) {
        let mut open = std::mem::replace(&mut self.open, Block::none());
        if std::mem::take(&mut self.is_settling) {
            return;
        }
        open.has_converged = has_converged;
        let oldest = std::mem::replace(&mut self.newest[0], open);
        self.newest.rotate_left(1);
        if oldest.has_converged {
            for (earlier, sums) in self.earlier.iter_mut().zip(&oldest.sums) {
                earlier.add(sums);
            }
        }
    }

    /// Drops the open block.
    pub(super) fn drop_block(&mut self) {
        self.open = Block::none();
    }

    /// Records that the model begins anew from an assumed state of motion.
    pub(super) fn restart(&mut self) {
        self.drop_block();
        self.is_settling = true;
    }

    /// Returns the delays if a sensor is later, or earlier, than the model can describe, than the parameters
    /// `values` say, or than it was.
    pub(super) fn late(&self, values: &Values) -> Option<LateSensor> {
        let parameters = [index::GYRO_DELAY, index::ACCELEROMETER_DELAY];
        let mut is_late = parameters
            .into_iter()
            .any(|place| values[place].abs() > IDENTIFIED_MAX_S);
        let [gyro_s, accelerometer_s, _] = delays_s(values);
        let identified_s = [gyro_s, accelerometer_s];
        let mut newest_s = identified_s;
        for (sensor, identified_s) in identified_s.into_iter().enumerate() {
            let Some(newest) = self.newest(sensor).delay() else {
                continue;
            };
            let identified = Delay {
                delay_s: identified_s,
                variance_s2: 0.0,
            };
            let earlier = self.earlier[sensor].delay();
            is_late |= newest.differs(identified, UNIDENTIFIED)
                || earlier.is_some_and(|earlier| newest.differs(earlier, CHANGED));
            if newest.variance_s2.sqrt() < IDENTIFIED_MAX_S {
                newest_s[sensor] = newest.delay_s;
            }
        }
        let delays = |[gyro_s, accelerometer_s]: [f64; SENSORS]| SensorDelays {
            gyro_s,
            accelerometer_s,
        };
        is_late.then(|| LateSensor {
            newest: delays(newest_s),
            identified: delays(identified_s),
        })
    }

    /// Returns the sums of a sensor over the newest blocks.
    fn newest(&self, sensor: usize) -> Sums {
        let mut sums = Sums::none();
        for block in &self.newest {
            sums.add(&block.sums[sensor]);
        }
        sums
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Rate of change of the output, in standard deviations per second.
    const RATE_1_S: f64 = 60.0;

    /// Adds a block of twenty comparisons, in which a sensor has a delay and the model another one.
    fn add_block(delays: &mut Delays, channel: usize, measured_s: f64, values: &Values) {
        add_block_of(delays, channel, measured_s, values, true);
    }

    /// The same of an estimate that has converged or has not.
    fn add_block_of(
        delays: &mut Delays,
        channel: usize,
        measured_s: f64,
        values: &Values,
        has_converged: bool,
    ) {
        let assumed_s = delays_s(values)[channel];
        for turn in 0..20 {
            let slope_1_s = if turn % 2 == 0 { RATE_1_S } else { -RATE_1_S };
            let noise = if turn % 4 < 2 { 1.0 } else { -1.0 };
            let standardised = slope_1_s * (measured_s - assumed_s) + noise;
            delays.add(
                channel,
                DelayResidual {
                    standardised,
                    slope_1_s,
                    delay_s: assumed_s,
                },
            );
        }
        delays.end_block(has_converged);
    }

    /// A comparison that has begun long ago.
    fn settled() -> Delays {
        let mut delays = Delays::new();
        delays.end_block(false);
        delays
    }

    fn identified(gyro_s: f64) -> Values {
        let mut values = Values::zeros();
        values[index::GYRO_DELAY] = gyro_s;
        values
    }

    #[test]
    fn a_sensor_that_becomes_late_is_noticed_though_the_estimate_follows() {
        for channel in 0..DELAYED {
            let mut delays = settled();
            for _ in 0..20 {
                add_block(&mut delays, channel, 0.0, &identified(0.0));
                assert_eq!(delays.late(&identified(0.0)), None);
            }
            // The identified delay follows block by block.
            for block in 1..=5 {
                let values = identified(0.004 * f64::from(block));
                add_block(&mut delays, channel, 0.02, &values);
            }
            let late = delays.late(&identified(0.02)).unwrap();
            let newest_s = if channel == 0 {
                late.newest.gyro_s
            } else {
                late.newest.accelerometer_s
            };
            assert!((newest_s - 0.02).abs() < 1.0e-3, "{channel}: {late:?}");
        }
    }

    #[test]
    fn a_delay_that_is_too_long_to_be_identified_is_one_of_a_late_sensor() {
        let delays = Delays::new();
        assert_eq!(delays.late(&identified(0.029)), None);
        let late = delays.late(&identified(0.031)).unwrap();
        assert!((late.identified.gyro_s - 0.031).abs() < 1.0e-12, "{late:?}");
        assert!(delays.late(&identified(-0.031)).is_some());
        // The delay of the accelerometer is limited relative to that of the gyro.
        let mut values = identified(0.025);
        values[index::ACCELEROMETER_DELAY] = 0.025;
        assert_eq!(delays.late(&values), None);
        values[index::ACCELEROMETER_DELAY] = -0.031;
        assert!(delays.late(&values).is_some());
    }

    #[test]
    fn a_delay_that_has_changed_for_good_becomes_the_usual_one() {
        let mut delays = settled();
        for _ in 0..3_600 {
            add_block(&mut delays, 0, 0.0, &identified(0.0));
        }
        let values = identified(0.02);
        let late = (0..120).filter(|_| {
            add_block(&mut delays, 0, 0.02, &values);
            delays.late(&values).is_some()
        });
        let late_blocks = late.count();
        assert!((20..70).contains(&late_blocks), "{late_blocks}");
        assert_eq!(delays.late(&values), None);
    }

    #[test]
    fn blocks_before_the_estimate_converged_are_no_earlier_ones() {
        let mut delays = settled();
        for _ in 0..20 {
            add_block_of(&mut delays, 0, 0.0, &identified(0.0), false);
        }
        for _ in 0..NEWEST {
            add_block(&mut delays, 0, 0.012, &identified(0.012));
        }
        assert_eq!(delays.late(&identified(0.012)), None);
    }

    #[test]
    fn a_delay_that_is_not_identified_yet_is_noticed_without_earlier_blocks() {
        let mut delays = settled();
        for _ in 0..NEWEST {
            add_block(&mut delays, 0, 0.025, &identified(0.002));
        }
        assert!(delays.late(&identified(0.002)).is_some());
        assert_eq!(delays.late(&identified(0.025)), None);
    }

    #[test]
    fn blocks_in_which_the_model_begins_do_not_count() {
        let mut delays = settled();
        for _ in 0..20 {
            delays.restart();
            add_block(&mut delays, 0, 0.025, &identified(0.0));
        }
        assert_eq!(delays.late(&identified(0.0)), None);
    }

    #[test]
    fn outputs_that_do_not_change_show_no_delay() {
        let mut delays = settled();
        for _ in 0..20 {
            delays.add(
                0,
                DelayResidual {
                    standardised: 5.0,
                    slope_1_s: 0.0,
                    delay_s: 0.0,
                },
            );
            delays.end_block(true);
        }
        assert_eq!(delays.late(&identified(0.0)), None);
    }

    proptest! {
        #[test]
        fn a_constant_delay_that_is_identified_is_never_late(
            delay_s in -0.025..0.025, errors_s in prop::collection::vec(-0.004..0.004, 1..60),
        ) {
            let mut delays = settled();
            for error_s in errors_s {
                let values = identified(delay_s + error_s);
                add_block(&mut delays, 0, delay_s, &values);
                prop_assert_eq!(delays.late(&values), None);
            }
        }
    }
}
