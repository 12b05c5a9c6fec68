//! Checked settings of a ROS 2 robot, from `[drive.ros2]` of `robot.toml`.

use std::time::Duration;

use tread_control::geometry::{Pose, wrap_angle_rad};
use tread_ros2::names::Name;
use tread_ros2::rmw::Generation;

/// Largest number of joints of one side.
pub const JOINTS_MAX: usize = 8;

/// Settings of a ROS 2 robot.
#[derive(Debug, Clone, PartialEq)]
pub struct Ros2Settings {
    /// Access to the robot's bus.
    pub bus: BusSettings,
    /// Limits on the age of messages.
    pub timing: Timing,
    /// Odometry, if it is read.
    pub odometry: Option<OdometrySettings>,
    /// Inertial measurement unit, if it is read; otherwise the odometry gives the yaw rate.
    pub imu: Option<ImuSettings>,
    /// Joints, if they are read; otherwise the odometry gives the wheel speeds.
    pub joints: Option<JointSettings>,
    /// Source of a pose that is better than odometry, if any.
    pub pose: Option<PoseSettings>,
    /// The battery's topic, if it is read.
    pub battery: Option<Name>,
    /// Command of the base.
    pub command: CommandSettings,
    /// Topics on which the agent publishes its state, if any.
    pub outward: Option<OutwardSettings>,
}

/// Mapping of ROS 2 topics to zenoh.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Scheme {
    /// As by `rmw_zenoh_cpp`.
    RmwZenoh(Generation),
    /// As by `zenoh-bridge-ros2dds`.
    Ros2Dds,
}

/// Router of the robot's bus.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BusMode {
    /// Another program: `rmw_zenohd`, or the bridge.
    Client,
    /// The agent itself; nodes connect to it.
    Router,
}

/// Access to the robot's bus.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BusSettings {
    /// Mapping of ROS 2 topics to zenoh.
    pub scheme: Scheme,
    /// Router of the bus.
    pub mode: BusMode,
    /// zenoh endpoint on this machine.
    pub endpoint: String,
    /// `ROS_DOMAIN_ID`, 0 to 232; used with `rmw_zenoh_cpp` only.
    pub domain: u32,
    /// Namespace of the bridge, or of the agent's node.
    pub namespace: Name,
    /// Name of the agent's node.
    pub node: Name,
}

/// Clock of the messages' stamps.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StampClock {
    /// Clock of this machine: a message's age is the difference to it.
    Host,
    /// Clock of the base, or simulated time: the smallest delay seen is assumed to be zero.
    Base,
}

/// Limits on the age of messages.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Timing {
    /// Clock of the messages' stamps.
    pub stamps: StampClock,
    /// Age of the last valid sample beyond which the base counts as silent.
    pub silent_after: Duration,
    /// Largest age of a message that is used.
    pub late_after: Duration,
    /// Largest age of a pose that is used, which takes longer to compute.
    pub pose_late_after: Duration,
}

/// What the odometry's twist describes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MotionOf {
    /// The wheels: it is computed from them, with the base's own radius and track.
    Wheels,
    /// The body over ground: it is measured by camera, laser or satellite.
    Ground,
}

/// Odometry.
#[derive(Debug, Clone, PartialEq)]
pub struct OdometrySettings {
    /// The topic.
    pub topic: Name,
    /// Frame of its pose.
    pub frame: String,
    /// Frame of its twist.
    pub child_frame: String,
    /// What its twist describes.
    pub motion_of: MotionOf,
    /// Pose of its frame in the site, if its pose shall be used as a position fix.
    pub site_from_odom: Option<Pose>,
}

/// Inertial measurement unit, mounted level, rotated about its z axis against the base.
#[derive(Debug, Clone, PartialEq)]
pub struct ImuSettings {
    /// The topic.
    pub topic: Name,
    /// Its frame.
    pub frame: String,
    /// Angle of its x axis against the base's, radians, positive to the left.
    pub yaw_rad: f64,
    /// Whether it is mounted upside down, rotated about its x axis.
    pub is_upside_down: bool,
}

/// Quantity in a joint's effort.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Effort {
    /// Not usable.
    None,
    /// Torque at the joint, N m.
    Torque,
    /// Current, A, with the torque constant of the joint, N m/A.
    Current(f64),
}

impl Effort {
    /// Returns the joint's torque per unit of effort, N m; `None` if it is not usable.
    pub const fn torque_n_m(self) -> Option<f64> {
        match self {
            Self::None => None,
            Self::Torque => Some(1.0),
            Self::Current(n_m_a) => Some(n_m_a),
        }
    }
}

/// The joints of one side.
#[derive(Debug, Clone, PartialEq)]
pub struct SideJoints {
    /// Names of the joints, 1 to [`JOINTS_MAX`].
    pub names: Vec<String>,
    /// 1.0, or -1.0 if the joints turn backwards when the robot moves forward.
    pub sign: f64,
    /// 1.0, or -1.0 if a positive effort acts against a positive rotation.
    pub effort_sign: f64,
}

/// Driven joints.
#[derive(Debug, Clone, PartialEq)]
pub struct JointSettings {
    /// The topic.
    pub topic: Name,
    /// Joints of the left side.
    pub left: SideJoints,
    /// Joints of the right side.
    pub right: SideJoints,
    /// Joint revolutions per wheel revolution.
    pub gear_ratio: f64,
    /// Quantity in the effort.
    pub effort: Effort,
}

/// Pose from a map, a satellite or a beacon.
#[derive(Debug, Clone, PartialEq)]
pub struct PoseSettings {
    /// The topic.
    pub topic: Name,
    /// Its frame.
    pub frame: String,
    /// Pose of that frame in the site.
    pub site_from_map: Pose,
}

/// Message type of the command.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CommandKind {
    /// `geometry_msgs/Twist`.
    Twist,
    /// `geometry_msgs/TwistStamped`.
    TwistStamped,
    /// `std_msgs/Float64MultiArray`: a velocity for each joint, left ones first.
    JointSpeeds,
}

/// Command of the base.
#[derive(Debug, Clone, PartialEq)]
pub struct CommandSettings {
    /// The topic.
    pub topic: Name,
    /// Message type.
    pub kind: CommandKind,
    /// The frame of a stamped command.
    pub frame: String,
    /// Wheel radius that the base assumes, metres.
    pub base_radius_m: f64,
    /// Track width that the base assumes, metres: its wheel separation times its multiplier.
    pub base_track_m: f64,
    /// 1.0, or -1.0 if a positive turn is to the right for the base.
    pub turn_sign: f64,
    /// 1.0, or -1.0 if a positive speed is backwards for the base.
    pub forward_sign: f64,
    /// Number of joints of each side, `[left, right]`, in [`CommandKind::JointSpeeds`].
    pub joints: [usize; 2],
    /// Joint revolutions per wheel revolution with sign, `[left, right]`.
    pub joint_ratios: [f64; 2],
}

impl Ros2Settings {
    /// Returns every topic that is read or commanded.
    pub(crate) fn topics(&self) -> Vec<&Name> {
        let read = [
            self.odometry.as_ref().map(|odometry| &odometry.topic),
            self.imu.as_ref().map(|imu| &imu.topic),
            self.joints.as_ref().map(|joints| &joints.topic),
            self.pose.as_ref().map(|pose| &pose.topic),
            self.battery.as_ref(),
        ];
        let read = read.into_iter().flatten();
        read.chain([&self.command.topic]).collect()
    }
}

/// Topics on which the agent publishes its state.
#[derive(Debug, Clone, PartialEq)]
pub struct OutwardSettings {
    /// Plan of the active mission, `nav_msgs/Path`.
    pub plan: Name,
    /// Driven path, `nav_msgs/Path`.
    pub driven: Name,
    /// θ, its standard deviation and θ̂ of the law, `std_msgs/Float64MultiArray`.
    pub theta: Name,
    /// State of the agent, `diagnostic_msgs/DiagnosticArray`.
    pub diagnostics: Name,
    /// Frame of both paths: that of the topic which gives the position.
    pub frame: String,
    /// Pose of that frame in the site.
    pub site_from_frame: Pose,
}

impl OutwardSettings {
    /// Transforms a pose from the site frame to the frame of both paths.
    pub(crate) fn frame_pose(&self, pose: Pose) -> Pose {
        let point = self.site_from_frame.body_from_site(pose.point());
        Pose {
            x_m: point.x_m,
            y_m: point.y_m,
            heading_rad: wrap_angle_rad(pose.heading_rad - self.site_from_frame.heading_rad),
        }
    }
}
