//! Detects ground that differs from the map: compares each cell's own measurement with the map's
//! estimate.
//!
//! `z = (θ − θ_map)/√(σ² + σ_map² + (s_b·θ_map)²)`, with the standard deviations of the segment, of
//! the map, and the relative one of a robot's bias (`s_b`). The segment does not contain the map's
//! estimate, so z is standard normal where the ground has not changed.
//!
//! ```text
//!        |z| ≥ RAISE_STD_DEVS in two cells in a row, the same way
//! quiet ────────────────────────► raised
//!   ▲ └── AGREE_CELLS cells in a row with |z| ≤ AGREE_DEVIATIONS, or another mission ──┘
//! ```

use tread_api::site::Cell;
use tread_control::tracking::ThetaKnowledge;

/// |z| from which a cell contradicts the map. By chance this happens in one cell in 147 000, and in
/// two in a row at most as often: at 2 000 cells an hour, at most one false alarm in 73 hours of
/// driving over mapped ground. A second cell is required since a single wrong estimate, of the map
/// or of a robot without torque sensors, is more likely than chance.
pub(crate) const RAISE_STD_DEVS: f64 = 4.5;
/// Probability of a false alarm in a cell: both tails of the standard normal distribution.
#[cfg(test)]
const FALSE_ALARM_PROBABILITY: f64 = 6.8e-6;
/// |z| up to which a cell agrees with the map.
const AGREE_DEVIATIONS: f64 = 2.5;
/// Number of consecutive agreeing cells after which the alert ends.
const AGREE_CELLS: u8 = 3;

/// θ measured in a cell and θ of the map there.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Comparison {
    pub(crate) cell: Cell,
    /// Measured by the robot alone, in this cell alone.
    pub(crate) measured: ThetaKnowledge,
    /// Estimate of the map.
    pub(crate) expected: ThetaKnowledge,
    /// Relative standard deviation of one robot's bias of θ.
    pub(crate) robot_bias_ratio: f64,
}

impl Comparison {
    /// Returns z; positive where the measured θ exceeds the map's.
    pub(crate) fn z_score(&self) -> f64 {
        let (measured, expected) = (self.measured, self.expected);
        let bias = self.robot_bias_ratio * expected.theta;
        let std_dev = measured.std_dev.hypot(expected.std_dev).hypot(bias);
        (measured.theta - expected.theta) / std_dev
    }

    /// Returns the relative difference, `θ/θ_map` − 1.
    pub(crate) fn difference_ratio(&self) -> f64 {
        self.measured.theta / self.expected.theta - 1.0
    }

    /// Whether |z| reaches [`RAISE_STD_DEVS`].
    pub(crate) fn contradicts(&self) -> bool {
        self.z_score().abs() >= RAISE_STD_DEVS
    }
}

/// State of the detection.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct SurfaceWatch {
    raised: Option<Comparison>,
    /// Whether the last cell contradicted the map; true if its θ exceeds the map's.
    suspects_slip: Option<bool>,
    agreed: u8,
}

impl SurfaceWatch {
    /// Returns the newest cell that contradicted the map, while the alert is raised.
    pub(crate) fn raised(&self) -> Option<Comparison> {
        self.raised
    }

    /// Processes the comparison of one cell.
    pub(crate) fn record(&mut self, comparison: Comparison) {
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

    /// Resets the detection: a new mission brings the map's newest estimates, which include what
    /// was measured before.
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

    /// Number of simulated cells, enough to measure the false-alarm rate.
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
            watch.record(seen(theta));
            assert_eq!(watch.raised(), None, "{theta}");
        }
        // One cell alone may be wrong itself, and so may two that say the opposite.
        for theta in [1.5, 0.2, 1.5, 0.01] {
            watch.record(seen(theta));
            assert_eq!(watch.raised(), None, "{theta}");
        }
        for theta in [1.4, 1.5] {
            watch.record(seen(theta));
        }
        assert_eq!(watch.raised(), Some(seen(1.5)));
        // What neither agrees nor contradicts keeps it as it is, and so does what is no number.
        for theta in [0.2, 0.2, 0.27, 0.2, 0.2, f64::NAN] {
            watch.record(seen(theta));
            assert!(watch.raised().is_some(), "{theta}");
        }
        watch.record(seen(0.2));
        assert_eq!(watch.raised(), None);
        for theta in [0.01, 0.01] {
            watch.record(seen(theta));
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
