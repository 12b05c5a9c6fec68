//! Converts between the types of the wire (`tread-api`) and of the controller (`tread-control`).
//!
//! The two crates are independent and have their own points and poses; only this module converts
//! them.

use tread_api::{geometry as wire, robot, safety, trajectory};
use tread_control::excitation::ExcitationSpec;
use tread_control::fence::{Fence, FenceSpec};
use tread_control::geometry as control;
use tread_control::plan::PlanOptions;
use tread_control::robot::{Limits, RobotModel, RobotModelError, RobotModelSpec};
use tread_control::trajectory as planned;

/// Converts a pose to the wire's, its heading within −π to π.
pub(crate) fn wire_pose(pose: control::Pose) -> wire::Pose {
    wire::Pose {
        x_m: pose.x_m,
        y_m: pose.y_m,
        heading_rad: control::wrap_angle_rad(pose.heading_rad),
    }
}

/// Converts a pose of the wire to the controller's.
pub(crate) fn control_pose(pose: wire::Pose) -> control::Pose {
    control::Pose {
        x_m: pose.x_m,
        y_m: pose.y_m,
        heading_rad: pose.heading_rad,
    }
}

/// Converts a twist to the wire's.
pub(crate) fn wire_twist(twist: control::Twist) -> wire::Twist {
    wire::Twist {
        linear_m_s: twist.linear_m_s,
        angular_rad_s: twist.angular_rad_s,
    }
}

/// Converts a point to the controller's.
pub(crate) fn control_point(point: wire::Point) -> control::Point {
    control::Point {
        x_m: point.x_m,
        y_m: point.y_m,
    }
}

/// Converts a geofence to the controller's.
pub fn fence_of(geofence: &safety::Geofence) -> Fence {
    let rings = |polygons: &[wire::Polygon]| {
        let corners = |polygon: &wire::Polygon| {
            let corners = polygon.corners().iter();
            corners.map(|corner| control_point(*corner)).collect()
        };
        polygons.iter().map(corners).collect()
    };
    Fence::new(&FenceSpec {
        keep_in: rings(&geofence.keep_in),
        keep_out: rings(&geofence.keep_out),
    })
}

/// Returns the position of a pose as a point of the wire.
pub(crate) fn wire_point(pose: control::Pose) -> wire::Point {
    wire::Point {
        x_m: pose.x_m,
        y_m: pose.y_m,
    }
}

/// Checks a robot's declared model and converts it to the controller's.
///
/// # Errors
/// [`RobotModelError`] names the parameter that is out of its range.
pub fn control_model(model: &robot::RobotModel) -> Result<RobotModel, RobotModelError> {
    let limits = model.limits;
    RobotModel::try_from(RobotModelSpec {
        mass_kg: model.mass_kg,
        track_width_m: model.track_width_m,
        wheelbase_m: model.wheelbase_m,
        wheel_radius_m: model.wheel_radius_m,
        yaw_inertia_kg_m2: model.yaw_inertia_kg_m2,
        limits: Limits {
            wheel_speed_max_rad_s: limits.wheel_speed_max_rad_s,
            wheel_acceleration_max_rad_s2: limits.wheel_acceleration_max_rad_s2,
            linear_max_m_s: limits.linear_max_m_s,
            angular_max_rad_s: limits.angular_max_rad_s,
            linear_acceleration_max_m_s2: limits.linear_acceleration_max_m_s2,
            linear_jerk_max_m_s3: limits.linear_jerk_max_m_s3,
            lateral_acceleration_max_m_s2: limits.lateral_acceleration_max_m_s2,
        },
    })
}

/// Returns the declared model of the paper's robot.
pub fn paper_robot() -> robot::RobotModel {
    let model = RobotModel::yi2007();
    let limits = model.limits();
    robot::RobotModel {
        name: "yi2007".to_owned(),
        tyres: "standard".to_owned(),
        mass_kg: model.mass_kg(),
        track_width_m: model.track_width_m(),
        wheelbase_m: model.wheelbase_m(),
        wheel_radius_m: model.wheel_radius_m(),
        yaw_inertia_kg_m2: model.yaw_inertia_kg_m2(),
        limits: robot::RobotLimits {
            linear_max_m_s: limits.linear_max_m_s,
            angular_max_rad_s: limits.angular_max_rad_s,
            linear_acceleration_max_m_s2: limits.linear_acceleration_max_m_s2,
            lateral_acceleration_max_m_s2: limits.lateral_acceleration_max_m_s2,
            linear_jerk_max_m_s3: limits.linear_jerk_max_m_s3,
            wheel_speed_max_rad_s: limits.wheel_speed_max_rad_s,
            wheel_acceleration_max_rad_s2: limits.wheel_acceleration_max_rad_s2,
        },
    }
}

/// Converts a requested trajectory to the controller's.
pub fn control_trajectory(requested: &trajectory::Trajectory) -> planned::Trajectory {
    match requested {
        trajectory::Trajectory::Circle(circle) => {
            planned::Trajectory::Circle(planned::CircleSpec {
                center: control_point(circle.center),
                radius_m: circle.radius_m,
                speed_m_s: circle.speed_m_s(),
                direction: match circle.direction {
                    trajectory::Direction::CounterClockwise => planned::Direction::CounterClockwise,
                    trajectory::Direction::Clockwise => planned::Direction::Clockwise,
                },
                turns: circle.turns,
            })
        }
        trajectory::Trajectory::Waypoints(waypoints) => {
            let point = |point: &trajectory::Waypoint| planned::Waypoint {
                point: control_point(point.position()),
                speed_m_s: point.speed_m_s,
                heading_rad: point.heading_rad,
            };
            planned::Trajectory::Waypoints(planned::WaypointsSpec {
                points: waypoints.points.iter().map(point).collect(),
                speed_m_s: waypoints.speed_m_s,
            })
        }
    }
}

/// Converts the options of a requested trajectory to the controller's.
pub fn plan_options(requested: &trajectory::Trajectory) -> PlanOptions<'static> {
    let options = requested.options();
    PlanOptions {
        approach_speed_m_s: options.approach_speed_m_s,
        excitation: options.excitation.map(|excitation| ExcitationSpec {
            depth_ratio: excitation.depth_ratio,
            period_s: excitation.period_s,
        }),
        traction_limit_mu: None,
        traction_limits: None,
    }
}

#[cfg(test)]
mod tests {
    use tread_api::friction;
    use tread_control::{estimation, path, plan};

    use super::*;

    #[test]
    #[expect(clippy::float_cmp, reason = "the bounds are the same figures")]
    fn planner_and_estimator_have_the_figures_that_the_api_has() {
        assert_eq!(trajectory::WAYPOINTS_MAX, plan::WAYPOINTS_MAX);
        assert_eq!(
            trajectory::WAYPOINT_SPACING_MIN_M,
            plan::WAYPOINT_SPACING_MIN_M
        );
        assert_eq!(trajectory::RADIUS_MIN_M, path::RADIUS_MIN_M);
        assert_eq!(wire::COORDINATE_MAX_M, plan::COORDINATE_MAX_M);
        assert_eq!(friction::NORMAL_95, estimation::NORMAL_95);
    }
}
