//! Chooses the topics and joints of the robot: the ones that are asked for, those of its
//! configuration, or else the only ones of their type.

mod joints;

use std::time::Duration;

use tread_agent::drive::ros2::settings::{
    BusMode, BusSettings, CommandKind, CommandSettings, Effort, ImuSettings, MotionOf,
    OdometrySettings, PoseSettings, Ros2Settings, Scheme, StampClock, Timing,
};
use tread_control::geometry::Pose;
use tread_control::robot::RobotModel;
use tread_ros2::names::Name;

use super::recording::{CDR, Contents, Recording, RecordingError, Topic};
use super::robot::Robot;
use joints::joint_settings;
pub use joints::{JointNames, sides_of};

/// Wheel speeds.
pub const JOINT_STATE: &str = "sensor_msgs/msg/JointState";
/// Yaw rate and acceleration.
pub const IMU: &str = "sensor_msgs/msg/Imu";
/// Speed, and a pose.
pub const ODOMETRY: &str = "nav_msgs/msg/Odometry";
/// A pose.
pub const POSE: &str = "geometry_msgs/msg/PoseStamped";
/// A pose with its covariance.
pub const COVARIANT_POSE: &str = "geometry_msgs/msg/PoseWithCovarianceStamped";

/// Largest age of a message when it was recorded.
pub const LATE_AFTER: Duration = Duration::from_secs(1);

/// What is asked for; the rest is chosen.
#[derive(Debug, Clone, Default)]
pub struct RequestedTopics {
    /// Topic of the wheels' joints.
    pub wheels: Option<String>,
    /// Joints.
    pub joints: Option<JointNames>,
    /// Whether the left and the right joints turn backwards when the robot drives forward.
    pub reversed: [bool; 2],
    /// Joint revolutions per wheel revolution.
    pub gear_ratio: Option<f64>,
    /// What the joints' effort is.
    pub effort: Option<Effort>,
    /// Topic of the inertial unit.
    pub imu: Option<String>,
    /// Angle of the inertial unit's x axis against the robot's, radians.
    pub imu_yaw_rad: Option<f64>,
    /// Whether the inertial unit is mounted upside down.
    pub is_imu_upside_down: bool,
    /// Topic of the odometry.
    pub odometry: Option<String>,
    /// Whether the odometry measures the motion of the body over ground.
    pub is_over_ground: bool,
    /// Track width with which the base computes its odometry from its wheels, metres.
    pub odometry_track_m: Option<f64>,
    /// Topic of the pose.
    pub pose: Option<String>,
}

/// Why no topics could be chosen. The texts end with the topics that there are.
#[derive(Debug, thiserror::Error)]
pub enum MappingError {
    /// A topic that was asked for is not there.
    #[error("there is no topic `{topic}`; the recording has\n{found}")]
    NoTopic {
        /// The topic.
        topic: String,
        /// The topics that there are.
        found: String,
    },
    /// A topic that was asked for is of another type.
    #[error(
        "`{topic}` is of the type {found_type}, and {expected} is needed; the recording has\n{found}"
    )]
    WrongType {
        /// The topic.
        topic: String,
        /// Its type.
        found_type: String,
        /// Types that can be read.
        expected: String,
        /// The topics that there are.
        found: String,
    },
    /// No topic, or several, of a type that is needed.
    #[error("{problem}: {advice}; the recording has\n{found}")]
    Missing {
        /// What is missing or ambiguous.
        problem: String,
        /// What to do.
        advice: &'static str,
        /// The topics that there are.
        found: String,
    },
    /// The names of the joints do not show their sides.
    #[error(
        "which joints of `{topic}` are left and which are right does not show in their names: say `--joints LEFT,…/RIGHT,…` with some of {names}"
    )]
    Joints {
        /// The topic.
        topic: String,
        /// Names of its joints.
        names: String,
    },
    /// A joint that was asked for is not there.
    #[error("`{topic}` has no joint `{joint}`: its joints are {names}")]
    NoJoint {
        /// The topic.
        topic: String,
        /// The joint.
        joint: String,
        /// Names of its joints.
        names: String,
    },
    /// Odometry of the wheels alone.
    #[error(
        "wheel speeds would come from the odometry `{0}`, which a base computes with a track width of its own: give it as `--odometry-track-m`"
    )]
    OdometryTrack(String),
    /// A yaw rate that is computed from the wheels.
    #[error(
        "the odometry `{0}` would give wheel speeds and yaw rate, and nothing is measured beside the wheels: θ needs a gyro (`--imu`)"
    )]
    NoGyro(String),
    /// The recording.
    #[error(transparent)]
    Recording(#[from] RecordingError),
}

/// The topics of a robot, by their use.
#[derive(Debug, Clone)]
pub struct Mapping {
    /// Wheel speeds, by joints.
    pub joints: Option<String>,
    /// Yaw rate and acceleration.
    pub imu: Option<String>,
    /// Odometry.
    pub odometry: Option<String>,
    /// Pose, and its type.
    pub pose: Option<(String, &'static str)>,
    /// What the agent's readers need to know of them. Frames are those of the first messages.
    pub settings: Ros2Settings,
    /// Choices that a person should know of.
    pub notices: Vec<String>,
}

impl Mapping {
    /// Returns the topics that are read.
    pub fn topics(&self) -> Vec<&str> {
        let pose = self.pose.as_ref().map(|(topic, _)| topic);
        let topics = [
            self.joints.as_ref(),
            self.imu.as_ref(),
            self.odometry.as_ref(),
            pose,
        ];
        topics.into_iter().flatten().map(String::as_str).collect()
    }
}

/// Type of which only one topic is read.
#[derive(Debug, Clone, Copy)]
struct TopicType {
    name: &'static str,
    /// What to do if several topics are of it.
    advice: &'static str,
}

/// Topics that are chosen, as far as there are any.
#[derive(Debug, Clone, Copy)]
struct Chosen<'a> {
    joints: Option<&'a str>,
    imu: Option<&'a str>,
    odometry: Option<&'a str>,
}

/// Topics of a recording, to choose from.
struct Choice<'a> {
    contents: &'a Contents,
    notices: Vec<String>,
}

impl<'a> Choice<'a> {
    fn found(&self) -> String {
        self.contents.lines()
    }

    fn of_types(&self, types: &[&'static str]) -> Vec<(&'a Topic, &'static str)> {
        let topics = self.contents.topics.iter();
        let topics = topics.filter(|topic| topic.encoding == CDR);
        let found = topics.filter_map(|topic| {
            let kind = types.iter().find(|kind| **kind == topic.message_type)?;
            Some((topic, *kind))
        });
        found.collect()
    }

    /// Returns the topic that was asked for, held against its type.
    fn asked(
        &self,
        asked: &str,
        types: &[&'static str],
    ) -> Result<(String, &'static str), MappingError> {
        let topics = &self.contents.topics;
        let named = |name: &str| name.trim_start_matches('/') == asked.trim_start_matches('/');
        let topic = topics.iter().find(|topic| named(&topic.name));
        let topic = topic.ok_or_else(|| MappingError::NoTopic {
            topic: asked.to_owned(),
            found: self.found(),
        })?;
        let kind = types.iter().find(|kind| **kind == topic.message_type);
        match kind.filter(|_| topic.encoding == CDR) {
            Some(kind) => Ok((topic.name.clone(), kind)),
            None => Err(MappingError::WrongType {
                topic: topic.name.clone(),
                found_type: format!("{} ({})", topic.message_type, topic.encoding),
                expected: types.join(" or "),
                found: self.found(),
            }),
        }
    }

    /// Returns the topic that was asked for, or the only one of its types; none where there are
    /// none or several.
    fn optional(
        &mut self,
        asked: Option<&str>,
        types: &[&'static str],
        flag: &str,
    ) -> Result<Option<(String, &'static str)>, MappingError> {
        if let Some(asked) = asked {
            return self.asked(asked, types).map(Some);
        }
        let all = self.of_types(types);
        if all.len() > 1 {
            let names: Vec<&str> = all.iter().map(|(topic, _)| topic.name.as_str()).collect();
            let names = names.join(", ");
            self.notices.push(format!(
                "of {names} none is read; choose one by `{flag}` if it shall be"
            ));
        }
        let only = all.first().filter(|_| all.len() == 1);
        Ok(only.map(|(topic, kind)| (topic.name.clone(), *kind)))
    }

    /// As [`Self::optional`], and an error where there are several.
    fn unambiguous(
        &mut self,
        asked: Option<&str>,
        kind: TopicType,
    ) -> Result<Option<String>, MappingError> {
        let TopicType { name: kind, advice } = kind;
        let count = self.of_types(&[kind]).len();
        if asked.is_none() && count > 1 {
            return Err(MappingError::Missing {
                problem: format!("{count} topics are of the type {kind}"),
                advice,
                found: self.found(),
            });
        }
        let found = self.optional(asked, &[kind], "")?;
        Ok(found.map(|(topic, _)| topic))
    }
}

/// Returns what is missing for an estimate, in words; nothing if nothing is.
pub fn missing(contents: &Contents) -> Vec<String> {
    let has = |kind: &str| {
        let mut topics = contents.topics.iter();
        topics.any(|topic| topic.message_type == kind && topic.encoding == CDR)
    };
    let mut missing = Vec::new();
    if !has(JOINT_STATE) {
        missing.push(if has(ODOMETRY) {
            format!(
                "wheel speeds: no {JOINT_STATE}; those behind the odometry can be computed if its track width is known (`--odometry-track-m`)"
            )
        } else {
            format!("wheel speeds: no {JOINT_STATE}, and no {ODOMETRY}")
        });
    }
    if !has(IMU) {
        missing.push(format!("yaw rate: no {IMU} with a gyro"));
    }
    missing
}

/// Chooses topics and joints.
///
/// # Errors
/// [`MappingError`] with the topics that there are.
pub fn choose(
    recording: &Recording,
    contents: &Contents,
    robot: &Robot,
    requested: &RequestedTopics,
) -> Result<Mapping, MappingError> {
    let mut choice = Choice {
        contents,
        notices: Vec::new(),
    };
    let configured = robot.settings.as_ref();
    let topic_of = |asked: &Option<String>, name: Option<&Name>| {
        let named = name.map(|name| format!("/{}", name.as_str()));
        asked.clone().or(named)
    };
    let joints_of = configured.and_then(|settings| settings.joints.as_ref());
    let asked = topic_of(&requested.wheels, joints_of.map(|joints| &joints.topic));
    let joints = choice.unambiguous(
        asked.as_deref(),
        TopicType {
            name: JOINT_STATE,
            advice: "say which has the wheels by `--wheels TOPIC`",
        },
    )?;
    let imu_of = configured.and_then(|settings| settings.imu.as_ref());
    let asked = topic_of(&requested.imu, imu_of.map(|imu| &imu.topic));
    let imu = choice.unambiguous(
        asked.as_deref(),
        TopicType {
            name: IMU,
            advice: "say which is the robot's by `--imu TOPIC`",
        },
    )?;
    let odometry_of = configured.and_then(|settings| settings.odometry.as_ref());
    let asked = topic_of(
        &requested.odometry,
        odometry_of.map(|odometry| &odometry.topic),
    );
    let is_odometry_of_use = joints.is_none() || requested.is_over_ground || asked.is_some();
    let odometry = if is_odometry_of_use {
        choice.unambiguous(
            asked.as_deref(),
            TopicType {
                name: ODOMETRY,
                advice: "say which by `--odometry TOPIC`",
            },
        )?
    } else {
        None
    };
    let pose_of = configured.and_then(|settings| settings.pose.as_ref());
    let asked = topic_of(&requested.pose, pose_of.map(|pose| &pose.topic));
    let pose = choice.optional(asked.as_deref(), &[COVARIANT_POSE, POSE], "--pose")?;
    let is_over_ground = requested.is_over_ground
        || odometry_of.is_some_and(|odometry| odometry.motion_of == MotionOf::Ground);
    let chosen = Chosen {
        joints: joints.as_deref(),
        imu: imu.as_deref(),
        odometry: odometry.as_deref(),
    };
    check_whole(&choice, chosen, is_over_ground)?;
    if let Some(topic) = odometry.as_deref().filter(|_| joints.is_none())
        && requested.odometry_track_m.is_none()
        && configured.is_none()
    {
        return Err(MappingError::OdometryTrack(topic.to_owned()));
    }
    let joint_settings = match &joints {
        Some(topic) => Some(joint_settings(recording, topic, joints_of, requested)?),
        None => None,
    };
    let mut settings = configured
        .cloned()
        .unwrap_or_else(|| settings_of(&robot.model, requested.odometry_track_m));
    settings.imu = imu.is_some().then(|| imu_settings(imu_of, requested));
    settings.odometry = odometry.is_some().then(|| OdometrySettings {
        topic: Name::default(),
        frame: String::new(),
        child_frame: String::new(),
        motion_of: if is_over_ground {
            MotionOf::Ground
        } else {
            MotionOf::Wheels
        },
        site_from_odom: None,
    });
    settings.pose = pose.is_some().then(|| PoseSettings {
        topic: Name::default(),
        frame: String::new(),
        site_from_map: Pose::default(),
    });
    settings.joints = joint_settings;
    settings.battery = None;
    Ok(Mapping {
        joints,
        imu,
        odometry,
        pose,
        settings,
        notices: choice.notices,
    })
}

/// Whether wheel speeds and a yaw rate that is not computed from them are there.
fn check_whole(
    choice: &Choice<'_>,
    chosen: Chosen<'_>,
    is_over_ground: bool,
) -> Result<(), MappingError> {
    let missing = |problem: String, advice| MappingError::Missing {
        problem,
        advice,
        found: choice.found(),
    };
    match (chosen.joints, chosen.imu, chosen.odometry) {
        (None, _, None) => Err(missing(
            format!("no topic has wheel speeds: none is of the type {JOINT_STATE} or {ODOMETRY}"),
            "record the wheels' joint states",
        )),
        (None, None, Some(topic)) => Err(MappingError::NoGyro(topic.to_owned())),
        (Some(_), None, _) if !is_over_ground => Err(missing(
            format!(
                "no topic has a yaw rate that is measured beside the wheels: none is of the type {IMU}"
            ),
            "record the inertial unit, or name odometry that is measured over ground by `--odometry TOPIC --over-ground`",
        )),
        _ => Ok(()),
    }
}

fn imu_settings(configured: Option<&ImuSettings>, requested: &RequestedTopics) -> ImuSettings {
    let yaw_rad = requested.imu_yaw_rad.or(configured.map(|imu| imu.yaw_rad));
    ImuSettings {
        topic: Name::default(),
        frame: String::new(),
        yaw_rad: yaw_rad.unwrap_or(0.0),
        is_upside_down: requested.is_imu_upside_down
            || configured.is_some_and(|imu| imu.is_upside_down),
    }
}

/// Returns the settings of a robot without a configuration. Nothing is connected or commanded, so
/// what only that needs is empty.
fn settings_of(model: &RobotModel, odometry_track_m: Option<f64>) -> Ros2Settings {
    Ros2Settings {
        bus: BusSettings {
            scheme: Scheme::Ros2Dds,
            mode: BusMode::Client,
            endpoint: String::new(),
            domain: 0,
            namespace: Name::default(),
            node: Name::default(),
        },
        timing: Timing {
            stamps: StampClock::Host,
            silent_after: tread_agent::drive::SILENT_AFTER_MAX,
            late_after: LATE_AFTER,
            pose_late_after: LATE_AFTER,
        },
        odometry: None,
        imu: None,
        joints: None,
        pose: None,
        battery: None,
        command: CommandSettings {
            topic: Name::default(),
            kind: CommandKind::Twist,
            frame: String::new(),
            base_radius_m: model.wheel_radius_m(),
            base_track_m: odometry_track_m.unwrap_or_else(|| model.track_width_m()),
            turn_sign: 1.0,
            forward_sign: 1.0,
            joints: [1, 1],
            joint_ratios: [1.0, 1.0],
        },
        outward: None,
    }
}

#[cfg(test)]
pub(crate) mod tests;
