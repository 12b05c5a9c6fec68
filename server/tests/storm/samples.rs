//! What is driven, and by what.

use tread_api::robot::{RobotLimits, RobotModel};
use tread_api::trajectory::{Circle, Direction, Trajectory, TrajectoryOptions};

pub(super) fn circle(radius_m: f64) -> Trajectory {
    Trajectory::Circle(Circle {
        center: tread_api::geometry::Point { x_m: 0.0, y_m: 0.0 },
        radius_m,
        speed_m_s: Some(0.5),
        period_s: None,
        direction: Direction::CounterClockwise,
        turns: 1.0,
        options: TrajectoryOptions::default(),
    })
}

pub(super) fn model() -> RobotModel {
    RobotModel {
        name: "storm".to_owned(),
        tyres: "any".to_owned(),
        mass_kg: 50.0,
        track_width_m: 0.6,
        wheelbase_m: 0.5,
        wheel_radius_m: 0.15,
        yaw_inertia_kg_m2: 3.0,
        limits: RobotLimits {
            linear_max_m_s: 2.0,
            angular_max_rad_s: 1.5,
            linear_acceleration_max_m_s2: 1.0,
            lateral_acceleration_max_m_s2: 1.0,
            linear_jerk_max_m_s3: 5.0,
            wheel_speed_max_rad_s: 20.0,
            wheel_acceleration_max_rad_s2: 50.0,
        },
    }
}
