//! The keys of `[drive.ros2]`, checked only by their types.

use serde::Deserialize;

#[derive(Debug, Clone, Copy, Default, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum SchemeFile {
    #[default]
    RmwZenoh,
    Ros2dds,
}

#[derive(Debug, Clone, Copy, Default, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum ModeFile {
    #[default]
    Client,
    Router,
}

#[derive(Debug, Clone, Copy, Default, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum DistributionFile {
    Humble,
    Iron,
    #[default]
    Jazzy,
    Kilted,
    Lyrical,
    Rolling,
}

#[derive(Debug, Clone, Copy, Default, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum StampsFile {
    #[default]
    Host,
    Base,
}

#[derive(Debug, Clone, Copy, Default, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum MotionFile {
    #[default]
    Wheels,
    Ground,
}

#[derive(Debug, Clone, Copy, Default, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum EffortFile {
    None,
    #[default]
    Torque,
    Current,
}

#[derive(Debug, Clone, Copy, Default, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum CommandFileKind {
    #[default]
    Twist,
    TwistStamped,
    JointSpeeds,
}

/// `[drive.ros2]`.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(in crate::config) struct Ros2File {
    pub(super) bus: SchemeFile,
    pub(super) mode: ModeFile,
    pub(super) endpoint: Option<String>,
    pub(super) distribution: DistributionFile,
    pub(super) domain: u32,
    pub(super) namespace: String,
    pub(super) node: Option<String>,
    pub(super) stamps: StampsFile,
    pub(super) silent_after_ms: Option<f64>,
    pub(super) late_after_ms: Option<f64>,
    pub(super) pose_late_after_ms: Option<f64>,
    pub(super) odometry: Option<OdometryFile>,
    pub(super) imu: Option<ImuFile>,
    pub(super) joints: Option<JointsFile>,
    pub(super) pose: Option<PoseFile>,
    pub(super) battery: Option<BatteryFile>,
    pub(super) command: CommandFile,
    pub(super) outward: OutwardFile,
}

#[derive(Debug, Clone, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct OdometryFile {
    pub(super) topic: Option<String>,
    pub(super) frame: Option<String>,
    pub(super) child_frame: Option<String>,
    pub(super) motion_of: MotionFile,
    pub(super) gives_position: bool,
    pub(super) site_x_m: f64,
    pub(super) site_y_m: f64,
    pub(super) site_heading_rad: f64,
}

#[derive(Debug, Clone, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct ImuFile {
    pub(super) topic: Option<String>,
    pub(super) frame: Option<String>,
    pub(super) yaw_rad: f64,
    pub(super) upside_down: bool,
}

#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct JointsFile {
    pub(super) topic: Option<String>,
    pub(super) left: Vec<String>,
    pub(super) right: Vec<String>,
    pub(super) left_sign: Option<f64>,
    pub(super) right_sign: Option<f64>,
    pub(super) left_effort_sign: Option<f64>,
    pub(super) right_effort_sign: Option<f64>,
    pub(super) gear_ratio: Option<f64>,
    #[serde(default)]
    pub(super) effort: EffortFile,
    pub(super) torque_constant_n_m_a: Option<f64>,
}

#[derive(Debug, Clone, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct PoseFile {
    pub(super) topic: Option<String>,
    pub(super) frame: Option<String>,
    pub(super) site_x_m: f64,
    pub(super) site_y_m: f64,
    pub(super) site_heading_rad: f64,
}

#[derive(Debug, Clone, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct BatteryFile {
    pub(super) topic: Option<String>,
}

#[derive(Debug, Clone, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct CommandFile {
    pub(super) topic: Option<String>,
    pub(super) kind: CommandFileKind,
    pub(super) frame: Option<String>,
    pub(super) wheel_radius_m: Option<f64>,
    pub(super) track_width_m: Option<f64>,
    pub(super) turn_sign: Option<f64>,
    pub(super) forward_sign: Option<f64>,
}

#[derive(Debug, Clone, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct OutwardFile {
    pub(super) enabled: Option<bool>,
    pub(super) plan: Option<String>,
    pub(super) driven: Option<String>,
    pub(super) theta: Option<String>,
    pub(super) diagnostics: Option<String>,
}
