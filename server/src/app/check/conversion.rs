//! Conversions from the API's types to the planner's.

use tread_api::geometry::{Point, Polygon};
use tread_api::robot::RobotModel;
use tread_api::safety::Geofence;
use tread_api::trajectory::{Direction, Trajectory, Waypoint};
use tread_control::excitation::ExcitationSpec;
use tread_control::fence::{Fence, FenceSpec};
use tread_control::geometry as control;
use tread_control::plan::PlanOptions;
use tread_control::robot::{self, RobotModelError, RobotModelSpec};
use tread_control::trajectory as planned;

/// Converts a geofence to the planner's type.
pub(in crate::app) fn control_fence(geofence: &Geofence) -> Fence {
    let rings = |polygons: &[Polygon]| {
        let ring = |polygon: &Polygon| {
            let corners = polygon.corners().iter();
            let corner = |corner: &Point| control::Point {
                x_m: corner.x_m,
                y_m: corner.y_m,
            };
            corners.map(corner).collect()
        };
        polygons.iter().map(ring).collect()
    };
    Fence::new(&FenceSpec {
        keep_in: rings(&geofence.keep_in),
        keep_out: rings(&geofence.keep_out),
    })
}

/// Converts a robot model to the planner's type.
pub(in crate::app) fn control_model(
    model: &RobotModel,
) -> Result<robot::RobotModel, RobotModelError> {
    let limits = model.limits;
    robot::RobotModel::try_from(RobotModelSpec {
        mass_kg: model.mass_kg,
        track_width_m: model.track_width_m,
        wheelbase_m: model.wheelbase_m,
        wheel_radius_m: model.wheel_radius_m,
        yaw_inertia_kg_m2: model.yaw_inertia_kg_m2,
        limits: robot::Limits {
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

/// Converts a trajectory to the planner's type.
pub(super) fn control_trajectory(requested: &Trajectory) -> planned::Trajectory {
    let control_point = |point: Point| control::Point {
        x_m: point.x_m,
        y_m: point.y_m,
    };
    match requested {
        Trajectory::Circle(circle) => planned::Trajectory::Circle(planned::CircleSpec {
            center: control_point(circle.center),
            radius_m: circle.radius_m,
            speed_m_s: circle.speed_m_s(),
            direction: match circle.direction {
                Direction::CounterClockwise => planned::Direction::CounterClockwise,
                Direction::Clockwise => planned::Direction::Clockwise,
            },
            turns: circle.turns,
        }),
        Trajectory::Waypoints(waypoints) => {
            let point = |point: &Waypoint| planned::Waypoint {
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

/// Converts the limits that the request gives beside the trajectory to the planner's options.
pub(super) fn plan_options(requested: &Trajectory) -> PlanOptions<'static> {
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
