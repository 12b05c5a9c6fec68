//! Teleoperation over `GET /v1/sites/{site}/robots/{robot}/drive`, a WebSocket with one JSON
//! object in each text frame.
//!
//! Every socket observes; at most one of a robot's drives, with a lease that the robot itself
//! gives. A driver sends [`DriveRequest::Drive`] again and again: the robot's target is zero at
//! the latest 250 ms after the end of the last one.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;
use uuid::Uuid;

use crate::geometry::{Pose, Twist};
use crate::robot::{Aged, LinkState, MissionProgress, RobotMode};
use crate::safety::{Lease, SafetyStatus};
use crate::stop::Stop;

/// Largest text frame from a client, in bytes.
pub const DRIVE_FRAME_MAX: usize = 4_096;
/// How long a drive command lasts when nothing is said, milliseconds.
pub const DRIVE_FOR_DEFAULT_MS: u64 = 250;
/// Shortest and longest that a drive command may last, milliseconds.
pub const DRIVE_FOR_MIN_MS: u64 = 20;
/// Longest that a drive command may last, milliseconds.
pub const DRIVE_FOR_MAX_MS: u64 = 500;
/// Time between two views of the robot on a drive socket, milliseconds.
pub const DRIVE_VIEW_PERIOD_MS: u64 = 100;

/// What a client sends.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum DriveRequest {
    /// Take the lease, if nobody else has it.
    Acquire(DriverName),
    /// Take the lease, whoever has it now.
    Take(DriverName),
    /// Give the lease back; the robot's target is zero at once.
    Release(Nothing),
    /// Drive like this for a while. The newest counts.
    Drive(Drive),
    /// Stop the robot, and latch it. Needs no lease.
    Stop(StopWords),
}

/// An object without fields.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct Nothing {}

/// Who wants to drive.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct DriverName {
    /// Name for people; others see it when they are refused, behind the token's name.
    #[serde(deserialize_with = "crate::text::bounded::<_, {crate::safety::BY_LENGTH_MAX}>")]
    pub name: String,
}

/// What a driver wants.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct Drive {
    /// Forward velocity, m/s; the robot reduces what is beyond its limits.
    pub linear_m_s: f64,
    /// Yaw rate, rad/s, counter-clockwise.
    pub angular_rad_s: f64,
    /// How long it lasts, milliseconds; 250 when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(minimum = 20, maximum = 500)]
    pub for_ms: Option<u64>,
}

/// Why to stop, for people.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct StopWords {
    /// Who stops; the token's name stands before it, and alone when absent.
    #[serde(
        default,
        skip_serializing_if = "Option::is_none",
        deserialize_with = "crate::text::bounded_option::<_, {crate::stop::STOP_TEXT_MAX}>"
    )]
    pub by: Option<String>,
    /// Why.
    #[serde(
        default,
        skip_serializing_if = "Option::is_none",
        deserialize_with = "crate::text::bounded_option::<_, {crate::stop::STOP_TEXT_MAX}>"
    )]
    pub reason: Option<String>,
}

/// What the server sends.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum DriveUpdate {
    /// The first frame: who this socket is.
    Welcome {
        /// The socket, as leases name it.
        client: Uuid,
    },
    /// This socket has the lease.
    Leased(Lease),
    /// This socket no longer has the lease.
    Released {
        /// Why.
        cause: ReleaseCause,
        /// For people.
        detail: String,
    },
    /// Something was not done.
    Refused {
        /// Why.
        cause: DriveRefusal,
        /// For people; names who has the lease.
        detail: String,
    },
    /// The requested stop, confirmed or not.
    Stopped(Box<Stop>),
    /// The robot's newest state, ten times a second.
    View(Box<DriveView>),
    /// The server closes the socket.
    Ended {
        /// For people.
        detail: String,
    },
}

/// Why a socket no longer has the lease.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum ReleaseCause {
    /// It gave it back.
    Released,
    /// Somebody took it.
    Taken,
    /// The robot no longer knows it: it restarted, or the driver was silent for too long.
    Lost,
}

/// Why something was not done.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum DriveRefusal {
    /// Somebody else has the lease.
    Leased,
    /// This socket has no lease.
    NoLease,
    /// A stop is in force; nothing is driven until it is cleared.
    Stopped,
    /// The token's role may watch and stop, not drive.
    Forbidden,
    /// The robot does not answer, or has not been heard.
    Unreachable,
    /// The robot will not.
    Refused,
}

/// A robot as a drive socket shows it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct DriveView {
    /// Whether its heartbeat arrives at the server.
    pub link: LinkState,
    /// Time since its last state, milliseconds.
    pub heard_age_ms: Option<u64>,
    /// What it is doing.
    pub mode: Option<RobotMode>,
    /// Where it is.
    pub pose: Option<Aged<Pose>>,
    /// How fast it moves.
    pub twist: Option<Aged<Twist>>,
    /// The mission in its hand.
    pub mission: Option<MissionProgress>,
    /// Its stop, its lease, what reduces it.
    pub safety: SafetyStatus,
    /// Age of drive commands at the robot, as it reports, plus this socket's round-trip time,
    /// milliseconds; `null` while one of the two is not known.
    pub latency_ms: Option<f64>,
    /// Round-trip time of this socket, milliseconds.
    pub socket_ms: Option<f64>,
}
