//! The keys of `robot.toml`, checked only by their types.

use std::path::PathBuf;

use serde::Deserialize;
use tread_api::ids::{OwnerId, RobotId, SiteId};
use tread_api::robot::RobotModel;
use tread_telemetry::TracingConfig;

use super::ros2::Ros2File;
use super::servers::ServerFile;

/// `robot.toml`.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct FileConfig {
    pub(super) site: Option<SiteId>,
    pub(super) robot: Option<RobotId>,
    pub(super) server: Option<ServerFile>,
    pub(super) server_timeout_s: Option<f64>,
    pub(super) data_dir: Option<PathBuf>,
    pub(super) rate_hz: Option<f64>,
    pub(super) state_rate_hz: Option<f64>,
    pub(super) friction_rate_hz: Option<f64>,
    pub(super) required_owners: Option<Vec<OwnerId>>,
    pub(super) blind_within_fence: Option<bool>,
    pub(super) model: Option<ModelFile>,
    pub(super) drive: Option<DriveFile>,
    pub(super) recording: Option<RecordingFile>,
    pub(super) tracing: Option<TracingConfig>,
    pub(super) estimation: Option<EstimationFile>,
    pub(super) realtime: Option<RealtimeFile>,
}

/// `[estimation]` in `robot.toml`.
#[derive(Debug, Clone, Copy, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct EstimationFile {
    pub(super) mass_std_dev_ratio: Option<f64>,
    pub(super) inertia_std_dev_ratio: Option<f64>,
    pub(super) tyre_curvature: Option<f64>,
    pub(super) tyre_curvature_std_dev: Option<f64>,
    pub(super) tyre_mu_max: Option<f64>,
    pub(super) tyre_relaxation_m: Option<f64>,
    pub(super) tyre_relaxation_std_dev_m: Option<f64>,
    pub(super) rotor_ratio: Option<f64>,
    pub(super) rotor_std_dev_ratio: Option<f64>,
    pub(super) load_difference_std_dev: Option<f64>,
    pub(super) payload_ratio: Option<f64>,
}

/// `[realtime]` in `robot.toml`.
#[derive(Debug, Clone, Copy, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct RealtimeFile {
    pub(super) priority: Option<u8>,
    pub(super) lock_memory: Option<bool>,
}

/// `[recording]` in `robot.toml`.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct RecordingFile {
    pub(super) enabled: Option<bool>,
    pub(super) folder: Option<PathBuf>,
    pub(super) file_mib: Option<u64>,
    pub(super) files: Option<usize>,
}

/// `[model]` of `robot.toml`, with the names of the wire; unknown keys are refused.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ModelFile {
    pub(super) name: String,
    pub(super) tyres: String,
    pub(super) mass_kg: f64,
    pub(super) track_width_m: f64,
    pub(super) wheelbase_m: f64,
    pub(super) wheel_radius_m: f64,
    pub(super) yaw_inertia_kg_m2: f64,
    pub(super) limits: LimitsFile,
}

#[derive(Debug, Clone, Copy, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct LimitsFile {
    pub(super) linear_max_m_s: f64,
    pub(super) angular_max_rad_s: f64,
    pub(super) linear_acceleration_max_m_s2: f64,
    pub(super) lateral_acceleration_max_m_s2: f64,
    pub(super) linear_jerk_max_m_s3: f64,
    pub(super) wheel_speed_max_rad_s: f64,
    pub(super) wheel_acceleration_max_rad_s2: f64,
}

impl From<ModelFile> for RobotModel {
    fn from(file: ModelFile) -> Self {
        let limits = file.limits;
        Self {
            name: file.name,
            tyres: file.tyres,
            mass_kg: file.mass_kg,
            track_width_m: file.track_width_m,
            wheelbase_m: file.wheelbase_m,
            wheel_radius_m: file.wheel_radius_m,
            yaw_inertia_kg_m2: file.yaw_inertia_kg_m2,
            limits: tread_api::robot::RobotLimits {
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
}

/// Kind of the base.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum DriveKind {
    Simulated,
    Ros2,
}

#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct DriveFile {
    pub(super) kind: DriveKind,
    pub(super) ros2: Option<Ros2File>,
    pub(super) scenario: Option<PathBuf>,
    pub(super) x_m: Option<f64>,
    pub(super) y_m: Option<f64>,
    pub(super) heading_rad: Option<f64>,
    pub(super) seed: Option<u64>,
    pub(super) battery_charge_ratio: Option<f64>,
    pub(super) clock_ahead_s: Option<i64>,
}

/// Parses the text of a configuration.
pub(super) fn parse(text: &str) -> Result<FileConfig, toml::de::Error> {
    toml::from_str(text)
}
