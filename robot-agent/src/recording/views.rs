//! Writes the recorded data as standard ROS messages, for programs that do not read the agent's
//! own.
//!
//! A replay does not read these messages; it reads those of [`super::codec`].

use std::time::Duration;

use tread_api::robot::RobotMode;
use tread_control::geometry::Pose as PlanePose;
use tread_control::geometry::Twist as PlaneTwist;
use tread_control::plan::Plan;
use tread_control::robot::GRAVITY_M_S2;
use tread_ros2::cdr::{Sequence, encode};
use tread_ros2::messages::{
    DiagnosticArray, DiagnosticStatus, Header, Imu, JointState, KeyValue, Level, Odometry, Path,
    Point, Pose, PoseStamped, PoseWithCovariance, PoseWithCovarianceStamped, Quaternion, Time,
    Twist, TwistStamped, TwistWithCovariance, Vector3,
};

use crate::control_loop::channels::Fault;
use crate::control_loop::frame::TickFrame;
use crate::drive::SensorSample;

/// Frame of positions and poses.
pub(crate) const SITE_FRAME: &str = "site";
/// Frame of the robot.
pub(crate) const BASE_FRAME: &str = "base_link";
/// Joint names of the wheels of each side, `[left, right]`.
const JOINTS: [&str; 2] = ["left_wheels", "right_wheels"];
/// Largest number of points of a path.
pub(crate) const PATH_POINTS_MAX: u32 = 500;
/// Distance between two points of a path, metres, larger if [`PATH_POINTS_MAX`] would be exceeded.
const PATH_SPACING_M: f64 = 0.1;

/// Converts a planar pose.
pub(crate) fn pose_message(pose: PlanePose) -> Pose {
    let (sin, cos) = (0.5 * pose.heading_rad).sin_cos();
    Pose {
        position: Point {
            x: pose.x_m,
            y: pose.y_m,
            z: 0.0,
        },
        orientation: Quaternion {
            x: 0.0,
            y: 0.0,
            z: sin,
            w: cos,
        },
    }
}

fn twist_message(twist: PlaneTwist) -> Twist {
    Twist {
        linear: Vector3 {
            x: twist.linear_m_s,
            ..Vector3::default()
        },
        angular: Vector3 {
            z: twist.angular_rad_s,
            ..Vector3::default()
        },
    }
}

/// Returns the header of a message at `wall_ns`, nanoseconds since the Unix epoch.
pub(crate) fn header(wall_ns: i64, frame_id: &str) -> Header<'_> {
    Header {
        stamp: Time::from_nanoseconds(wall_ns),
        frame_id,
    }
}

/// Returns the measuring time of a sample by the wall clock of its tick, nanoseconds since the Unix
/// epoch.
pub(super) fn sample_wall_ns(frame: &TickFrame, wall_ns: i64, sample: &SensorSample) -> i64 {
    let age = frame.inputs.now.monotonic.saturating_sub(sample.at);
    wall_ns.saturating_sub(i64::try_from(age.as_nanos()).unwrap_or(i64::MAX))
}

/// Encodes the estimated pose and twist; false if the pose is unknown.
pub(super) fn odometry(frame: &TickFrame, wall_ns: i64, into: &mut Vec<u8>) -> bool {
    let Some(pose) = frame.outputs.pose else {
        return false;
    };
    let message = Odometry {
        header: header(wall_ns, SITE_FRAME),
        child_frame_id: BASE_FRAME,
        pose: PoseWithCovariance {
            pose: pose_message(pose),
            ..PoseWithCovariance::default()
        },
        twist: TwistWithCovariance {
            twist: twist_message(frame.outputs.twist),
            ..TwistWithCovariance::default()
        },
    };
    encode(&message, into);
    true
}

/// Encodes the twist of the commanded wheel speeds without slip.
pub(super) fn commanded(twist: PlaneTwist, wall_ns: i64, into: &mut Vec<u8>) {
    let message = TwistStamped {
        header: header(wall_ns, BASE_FRAME),
        twist: twist_message(twist),
    };
    encode(&message, into);
}

/// Encodes yaw rate and acceleration; false if the sample has neither.
pub(super) fn imu(sample: &SensorSample, wall_ns: i64, into: &mut Vec<u8>) -> bool {
    if sample.yaw_rate_rad_s.is_none() && sample.acceleration.is_none() {
        return false;
    }
    let unmeasured = |is_unmeasured: bool| {
        let mut covariance = [0.0; 9];
        covariance[0] = if is_unmeasured { -1.0 } else { 0.0 };
        covariance
    };
    let acceleration = sample.acceleration.unwrap_or_default();
    let message = Imu {
        header: header(wall_ns, BASE_FRAME),
        orientation_covariance: unmeasured(true),
        angular_velocity: Vector3 {
            z: sample.yaw_rate_rad_s.unwrap_or_default(),
            ..Vector3::default()
        },
        angular_velocity_covariance: unmeasured(sample.yaw_rate_rad_s.is_none()),
        linear_acceleration: Vector3 {
            x: acceleration.forward_m_s2,
            y: acceleration.left_m_s2,
            z: if sample.is_specific_force {
                GRAVITY_M_S2
            } else {
                0.0
            },
        },
        linear_acceleration_covariance: unmeasured(sample.acceleration.is_none()),
        ..Imu::default()
    };
    encode(&message, into);
    true
}

/// Encodes wheel speeds and torques; false if the sample has neither.
pub(super) fn joints(sample: &SensorSample, wall_ns: i64, into: &mut Vec<u8>) -> bool {
    let velocity = sample
        .wheel_speeds
        .map(|wheels| [wheels.left_rad_s, wheels.right_rad_s]);
    let effort = sample
        .wheel_torques
        .map(|torques| [torques.left_n_m, torques.right_n_m]);
    if velocity.is_none() && effort.is_none() {
        return false;
    }
    let message = JointState {
        header: header(wall_ns, BASE_FRAME),
        name: Sequence::from(&JOINTS),
        velocity: velocity.as_ref().map(Sequence::from).unwrap_or_default(),
        effort: effort.as_ref().map(Sequence::from).unwrap_or_default(),
        ..JointState::default()
    };
    encode(&message, into);
    true
}

/// Encodes the position fix; false if the sample has none.
pub(super) fn fix(sample: &SensorSample, wall_ns: i64, into: &mut Vec<u8>) -> bool {
    let Some(pose) = sample.position else {
        return false;
    };
    let mut message = PoseWithCovarianceStamped {
        header: header(wall_ns, SITE_FRAME),
        pose: PoseWithCovariance {
            pose: pose_message(pose),
            ..PoseWithCovariance::default()
        },
    };
    if let Some(noise) = sample.position_noise {
        let covariance = &mut message.pose.covariance;
        covariance[0][0] = noise.position_m * noise.position_m;
        covariance[1][1] = covariance[0][0];
        covariance[5][5] = noise.heading_rad * noise.heading_rad;
    }
    encode(&message, into);
    true
}

/// Encodes a path of at most [`PATH_POINTS_MAX`] points; the rest is dropped.
pub(crate) fn path(poses: &[PlanePose], frame: &str, wall_ns: i64, into: &mut Vec<u8>) {
    let head = header(wall_ns, frame);
    let poses: Vec<PoseStamped<'_>> = poses
        .iter()
        .take(PATH_POINTS_MAX as usize)
        .map(|pose| PoseStamped {
            header: head,
            pose: pose_message(*pose),
        })
        .collect();
    let message = Path {
        header: head,
        poses: Sequence::from(poses.as_slice()),
    };
    encode(&message, into);
}

/// Returns equally spaced poses along a plan, at most [`PATH_POINTS_MAX`], including its end.
pub(crate) fn poses_of(plan: &Plan) -> Vec<PlanePose> {
    let length_m = plan.length_m();
    let spacing_m = PATH_SPACING_M.max(length_m / f64::from(PATH_POINTS_MAX - 1));
    // The last point is the end of the plan.
    let inner = (0..PATH_POINTS_MAX - 1).map(|step| f64::from(step) * spacing_m);
    inner
        .take_while(|arc_m| *arc_m < length_m)
        .chain([length_m])
        .map(|arc_m| plan.path().sample(arc_m).pose)
        .collect()
}

/// Returns the diagnostic level and the description of a state.
pub(crate) fn state(mode: RobotMode, fault: Option<Fault>) -> (Level, &'static str) {
    match (mode, fault) {
        (_, Some(fault)) => (Level::Error, fault.text()),
        (RobotMode::Stopped, _) => (Level::Warn, "stopped"),
        (RobotMode::Teleoperated, _) => (Level::Ok, "teleoperated"),
        (RobotMode::Tracking, _) => (Level::Ok, "on a mission"),
        (RobotMode::Idle | RobotMode::Fault, _) => (Level::Ok, "idle"),
    }
}

/// Encodes the diagnostics of a tick; `lost` is the number of notes lost so far.
pub(super) fn diagnostics(frame: &TickFrame, robot: &str, lost: u64, into: &mut Vec<u8>) {
    let outputs = &frame.outputs;
    let (level, text) = state(outputs.mode, outputs.fault);
    let wall_ns = i64::try_from(frame.inputs.now.wall.as_nanosecond()).unwrap_or(i64::MAX);
    let gate = outputs.gate.map(|cause| format!("{cause:?}"));
    let silence_s = seconds(frame.inputs.server_silence);
    let (number, lost) = (frame.number.to_string(), lost.to_string());
    let values = [
        ("tick", number.as_str()),
        ("gate", gate.as_deref().unwrap_or("open")),
        ("server silent for, s", &silence_s),
        ("notes lost", &lost),
    ];
    let values = values.map(|(key, value)| KeyValue { key, value });
    let status = [DiagnosticStatus {
        level: level as u8,
        name: "tread_agent: control loop",
        message: text,
        hardware_id: robot,
        values: Sequence::from(&values),
    }];
    let message = DiagnosticArray {
        header: header(wall_ns, ""),
        status: Sequence::from(&status),
    };
    encode(&message, into);
}

fn seconds(time: Duration) -> String {
    format!("{:.3}", time.as_secs_f64())
}
