//! Speed and acceleration limits at each node of a path.

use super::{PlanError, SlowedBy};
use crate::excitation::{Excitation, ExcitationLimits, ExcitationSpec};
use crate::path::PathSample;
use crate::profile::NodeLimits;
use crate::robot::RobotModel;

/// Fraction of the wheels' speed and acceleration limits that a plan may use; the rest is left for
/// feedback. [`Shares`] has the fractions of the twist limits.
pub(super) const WHEEL_SHARE: f64 = 0.85;
/// Minimum fraction of the yaw acceleration that is left for a change of speed in a bend.
const YAW_LEFT_MIN: f64 = 0.2;

/// Fractions of the twist limits that a plan may use.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Shares {
    linear_speed: f64,
    angular_speed: f64,
    linear_acceleration: f64,
    /// None if the timing ignores the yaw acceleration limit.
    angular_acceleration: Option<f64>,
}

impl Shares {
    /// Fractions on the trajectory. The 2 % of speed that they leave unused is not reported as
    /// slowing.
    const TRAJECTORY: Self = Self {
        linear_speed: 0.98,
        angular_speed: 0.95,
        linear_acceleration: 0.95,
        angular_acceleration: Some(0.9),
    };
    /// Fractions on the approach: time counts, and lag or cutting a bend does no harm.
    const APPROACH: Self = Self {
        linear_speed: 1.0,
        angular_speed: 1.0,
        linear_acceleration: 1.0,
        angular_acceleration: None,
    };

    /// Returns the fractions for the approach, or for the trajectory itself.
    pub(super) fn on(is_approach: bool) -> &'static Self {
        if is_approach {
            &Self::APPROACH
        } else {
            &Self::TRAJECTORY
        }
    }
}

/// Returns the excitation that the limits allow, and subtracts its share from `nodes` and
/// `jerk_m_s3`.
///
/// # Errors
/// [`PlanError::Excitation`] if depth or period is out of its range.
pub(super) fn with_excitation(
    spec: ExcitationSpec,
    nodes: &mut [NodeLimits],
    jerk_m_s3: &mut f64,
) -> Result<Excitation, PlanError> {
    let limits = nodes.iter().fold(
        ExcitationLimits {
            speed_m_s: 0.0,
            acceleration_m_s2: f64::INFINITY,
            jerk_m_s3: *jerk_m_s3,
        },
        |limits, node| ExcitationLimits {
            speed_m_s: limits.speed_m_s.max(node.speed_m_s),
            acceleration_m_s2: limits.acceleration_m_s2.min(node.acceleration_m_s2),
            ..limits
        },
    );
    let excitation = Excitation::within(spec, limits)?;
    for node in nodes {
        node.acceleration_m_s2 -= excitation.acceleration_m_s2(limits.speed_m_s);
    }
    *jerk_m_s3 *= Excitation::jerk_left_ratio();
    Ok(excitation)
}

/// Names of the limits that bound the accelerations: the robot's own, or the ground's traction.
#[derive(Debug, Clone, Copy)]
pub(super) struct BindingLimits {
    pub(super) longitudinal: SlowedBy,
    pub(super) lateral: SlowedBy,
}

impl BindingLimits {
    /// Returns which limits bind. `model` must already be limited to the traction limit.
    pub(super) fn of(model: &RobotModel, traction_limit_mu: Option<f64>) -> Self {
        let limits = model.limits();
        let binds = |at_m_s2: fn(f64) -> f64, limit_m_s2: f64| {
            traction_limit_mu.is_some_and(|mu| at_m_s2(mu) <= limit_m_s2)
        };
        Self {
            longitudinal: if binds(
                RobotModel::longitudinal_traction_m_s2,
                limits.linear_acceleration_max_m_s2,
            ) {
                SlowedBy::Traction
            } else {
                SlowedBy::LinearAcceleration
            },
            lateral: if binds(
                RobotModel::lateral_traction_m_s2,
                limits.lateral_acceleration_max_m_s2,
            ) {
                SlowedBy::Traction
            } else {
                SlowedBy::LateralAcceleration
            },
        }
    }
}

/// Limits at a node, and the limit that keeps the speed below the requested one.
#[derive(Debug, Clone, Copy)]
pub(super) struct NodeBounds {
    pub(super) limits: NodeLimits,
    /// Limit that keeps the speed below the requested one; None if there is none.
    pub(super) by: Option<SlowedBy>,
    /// Limit of the acceleration along the path.
    pub(super) longitudinal: SlowedBy,
}

impl NodeBounds {
    /// Returns the smaller speed and the smaller acceleration, each with its cause.
    pub(super) fn stricter(&self, other: &Self) -> Self {
        Self {
            limits: self.limits.stricter(&other.limits),
            by: if other.limits.speed_m_s < self.limits.speed_m_s {
                other.by
            } else {
                self.by
            },
            longitudinal: if other.limits.acceleration_m_s2 < self.limits.acceleration_m_s2 {
                other.longitudinal
            } else {
                self.longitudinal
            },
        }
    }
}

/// Returns the limits at a point of the path with its curvature. `binding` names the causes of the
/// acceleration limits.
pub(super) fn node_limits(
    path: &PathSample,
    requested_m_s: f64,
    model: &RobotModel,
    binding: BindingLimits,
    shares: &Shares,
) -> NodeBounds {
    let limits = model.limits();
    let bend = path.curvature_1_m.abs();
    let slope = path.curvature_slope_1_m2.abs();
    let radius_m = model.wheel_radius_m();
    let half_track_m = 0.5 * model.effective_track_m();
    let yaw_max_rad_s2 = shares.angular_acceleration.map_or(f64::INFINITY, |share| {
        share * model.angular_acceleration_max_rad_s2()
    });
    let rim_max_m_s = WHEEL_SHARE * limits.wheel_speed_max_rad_s * radius_m;
    let rim_max_m_s2 = WHEEL_SHARE * limits.wheel_acceleration_max_rad_s2 * radius_m;
    // Outer wheels: v (1 + bW/2), and a (1 + bW/2) + v² b' W/2, each term with half of the limit
    // (W: effective track).
    let outer = 1.0 + bend * half_track_m;
    let floor = f64::MIN_POSITIVE;
    let bounds_m_s = [
        (
            binding.lateral,
            (limits.lateral_acceleration_max_m_s2 / bend.max(floor)).sqrt(),
        ),
        (
            SlowedBy::AngularSpeed,
            shares.angular_speed * limits.angular_max_rad_s / bend.max(floor),
        ),
        (SlowedBy::WheelSpeed, rim_max_m_s / outer),
        (
            SlowedBy::WheelAcceleration,
            (0.5 * rim_max_m_s2 / (slope * half_track_m).max(floor)).sqrt(),
        ),
        (
            SlowedBy::WheelAcceleration,
            ((1.0 - YAW_LEFT_MIN) * yaw_max_rad_s2 / slope.max(floor)).sqrt(),
        ),
    ];
    let mut speed_m_s = requested_m_s.min(shares.linear_speed * limits.linear_max_m_s);
    let mut slowed_by = None;
    for (by, bound_m_s) in bounds_m_s {
        if bound_m_s < speed_m_s {
            speed_m_s = bound_m_s;
            slowed_by = Some(by);
        }
    }
    let yaw_left_rad_s2 = yaw_max_rad_s2 - speed_m_s * speed_m_s * slope;
    NodeBounds {
        limits: NodeLimits {
            speed_m_s,
            acceleration_m_s2: (shares.linear_acceleration * limits.linear_acceleration_max_m_s2)
                .min(0.5 * rim_max_m_s2 / outer)
                .min(yaw_left_rad_s2 / bend.max(floor)),
        },
        by: slowed_by,
        longitudinal: binding.longitudinal,
    }
}
