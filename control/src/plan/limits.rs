//! What the robot may do at each place of a path.

use super::PlanError;
use crate::excitation::{Excitation, ExcitationSpec, Room};
use crate::path::PathSample;
use crate::profile::NodeLimits;
use crate::robot::RobotModel;

/// Share of the wheels' speed and acceleration that a plan may ask for; the rest is for feedback.
pub(super) const WHEEL_SHARE: f64 = 0.85;

/// The wiggle that the limits leave room for, and limits without that room.
pub(super) fn wiggled(
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

/// What the robot may do where the path bends like this.
pub(super) fn node_limits(path: &PathSample, asked_m_s: f64, model: &RobotModel) -> NodeLimits {
    let limits = model.limits();
    let bend = path.curvature_1_m.abs();
    let slope = path.curvature_slope_1_m2.abs();
    let radius_m = model.wheel_radius_m();
    let half_track_m = 0.5 * model.effective_track_m();
    let rim_max_m_s = WHEEL_SHARE * limits.wheel_speed_max_rad_s * radius_m;
    let rim_max_m_s2 = WHEEL_SHARE * limits.wheel_acceleration_max_rad_s2 * radius_m;
    // The outer wheels: v (1 + bW/2), and a (1 + bW/2) + v² b' W/2, half of the limit for each.
    let outer = 1.0 + bend * half_track_m;
    let floor = f64::MIN_POSITIVE;
    NodeLimits {
        speed_m_s: asked_m_s
            .min((limits.lateral_acceleration_max_m_s2 / bend.max(floor)).sqrt())
            .min(limits.angular_max_rad_s / bend.max(floor))
            .min(rim_max_m_s / outer)
            .min((0.5 * rim_max_m_s2 / (slope * half_track_m).max(floor)).sqrt()),
        acceleration_m_s2: limits
            .linear_acceleration_max_m_s2
            .min(0.5 * rim_max_m_s2 / outer),
    }
}
