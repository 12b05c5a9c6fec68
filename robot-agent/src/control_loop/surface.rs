//! Whether the ground is as the map says: each cell's own measurement against the map's word on it.
//!
//! `z = (θ − θ_map)/√(σ² + σ_map² + (s_b·θ_map)²)`: the segment's standard deviation, the map's,
//! and how much one robot differs from all others (`s_b`). The segment never contains the map's
//! word, so z is standard normal where nothing has changed.
//!
//! ```text
//!        |z| ≥ RAISE_STD_DEVS in two cells in a row, the same way
//! quiet ────────────────────────► raised
//!   ▲ └── AGREE_CELLS cells in a row with |z| ≤ AGREE_DEVIATIONS, or another mission ──┘
//! ```

use tread_api::site::Cell;
use tread_control::tracking::ThetaKnowledge;

/// Standard deviations from which a cell's ground is another one than the map's. By chance, one
/// cell in 147 000 is as far off, and two in a row at the most as often:
/// a robot that drives 2 000 cells an hour gives at most one false alarm in 73 hours of driving
/// over ground that the map knows. The second cell is asked for since a single wrong word, of the
/// map or of a robot without torque, is likelier than chance has it.
pub(crate) const RAISE_STD_DEVS: f64 = 4.5;
/// The probability of a false alarm in a cell: both tails of the standard normal distribution.
#[cfg(test)]
const FALSE_ALARM_PROBABILITY: f64 = 6.8e-6;
/// Standard deviations within which a cell agrees with the map.
const AGREE_DEVIATIONS: f64 = 2.5;
/// Cells in a row that must agree until the alert is over.
const AGREE_CELLS: u8 = 3;

/// What was measured in a cell beside what the map says of it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Comparison {
    pub(crate) cell: Cell,
    /// By the robot alone, in this cell alone.
    pub(crate) measured: ThetaKnowledge,
    /// By the map.
    pub(crate) expected: ThetaKnowledge,
    /// Standard deviation of one robot's own bias as a share of θ.
    pub(crate) robot_bias_ratio: f64,
}

impl Comparison {
    /// How far apart they are, in standard deviations; above zero where the ground slips more.
    pub(crate) fn z_score(&self) -> f64 {
        let (measured, expected) = (self.measured, self.expected);
        let bias = self.robot_bias_ratio * expected.theta;
        let std_dev = measured.std_dev.hypot(expected.std_dev).hypot(bias);
        (measured.theta - expected.theta) / std_dev
    }

    /// How far apart they are, as a share of what was expected.
    pub(crate) fn difference_ratio(&self) -> f64 {
        self.measured.theta / self.expected.theta - 1.0
    }

    /// Whether the ground is another one.
    pub(crate) fn contradicts(&self) -> bool {
        self.z_score().abs() >= RAISE_STD_DEVS
    }
}

/// Remembers whether the ground is as the map says.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct SurfaceWatch {
    raised: Option<Comparison>,
    /// Whether the last cell contradicted the map, and if so whether it slips more.
    suspects_slip: Option<bool>,
    agreed: u8,
}

impl SurfaceWatch {
    /// The newest cell that contradicted the map, while the alert stands.
    pub(crate) fn raised(&self) -> Option<Comparison> {
        self.raised
    }

    /// Takes what a cell has shown.
    pub(crate) fn note(&mut self, comparison: Comparison) {
        let apart = comparison.z_score().abs();
        if !apart.is_finite() {
            return;
        }
        let slips = comparison.contradicts().then(|| comparison.z_score() > 0.0);
        let before = std::mem::replace(&mut self.suspects_slip, slips);
        if slips.is_some() {
            if self.raised.is_some() || before == slips {
                self.raised = Some(comparison);
            }
            self.agreed = 0;
        } else if apart <= AGREE_DEVIATIONS {
            self.agreed = self.agreed.saturating_add(1);
            if self.agreed >= AGREE_CELLS {
                self.raised = None;
            }
        } else {
            self.agreed = 0;
        }
    }

    /// Another mission brings the map's newest word, in which what was found is contained.
    pub(crate) fn begin_mission(&mut self) {
        *self = Self::default();
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use tread_api::friction::ROBOT_BIAS_RATIO;

    use super::*;

    /// Cells of which as many raise a false alarm as chance lets them.
    const CELLS: u32 = 3_000_000;

    fn seen(theta: f64) -> Comparison {
        Comparison {
            cell: Cell { ix: 3, iy: 4 },
            measured: ThetaKnowledge {
                theta,
                std_dev: 0.01,
            },
            expected: ThetaKnowledge {
                theta: 0.2,
                std_dev: 0.01,
            },
            robot_bias_ratio: ROBOT_BIAS_RATIO,
        }
    }

    #[test]
    fn ice_raises_at_its_second_cell_and_three_cells_as_expected_end_it() {
        let mut watch = SurfaceWatch::default();
        for theta in [0.2, 0.23, 0.17] {
            watch.note(seen(theta));
            assert_eq!(watch.raised(), None, "{theta}");
        }
        // One cell alone may be wrong itself, and so may two that say the opposite.
        for theta in [1.5, 0.2, 1.5, 0.01] {
            watch.note(seen(theta));
            assert_eq!(watch.raised(), None, "{theta}");
        }
        for theta in [1.4, 1.5] {
            watch.note(seen(theta));
        }
        assert_eq!(watch.raised(), Some(seen(1.5)));
        // What neither agrees nor contradicts keeps it as it is, and so does what is no number.
        for theta in [0.2, 0.2, 0.27, 0.2, 0.2, f64::NAN] {
            watch.note(seen(theta));
            assert!(watch.raised().is_some(), "{theta}");
        }
        watch.note(seen(0.2));
        assert_eq!(watch.raised(), None);
        for theta in [0.01, 0.01] {
            watch.note(seen(theta));
        }
        assert!(watch.raised().is_some(), "more friction is a change too");
        watch.begin_mission();
        assert_eq!(watch.raised(), None);
    }

    #[test]
    fn the_rate_of_false_alarms_is_the_one_that_is_stated() {
        let mut random = ChaCha8Rng::seed_from_u64(11);
        let mut normal = || {
            let radius = (-2.0 * (1.0 - random.random::<f64>()).ln()).sqrt();
            radius * (std::f64::consts::TAU * random.random::<f64>()).cos()
        };
        let mut alarms = 0_u32;
        for _ in 0..CELLS {
            let truth = 0.2;
            let map = truth * (1.0 + 0.05 * normal());
            let own = truth * (1.0 + 0.08 * normal()) + 0.02 * normal();
            let comparison = Comparison {
                measured: ThetaKnowledge {
                    theta: own,
                    std_dev: 0.02,
                },
                expected: ThetaKnowledge {
                    theta: map,
                    std_dev: 0.05 * truth,
                },
                ..seen(truth)
            };
            alarms += u32::from(comparison.contradicts());
        }
        let expected = f64::from(CELLS) * FALSE_ALARM_PROBABILITY;
        // Four standard deviations of a count of that mean; the bias is given as a share of the
        // map's θ.
        assert!(alarms > 0, "an alarm that never comes tests nothing");
        assert!(
            f64::from(alarms) < expected + 4.0 * expected.sqrt(),
            "{alarms} false alarms, {expected} expected"
        );
    }
}
