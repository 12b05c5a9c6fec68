//! Functions that only reduce a robot's motion: stops, teleoperation leases, external limits,
//! geofences.
//!
//! The types are the same over REST and on zenoh. The robot is the authority on all of them, except
//! the geofence, which belongs to its site.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;
use uuid::Uuid;

use crate::geometry::Polygon;
use crate::ids::{OwnerId, StopId};

/// Maximum length of the name of a person or program that stops or drives, characters.
pub const BY_LENGTH_MAX: usize = 100;
/// Maximum number of external limits of one robot at a time.
pub const LIMITS_MAX: usize = 32;
/// Maximum time from now to the end of an external limit, microseconds: one hour.
pub const LIMIT_AHEAD_MAX_US: u64 = 3_600_000_000;
/// Maximum time from now to the end of a drive command, microseconds; a command with a later end is
/// refused.
pub const DRIVE_AHEAD_MAX_US: u64 = 1_000_000;
/// Silence of the driver after which a lease ends, microseconds.
pub const LEASE_SILENCE_MAX_US: u64 = 5_000_000;
/// Maximum size of the zenoh payload of a drive command or an external limit, bytes.
pub const SMALL_PAYLOAD_MAX: usize = 1_024;
/// Maximum number of polygons of a geofence.
pub const FENCE_POLYGONS_MAX: usize = 64;
/// Maximum number of corners of all polygons of a geofence together; the robot checks every corner
/// in each tick.
pub const FENCE_CORNERS_MAX: usize = 1_000;

/// Latched stop of a robot, in force until a person clears it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct StopLatch {
    /// Identifier of the newest stop; a request to clear it must name it.
    pub id: StopId,
    /// Name of the person or program that stopped the robot.
    #[serde(deserialize_with = "crate::text::bounded::<_, {crate::stop::STOP_TEXT_MAX}>")]
    pub by: String,
    /// Reason, for people.
    #[serde(deserialize_with = "crate::text::bounded::<_, {crate::mission::REASON_LENGTH_MAX}>")]
    pub reason: String,
    /// Time when the robot latched it, by the robot's wall clock.
    pub since: Timestamp,
}

/// Person who asks for, or has, the lease of teleoperation.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Driver {
    /// Identifier of one connection of the driver.
    pub client: Uuid,
    /// Name, for people, at most 100 characters.
    #[serde(deserialize_with = "crate::text::bounded::<_, {BY_LENGTH_MAX}>")]
    pub name: String,
}

/// Teleoperation lease that the robot granted.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Lease {
    /// Number of the lease, strictly increasing within one run of the agent.
    pub epoch: u64,
    /// Driver that has the lease.
    pub driver: Driver,
}

/// Cause for which the gate reduced a command before it reached the wheels, in ascending order of
/// strictness.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, ToSchema,
)]
#[serde(rename_all = "snake_case")]
pub enum GateCause {
    /// The command exceeded an acceleration limit of the robot or its wheels.
    Acceleration,
    /// The command exceeded a speed limit of the robot or its wheels.
    Speed,
    /// Drive commands arrive late; the later they arrive, the slower the robot drives.
    CommandAge,
    /// An external limit reduces the speed.
    ExternalLimit,
    /// The robot is near the geofence, or has crossed it.
    Fence,
    /// The command was not a finite number.
    NotFinite,
    /// There was no command.
    NoCommand,
    /// The driver is silent, or the lease has ended.
    Lease,
    /// The server was silent for longer than the mission allows.
    LinkPolicy,
    /// An external limit holds the robot, or a required owner is silent.
    ExternalHold,
    /// The control loop of the robot does not keep its rate.
    LoopOverrun,
    /// Sensors contradict each other; the robot is held or slowed down.
    SensorFault,
    /// The position of the robot is unknown or too old.
    StalePosition,
    /// The robot is tilted too far.
    Tilt,
    /// The base has sent no valid feedback for too long.
    StaleFeedback,
    /// A stop is in force.
    Stop,
    /// Cause that this version does not know, from a newer peer.
    #[serde(other)]
    Other,
}

/// Number of times that one cause began to be in force.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct GateCount {
    /// The cause.
    pub cause: GateCause,
    /// Number of times that it began to be the strictest cause, since the start of the agent.
    #[serde(alias = "times")]
    pub count: u64,
}

/// State of the gate, the last stage of the control loop, which can only reduce a command.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize, ToSchema)]
pub struct GateStatus {
    /// Strictest cause in the last tick; `null` while commands pass unchanged.
    pub cause: Option<GateCause>,
    /// Number of ticks since the start of the agent in which a command was reduced.
    pub reduced_ticks: u64,
    /// Number of times that each cause began; causes that never began are absent.
    #[serde(default)]
    pub counts: Vec<GateCount>,
}

/// Number of drive commands since the start of the agent, by result.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, ToSchema)]
pub struct DriveCounts {
    /// Accepted commands.
    pub accepted: u64,
    /// Accepted commands that exceeded a limit and were reduced to it.
    pub over_limit: u64,
    /// Refused commands that do not parse, are too large, or are not finite.
    pub malformed: u64,
    /// Refused commands that are addressed to another run of the agent or belong to another lease.
    pub foreign: u64,
    /// Refused commands that are not newer than an accepted one.
    pub out_of_order: u64,
    /// Refused commands whose end has passed, or is too far in the future.
    pub expired: u64,
}

/// State of teleoperation, as the robot reports it.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, ToSchema)]
pub struct DriveStatus {
    /// Maximum recent age of drive commands on arrival, milliseconds; `null` without a recent
    /// command.
    pub command_age_ms: Option<f64>,
    /// Fraction of the robot's speed limit that this age permits, 0 to 1.
    #[serde(alias = "speed_share")]
    pub speed_ratio: f64,
    /// Number of commands by result.
    pub counts: DriveCounts,
}

/// External limit of a robot.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct LimitStatus {
    /// Owner of the limit: the program that sets it.
    #[serde(alias = "holder")]
    pub owner: OwnerId,
    /// Whether the owner is required: the robot is on hold while a required owner is silent.
    pub required: bool,
    /// Whether the robot is on hold now, because the owner holds it or because a required owner is
    /// silent.
    pub hold: bool,
    /// Maximum speed, m/s; `null` if the owner set none.
    pub linear_max_m_s: Option<f64>,
    /// Time until the limit expires, milliseconds; `null` for a required owner that is silent.
    pub ends_in_ms: Option<u64>,
}

/// Whether a robot that is commanded to rest is at standstill, measured by wheels, odometry, gyro
/// and position.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, ToSchema)]
pub struct StandstillStatus {
    /// Measured state.
    pub state: StandstillState,
    /// Time from the command to rest until standstill, milliseconds; `null` before standstill.
    #[serde(alias = "took_ms")]
    pub stopping_time_ms: Option<u64>,
}

/// Measured state of a robot that is commanded to rest.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum StandstillState {
    /// Braking, or not yet at rest for long enough to be certain.
    #[default]
    Stopping,
    /// At standstill.
    #[serde(alias = "standing")]
    Standstill,
    /// Still moving after the time in which it should have stopped: its base does not obey.
    #[serde(alias = "does_not_stand")]
    StandstillNotReached,
    /// Moving again after standstill: it is pushed, rolls, or another program commands it.
    #[serde(alias = "moves")]
    UnexpectedMotion,
    /// State that this version does not know, from a newer peer.
    #[serde(other)]
    Other,
}

/// State of all functions that only reduce a robot's motion.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, ToSchema)]
pub struct SafetyStatus {
    /// Stop in force; absent without one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stop: Option<StopLatch>,
    /// Teleoperation lease; absent while nobody has it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lease: Option<Lease>,
    /// State of teleoperation; absent before the first lease.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub drive: Option<DriveStatus>,
    /// State of the gate.
    #[serde(default)]
    pub gate: GateStatus,
    /// External limits, at most 32.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub limits: Vec<LimitStatus>,
    /// Number of external limits refused since the start of the agent.
    #[serde(default)]
    pub limits_refused: u64,
    /// Whether the robot is at standstill, as measured; absent while it is permitted to drive.
    #[serde(default, alias = "standing", skip_serializing_if = "Option::is_none")]
    pub standstill: Option<StandstillStatus>,
    /// Revision of the geofence on the robot; absent before the robot has its site's definition.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fence_revision: Option<u64>,
}

/// Geofence of a site: the area within which its robots drive.
///
/// A robot stays inside one of the `keep_in` polygons, if there are any, and outside all `keep_out`
/// polygons. A robot passes from one `keep_in` polygon into another only if they overlap by at
/// least its size.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, ToSchema)]
pub struct Geofence {
    /// Number of changes of the geofence; 0 for a site that never had one.
    pub revision: u64,
    /// Polygons inside which robots stay; no restriction when empty.
    pub keep_in: Vec<Polygon>,
    /// Polygons outside which robots stay.
    pub keep_out: Vec<Polygon>,
}

/// Reason why polygons do not form a geofence.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum InvalidGeofence {
    /// More than [`FENCE_POLYGONS_MAX`] polygons.
    #[error("a geofence has at most {FENCE_POLYGONS_MAX} polygons, this one has {0}")]
    Polygons(usize),
    /// More than [`FENCE_CORNERS_MAX`] corners.
    #[error("a geofence has at most {FENCE_CORNERS_MAX} corners, this one has {0}")]
    Corners(usize),
}

/// Body of `PUT /v1/sites/{site}/geofence`, which replaces the whole geofence.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, ToSchema)]
pub struct ReplaceGeofence {
    /// Polygons inside which robots must stay; no restriction when empty.
    #[serde(default)]
    pub keep_in: Vec<Polygon>,
    /// Polygons outside which robots must stay.
    #[serde(default)]
    pub keep_out: Vec<Polygon>,
}

/// Body of `PUT /v1/sites/{site}/robots/{robot}/limits/{owner}`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct SetLimit {
    /// Whether to hold the robot at rest.
    #[serde(default)]
    pub hold: bool,
    /// Maximum speed, m/s, not negative; unchanged when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub linear_max_m_s: Option<f64>,
    /// Duration of the limit, milliseconds, 1 to 3 600 000 (one hour); renew it before it ends.
    #[schema(minimum = 1, maximum = 3_600_000)]
    pub for_ms: u64,
}

impl Geofence {
    /// Whether the geofence has no polygons.
    pub fn is_empty(&self) -> bool {
        self.keep_in.is_empty() && self.keep_out.is_empty()
    }

    /// Checks the numbers of polygons and corners.
    ///
    /// # Errors
    /// [`InvalidGeofence`] if there are more than a robot can check in a tick.
    pub fn validate(&self) -> Result<(), InvalidGeofence> {
        let polygons = self.keep_in.len() + self.keep_out.len();
        if polygons > FENCE_POLYGONS_MAX {
            return Err(InvalidGeofence::Polygons(polygons));
        }
        let all = self.keep_in.iter().chain(&self.keep_out);
        let corners = all.map(|polygon| polygon.corners().len()).sum();
        if corners > FENCE_CORNERS_MAX {
            return Err(InvalidGeofence::Corners(corners));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Point;

    #[test]
    fn a_geofence_too_large_for_a_tick_is_refused() {
        let corners = [(0.0, 0.0), (4.0, 0.0), (0.0, 3.0)];
        let corners = corners.map(|(x_m, y_m)| Point { x_m, y_m }).to_vec();
        let polygon = Polygon::new(corners).unwrap();
        let fence = |keep_out: usize| Geofence {
            revision: 1,
            keep_in: vec![polygon.clone()],
            keep_out: vec![polygon.clone(); keep_out],
        };
        assert_eq!(fence(FENCE_POLYGONS_MAX - 1).validate(), Ok(()));
        let refused = fence(FENCE_POLYGONS_MAX).validate();
        assert_eq!(refused, Err(InvalidGeofence::Polygons(65)));
        assert!(Geofence::default().is_empty());
        assert!(!fence(0).is_empty());
    }

    #[test]
    fn a_state_of_an_older_agent_has_no_safety_and_that_of_a_newer_one_is_read() {
        let status: SafetyStatus = serde_json::from_str("{}").unwrap();
        assert_eq!(status, SafetyStatus::default());
        let newer = r#"{"gate":{"cause":"meteor","reduced_ticks":3,"counts":[]}}"#;
        let status: SafetyStatus = serde_json::from_str(newer).unwrap();
        assert_eq!(status.gate.cause, Some(GateCause::Other));
    }

    #[test]
    fn a_teleoperation_state_of_an_older_agent_is_read_under_its_former_name() {
        let counts = serde_json::to_string(&DriveCounts::default()).unwrap();
        let older = format!(r#"{{"command_age_ms":180.0,"speed_share":0.5,"counts":{counts}}}"#);
        let status: DriveStatus = serde_json::from_str(&older).unwrap();
        let expected = DriveStatus {
            command_age_ms: Some(180.0),
            speed_ratio: 0.5,
            counts: DriveCounts::default(),
        };
        assert_eq!(status, expected);
    }
}
