//! Robots other than the paper's.

use tread_control::robot::{Limits, RobotModel, RobotModelSpec};

/// Returns a robot about as large as a Husky: 50 kg, wheel radius 16.5 cm.
pub fn husky_like() -> RobotModel {
    let spec = RobotModelSpec {
        mass_kg: 50.0,
        track_width_m: 0.57,
        wheelbase_m: 0.51,
        wheel_radius_m: 0.165,
        yaw_inertia_kg_m2: 3.0,
        limits: Limits {
            wheel_speed_max_rad_s: 8.0,
            wheel_acceleration_max_rad_s2: 30.0,
            linear_max_m_s: 1.0,
            angular_max_rad_s: 1.5,
            linear_acceleration_max_m_s2: 0.8,
            linear_jerk_max_m_s3: 3.0,
            lateral_acceleration_max_m_s2: 0.8,
        },
    };
    RobotModel::try_from(spec).expect("every figure is above zero")
}
