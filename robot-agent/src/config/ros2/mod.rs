//! Checks `[drive.ros2]` of `robot.toml` and converts it to [`Ros2Settings`].

mod file;
mod outward;
#[cfg(test)]
mod tests;

use std::ops::RangeInclusive;
use std::time::Duration;

use tread_api::robot::RobotModel;
use tread_control::geometry::Pose;
use tread_ros2::names::{Name, NameError};
use tread_ros2::rmw::Generation;

pub(super) use file::Ros2File;
use file::{
    CommandFile, CommandFileKind, DistributionFile, EffortFile, ImuFile, JointsFile, ModeFile,
    MotionFile, OdometryFile, PoseFile, SchemeFile, StampsFile,
};

use super::place::is_here;
use super::{ConfigError, Key, within};
use crate::drive::SILENT_AFTER_MAX;
use crate::drive::ros2::settings::{
    BusMode, BusSettings, CommandKind, CommandSettings, Effort, ImuSettings, JOINTS_MAX,
    JointSettings, MotionOf, OdometrySettings, PoseSettings, Ros2Settings, Scheme, SideJoints,
    StampClock, Timing,
};

/// Default endpoint of the robot's own router.
const ENDPOINT_DEFAULT: &str = "tcp/127.0.0.1:7447";
/// Largest ROS 2 domain.
const DOMAIN_MAX: u32 = 232;
/// Smallest permitted `silent_after`, milliseconds.
const SILENT_AFTER_MIN_MS: f64 = 30.0;
/// Largest permitted age of a pose, milliseconds: localisation propagates none for longer.
const POSE_LATE_AFTER_MAX_MS: f64 = 1_000.0;
/// Permitted gear ratios and torque constants.
const RATIO_RANGE: std::ops::RangeInclusive<f64> = 1.0e-3..=1.0e4;
/// Permitted wheel radius and track width of the base, metres.
const LENGTH_RANGE_M: std::ops::RangeInclusive<f64> = 1.0e-3..=100.0;

fn refused(Key(key): Key, problem: impl Into<String>) -> ConfigError {
    ConfigError::OutOfRange {
        key,
        problem: problem.into(),
    }
}

fn named(key: &'static str) -> impl FnOnce(NameError) -> ConfigError {
    move |problem| refused(Key(key), problem.to_string())
}

fn sign(key: &'static str, sign: Option<f64>) -> Result<f64, ConfigError> {
    let sign = sign.unwrap_or(1.0);
    if (sign.abs() - 1.0).abs() < f64::EPSILON {
        Ok(sign)
    } else {
        Err(refused(Key(key), "it is 1 or -1"))
    }
}

fn milliseconds(
    key: &'static str,
    span_ms: f64,
    range_ms: &RangeInclusive<f64>,
) -> Result<Duration, ConfigError> {
    within(key, span_ms, range_ms)?;
    Ok(Duration::from_secs_f64(span_ms * 1.0e-3))
}

fn place(key: &'static str, [x_m, y_m, heading_rad]: [f64; 3]) -> Result<Pose, ConfigError> {
    let pose = Pose {
        x_m,
        y_m,
        heading_rad,
    };
    if pose.is_finite() {
        Ok(pose)
    } else {
        Err(refused(Key(key), "a place is finite numbers"))
    }
}

/// A topic's setting: its key, for errors, and its default.
struct TopicSetting {
    key: &'static str,
    default: &'static str,
}

/// Resolves the names of topics.
struct Topics {
    namespace: Name,
}

impl Topics {
    fn name(&self, setting: &TopicSetting, given: Option<&str>) -> Result<Name, ConfigError> {
        let text = given.unwrap_or(setting.default);
        Name::topic(text, &self.namespace).map_err(named(setting.key))
    }
}

fn text(given: Option<&str>, default: &str) -> String {
    given.unwrap_or(default).to_owned()
}

impl Ros2File {
    /// Checks all keys and returns the settings.
    ///
    /// # Errors
    /// [`ConfigError::OutOfRange`] names the key.
    pub(in crate::config) fn checked(
        &self,
        model: &RobotModel,
    ) -> Result<Ros2Settings, ConfigError> {
        let bus = self.bus()?;
        let topics = Topics {
            // The bridge's namespace precedes every topic, a node's only relative ones.
            namespace: match bus.scheme {
                Scheme::RmwZenoh(_) => bus.namespace.clone(),
                Scheme::Ros2Dds => Name::default(),
            },
        };
        let joints = self.joints.as_ref();
        let joints = joints.map(|joints| joints.checked(&topics)).transpose()?;
        let battery = self.battery.as_ref().map(|file| {
            let given = file.topic.as_deref();
            topics.name(
                &TopicSetting {
                    key: "drive.ros2.battery.topic",
                    default: "battery_state",
                },
                given,
            )
        });
        let settings = Ros2Settings {
            timing: self.timing()?,
            odometry: self
                .odometry
                .as_ref()
                .map(|file| file.checked(&topics))
                .transpose()?,
            imu: self
                .imu
                .as_ref()
                .map(|file| file.checked(&topics))
                .transpose()?,
            pose: self
                .pose
                .as_ref()
                .map(|file| file.checked(&topics))
                .transpose()?,
            battery: battery.transpose()?,
            command: self.command.checked(&topics, joints.as_ref(), model)?,
            outward: None,
            joints,
            bus,
        };
        check_whole(&settings)?;
        let outward = self.outward.checked(&topics, &settings)?;
        Ok(Ros2Settings {
            outward,
            ..settings
        })
    }

    fn bus(&self) -> Result<BusSettings, ConfigError> {
        let endpoint = text(self.endpoint.as_deref(), ENDPOINT_DEFAULT);
        if !is_here(&endpoint) {
            let problem =
                format!("`{endpoint}` is another machine: ROS keys never leave the robot");
            return Err(refused(Key("drive.ros2.endpoint"), problem));
        }
        if self.domain > DOMAIN_MAX {
            return Err(refused(
                Key("drive.ros2.domain"),
                format!("it is at most {DOMAIN_MAX}"),
            ));
        }
        let generation = match self.distribution {
            DistributionFile::Humble => Generation::Humble,
            DistributionFile::Iron
            | DistributionFile::Jazzy
            | DistributionFile::Kilted
            | DistributionFile::Lyrical
            | DistributionFile::Rolling => Generation::Hashed,
        };
        Ok(BusSettings {
            scheme: match self.bus {
                SchemeFile::RmwZenoh => Scheme::RmwZenoh(generation),
                SchemeFile::Ros2dds => Scheme::Ros2Dds,
            },
            mode: match self.mode {
                ModeFile::Client => BusMode::Client,
                ModeFile::Router => BusMode::Router,
            },
            endpoint,
            domain: self.domain,
            namespace: Name::namespace(&self.namespace).map_err(named("drive.ros2.namespace"))?,
            node: Name::node(self.node.as_deref().unwrap_or("tread_agent"))
                .map_err(named("drive.ros2.node"))?,
        })
    }

    fn timing(&self) -> Result<Timing, ConfigError> {
        let range_ms = SILENT_AFTER_MIN_MS..=SILENT_AFTER_MAX.as_secs_f64() * 1.0e3;
        let pose_range_ms = SILENT_AFTER_MIN_MS..=POSE_LATE_AFTER_MAX_MS;
        let silent_ms = self.silent_after_ms.unwrap_or(100.0);
        let late_ms = self.late_after_ms.unwrap_or(100.0);
        let (silent_key, late_key) = ("drive.ros2.silent_after_ms", "drive.ros2.late_after_ms");
        let pose_key = "drive.ros2.pose_late_after_ms";
        let pose_ms = self.pose_late_after_ms.unwrap_or(300.0);
        Ok(Timing {
            stamps: match self.stamps {
                StampsFile::Host => StampClock::Host,
                StampsFile::Base => StampClock::Base,
            },
            silent_after: milliseconds(silent_key, silent_ms, &range_ms)?,
            late_after: milliseconds(late_key, late_ms, &range_ms)?,
            pose_late_after: milliseconds(pose_key, pose_ms, &pose_range_ms)?,
        })
    }
}

/// Checks conditions that involve several sections.
fn check_whole(settings: &Ros2Settings) -> Result<(), ConfigError> {
    let odometry = settings.odometry.as_ref();
    let is_of_wheels = odometry.is_some_and(|odometry| odometry.motion_of == MotionOf::Wheels);
    if settings.joints.is_none() && !is_of_wheels {
        return Err(refused(
            Key("drive.ros2"),
            "the wheels' speeds come from nowhere: give [drive.ros2.joints], or \
             [drive.ros2.odometry] with motion_of = \"wheels\"",
        ));
    }
    if settings.imu.is_none() && odometry.is_none() {
        return Err(refused(
            Key("drive.ros2"),
            "the turn rate comes from nowhere: give [drive.ros2.imu] or [drive.ros2.odometry]",
        ));
    }
    let gives_position = odometry.is_some_and(|odometry| odometry.site_from_odom.is_some());
    if settings.pose.is_some() && gives_position {
        let problem = "[drive.ros2.pose] gives the position: two would quarrel";
        return Err(refused(Key("drive.ros2.odometry.gives_position"), problem));
    }
    Ok(())
}

impl OdometryFile {
    fn checked(&self, topics: &Topics) -> Result<OdometrySettings, ConfigError> {
        let site = [self.site_x_m, self.site_y_m, self.site_heading_rad];
        let site = place("drive.ros2.odometry.site_x_m", site)?;
        Ok(OdometrySettings {
            topic: topics.name(
                &TopicSetting {
                    key: "drive.ros2.odometry.topic",
                    default: "odom",
                },
                self.topic.as_deref(),
            )?,
            frame: text(self.frame.as_deref(), "odom"),
            child_frame: text(self.child_frame.as_deref(), "base_link"),
            motion_of: match self.motion_of {
                MotionFile::Wheels => MotionOf::Wheels,
                MotionFile::Ground => MotionOf::Ground,
            },
            site_from_odom: self.gives_position.then_some(site),
        })
    }
}

impl ImuFile {
    fn checked(&self, topics: &Topics) -> Result<ImuSettings, ConfigError> {
        if !self.yaw_rad.is_finite() {
            return Err(refused(Key("drive.ros2.imu.yaw_rad"), "it must be finite"));
        }
        Ok(ImuSettings {
            topic: topics.name(
                &TopicSetting {
                    key: "drive.ros2.imu.topic",
                    default: "imu/data",
                },
                self.topic.as_deref(),
            )?,
            frame: text(self.frame.as_deref(), "imu_link"),
            yaw_rad: self.yaw_rad,
            is_upside_down: self.upside_down,
        })
    }
}

impl PoseFile {
    fn checked(&self, topics: &Topics) -> Result<PoseSettings, ConfigError> {
        let site = [self.site_x_m, self.site_y_m, self.site_heading_rad];
        Ok(PoseSettings {
            topic: topics.name(
                &TopicSetting {
                    key: "drive.ros2.pose.topic",
                    default: "pose",
                },
                self.topic.as_deref(),
            )?,
            frame: text(self.frame.as_deref(), "map"),
            site_from_map: place("drive.ros2.pose.site_x_m", site)?,
        })
    }
}

impl JointsFile {
    fn checked(&self, topics: &Topics) -> Result<JointSettings, ConfigError> {
        let gear_ratio = self.gear_ratio.unwrap_or(1.0);
        within("drive.ros2.joints.gear_ratio", gear_ratio, &RATIO_RANGE)?;
        let constant = self.torque_constant_n_m_a;
        let key = "drive.ros2.joints.torque_constant_n_m_a";
        if let Some(constant) = constant {
            within(key, constant, &RATIO_RANGE)?;
        }
        let effort = match (self.effort, constant) {
            (EffortFile::None, _) => Effort::None,
            (EffortFile::Torque, None) => Effort::Torque,
            (EffortFile::Torque, Some(_)) => {
                return Err(refused(Key(key), "it is for effort = \"current\""));
            }
            (EffortFile::Current, Some(constant)) => Effort::Current(constant),
            (EffortFile::Current, None) => {
                return Err(refused(Key(key), "effort = \"current\" needs it"));
            }
        };
        let side = |key, names: &[String], [turns, pulls]: [(&'static str, Option<f64>); 2]| {
            if names.is_empty() || names.len() > JOINTS_MAX {
                return Err(refused(
                    Key(key),
                    format!("1 to {JOINTS_MAX} joints are needed"),
                ));
            }
            Ok(SideJoints {
                names: names.to_vec(),
                sign: sign(turns.0, turns.1)?,
                effort_sign: sign(pulls.0, pulls.1)?,
            })
        };
        if self.left.iter().any(|name| self.right.contains(name)) {
            return Err(refused(
                Key("drive.ros2.joints.right"),
                "a joint is on both sides",
            ));
        }
        Ok(JointSettings {
            topic: topics.name(
                &TopicSetting {
                    key: "drive.ros2.joints.topic",
                    default: "joint_states",
                },
                self.topic.as_deref(),
            )?,
            left: side(
                "drive.ros2.joints.left",
                &self.left,
                [
                    ("drive.ros2.joints.left_sign", self.left_sign),
                    ("drive.ros2.joints.left_effort_sign", self.left_effort_sign),
                ],
            )?,
            right: side(
                "drive.ros2.joints.right",
                &self.right,
                [
                    ("drive.ros2.joints.right_sign", self.right_sign),
                    (
                        "drive.ros2.joints.right_effort_sign",
                        self.right_effort_sign,
                    ),
                ],
            )?,
            gear_ratio,
            effort,
        })
    }
}

impl CommandFile {
    fn checked(
        &self,
        topics: &Topics,
        joints: Option<&JointSettings>,
        model: &RobotModel,
    ) -> Result<CommandSettings, ConfigError> {
        let kind = match self.kind {
            CommandFileKind::Twist => CommandKind::Twist,
            CommandFileKind::TwistStamped => CommandKind::TwistStamped,
            CommandFileKind::JointSpeeds => CommandKind::JointSpeeds,
        };
        if kind == CommandKind::JointSpeeds && joints.is_none() {
            let problem = "\"joint_speeds\" needs [drive.ros2.joints]";
            return Err(refused(Key("drive.ros2.command.kind"), problem));
        }
        let base_radius_m = self.wheel_radius_m.unwrap_or(model.wheel_radius_m);
        within(
            "drive.ros2.command.wheel_radius_m",
            base_radius_m,
            &LENGTH_RANGE_M,
        )?;
        let base_track_m = self.track_width_m.unwrap_or(model.track_width_m);
        within(
            "drive.ros2.command.track_width_m",
            base_track_m,
            &LENGTH_RANGE_M,
        )?;
        // Without joints one per side is assumed; no joint command is written then.
        let ratio = |side: &SideJoints, gear_ratio: f64| gear_ratio * side.sign;
        let (joints, joint_ratios) = joints.map_or(([1, 1], [1.0, 1.0]), |joints| {
            let (left, right, gear_ratio) = (&joints.left, &joints.right, joints.gear_ratio);
            (
                [left.names.len(), right.names.len()],
                [ratio(left, gear_ratio), ratio(right, gear_ratio)],
            )
        });
        Ok(CommandSettings {
            topic: topics.name(
                &TopicSetting {
                    key: "drive.ros2.command.topic",
                    default: "cmd_vel",
                },
                self.topic.as_deref(),
            )?,
            kind,
            frame: self.frame.clone().unwrap_or_else(|| "base_link".to_owned()),
            base_radius_m,
            base_track_m,
            turn_sign: sign("drive.ros2.command.turn_sign", self.turn_sign)?,
            forward_sign: sign("drive.ros2.command.forward_sign", self.forward_sign)?,
            joints,
            joint_ratios,
        })
    }
}
