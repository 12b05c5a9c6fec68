//! What tests, benchmarks and reports send to a server, the service manager that tests play, and the S3
//! storage that they start. No program depends on it.

pub mod s3;
pub mod service_manager;

use tread_api::robot::{RobotLimits, RobotModel};

/// A rover of 50 kg by this name, on lugged tyres.
pub fn rover(name: &str) -> RobotModel {
    RobotModel {
        name: name.to_owned(),
        tyres: "lugged".to_owned(),
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
