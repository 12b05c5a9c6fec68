//! The robot's own parameters in physical units, with standard deviations.

use super::parameters::{Values, index};
use super::{BLOCKS_MIN, Identification, SQUARE_MAX};
use crate::estimation::{IdentifiedRobot, IdentifiedValue};

/// Standard deviations of the errors that remain because real contacts do not follow the model's
/// equations: of masses relative to the configured mass, of yaw inertia per mass relative to the
/// configured one, and of the centre of mass relative to wheelbase and track width.
const MODEL_MASS_RATIO: f64 = 0.03;
const MODEL_INERTIA_RATIO: f64 = 0.025;
const MODEL_CENTRE_RATIO: f64 = 0.006;
/// Fraction of the initial prior variance above which an estimate counts as prior-dominated.
const PRIOR_SHARE_MAX: f64 = 0.5;

impl Identification {
    /// Returns the robot's own parameters from the hypothesis with the lowest cost; variances are
    /// propagated to first order. None before [`BLOCKS_MIN`] blocks, or if residuals are too large
    /// for the model.
    pub(super) fn identify_robot(&self) -> Option<IdentifiedRobot> {
        let best = self.best()?;
        if best.age() < BLOCKS_MIN || best.worst_square() > SQUARE_MAX || !best.is_determined() {
            return None;
        }
        let values = best.values();
        let (mass, rotors) = (values[index::MASS].exp(), values[index::ROTORS]);
        let (scale, inertia) = (
            1.0 + values[index::TORQUE_SCALE],
            values[index::INERTIA].exp(),
        );
        let (base_m, track_m) = (self.model.wheelbase_m(), self.model.track_width_m());
        let slopes = |parts: &[(usize, f64)]| {
            let mut slopes = Values::zeros();
            for &(place, slope) in parts {
                slopes[place] = slope;
            }
            slopes
        };
        let apparent = scale * (mass + rotors);
        let slopes = [
            slopes(&[
                (index::TORQUE_SCALE, mass + rotors),
                (index::MASS, scale * mass),
                (index::ROTORS, scale),
            ]),
            slopes(&[(index::MASS, mass * self.model.mass_kg())]),
            slopes(&[(index::INERTIA, inertia)]),
            slopes(&[(index::CENTRE_FORWARD, base_m)]),
            slopes(&[(index::CENTRE_LEFT, track_m)]),
        ];
        // Errors of the model's equations.
        let mass_kg = self.model.mass_kg();
        let model = [
            MODEL_MASS_RATIO,
            MODEL_MASS_RATIO * mass_kg,
            MODEL_INERTIA_RATIO,
            MODEL_CENTRE_RATIO * base_m,
            MODEL_CENTRE_RATIO * track_m,
        ];
        let variances = best.variances_of(&self.prior, &slopes)?;
        let means = [
            apparent,
            mass * self.model.mass_kg(),
            inertia,
            values[index::CENTRE_FORWARD] * base_m,
            values[index::CENTRE_LEFT] * track_m,
        ];
        let value = |place: usize| {
            let first = slopes[place].component_mul(&self.prior.std_devs);
            IdentifiedValue {
                value: means[place],
                std_dev: variances[place].sqrt().hypot(model[place]),
                is_prior_dominated: variances[place] > PRIOR_SHARE_MAX * first.norm_squared(),
            }
        };
        let is_known = variances
            .iter()
            .chain(&means)
            .all(|value| value.is_finite());
        is_known.then(|| IdentifiedRobot {
            apparent_mass_ratio: value(0),
            mass_kg: value(1),
            inertia_ratio: value(2),
            centre_forward_m: value(3),
            centre_left_m: value(4),
        })
    }
}
