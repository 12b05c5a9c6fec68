//! Whether each regime of motion shows the same K.
//!
//! Errors of the model are alike within a regime: in every turn entry the relaxation of the tyres is wrong
//! in the same way, in every steady turn their curve. The scatter of single blocks does not show what
//! they have in common. A jackknife over the regimes does (Efron, The Jackknife, the Bootstrap and Other
//! Resampling Plans, 1982, ch. 3): with the change `Δ_r` of ln K without the blocks of regime r, the
//! variance of ln K is `(R − 1)/R Σ Δ_r²`. If regimes differ by noise alone, `Δ_r²` is on average the
//! variance without the regime minus that with it (Hausman, Econometrica 46, 1978), which the estimate's
//! variance contains already. What exceeds it is added.

use super::blocks::Blocks;
use super::parameters::{Prior, Square, Values, index, ln_stiffness_gradient};

/// Number of regimes.
const REGIMES: usize = 5;
/// Change of the mean rim speed in a block, relative to its maximum, from which the robot speeds up or
/// brakes, and the same of the turn from which the robot enters or leaves it.
const SPEED_CHANGE_RATIO: f64 = 0.2;
const TURN_CHANGE_RATIO: f64 = 0.2;
/// Half the difference of the rim speeds, relative to their mean, below which the robot drives straight.
const STRAIGHT_RATIO: f64 = 0.1;
/// Maximum variance of ln K without the blocks of a regime: beyond it, the regime cannot be compared
/// with the others.
const VARIANCE_MAX: f64 = 0.1;
/// Factor of stored sums below which they are multiplied by it.
const FACTOR_MIN: f64 = 1.0e-6;

/// Regime of motion in a block.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Regime {
    Straight,
    SteadyTurn,
    TurnEntry,
    TurnExit,
    SpeedChange,
}

/// Speed and turn by the wheels, as magnitudes.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct RimMotion {
    /// Mean of the rim speeds of both sides, metres per second.
    speed_m_s: f64,
    /// Half their difference, metres per second.
    turn_m_s: f64,
}

/// Motion of the wheels in the open block.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct BlockMotion {
    first: Option<RimMotion>,
    last: RimMotion,
    largest: RimMotion,
}

impl BlockMotion {
    /// Adds the rim speeds of a sample, left and right, metres per second.
    pub(super) fn add(&mut self, [left_m_s, right_m_s]: [f64; 2]) {
        let now = RimMotion {
            speed_m_s: 0.5 * (left_m_s + right_m_s).abs(),
            turn_m_s: 0.5 * (right_m_s - left_m_s).abs(),
        };
        self.first.get_or_insert(now);
        self.last = now;
        self.largest = RimMotion {
            speed_m_s: self.largest.speed_m_s.max(now.speed_m_s),
            turn_m_s: self.largest.turn_m_s.max(now.turn_m_s),
        };
    }

    /// Returns the regime of the motion since the start of the block.
    pub(super) fn regime(&self) -> Regime {
        let first = self.first.unwrap_or(self.last);
        let faster_m_s = self.last.speed_m_s - first.speed_m_s;
        let tighter_m_s = self.last.turn_m_s - first.turn_m_s;
        let is_speed_changed = faster_m_s.abs() > SPEED_CHANGE_RATIO * self.largest.speed_m_s;
        if is_speed_changed && faster_m_s.abs() > tighter_m_s.abs() {
            Regime::SpeedChange
        } else if self.largest.turn_m_s < STRAIGHT_RATIO * self.largest.speed_m_s {
            Regime::Straight
        } else if tighter_m_s.abs() <= TURN_CHANGE_RATIO * self.largest.turn_m_s {
            Regime::SteadyTurn
        } else if tighter_m_s > 0.0 {
            Regime::TurnEntry
        } else {
            Regime::TurnExit
        }
    }
}

/// ln K by the blocks of some regimes.
#[derive(Debug, Clone, Copy, PartialEq)]
struct LnStiffness {
    value: f64,
    variance: f64,
}

impl LnStiffness {
    /// Returns the solution of normal equations; None if there is none.
    fn of(information: &Square, vector: &Values) -> Option<Self> {
        let cholesky = information.clone_owned().cholesky()?;
        let covariance = cholesky.solve(&ln_stiffness_gradient());
        Some(Self {
            value: covariance.dot(vector),
            variance: covariance[index::STIFFNESS],
        })
    }
}

/// Comparison of the regimes, one in each step.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Comparison {
    /// ln K by all regimes; None if it is not computed yet.
    all: Option<LnStiffness>,
    /// Number of regimes that were left out in turn.
    steps: usize,
    /// Sum of `Δ_r²` minus its variance by noise, and the number of regimes with blocks.
    excess: f64,
    regimes: f64,
}

impl Comparison {
    const START: Self = Self {
        all: None,
        steps: 0,
        excess: 0.0,
        regimes: 0.0,
    };
}

/// Blocks by regime, and their disagreement.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Regimes {
    /// Sums of each regime, over `factor`: so all of them are multiplied at once.
    blocks: [Blocks; REGIMES],
    factor: f64,
    last: Regime,
    comparison: Comparison,
    variance: f64,
}

impl Regimes {
    /// Removes all blocks.
    pub(super) fn clear(&mut self) {
        self.blocks.iter_mut().for_each(Blocks::clear);
        self.factor = 1.0;
        self.last = Regime::Straight;
        self.comparison = Comparison::START;
        self.variance = 0.0;
    }

    /// Creates the comparison without blocks.
    pub(super) fn new() -> Self {
        Self {
            blocks: std::array::from_fn(|_| Blocks::none()),
            factor: 1.0,
            last: Regime::Straight,
            comparison: Comparison::START,
            variance: 0.0,
        }
    }

    /// Returns the variance of ln K by the disagreement of the regimes beyond noise, 0 if there is none.
    pub(super) fn variance(&self) -> f64 {
        self.variance
    }

    /// Multiplies the weights of all blocks.
    pub(super) fn multiply(&mut self, ratio: f64) {
        self.factor *= ratio;
        self.comparison = Comparison::START;
        if self.factor < FACTOR_MIN {
            let factor = std::mem::replace(&mut self.factor, 1.0);
            self.blocks
                .iter_mut()
                .for_each(|blocks| blocks.multiply(factor));
        }
    }

    /// Adds a block of the motion `regime`.
    pub(super) fn add(&mut self, block: &Blocks, regime: Regime) {
        let share = self.factor.recip();
        self.blocks[regime as usize].combine(block, |own, block| own + share * block);
        self.last = regime;
        self.comparison = Comparison::START;
    }

    /// Subtracts the block that was added last, or what is left of it.
    pub(super) fn subtract_last(&mut self, block: &Blocks) {
        let share = self.factor.recip();
        self.blocks[self.last as usize].combine(block, |own, block| own - share * block);
        self.comparison = Comparison::START;
    }

    /// Takes the next step of the comparison, about as long as one solution of the normal equations. Does
    /// nothing after the last one, until blocks are added.
    pub(super) fn compare_next(&mut self, prior: &Prior) {
        if self.comparison.steps >= REGIMES {
            return;
        }
        let mut information = prior.information;
        let mut vector = prior.information_vector;
        let left_out = self.comparison.all.map(|_| self.comparison.steps);
        if let Some(place) = left_out {
            self.comparison.steps += 1;
            if self.blocks[place].count <= 0.0 {
                self.end_step(None);
                return;
            }
        }
        for (place, blocks) in self.blocks.iter().enumerate() {
            if Some(place) != left_out && blocks.count > 0.0 {
                let sums = information.as_mut_slice().iter_mut();
                for (sum, own) in sums.zip(blocks.information.as_slice()) {
                    *sum += self.factor * own;
                }
                vector.axpy(self.factor, &blocks.information_vector, 1.0);
            }
        }
        let found = LnStiffness::of(&information, &vector);
        if left_out.is_some() {
            self.comparison.regimes += 1.0;
            self.end_step(found);
        } else if found.is_some() {
            self.comparison.all = found;
        } else {
            self.comparison.steps = REGIMES;
        }
    }

    /// Adds ln K without a regime, if it is known, to the comparison.
    fn end_step(&mut self, without: Option<LnStiffness>) {
        let comparison = &mut self.comparison;
        let known = without.filter(|without| without.variance < VARIANCE_MAX);
        if let Some((without, all)) = known.zip(comparison.all) {
            let by_noise = without.variance - all.variance;
            comparison.excess += (without.value - all.value).powi(2) - by_noise;
        }
        if comparison.steps >= REGIMES {
            let ratio = (comparison.regimes - 1.0) / comparison.regimes.max(1.0);
            self.variance = (ratio * comparison.excess).max(0.0);
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::super::parameters;
    use super::*;
    use crate::estimation::{EstimatorPrior, SensorNoise};

    const ALL: [Regime; REGIMES] = [
        Regime::Straight,
        Regime::SteadyTurn,
        Regime::TurnEntry,
        Regime::TurnExit,
        Regime::SpeedChange,
    ];

    fn prior() -> Prior {
        parameters::prior(&EstimatorPrior::default(), &SensorNoise::default())
    }

    /// A block that measures ln K alone.
    fn block(ln_stiffness: f64, information: f64) -> Blocks {
        let mut block = Blocks::none();
        block.information[(index::STIFFNESS, index::STIFFNESS)] = information;
        block.information_vector[index::STIFFNESS] = information * ln_stiffness;
        block.count = 1.0;
        block
    }

    fn compare(regimes: &mut Regimes) -> f64 {
        let prior = prior();
        for _ in 0..=REGIMES {
            regimes.compare_next(&prior);
        }
        regimes.variance()
    }

    fn regime(rims_m_s: &[[f64; 2]]) -> Regime {
        let mut motion = BlockMotion::default();
        for rims in rims_m_s {
            motion.add(*rims);
        }
        motion.regime()
    }

    #[test]
    fn the_wheels_show_the_regime_of_a_block_forward_and_backward() {
        for sign in [1.0, -1.0] {
            let of =
                |rims_m_s: [[f64; 2]; 2]| regime(&rims_m_s.map(|rims| rims.map(|rim| sign * rim)));
            assert_eq!(of([[0.6, 0.6], [0.62, 0.61]]), Regime::Straight);
            assert_eq!(of([[0.5, 0.7], [0.5, 0.71]]), Regime::SteadyTurn);
            assert_eq!(of([[0.7, 0.5], [0.71, 0.5]]), Regime::SteadyTurn);
            assert_eq!(of([[0.55, 0.65], [0.5, 0.7]]), Regime::TurnEntry);
            assert_eq!(of([[0.7, 0.5], [0.65, 0.55]]), Regime::TurnExit);
            assert_eq!(of([[0.6, 0.6], [0.3, 0.32]]), Regime::SpeedChange);
            assert_eq!(of([[0.0, 0.0], [0.3, 0.3]]), Regime::SpeedChange);
        }
        assert_eq!(regime(&[[-0.2, 0.2], [-0.21, 0.2]]), Regime::SteadyTurn);
        assert_eq!(BlockMotion::default().regime(), Regime::SteadyTurn);
    }

    #[test]
    fn regimes_that_disagree_beyond_noise_add_the_variance_of_their_mean() {
        let mut regimes = Regimes::new();
        for _ in 0..10 {
            regimes.add(&block(1.0, 1_000.0), Regime::TurnEntry);
            regimes.add(&block(1.2, 1_000.0), Regime::SteadyTurn);
        }
        // Two values that differ by 0.2 have a mean of the variance 0.1².
        let variance = compare(&mut regimes);
        assert!((variance - 0.01).abs() < 2.0e-4, "{variance}");
        // Once they agree, nothing is added.
        for _ in 0..10 {
            regimes.add(&block(1.2, 1_000.0), Regime::TurnEntry);
            regimes.add(&block(1.0, 1_000.0), Regime::SteadyTurn);
        }
        let variance = compare(&mut regimes);
        assert!(variance.abs() < 1.0e-12, "{variance}");
    }

    #[test]
    fn a_drive_of_one_regime_cannot_disagree_with_itself() {
        for regime in ALL {
            let mut regimes = Regimes::new();
            regimes.add(&block(1.0, 1_000.0), regime);
            regimes.add(&block(2.0, 1_000.0), regime);
            assert!(compare(&mut regimes).abs() < 1.0e-12);
        }
    }

    #[test]
    fn a_regime_without_which_nothing_is_known_is_not_compared() {
        let mut regimes = Regimes::new();
        regimes.add(&block(1.0, 1_000.0), Regime::TurnEntry);
        regimes.add(&block(3.0, 1.0e-3), Regime::SteadyTurn);
        assert!(compare(&mut regimes) < 1.0e-6);
    }

    proptest! {
        #[test]
        fn a_block_that_is_subtracted_leaves_no_trace(
            values in prop::collection::vec((-1.0..1.0, 1.0..1.0e3, 0..REGIMES, 1.0e-4..1.0), 1..20),
            dropped in (-1.0..1.0, 1.0..1.0e3, 0..REGIMES),
        ) {
            let mut regimes = Regimes::new();
            for (value, information, place, ratio) in values {
                regimes.multiply(ratio);
                regimes.add(&block(value, information), ALL[place]);
            }
            let before = compare(&mut regimes);
            let (value, information, place) = dropped;
            let dropped = block(value, information);
            regimes.add(&dropped, ALL[place]);
            regimes.subtract_last(&dropped);
            let after = compare(&mut regimes);
            prop_assert!((after - before).abs() <= 1.0e-6 * before.max(1.0e-3), "{} {}", before, after);
        }

        #[test]
        fn a_comparison_that_is_cleared_is_a_new_one(
            values in prop::collection::vec((-1.0..1.0, 1.0..1.0e3, 0..REGIMES, 1.0e-4..1.0), 1..20),
        ) {
            let mut regimes = Regimes::new();
            for (value, information, place, ratio) in values {
                regimes.multiply(ratio);
                regimes.add(&block(value, information), ALL[place]);
            }
            compare(&mut regimes);
            regimes.clear();
            prop_assert_eq!(regimes, Regimes::new());
        }

        #[test]
        fn regimes_that_agree_never_add_variance(
            values in prop::collection::vec((1.0..1.0e4, 0..REGIMES), 1..40),
        ) {
            let mut regimes = Regimes::new();
            let mean = prior().mean[index::STIFFNESS];
            for (information, place) in values {
                regimes.add(&block(mean, information), ALL[place]);
            }
            prop_assert!(compare(&mut regimes) < 1.0e-12);
        }
    }
}
