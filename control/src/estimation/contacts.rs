//! Forces and moments of four contacts with curved tyres.
//!
//! Contact i has the fraction `w_i = 1 − κℓ_i` of its initial stiffness, with `ℓ = s − κs²/3` at
//! its combined slip s. A force or moment F, to which each contact contributes its slip times a
//! lever, `m_i`, then satisfies `Σ w_i m_i = θF`. With the means `ℓ̄` and `w̄` over the contacts
//! this is exactly
//!
//! ```text
//! Σ m_i = (θF + κ Σ (ℓ_i − ℓ̄) m_i) / w̄
//! ```
//! Slip that varies within the time of a row is represented by its deviations in several intervals
//! ([`IntervalDeviation`]).

use super::curved::{Curvatures, Turn};
use super::rows::CurvatureRegressors;
use super::types::Curvature;
use super::window::IntervalDeviation;
use crate::robot::{GRAVITY_M_S2, RobotModel};

/// Number of iterations for the slip that the forces cause.
const ROUNDS: usize = 3;
/// Lower bound of `w̄`.
const STIFFNESS_LEFT_MIN: f64 = 0.2;

/// Loss of the contacts' stiffness by the tyres' curvature, over κ; symbols as in the module.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct StiffnessLoss {
    /// `ℓ̄`.
    pub(super) mean: f64,
    /// `w̄`.
    pub(super) left: f64,
    /// Mean of `(ℓ_i − ℓ̄)` times the longitudinal slip.
    pub(super) forward: f64,
    /// Mean of `(ℓ_i − ℓ̄)` times the lateral slip, to the left.
    pub(super) lateral: f64,
    /// Mean of `(ℓ_i − ℓ̄)` times the moment of the slip, metres.
    pub(super) moment_m: f64,
}

/// Mean slip of linear tyres: θ times force over load.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct MeanSlip {
    pub(super) forward: f64,
    pub(super) lateral: f64,
}

/// Slip compliance and curvature of the tyres' friction curve.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct TyreCurve {
    /// θ.
    pub(super) theta: f64,
    /// κ, per slip.
    pub(super) curvature: f64,
}

impl StiffnessLoss {
    /// Computes the loss at a mean rim speed above zero, for a robot that drives forward. `slip` is
    /// the mean slip of linear tyres of the same θ.
    pub(super) fn of(
        turn: &Turn,
        variation: &[IntervalDeviation],
        slip: MeanSlip,
        tyres: TyreCurve,
        model: &RobotModel,
    ) -> Self {
        let TyreCurve { theta, curvature } = tyres;
        let slip_difference =
            (turn.rim_difference_m_s - model.track_width_m() * turn.yaw_rate_rad_s) / turn.rim_m_s
                - turn.radius_difference;
        let sides_m_s = [
            turn.rim_m_s - 0.5 * turn.rim_difference_m_s,
            turn.rim_m_s + 0.5 * turn.rim_difference_m_s,
        ];
        let half_base_m = 0.5 * model.wheelbase_m();
        let half_track_m = 0.5 * model.track_width_m();
        let mut found = Self {
            left: 1.0,
            ..Self::default()
        };
        let mut now = slip;
        for _ in 0..ROUNDS {
            // Sums of ℓ, of ℓ times each slip, of the slips themselves.
            let (mut loss, mut forward, mut lateral, mut turning) = (0.0, 0.0, 0.0, 0.0);
            let (mut longitudinal_sum, mut lateral_sum, mut sum_moment) = (0.0, 0.0, 0.0);
            for interval in variation {
                let share = 0.25 * interval.weight;
                let gap = slip_difference + interval.slip_difference;
                let turn_rad_s = turn.yaw_rate_rad_s + interval.turn_rad_s;
                let common = now.forward + theta * interval.longitudinal_mu;
                let drift = now.lateral + theta * turn.rim_m_s * interval.turn_rad_s / GRAVITY_M_S2;
                for (side, sign) in [-1.0, 1.0].into_iter().enumerate() {
                    let longitudinal_slip = common + 0.5 * sign * gap;
                    for x_m in [half_base_m, -half_base_m] {
                        let lateral_slip = drift - x_m * turn_rad_s / sides_m_s[side];
                        let slip = longitudinal_slip.hypot(lateral_slip);
                        let loss_share = share * slip * (1.0 - curvature * slip / 3.0);
                        let lever = sign * half_track_m * longitudinal_slip + x_m * lateral_slip;
                        loss += loss_share;
                        forward += loss_share * longitudinal_slip;
                        lateral += loss_share * lateral_slip;
                        turning += loss_share * lever;
                        longitudinal_sum += share * longitudinal_slip;
                        lateral_sum += share * lateral_slip;
                        sum_moment += share * lever;
                    }
                }
            }
            let mean = loss;
            found = Self {
                mean,
                left: (1.0 - curvature * mean).max(STIFFNESS_LEFT_MIN),
                forward: forward - mean * longitudinal_sum,
                lateral: lateral - mean * lateral_sum,
                moment_m: turning - mean * sum_moment,
            };
            now = MeanSlip {
                forward: (slip.forward + curvature * found.forward) / found.left,
                lateral: (slip.lateral + curvature * found.lateral) / found.left,
            };
        }
        found
    }
}

/// Ratio of the second θ, at which the effect of curvature is evaluated for its derivative, to the
/// estimated one.
const THETA_STEP: f64 = 1.5;

/// Input for the regressors of curvature in a row with the force `force_m_s`. `uneven_m_s` computes
/// the effect of unequal contacts from their [`StiffnessLoss`], before division by `w̄`. `theta`
/// must be above zero.
pub(super) struct CurvatureInput<'of, F: Fn(&StiffnessLoss) -> f64> {
    pub(super) turn: &'of Turn,
    pub(super) variation: &'of [IntervalDeviation],
    /// Mean forces over load.
    pub(super) mu: MeanSlip,
    pub(super) theta: f64,
    pub(super) force_m_s: f64,
    pub(super) uneven_m_s: F,
}

impl<F: Fn(&StiffnessLoss) -> f64> CurvatureInput<'_, F> {
    /// Returns the curvature regressors of the row, and the ratios of the regressors of θκ, θκ² and
    /// θ²κ to the force.
    pub(super) fn regressors(
        &self,
        model: &RobotModel,
        prior: Curvature,
    ) -> (CurvatureRegressors, [f64; 3]) {
        if prior.mean <= 0.0 && prior.std_dev <= 0.0 {
            return (CurvatureRegressors::default(), [0.0; 3]);
        }
        let at = |tyres: TyreCurve| {
            let slip = MeanSlip {
                forward: tyres.theta * self.mu.forward,
                lateral: tyres.theta * self.mu.lateral,
            };
            let loss = StiffnessLoss::of(self.turn, self.variation, slip, tyres, model);
            [loss.mean / loss.left, (self.uneven_m_s)(&loss) / loss.left]
        };
        let theta = self.theta;
        let curvatures = Curvatures::of(prior);
        let known = curvatures
            .nodes()
            .map(|curvature| at(TyreCurve { theta, curvature }));
        let [share, square_share] = curvatures.split(known.map(|[share, _]| share));
        let by_curvature = curvatures
            .split(known.map(|[share, uneven_m_s]| self.force_m_s * share + uneven_m_s / theta));
        // Linear in θ between the two values, at the mean κ.
        let at_mean = |theta: f64| {
            let curvature = prior.mean;
            at(TyreCurve { theta, curvature })
        };
        let (lower, upper) = (at_mean(theta), at_mean(THETA_STEP * theta));
        let slope = [0, 1].map(|part| (upper[part] - lower[part]) / ((THETA_STEP - 1.0) * theta));
        let alone_m_s = lower[1] - slope[1] * theta;
        let of_theta_m_s = slope[0] * self.force_m_s;
        let found = CurvatureRegressors {
            curvature: [
                by_curvature[0] - alone_m_s / theta - of_theta_m_s * theta,
                by_curvature[1],
            ],
            theta: [alone_m_s, of_theta_m_s],
        };
        (found, [share - slope[0] * theta, square_share, slope[0]])
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Returns the remaining fraction of the stiffness of a brush model.
    fn left(slip: f64, curvature: f64) -> f64 {
        let bend = curvature * slip;
        1.0 - bend + bend * bend / 3.0
    }

    proptest! {
        #[test]
        fn what_contacts_lose_is_that_of_four_brushes(
            curvature in 0.3..3.0_f64, forward in -0.04..0.04_f64,
            slip_difference in -0.06..0.06_f64,
            turn_rad_s in -0.3..0.3_f64, lateral in -0.01..0.01_f64,
        ) {
            let model = RobotModel::yi2007();
            let rim_m_s = 0.6;
            let turn = Turn {
                rim_m_s,
                rim_difference_m_s: slip_difference * rim_m_s + model.track_width_m() * turn_rad_s,
                yaw_rate_rad_s: turn_rad_s,
                radius_difference: 0.0,
            };
            let still = [IntervalDeviation { weight: 1.0, ..IntervalDeviation::default() }];
            // Forces that these slips cause.
            let (mut longitudinal_force, mut lateral_force, mut moment_m) = (0.0, 0.0, 0.0);
            let mut straight_moment_m = 0.0;
            for sign in [-1.0, 1.0] {
                for end in [-0.5, 0.5] {
                    let x_m = end * model.wheelbase_m();
                    let side_m_s = rim_m_s + 0.5 * sign * turn.rim_difference_m_s;
                    let longitudinal_slip = forward + 0.5 * sign * slip_difference;
                    let lateral_slip = lateral - x_m * turn_rad_s / side_m_s;
                    let half_track_m = 0.5 * model.track_width_m();
                    let lever_m = sign * half_track_m * longitudinal_slip + x_m * lateral_slip;
                    let stiffness = left(longitudinal_slip.hypot(lateral_slip), curvature);
                    longitudinal_force += 0.25 * stiffness * longitudinal_slip;
                    lateral_force += 0.25 * stiffness * lateral_slip;
                    moment_m += 0.25 * stiffness * lever_m;
                    straight_moment_m += 0.25 * lever_m;
                }
            }
            let forces = MeanSlip { forward: longitudinal_force, lateral: lateral_force };
            let tyres = TyreCurve { theta: 0.2, curvature };
            let loss = StiffnessLoss::of(&turn, &still, forces, tyres, &model);
            let found_m = (moment_m + curvature * loss.moment_m) / loss.left;
            prop_assert!((found_m - straight_moment_m).abs() < 2.0e-5);
            let found_longitudinal = (longitudinal_force + curvature * loss.forward) / loss.left;
            prop_assert!((found_longitudinal - forward).abs() < 2.0e-4);
        }
    }
}
