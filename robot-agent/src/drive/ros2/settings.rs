//! What must be known of a ROS 2 robot, checked; `[drive.ros2]` in `robot.toml` says it.

use std::time::Duration;

use tread_control::geometry::Pose;
use tread_ros2::names::Name;
use tread_ros2::rmw::Generation;

/// Most joints of one side.
pub const JOINTS_MAX: usize = 8;

/// A ROS 2 robot.
#[derive(Debug, Clone, PartialEq)]
pub struct Ros2Settings {
    /// How its bus is reached.
    pub bus: BusSettings,
    /// What is fresh and what is late.
    pub timing: Timing,
    /// Odometry, if it is read.
    pub odometry: Option<OdometrySettings>,
    /// The inertial unit, if it is read; else the odometry gives the turn rate.
    pub imu: Option<ImuSettings>,
    /// The joints, if they are read; else the odometry gives the wheels' speeds.
    pub joints: Option<JointSettings>,
    /// Where a pose comes from that is better than odometry, if there is such.
    pub pose: Option<PoseSettings>,
    /// The battery's topic, if it is read.
    pub battery: Option<Name>,
    /// What is written.
    pub command: CommandSettings,
    /// What is said to the rest of the robot, if anything is.
    pub outward: Option<OutwardSettings>,
}

/// How ROS 2 is spoken over zenoh.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Scheme {
    /// As by `rmw_zenoh_cpp`.
    RmwZenoh(Generation),
    /// As by `zenoh-bridge-ros2dds`.
    Ros2Dds,
}

/// Who is the robot's router.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BusMode {
    /// Somebody else: `rmw_zenohd`, or the bridge.
    Client,
    /// The agent itself; nodes come to it.
    Router,
}

/// How the robot's bus is reached.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BusSettings {
    /// How ROS 2 is spoken on it.
    pub scheme: Scheme,
    /// Who is its router.
    pub mode: BusMode,
    /// A zenoh endpoint on this machine.
    pub endpoint: String,
    /// The domain of `rmw_zenoh_cpp`.
    pub domain: u32,
    /// The namespace of the bridge, or of the agent's node.
    pub namespace: Name,
    /// The agent's node.
    pub node: Name,
}

/// Whose clock the messages' stamps are of.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StampClock {
    /// This machine's: a message is as old as its stamp says.
    Host,
    /// One of the base's own, or simulated time: the least delay seen is taken for none.
    Base,
}

/// What is fresh and what is late.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Timing {
    /// Whose clock the stamps are of.
    pub stamps: StampClock,
    /// Oldest word of the base with which it does not count as silent.
    pub silent_after: Duration,
    /// Oldest message that is used.
    pub late_after: Duration,
    /// The same for a pose, which takes longer to find.
    pub pose_late_after: Duration,
}

/// What the odometry's motion is the motion of.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MotionOf {
    /// The wheels: it was computed from them, by the base's own radius and track.
    Wheels,
    /// The body over ground: by camera, laser or satellite.
    Ground,
}

/// Odometry.
#[derive(Debug, Clone, PartialEq)]
pub struct OdometrySettings {
    /// The topic.
    pub topic: Name,
    /// The frame of its pose.
    pub frame: String,
    /// The frame of its motion.
    pub child_frame: String,
    /// What its motion is the motion of.
    pub motion_of: MotionOf,
    /// Where its frame lies in the site, if its pose is to count as a position.
    pub site_from_odom: Option<Pose>,
}

/// An inertial unit, level, turned about its z axis against the base.
#[derive(Debug, Clone, PartialEq)]
pub struct ImuSettings {
    /// The topic.
    pub topic: Name,
    /// Its frame.
    pub frame: String,
    /// How far its x axis is turned from the base's, radians, to the left.
    pub yaw_rad: f64,
    /// Whether it hangs upside down, turned about its x axis.
    pub is_upside_down: bool,
}

/// What a joint's effort is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Effort {
    /// Nothing that can be used.
    None,
    /// Newton metres of the joint.
    Torque,
    /// Amperes, each so many newton metres of the joint.
    Current(f64),
}

impl Effort {
    /// Newton metres of the joint for one of its effort; none where it is of no use.
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
    /// Their names, 1 to [`JOINTS_MAX`].
    pub names: Vec<String>,
    /// 1.0, or -1.0 where they turn backwards when the robot goes ahead.
    pub sign: f64,
    /// 1.0, or -1.0 where their effort is positive against the way they turn.
    pub effort_sign: f64,
}

/// The joints that drive.
#[derive(Debug, Clone, PartialEq)]
pub struct JointSettings {
    /// The topic.
    pub topic: Name,
    /// The left ones.
    pub left: SideJoints,
    /// The right ones.
    pub right: SideJoints,
    /// Turns of a joint for one turn of its wheel.
    pub gear_ratio: f64,
    /// What the effort is.
    pub effort: Effort,
}

/// A pose that was found by a map, a satellite or a beacon.
#[derive(Debug, Clone, PartialEq)]
pub struct PoseSettings {
    /// The topic.
    pub topic: Name,
    /// Its frame.
    pub frame: String,
    /// Where that frame lies in the site.
    pub site_from_map: Pose,
}

/// What kind of message commands the base.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CommandKind {
    /// `geometry_msgs/Twist`.
    Twist,
    /// `geometry_msgs/TwistStamped`.
    TwistStamped,
    /// `std_msgs/Float64MultiArray`: a velocity for each joint, left ones first.
    JointSpeeds,
}

/// What is written.
#[derive(Debug, Clone, PartialEq)]
pub struct CommandSettings {
    /// The topic.
    pub topic: Name,
    /// The kind of message.
    pub kind: CommandKind,
    /// The frame of a stamped command.
    pub frame: String,
    /// The wheels' radius that the base assumes, metres.
    pub base_radius_m: f64,
    /// The track that the base assumes, metres: its separation times its multiplier.
    pub base_track_m: f64,
    /// 1.0, or -1.0 where the base takes a turn to the right for positive.
    pub turn_sign: f64,
    /// 1.0, or -1.0 where the base takes backwards for positive.
    pub forward_sign: f64,
    /// Joints of the left and of the right side in [`CommandKind::JointSpeeds`].
    pub joints: [usize; 2],
    /// Turns of a joint for one turn of its wheel, each side with its sign.
    pub joint_ratios: [f64; 2],
}

impl Ros2Settings {
    /// Every topic that is read or commanded.
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

/// What is said to the rest of the robot.
#[derive(Debug, Clone, PartialEq)]
pub struct OutwardSettings {
    /// The plan of the active mission, `nav_msgs/Path`.
    pub plan: Name,
    /// The driven path, `nav_msgs/Path`.
    pub driven: Name,
    /// θ, its standard deviation and θ̂ of the law, `std_msgs/Float64MultiArray`.
    pub theta: Name,
    /// How the agent is, `diagnostic_msgs/DiagnosticArray`.
    pub diagnostics: Name,
    /// The frame of both ways: that of the topic which gives the position.
    pub frame: String,
    /// Where that frame lies in the site.
    pub site_from_frame: Pose,
}
