//! Curvature of the tyres' friction curve: its regressors in rows that are linear in θκ.
//!
//! Stiffness decreases with the combined slip s as `1 − x + x²/3`, `x = κs` (brush model).
//! Regressors are exact in s at two values of κ, and of second order in κ between them. The effect
//! of unequal contacts is in [`super::contacts`].

use super::types::Curvature;
use crate::robot::RobotModel;

/// Lower bound of slip in denominators.
pub(super) const SLIP_MIN: f64 = 1.0e-4;

/// Force of contacts at their combined slip.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct ForceAtSlip {
    /// Friction coefficient times rim speed, metres per second.
    pub(super) force_m_s: f64,
    /// Combined slip λ.
    pub(super) slip: f64,
}

impl ForceAtSlip {
    /// Returns the regressor of θκ at a curvature κ.
    ///
    /// For the same force, curved tyres slip more than linear ones by the factor
    /// `1/(1 − x + x²/3)`, `x = κλ`. The result is the series of this factor minus 1, to the order
    /// x⁴, times the force and over κ.
    pub(super) fn curvature_regressor(self, curvature: f64) -> f64 {
        let Self { force_m_s, slip } = self;
        let bend = curvature * slip;
        force_m_s * slip * (1.0 + bend * (2.0 / 3.0 + bend * (1.0 / 3.0 + bend / 9.0)))
    }

    /// Returns the derivative of [`Self::curvature_regressor`] with respect to slip.
    pub(super) fn curvature_regressor_slope(self, curvature: f64) -> f64 {
        let Self { force_m_s, slip } = self;
        let bend = curvature * slip;
        force_m_s * (1.0 + bend * (4.0 / 3.0 + bend * (1.0 + bend * (4.0 / 9.0))))
    }
}

/// The two values of κ at which a regressor of θκ is evaluated, because it depends on κ itself.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Curvatures {
    low: f64,
    high: f64,
}

impl Curvatures {
    /// Returns the values one standard deviation below and above the mean, at least 0.
    pub(super) fn of(known: Curvature) -> Self {
        Self {
            low: (known.mean - known.std_dev).max(0.0),
            high: known.mean + known.std_dev,
        }
    }

    /// Returns both values of κ.
    pub(super) fn nodes(self) -> [f64; 2] {
        [self.low, self.high]
    }

    /// Returns the regressors of θκ and θκ² whose sum equals the given regressor of θκ at both
    /// values of κ.
    pub(super) fn split(self, [at_low, at_high]: [f64; 2]) -> [f64; 2] {
        let width = self.high - self.low;
        if width <= 0.0 {
            return [at_low, 0.0];
        }
        let slope = (at_high - at_low) / width;
        [at_low - slope * self.low, slope]
    }
}

/// Curvature of a tyre at its combined slip.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct CurvatureAtSlip {
    /// κ, per slip.
    pub(super) curvature: f64,
    /// Combined slip.
    pub(super) slip: f64,
}

/// Returns the relative difference of the sides' stiffness by their unequal slip, over κ times the
/// difference of their slip. It is exact if κ is that of the tyres.
pub(super) fn stiffness_difference(at: CurvatureAtSlip) -> f64 {
    let bend = at.curvature * at.slip;
    (1.0 - 2.0 / 3.0 * bend) / (1.0 - bend + bend * bend / 3.0)
}

/// Rim speeds and turn rate of a robot.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Turn {
    pub(super) rim_m_s: f64,
    pub(super) rim_difference_m_s: f64,
    pub(super) yaw_rate_rad_s: f64,
    /// Estimated `δ_d`, right minus left relative error of the nominal radii; negated in reverse.
    pub(super) radius_difference: f64,
}

/// Slips of the two sides in a turn.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct SlipBySide {
    /// Combined slip of the left wheels.
    pub(super) left: f64,
    /// Combined slip of the right wheels.
    pub(super) right: f64,
    /// Mean combined slip.
    pub(super) mean: f64,
    /// Left minus right combined slip.
    pub(super) unequal: f64,
    /// Right minus left longitudinal slip.
    pub(super) slip_difference: f64,
    /// Derivatives of left and right combined slip with respect to `slip_difference`.
    pub(super) by_slip_difference: [f64; 2],
    /// Derivatives of left and right combined slip with respect to the turn rate, seconds.
    pub(super) by_turn_s: [f64; 2],
}

impl SlipBySide {
    /// Computes the slips at a mean rim speed above zero, for a robot that drives forward. `common`
    /// is the mean longitudinal slip of both sides.
    pub(super) fn of(turn: &Turn, common: f64, model: &RobotModel) -> Self {
        let Turn {
            rim_m_s,
            rim_difference_m_s,
            yaw_rate_rad_s,
            radius_difference,
        } = *turn;
        let slip_difference = (rim_difference_m_s - model.track_width_m() * yaw_rate_rad_s)
            / rim_m_s
            - radius_difference;
        let combined = |forward: f64, side_m_s: f64| {
            let arm_s = 0.5 * model.wheelbase_m() / side_m_s;
            let lateral = arm_s * yaw_rate_rad_s;
            let slip = forward.hypot(lateral);
            let inverse = slip.max(SLIP_MIN).recip();
            (slip, 0.5 * forward * inverse, arm_s * lateral * inverse)
        };
        let (left, left_by_difference, left_by_turn_s) = combined(
            common - 0.5 * slip_difference,
            rim_m_s - 0.5 * rim_difference_m_s,
        );
        let (right, right_by_difference, right_by_turn_s) = combined(
            common + 0.5 * slip_difference,
            rim_m_s + 0.5 * rim_difference_m_s,
        );
        Self {
            by_slip_difference: [-left_by_difference, right_by_difference],
            by_turn_s: [left_by_turn_s, right_by_turn_s],
            left,
            right,
            mean: 0.5 * (left + right),
            unequal: left - right,
            slip_difference,
        }
    }
}
