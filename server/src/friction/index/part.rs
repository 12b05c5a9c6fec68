//! Compact sums of one (terrain, configuration, robot, epoch) of a cell.

use tread_api::friction::Information;

use super::names::Number;
use crate::friction::fixed::Fixed;
use crate::friction::sums::{Known, Pair, Pass};
use crate::friction::{EpochMeasurement, Sums};

/// Steps per unit of a stored friction coefficient.
const MU_STEPS: f64 = 1.0e6;
/// Steps per unit of the lower half of a fixed-point number, 2³².
const STEPS: f64 = 4_294_967_296.0;

/// Key of a sum within a cell.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct PartKey {
    pub(super) terrain: Number,
    pub(super) configuration: Number,
    pub(super) robot: Number,
    pub(super) epoch_h: i32,
}

/// [`Sums`] in a compact layout, without the number of samples.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Part {
    hi: [i64; 9],
    lo: [u32; 9],
    pub(super) key: PartKey,
    segments: u32,
    /// Peak friction coefficient in steps, plus one; 0 for none. `newest_mu` likewise.
    mu_peak: u32,
    newest_mu: u32,
    pub(super) newest_at_us: i64,
    /// End of the newest significant pass, which is stored separately.
    pass_at_us: i64,
    /// Information of that pass; 0 if it is not stored.
    newest_information: f64,
    newest_weighted: f64,
}

fn pack_mu(mu: Option<f64>) -> u32 {
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "0 to 10 units"
    )]
    mu.map_or(0, |mu| (mu * MU_STEPS + 1.0e-6).floor() as u32 + 1)
}

fn unpack_mu(steps: u32) -> Option<f64> {
    (steps > 0).then(|| f64::from(steps - 1) / MU_STEPS)
}

impl Part {
    pub(super) fn new(key: PartKey, sums: &Sums) -> Self {
        let mut part = Self {
            hi: [0; 9],
            lo: [0; 9],
            key,
            segments: u32::try_from(sums.segments).unwrap_or(u32::MAX),
            mu_peak: pack_mu(sums.mu_peak),
            newest_mu: pack_mu(sums.newest.mu_peak),
            newest_at_us: sums.newest_at_us,
            pass_at_us: sums.newest.ended_at_us,
            newest_information: sums.newest.theta.map_or(0.0, |theta| theta.information),
            newest_weighted: sums.newest.theta.map_or(0.0, |theta| theta.weighted),
        };
        let fixed = [
            sums.theta.information,
            sums.theta.weighted,
            sums.theta_square,
            sums.track.information,
            sums.track.weighted,
            sums.rolling.information,
            sums.rolling.weighted,
            sums.robot_error,
            sums.tyre_error,
        ];
        for (index, fixed) in fixed.into_iter().enumerate() {
            // Clamped as the database does, so that sums read again are the same.
            let (hi, lo) = fixed.clamped_halves();
            part.hi[index] = hi;
            part.lo[index] = u32::try_from(lo).unwrap_or_default();
        }
        part
    }

    pub(super) fn sums(&self) -> Sums {
        let fixed = |index: usize| {
            Fixed::from_units(self.hi[index]) + Fixed::from_steps(self.lo[index].into())
        };
        let pair = |index| Pair {
            information: fixed(index),
            weighted: fixed(index + 1),
        };
        Sums {
            theta: pair(0),
            theta_square: fixed(2),
            robot_error: fixed(7),
            tyre_error: fixed(8),
            track: pair(3),
            rolling: pair(5),
            segments: u64::from(self.segments),
            samples: 0,
            mu_peak: unpack_mu(self.mu_peak),
            newest_at_us: self.newest_at_us,
            newest: Pass {
                ended_at_us: self.pass_at_us,
                theta: (self.newest_information > 0.0).then_some(Information {
                    information: self.newest_information,
                    weighted: self.newest_weighted,
                }),
                mu_peak: unpack_mu(self.newest_mu),
            },
        }
    }

    /// Returns the number of passes, with or without information.
    pub(super) fn passes(&self) -> u64 {
        u64::from(self.segments)
    }

    /// Returns [`EpochMeasurement::of`] of [`Self::sums`], identical to the bit but faster.
    pub(super) fn seen<R>(&self, robot: R) -> Option<EpochMeasurement<R>> {
        let number = |index: usize| {
            let (hi, lo) = (self.hi[index], self.lo[index]);
            // Both halves are exact, so their sum is rounded once, like the whole.
            #[expect(clippy::cast_precision_loss, reason = "below 2^52")]
            if hi.unsigned_abs() < 1 << 52 {
                hi as f64 + f64::from(lo) / STEPS
            } else {
                (Fixed::from_units(hi) + Fixed::from_steps(lo.into())).to_f64()
            }
        };
        let known = |index: usize| {
            let information = number(index);
            (information > 0.0).then(|| Known {
                information,
                value: number(index + 1) / information,
            })
        };
        let theta = known(0)?;
        let scatter = number(2) - theta.information * theta.value * theta.value;
        let newest = (self.newest_information > 0.0).then(|| Known {
            information: self.newest_information,
            value: self.newest_weighted / self.newest_information,
        });
        Some(EpochMeasurement {
            robot,
            epoch_h: i64::from(self.key.epoch_h),
            theta,
            robot_ratio: number(7) / theta.information,
            tyre_ratio: number(8) / theta.information,
            scatter: scatter.max(0.0),
            passes: u64::from(self.segments),
            newest_at_us: self.newest_at_us,
            newest,
            newest_mu: unpack_mu(self.newest_mu),
            mu_peak: unpack_mu(self.mu_peak),
            track: known(3),
            rolling: known(5),
        })
    }

    /// Returns the sums with another key.
    pub(super) fn moved(&self, key: PartKey) -> Self {
        Self { key, ..*self }
    }

    pub(super) fn add(&mut self, sums: &Sums) {
        let mut whole = self.sums();
        whole.add(sums);
        *self = Self::new(self.key, &whole);
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn fixed() -> impl Strategy<Value = Fixed> {
        (any::<bool>(), 0_i64..1 << 60, 0_i64..1 << 32, 0_u32..60).prop_map(
            |(minus, hi, lo, less)| {
                let hi = hi >> less;
                Fixed::from_units(if minus { -hi } else { hi }) + Fixed::from_steps(lo)
            },
        )
    }

    proptest! {
        #[test]
        fn what_a_part_has_seen_is_what_its_sums_have_seen_to_the_bit(
            numbers in prop::array::uniform9(fixed()), segments in 1_u64..9, mu in prop::option::of(0.0_f64..3.0),
        ) {
            let pair = |index: usize| Pair { information: numbers[index], weighted: numbers[index + 1] };
            let sums = Sums {
                theta: pair(0),
                theta_square: numbers[2],
                robot_error: numbers[7],
                tyre_error: numbers[8],
                track: pair(3),
                rolling: pair(5),
                segments,
                samples: 0,
                mu_peak: mu,
                newest_at_us: 9,
                newest: Pass { ended_at_us: 7, theta: None, mu_peak: mu },
            };
            let key = PartKey { terrain: 0, configuration: 0, robot: 3, epoch_h: 11 };
            let part = Part::new(key, &sums);
            prop_assert_eq!(part.seen(3), EpochMeasurement::of(3, 11, &part.sums()));
        }
    }
}
