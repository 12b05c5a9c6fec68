//! What the robot may do at each place of a path.

use super::{PlanError, SlowedBy};
use crate::excitation::{Excitation, ExcitationSpec, Room};
use crate::path::PathSample;
use crate::profile::NodeLimits;
use crate::robot::RobotModel;

/// Share of the wheels' speed and acceleration that a plan may ask for; the rest is for feedback,
/// which keeps to the limits too. [`Shares`] are those of the twist.
pub(super) const WHEEL_SHARE: f64 = 0.85;
/// Least share of the yaw acceleration that a speed that changes in a bend gets.
const YAW_LEFT_MIN: f64 = 0.2;

/// Shares of the limits of the twist that a plan may ask for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Shares {
    linear_speed: f64,
    angular_speed: f64,
    linear_acceleration: f64,
    /// None where the timing does not look at it.
    angular_acceleration: Option<f64>,
}

impl Shares {
    /// On the trajectory. Of the speed less is left than what a robot is said to be slowed by.
    const TRAJECTORY: Self = Self {
        linear_speed: 0.98,
        angular_speed: 0.95,
        linear_acceleration: 0.95,
        angular_acceleration: Some(0.9),
    };
    /// On the way to it time counts, and a robot that lags, or cuts a bend, does no harm.
    const APPROACH: Self = Self {
        linear_speed: 1.0,
        angular_speed: 1.0,
        linear_acceleration: 1.0,
        angular_acceleration: None,
    };

    /// Those of the approach to the trajectory, or of the trajectory itself.
    pub(super) fn on(is_approach: bool) -> &'static Self {
        if is_approach {
            &Self::APPROACH
        } else {
            &Self::TRAJECTORY
        }
    }
}

/// The excitation that the limits leave room for, and limits without that room.
pub(super) fn with_excitation(
    spec: ExcitationSpec,
    nodes: &mut [NodeLimits],
    jerk_m_s3: &mut f64,
) -> Result<Excitation, PlanError> {
    let room = nodes.iter().fold(
        Room {
            speed_m_s: 0.0,
            acceleration_m_s2: f64::INFINITY,
            jerk_m_s3: *jerk_m_s3,
        },
        |room, node| Room {
            speed_m_s: room.speed_m_s.max(node.speed_m_s),
            acceleration_m_s2: room.acceleration_m_s2.min(node.acceleration_m_s2),
            ..room
        },
    );
    let excitation = Excitation::within(spec, room)?;
    for node in nodes {
        node.acceleration_m_s2 -= excitation.acceleration_m_s2(room.speed_m_s);
    }
    *jerk_m_s3 *= Excitation::jerk_left_ratio();
    Ok(excitation)
}

/// What bounds the accelerations: the robot's own limits, or what the ground gives.
#[derive(Debug, Clone, Copy)]
pub(super) struct Blame {
    pub(super) longitudinal: SlowedBy,
    pub(super) lateral: SlowedBy,
}

impl Blame {
    /// Of a model whose limits have been brought within the traction limit already.
    pub(super) fn of(model: &RobotModel, traction_limit_mu: Option<f64>) -> Self {
        let limits = model.limits();
        let gives = |at_m_s2: fn(f64) -> f64, limit_m_s2: f64| {
            traction_limit_mu.is_some_and(|mu| at_m_s2(mu) <= limit_m_s2)
        };
        Self {
            longitudinal: if gives(
                RobotModel::longitudinal_traction_m_s2,
                limits.linear_acceleration_max_m_s2,
            ) {
                SlowedBy::Traction
            } else {
                SlowedBy::LinearAcceleration
            },
            lateral: if gives(
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

/// What the robot may do at a node, and the limit that makes it slower than it was asked to be.
#[derive(Debug, Clone, Copy)]
pub(super) struct NodeBounds {
    pub(super) limits: NodeLimits,
    pub(super) by: Option<SlowedBy>,
    /// What bounds the acceleration along the path.
    pub(super) longitudinal: SlowedBy,
}

impl NodeBounds {
    /// The stricter of both in every respect.
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

/// What the robot may do where the path bends like this. `blame` names what bounds its
/// accelerations.
pub(super) fn node_limits(
    path: &PathSample,
    asked_m_s: f64,
    model: &RobotModel,
    blame: Blame,
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
    // The outer wheels: v (1 + bW/2), and a (1 + bW/2) + v² b' W/2, half of the limit for each.
    let outer = 1.0 + bend * half_track_m;
    let floor = f64::MIN_POSITIVE;
    let bounds_m_s = [
        (
            blame.lateral,
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
    let mut speed_m_s = asked_m_s.min(shares.linear_speed * limits.linear_max_m_s);
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
        longitudinal: blame.longitudinal,
    }
}
