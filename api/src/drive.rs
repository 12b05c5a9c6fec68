//! Messages of teleoperation over `GET /v1/sites/{site}/robots/{robot}/drive`, a WebSocket with one
//! JSON object in each text frame: [`DriveRequest`] from the client, [`DriveUpdate`] from the
//! server.
//!
//! Every socket shows the robot; at most one socket per robot drives it, with a lease that the
//! robot itself grants. A driver sends [`DriveRequest::Drive`] repeatedly: the robot's target
//! velocity is zero at the latest 250 ms after the end of the last command.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;
use uuid::Uuid;

use crate::geometry::{Pose, Twist};
use crate::robot::{Aged, LinkState, MissionProgress, RobotMode};
use crate::safety::{Lease, SafetyStatus};
use crate::stop::Stop;

/// Maximum size of a text frame from a client, bytes; the server closes the socket on a larger one.
pub const DRIVE_FRAME_MAX: usize = 4_096;
/// Default duration of a drive command, milliseconds.
pub const DRIVE_FOR_DEFAULT_MS: u64 = 250;
/// Minimum duration of a drive command, milliseconds.
pub const DRIVE_FOR_MIN_MS: u64 = 20;
/// Maximum duration of a drive command, milliseconds.
pub const DRIVE_FOR_MAX_MS: u64 = 500;
/// Period of [`DriveUpdate::View`] on a drive socket, milliseconds.
pub const DRIVE_VIEW_PERIOD_MS: u64 = 100;

/// Message from the client of a drive socket.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum DriveRequest {
    /// Acquires the lease; refused if another socket has it.
    Acquire(DriverName),
    /// Takes the lease, also from another socket that has it.
    Take(DriverName),
    /// Gives the lease back; the robot's target velocity is zero at once.
    Release(EmptyBody),
    /// Commands a velocity for a limited time. A newer command replaces an older one.
    Drive(Drive),
    /// Stops the robot and latches the stop. Needs no lease.
    Stop(StopReason),
}

/// Object without fields.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct EmptyBody {}

/// Person who asks for the lease.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct DriverName {
    /// Name for people, shown to others whose requests are refused; the token's name is put before
    /// it.
    #[serde(deserialize_with = "crate::text::bounded::<_, {crate::safety::BY_LENGTH_MAX}>")]
    pub name: String,
}

/// Velocity command of the driver.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct Drive {
    /// Forward velocity, m/s, negative backwards; the robot reduces values above its limits.
    pub linear_m_s: f64,
    /// Yaw rate, rad/s, positive counter-clockwise; the robot reduces values above its limits.
    pub angular_rad_s: f64,
    /// Duration of the command, milliseconds; 250 when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(minimum = 20, maximum = 500)]
    pub for_ms: Option<u64>,
}

/// Author and reason of a stop, for people.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct StopReason {
    /// Name of the person who requests the stop; the server puts the token's name before it.
    #[serde(
        default,
        skip_serializing_if = "Option::is_none",
        deserialize_with = "crate::text::bounded_option::<_, {crate::stop::STOP_TEXT_MAX}>"
    )]
    pub by: Option<String>,
    /// Reason of the stop.
    #[serde(
        default,
        skip_serializing_if = "Option::is_none",
        deserialize_with = "crate::text::bounded_option::<_, {crate::stop::STOP_TEXT_MAX}>"
    )]
    pub reason: Option<String>,
}

/// Message from the server on a drive socket.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum DriveUpdate {
    /// First message on the socket.
    Welcome {
        /// Identifier of this socket, as leases contain it in `driver.client`.
        client: Uuid,
    },
    /// This socket has the lease.
    Leased(Lease),
    /// This socket no longer has the lease.
    Released {
        /// Reason, for programs.
        cause: ReleaseCause,
        /// Reason, for people.
        detail: String,
    },
    /// A request was refused.
    Refused {
        /// Reason, for programs.
        cause: DriveRefusal,
        /// Reason, for people; names who has the lease when `cause` is `leased`.
        detail: String,
    },
    /// The requested stop, confirmed by the robot or not.
    Stopped(Box<Stop>),
    /// Latest state of the robot, sent ten times a second.
    View(Box<DriveView>),
    /// The server closes the socket.
    Ended {
        /// Reason, for people.
        detail: String,
    },
}

/// Reason why a socket no longer has the lease.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum ReleaseCause {
    /// The socket gave the lease back.
    Released,
    /// Another socket took the lease.
    Taken,
    /// The lease has ended on the robot: the agent restarted, or the driver sent nothing for too
    /// long.
    Lost,
}

/// Reason why a request on a drive socket was refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum DriveRefusal {
    /// Another socket has the lease.
    Leased,
    /// This socket has no lease.
    NoLease,
    /// A stop is in force; the robot does not move until it is cleared.
    Stopped,
    /// The token does not have the right `drive` for this robot.
    Forbidden,
    /// The robot does not answer, or is offline.
    Unreachable,
    /// The robot refused the request for another reason.
    Refused,
}

/// State of a robot as a drive socket shows it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct DriveView {
    /// Link state of the robot.
    pub link: LinkState,
    /// Time since the server received the robot's last state, milliseconds; `null` before the first
    /// one.
    #[serde(alias = "heard_age_ms")]
    pub state_age_ms: Option<u64>,
    /// Operating mode; `null` before the first state.
    pub mode: Option<RobotMode>,
    /// Pose in the site frame; `null` if unknown.
    pub pose: Option<Aged<Pose>>,
    /// Velocity in the robot frame; `null` if unknown.
    pub twist: Option<Aged<Twist>>,
    /// Progress of the robot's active mission; `null` without one.
    pub mission: Option<MissionProgress>,
    /// Stops, leases, limits and everything else that reduces the robot's speed.
    pub safety: SafetyStatus,
    /// Age of drive commands at the robot, as the robot reports it, plus this socket's round-trip
    /// time, milliseconds; `null` while one of the two is unknown.
    pub latency_ms: Option<f64>,
    /// Round-trip time of this socket, milliseconds; `null` before the first pong.
    pub socket_ms: Option<f64>,
}
