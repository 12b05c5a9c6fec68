//! Decodes ROS messages, checks their values, and converts them to the agent's types and frames.
//!
//! Pure. A message that is not entirely valid is refused as a whole, with the reason.

use std::ops::RangeInclusive;

use tread_api::geometry::COORDINATE_MAX_M;
use tread_api::wire::state::VOLTAGE_MAX_V;
use tread_control::geometry::{Pose, wrap_angle_rad};
use tread_control::localisation::FixNoise;
use tread_control::measured::{BodyAcceleration, WheelSpeeds, WheelTorques};
use tread_control::robot::GRAVITY_M_S2;
use tread_ros2::cdr::decode;
use tread_ros2::messages::{
    self, BatteryState, Imu, JointState, Odometry, PoseWithCovarianceStamped, Time,
};

use super::refusal::Refusal;
use super::settings::{
    CommandSettings, ImuSettings, JointSettings, OdometrySettings, PoseSettings, SideJoints,
};
use crate::drive::Battery;

/// Accepted speeds and rates, m/s or rad/s.
const RATE_RANGE: RangeInclusive<f64> = -100.0..=100.0;
/// Accepted accelerations, m/s².
const ACCELERATION_RANGE_M_S2: RangeInclusive<f64> = -200.0..=200.0;
/// Largest accepted torque, N m.
const TORQUE_MAX_N_M: f64 = 1.0e5;
/// Accepted coordinates, metres.
const PLACE_RANGE_M: RangeInclusive<f64> = -COORDINATE_MAX_M..=COORDINATE_MAX_M;
/// Largest accepted standard deviation: metres (or m/s), radians.
const DEVIATION_MAX: f64 = 10.0;
/// Lower bounds of a fix's standard deviations, metres and radians; smaller ones are raised to
/// these.
const FIX_DEVIATION_MIN: (f64, f64) = (0.002, 0.001);

/// Content of a message.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Content {
    /// Wheel speeds and torques.
    Wheels(Wheels),
    /// Sample of the inertial measurement unit.
    Inertial(Inertial),
    /// Odometry.
    Motion(Motion),
    /// Position fix.
    Position(Position),
    /// The battery.
    Battery(Battery),
}

/// Wheel speeds and torques.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Wheels {
    /// Wheel speeds.
    pub speeds: WheelSpeeds,
    /// Wheel torques, if measured.
    pub torques: Option<WheelTorques>,
}

/// Sample of the inertial measurement unit, in the robot frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Inertial {
    /// Yaw rate, rad/s, positive to the left.
    pub yaw_rate_rad_s: f64,
    /// Standard deviation of the yaw rate, rad/s, if stated.
    pub yaw_rate_std_dev: Option<f64>,
    /// Acceleration along the ground, if measured.
    pub acceleration: Option<BodyAcceleration>,
    /// Whether it is the specific force, because no attitude says how much of it is gravity.
    pub is_specific_force: bool,
    /// Standard deviation of the acceleration, m/s², if stated.
    pub acceleration_std_dev: Option<f64>,
    /// Tilt against the vertical, radians, if the orientation is measured.
    pub tilt_rad: Option<f64>,
}

/// Odometry.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Motion {
    /// Forward speed, m/s.
    pub forward_m_s: f64,
    /// Standard deviation of the forward speed, m/s, if stated.
    pub forward_std_dev: Option<f64>,
    /// Yaw rate, rad/s, positive to the left.
    pub yaw_rate_rad_s: f64,
    /// Position fix, if the settings use the odometry's pose as one.
    pub position: Option<Position>,
}

/// Position fix in the site frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Position {
    /// Pose in the site frame.
    pub pose: Pose,
    /// Standard deviations, if stated.
    pub noise: Option<FixNoise>,
}

/// Stamp and content of a message. The stamp is not used for a battery.
pub type Reading = (Time, Content);

/// Returns the value if it is within its range.
fn bounded(value: f64, range: &RangeInclusive<f64>) -> Result<f64, Refusal> {
    // No range contains NaN.
    if range.contains(&value) {
        Ok(value)
    } else {
        Err(Refusal::Value)
    }
}

/// Returns the standard deviation of a variance; `None` for zero, which means unknown in ROS.
fn std_dev(variance: f64) -> Result<Option<f64>, Refusal> {
    if variance == 0.0 {
        return Ok(None);
    }
    let is_stated = variance > 0.0 && variance.sqrt() <= DEVIATION_MAX;
    is_stated
        .then(|| Some(variance.sqrt()))
        .ok_or(Refusal::Covariance)
}

/// Whether a 3 × 3 covariance states that its value is not measured (first element −1).
fn is_unmeasured(covariance: &[f64; 9]) -> bool {
    (covariance[0] + 1.0).abs() < f64::EPSILON
}

/// Returns the name of a frame without the slash that tf1 wrote before it.
pub(super) fn bare(frame: &str) -> &str {
    frame.strip_prefix('/').unwrap_or(frame)
}

/// Converts a ROS pose to a planar pose in the site frame.
fn site_pose(site_from_frame: Pose, pose: &messages::Pose) -> Result<Pose, Refusal> {
    let x_m = bounded(pose.position.x, &PLACE_RANGE_M)?;
    let y_m = bounded(pose.position.y, &PLACE_RANGE_M)?;
    let heading_rad = pose.orientation.yaw_rad().ok_or(Refusal::Value)?;
    let (sin, cos) = site_from_frame.heading_rad.sin_cos();
    Ok(Pose {
        x_m: site_from_frame.x_m + cos * x_m - sin * y_m,
        y_m: site_from_frame.y_m + sin * x_m + cos * y_m,
        heading_rad: wrap_angle_rad(site_from_frame.heading_rad + heading_rad),
    })
}

fn position(
    site_from_frame: Pose,
    pose: &messages::PoseWithCovariance,
) -> Result<Position, Refusal> {
    let covariance = &pose.covariance;
    if !covariance
        .as_flattened()
        .iter()
        .all(|value| value.is_finite())
    {
        return Err(Refusal::Covariance);
    }
    // Diagonal indices of x, y and the rotation about z.
    let [x_m, y_m, heading_rad] = [0, 1, 5].map(|at: usize| std_dev(covariance[at][at]));
    let (place_min_m, heading_min_rad) = FIX_DEVIATION_MIN;
    let noise = match (x_m?, y_m?, heading_rad?) {
        (Some(x_m), Some(y_m), Some(heading_rad)) => Some(FixNoise {
            position_m: x_m.max(y_m).max(place_min_m),
            heading_rad: heading_rad.max(heading_min_rad),
        }),
        _ => None,
    };
    Ok(Position {
        pose: site_pose(site_from_frame, &pose.pose)?,
        noise,
    })
}

/// Reads `sensor_msgs/JointState`; `None` if it has none of the robot's joints.
///
/// # Errors
/// [`Refusal`]: the reason why the message is not valid.
pub fn joints(bytes: &[u8], settings: &JointSettings) -> Result<Option<Reading>, Refusal> {
    let message: JointState<'_> = decode(bytes)?;
    let count = message.name.len();
    let is_known = |name: &str| {
        let sides = [&settings.left, &settings.right];
        sides
            .iter()
            .any(|side| side.names.iter().any(|known| known == name))
    };
    if !message.name.iter().any(is_known) {
        return Ok(None);
    }
    if message.velocity.len() != count {
        return Err(Refusal::Joints);
    }
    let has_effort = message.effort.len() == count;
    let side = |joints: &SideJoints| -> Result<(f64, Option<f64>), Refusal> {
        let (mut speed_rad_s, mut torque_n_m) = (0.0, Some(0.0));
        for known in &joints.names {
            let index = message.name.iter().position(|name| name == known);
            let index = index.ok_or(Refusal::Joints)?;
            let turned = message.velocity.get(index).ok_or(Refusal::Joints)?;
            speed_rad_s += bounded(turned / settings.gear_ratio, &RATE_RANGE)?;
            let effort = message.effort.get(index).filter(|_| has_effort);
            torque_n_m = match (settings.effort.torque_n_m(), effort) {
                (Some(constant), Some(effort)) => {
                    let pulled = effort * constant * joints.effort_sign * settings.gear_ratio;
                    // Some bases write NaN for an effort that they do not measure.
                    torque_n_m
                        .filter(|_| pulled.abs() <= TORQUE_MAX_N_M)
                        .map(|sum| sum + pulled)
                }
                _ => None,
            };
        }
        let wheels = f64::from(u32::try_from(joints.names.len()).unwrap_or(u32::MAX));
        Ok((
            joints.sign * speed_rad_s / wheels,
            torque_n_m.map(|torque_n_m| joints.sign * torque_n_m),
        ))
    };
    let ((left_rad_s, left_n_m), (right_rad_s, right_n_m)) =
        (side(&settings.left)?, side(&settings.right)?);
    let wheels = Wheels {
        speeds: WheelSpeeds {
            left_rad_s,
            right_rad_s,
        },
        torques: left_n_m
            .zip(right_n_m)
            .map(|(left_n_m, right_n_m)| WheelTorques {
                left_n_m,
                right_n_m,
            }),
    };
    Ok(Some((message.header.stamp, Content::Wheels(wheels))))
}

/// Reads `sensor_msgs/Imu`.
///
/// # Errors
/// [`Refusal`]: the reason why the message is not valid.
pub fn imu(bytes: &[u8], settings: &ImuSettings) -> Result<Reading, Refusal> {
    let message: Imu<'_> = decode(bytes)?;
    if bare(message.header.frame_id) != settings.frame {
        return Err(Refusal::WrongFrame);
    }
    if is_unmeasured(&message.angular_velocity_covariance) {
        return Err(Refusal::Value);
    }
    // Mounted upside down, rotated about x: y and z change their signs.
    let flip = if settings.is_upside_down { -1.0 } else { 1.0 };
    let up = if is_unmeasured(&message.orientation_covariance) {
        None
    } else {
        message.orientation.up()
    };
    let tilt_rad = up.map(|up| (flip * up.z).clamp(-1.0, 1.0).acos());
    let acceleration = if is_unmeasured(&message.linear_acceleration_covariance) {
        None
    } else {
        let felt = message.linear_acceleration;
        let range = ACCELERATION_RANGE_M_S2;
        // Without an orientation nothing is removed.
        let up = up.unwrap_or_default();
        let x = bounded(felt.x, &range)? - GRAVITY_M_S2 * up.x;
        let y = flip * (bounded(felt.y, &range)? - GRAVITY_M_S2 * up.y);
        let (sin, cos) = settings.yaw_rad.sin_cos();
        Some(BodyAcceleration {
            forward_m_s2: cos * x - sin * y,
            left_m_s2: sin * x + cos * y,
        })
    };
    // Drivers without an attitude state the identity, or that there is none. A simulation without
    // gravity gives accelerations without it.
    let has_attitude = up.is_some_and(|up| up.x != 0.0 || up.y != 0.0);
    let has_gravity = message.linear_acceleration.z.abs() > 0.5 * GRAVITY_M_S2;
    let acceleration_std_dev = match acceleration {
        Some(_) => std_dev(message.linear_acceleration_covariance[0])?,
        None => None,
    };
    let inertial = Inertial {
        yaw_rate_rad_s: flip * bounded(message.angular_velocity.z, &RATE_RANGE)?,
        yaw_rate_std_dev: std_dev(message.angular_velocity_covariance[8])?,
        acceleration,
        is_specific_force: has_gravity && !has_attitude,
        acceleration_std_dev,
        tilt_rad,
    };
    Ok((message.header.stamp, Content::Inertial(inertial)))
}

/// Reads `nav_msgs/Odometry`.
///
/// # Errors
/// [`Refusal`]: the reason why the message is not valid.
pub fn odometry(bytes: &[u8], settings: &OdometrySettings) -> Result<Reading, Refusal> {
    let message: Odometry<'_> = decode(bytes)?;
    let is_of_frame = bare(message.header.frame_id) == settings.frame;
    if !is_of_frame || bare(message.child_frame_id) != settings.child_frame {
        return Err(Refusal::WrongFrame);
    }
    let (twist, covariance) = (&message.twist.twist, &message.twist.covariance);
    let position = match settings.site_from_odom {
        Some(site_from_odom) => Some(position(site_from_odom, &message.pose)?),
        None => None,
    };
    let motion = Motion {
        forward_m_s: bounded(twist.linear.x, &RATE_RANGE)?,
        forward_std_dev: std_dev(covariance[0][0])?,
        yaw_rate_rad_s: bounded(twist.angular.z, &RATE_RANGE)?,
        position,
    };
    Ok((message.header.stamp, Content::Motion(motion)))
}

/// Reads `geometry_msgs/PoseWithCovarianceStamped`.
///
/// # Errors
/// [`Refusal`]: the reason why the message is not valid.
pub fn pose(bytes: &[u8], settings: &PoseSettings) -> Result<Reading, Refusal> {
    let message: PoseWithCovarianceStamped<'_> = decode(bytes)?;
    if bare(message.header.frame_id) != settings.frame {
        return Err(Refusal::WrongFrame);
    }
    let position = position(settings.site_from_map, &message.pose)?;
    Ok((message.header.stamp, Content::Position(position)))
}

/// Reads `sensor_msgs/BatteryState`; `None` if no battery is present.
///
/// # Errors
/// [`Refusal`]: the reason why the message is not valid.
pub fn battery(bytes: &[u8]) -> Result<Option<Reading>, Refusal> {
    let message: BatteryState<'_> = decode(bytes)?;
    if !message.present {
        return Ok(None);
    }
    let charge_ratio = f64::from(message.percentage);
    let voltage_v = f64::from(message.voltage);
    if !(0.0..=1.0).contains(&charge_ratio) || !(0.0..=VOLTAGE_MAX_V).contains(&voltage_v) {
        return Err(Refusal::Value);
    }
    let battery = Battery {
        charge_ratio,
        voltage_v,
    };
    Ok(Some((message.header.stamp, Content::Battery(battery))))
}

/// Computes the wheel speeds from which the base computed this motion.
pub fn wheels_of(motion: &Motion, command: &CommandSettings) -> WheelSpeeds {
    let turn_m_s = 0.5 * command.base_track_m * motion.yaw_rate_rad_s;
    WheelSpeeds {
        left_rad_s: (motion.forward_m_s - turn_m_s) / command.base_radius_m,
        right_rad_s: (motion.forward_m_s + turn_m_s) / command.base_radius_m,
    }
}
