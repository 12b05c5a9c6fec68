//! Measures the value of the map's prior for a mission: for how long θ was known, and how
//! accurately.

use tread_api::mission::{PriorGain, THETA_SURE_RATIO};
use tread_control::tracking::ThetaKnowledge;

use super::surface::Comparison;

/// Knowledge of the ground in a tick.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct GroundRecord {
    /// Friction coefficient of the plan; `None` where the map had none.
    pub(crate) traction_limit_mu: Option<f64>,
    /// Whether the map has an estimate for this cell.
    pub(crate) is_on_the_map: bool,
    /// θ given to the tracking law.
    pub(crate) given: Option<ThetaKnowledge>,
    /// θ measured by the robot alone.
    pub(crate) measured: Option<ThetaKnowledge>,
}

/// Duration of a tick, and the distance driven in it.
#[derive(Debug, Clone, Copy)]
pub(super) struct GainTick {
    pub(super) dt_s: f64,
    pub(super) driven_m: f64,
    /// Time since the mission's start.
    pub(super) since_start_s: f64,
}

fn is_sure(known: Option<ThetaKnowledge>) -> bool {
    known.is_some_and(|known| known.std_dev <= THETA_SURE_RATIO * known.theta)
}

/// Sums from which a [`PriorGain`] is computed.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Gain {
    traction_limit_mu: Option<f64>,
    known_m: f64,
    known_s: f64,
    known_alone_s: f64,
    first_known_alone_s: Option<f64>,
    compared: u32,
    contradicted: u32,
    difference_sum: f64,
    square_sum: f64,
}

impl Gain {
    /// Adds a tick.
    pub(super) fn add(&mut self, ground: &GroundRecord, tick: GainTick) {
        self.traction_limit_mu = ground.traction_limit_mu.or(self.traction_limit_mu);
        if ground.is_on_the_map {
            self.known_m += tick.driven_m;
        }
        if is_sure(ground.given) {
            self.known_s += tick.dt_s;
        }
        if is_sure(ground.measured) {
            self.known_alone_s += tick.dt_s;
            self.first_known_alone_s.get_or_insert(tick.since_start_s);
        }
    }

    /// Adds the difference between the map's and the robot's θ in one cell. A difference whose
    /// z-score is not finite is ignored.
    pub(super) fn compare(&mut self, comparison: &Comparison) {
        let apart = comparison.z_score();
        if !apart.is_finite() {
            return;
        }
        self.compared = self.compared.saturating_add(1);
        self.contradicted += u32::from(comparison.contradicts());
        self.difference_sum += comparison.difference_ratio();
        self.square_sum += apart * apart;
    }

    /// Returns the report for a driven path of `distance_m`; `None` if no tick had a traction limit
    /// from the map.
    pub(super) fn report(&self, distance_m: f64) -> Option<PriorGain> {
        let traction_limit_mu = self.traction_limit_mu?;
        let mean = |sum: f64| (self.compared > 0).then(|| sum / f64::from(self.compared));
        Some(PriorGain {
            traction_limit_mu,
            known_ratio: if distance_m > 0.0 {
                (self.known_m / distance_m).min(1.0)
            } else {
                0.0
            },
            known_s: self.known_s,
            known_alone_s: self.known_alone_s,
            first_known_alone_s: self.first_known_alone_s,
            cells_compared: self.compared,
            cells_contradicted: self.contradicted,
            difference_ratio: mean(self.difference_sum),
            difference_rms: mean(self.square_sum).map(f64::sqrt),
        })
    }
}
