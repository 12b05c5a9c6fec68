//! Tyres that rise along a curve: what their bend adds to rows that are linear in θκ.
//!
//! Stiffness falls with the combined slip s as `1 − x + x²/3`, `x = κs` (a brush). With the mean κ
//! rows are exact in s; the spread of κ about it enters by its mean. Three things besides the bend
//! of the force itself: the side that slips more carries less, drift sideways loads the axles
//! unequally, and slip that swings within a row's time loses more stiffness than its mean does.

use super::TyrePrior;
use crate::robot::RobotModel;

/// What a swing's variance adds to the square of the slip by which a curved tyre loses stiffness:
/// for a normal swing about zero the mean of b|b| grows by `√(8/π) σ` per mean of b.
const SWING_SHARE: f64 = 8.0 / std::f64::consts::PI;
/// Slip that is divided by at least.
pub(super) const SLIP_MIN: f64 = 1.0e-4;
/// Share of a tyre's stiffness that is reckoned with at least.
const STIFFNESS_LEFT_MIN: f64 = 0.2;

/// Regressor of θκ: the force's slip grows with slip itself on a curved tyre, by
/// `1/(1 − x + x²/3) − 1` with x = κλ.
pub(super) fn bent(force_m_s: f64, slip: f64, curvature: f64) -> f64 {
    let bend = curvature * slip;
    force_m_s * slip * (1.0 + bend * (2.0 / 3.0 + bend * (1.0 / 3.0 + bend / 9.0)))
}

/// [`bent`] by slip.
pub(super) fn bent_slope(force_m_s: f64, slip: f64, curvature: f64) -> f64 {
    let bend = curvature * slip;
    force_m_s * (1.0 + bend * (4.0 / 3.0 + bend * (1.0 + bend * (4.0 / 9.0))))
}

/// What a force counts on tyres of which only mean and spread of κ are known: the bend is not even
/// in κ, so that its mean is not that of the mean κ. Rows are linear in κ and would leave it to θ.
pub(super) fn spread_out(force_m_s: f64, slip: f64, tyres: &TyrePrior) -> f64 {
    let spread = tyres.curvature_spread * slip;
    force_m_s * (1.0 + spread * spread * (2.0 / 3.0 + tyres.curvature * slip))
}

/// Share by which the sides' unequal slip makes their stiffness unequal, over κ times that slip and
/// over their mean stiffness: exact where the mean κ is the tyres' own.
pub(super) fn uneven(slip: f64, curvature: f64) -> f64 {
    let bend = curvature * slip;
    (1.0 - 2.0 / 3.0 * bend) / (1.0 - bend + bend * bend / 3.0)
}

/// By how much more a curved tyre drifts sideways in a turn, over κ: with slip s, of which ℓ is the
/// geometric one across, drift adds to the slip of one axle and takes from the other's, and
/// `1 − κs + κ²s²/3 − (κ − ⅔κ²s) ℓ²/s` of the stiffness is left.
pub(super) fn drift_bend(slip: f64, across: f64, curvature: f64) -> f64 {
    let bend = curvature * slip;
    let loss =
        slip * (1.0 - bend / 3.0) + (1.0 - 2.0 / 3.0 * bend) * across * across / slip.max(SLIP_MIN);
    loss / (1.0 - curvature * loss).max(STIFFNESS_LEFT_MIN)
}

/// Rims and body in a turn.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Turn {
    pub(super) rim_m_s: f64,
    pub(super) rim_difference_m_s: f64,
    pub(super) yaw_rate_rad_s: f64,
    /// `δ_d` as it is known; looked at mirrored in reverse.
    pub(super) radius_difference: f64,
    /// Variance of right minus left slip ahead about its mean.
    pub(super) apart_variance: f64,
}

/// Slips of the two sides in a turn.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct SideSlips {
    /// Combined slip of the left wheels.
    pub(super) left: f64,
    /// Combined slip of the right wheels.
    pub(super) right: f64,
    /// Mean combined slip.
    pub(super) mean: f64,
    /// Left minus right combined slip.
    pub(super) unequal: f64,
    /// Right minus left slip ahead.
    pub(super) apart: f64,
    /// Left and right combined slip by `apart`.
    pub(super) by_apart: [f64; 2],
    /// Left and right combined slip by the turn rate, seconds.
    pub(super) by_turn_s: [f64; 2],
}

impl SideSlips {
    /// At a mean rim speed above zero, all of a robot that drives ahead; `common` is the slip ahead
    /// that both sides have.
    pub(super) fn of(turn: &Turn, common: f64, model: &RobotModel) -> Self {
        let Turn {
            rim_m_s,
            rim_difference_m_s,
            yaw_rate_rad_s,
            radius_difference,
            apart_variance,
        } = *turn;
        let apart = (rim_difference_m_s - model.track_width_m() * yaw_rate_rad_s) / rim_m_s
            - radius_difference;
        let combined = |ahead: f64, side_m_s: f64| {
            let arm_s = 0.5 * model.wheelbase_m() / side_m_s;
            let across = arm_s * yaw_rate_rad_s;
            let slip = (ahead * ahead + across * across + 0.25 * SWING_SHARE * apart_variance)
                .max(0.0)
                .sqrt();
            let inverse = slip.max(SLIP_MIN).recip();
            (slip, 0.5 * ahead * inverse, arm_s * across * inverse)
        };
        let (left, left_by_apart, left_by_turn_s) =
            combined(common - 0.5 * apart, rim_m_s - 0.5 * rim_difference_m_s);
        let (right, right_by_apart, right_by_turn_s) =
            combined(common + 0.5 * apart, rim_m_s + 0.5 * rim_difference_m_s);
        Self {
            by_apart: [-left_by_apart, right_by_apart],
            by_turn_s: [left_by_turn_s, right_by_turn_s],
            left,
            right,
            mean: 0.5 * (left + right),
            unequal: left - right,
            apart,
        }
    }
}

/// Regressors of a force on curved tyres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Bent {
    pub(super) theta_m_s: f64,
    pub(super) curvature_m_s: f64,
}

impl Bent {
    /// Of a force that holds so much rolling resistance.
    pub(super) fn of(force_m_s: f64, rolling_m_s: f64, slip: f64, tyres: &TyrePrior) -> Self {
        let contact_m_s = force_m_s - rolling_m_s;
        Self {
            theta_m_s: spread_out(contact_m_s, slip, tyres) + rolling_m_s,
            curvature_m_s: bent(contact_m_s, slip, tyres.curvature),
        }
    }

    /// One times a share and another times a share.
    pub(super) fn sum(one: Self, share: f64, other: Self, other_share: f64) -> Self {
        Self {
            theta_m_s: share * one.theta_m_s + other_share * other.theta_m_s,
            curvature_m_s: share * one.curvature_m_s + other_share * other.curvature_m_s,
        }
    }
}
