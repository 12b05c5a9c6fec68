//! Feed-forward of the reference's turn beyond the kinematics: sideslip, and rim speeds.

use crate::friction::FrictionCurve;
use crate::geometry::Twist;
use crate::measured::WheelSpeeds;
use crate::reference::ReferenceSample;
use crate::robot::{GRAVITY_M_S2, RobotModel};

use super::turn::{SIDESLIP_MAX, SteadyTurn, Turn, TurnSpec};

/// Time over which the sideslip's rate is computed, seconds.
const RATE_SPAN_S: f64 = 0.02;
/// Lower bound of the speed by which the turn rate is divided for the curvature, metres per second.
const SPEED_MIN_M_S: f64 = 1.0e-3;
/// Minimum θ in computing a turn, because its sideslip is divided by θ.
const THETA_MIN: f64 = 0.02;

/// Adapted parameters of the ground.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct AdaptedGround {
    /// Adapted θ̂.
    pub(super) theta: f64,
    /// Adapted χ̂: fraction of the loss beyond the peak, 0 to 1.
    pub(super) beyond: f64,
}

/// Sideslip of a reference with its derivatives with respect to time, θ and χ.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Sideslip {
    /// Course minus heading β, radians, counter-clockwise positive.
    pub(super) angle_rad: f64,
    /// Rate of β, radians per second.
    pub(super) rate_rad_s: f64,
    /// Drift to the right per θ, φ, metres per second.
    pub(super) drift_per_theta_m_s: f64,
    /// Drift to the right per χ, `φ_χ`, metres per second.
    pub(super) drift_per_beyond_m_s: f64,
    /// Whether the sideslip is at its bound, so that a larger θ̂ or χ̂ has no effect.
    pub(super) is_at_bound: bool,
    /// Twist of the rims minus twist of the reference.
    pub(super) rims: Twist,
}

impl Sideslip {
    /// Computes the feed-forward of the reference's turn with the adapted θ̂ and χ̂. Only the shape
    /// of `friction_curve` is used, not its stiffness.
    pub(super) fn of(
        reference: &ReferenceSample,
        adapted_ground: AdaptedGround,
        friction_curve: &FrictionCurve,
        model: &RobotModel,
    ) -> Self {
        let speed_m_s = reference.speed_m_s;
        let at = |twist: Twist| MomentarySideslip::of(twist, adapted_ground, friction_curve, model);
        let now = at(Twist {
            linear_m_s: speed_m_s,
            angular_rad_s: reference.turn_rad_s,
        });
        let then = at(Twist {
            linear_m_s: (speed_m_s + RATE_SPAN_S * reference.acceleration_m_s2).max(0.0),
            angular_rad_s: reference.turn_rad_s + RATE_SPAN_S * reference.turn_acceleration_rad_s2,
        });
        let angle_rad = -adapted_ground.theta * now.per_theta;
        Self {
            angle_rad,
            rate_rad_s: (-adapted_ground.theta * then.per_theta - angle_rad) / RATE_SPAN_S,
            drift_per_theta_m_s: speed_m_s * now.per_theta,
            drift_per_beyond_m_s: speed_m_s * adapted_ground.theta * now.per_theta_beyond,
            is_at_bound: now.is_at_bound,
            rims: now.rims,
        }
    }
}

/// Sideslip and rim speeds of a steady turn at one speed and turn rate.
struct MomentarySideslip {
    /// Sideslip to the right per θ, radians.
    per_theta: f64,
    /// Additional sideslip per θ at χ = 1, radians.
    per_theta_beyond: f64,
    is_at_bound: bool,
    rims: Twist,
}

impl MomentarySideslip {
    fn of(
        twist: Twist,
        adapted_ground: AdaptedGround,
        friction_curve: &FrictionCurve,
        model: &RobotModel,
    ) -> Self {
        let speed_m_s = twist.linear_m_s;
        let curvature_1_m = twist.angular_rad_s / speed_m_s.max(SPEED_MIN_M_S);
        let theta = adapted_ground.theta.max(THETA_MIN);
        let compliance_m = theta * speed_m_s * speed_m_s / GRAVITY_M_S2;
        let turn = Turn::steady(
            model,
            friction_curve,
            TurnSpec {
                curvature_1_m,
                compliance_m,
            },
        );
        let per_theta = |turn: SteadyTurn| -turn.sideslip / theta;
        let (linear, beyond) = (per_theta(turn.linear), per_theta(turn.beyond));
        let of_rims = |turn: SteadyTurn| {
            let [left_rad_s, right_rad_s] = turn
                .rims
                .map(|rim| rim * speed_m_s / model.wheel_radius_m());
            model.twist_from_wheel_speeds(WheelSpeeds {
                left_rad_s,
                right_rad_s,
            })
        };
        let (straight, slid) = (of_rims(turn.linear), of_rims(turn.beyond));
        let interpolated = |one: f64, other: f64| one + adapted_ground.beyond * (other - one);
        Self {
            per_theta: interpolated(linear, beyond),
            per_theta_beyond: beyond - linear,
            is_at_bound: turn.linear.sideslip.abs() >= SIDESLIP_MAX
                || adapted_ground.beyond > 0.0 && turn.beyond.sideslip.abs() >= SIDESLIP_MAX,
            rims: Twist {
                linear_m_s: interpolated(straight.linear_m_s, slid.linear_m_s) - speed_m_s,
                angular_rad_s: interpolated(straight.angular_rad_s, slid.angular_rad_s)
                    - speed_m_s * turn.curvature_1_m,
            },
        }
    }
}
