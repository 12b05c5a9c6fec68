//! What may only slow a robot down: stops, leases of hand driving, external limits, geofences.
//!
//! These words are the same over REST and on zenoh. The robot is the truth of all of them but the
//! geofence, which its site has.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;
use uuid::Uuid;

use crate::geometry::Polygon;
use crate::ids::{OwnerId, StopId};

/// Longest name of a person or program that stops or drives, in characters.
pub const BY_LENGTH_MAX: usize = 100;
/// Most external limits of one robot at a time.
pub const LIMITS_MAX: usize = 32;
/// Farthest that the end of an external limit may lie ahead, microseconds: one hour.
pub const LIMIT_AHEAD_MAX_US: u64 = 3_600_000_000;
/// Farthest that the end of a drive command may lie ahead, microseconds.
pub const DRIVE_AHEAD_MAX_US: u64 = 1_000_000;
/// Longest silence of a driver with which the lease stays, microseconds.
pub const LEASE_SILENCE_MAX_US: u64 = 5_000_000;
/// Largest zenoh payload of a drive command or an external limit, in bytes.
pub const SMALL_PAYLOAD_MAX: usize = 1_024;
/// Most polygons of a geofence.
pub const FENCE_POLYGONS_MAX: usize = 64;
/// Most corners of all polygons of a geofence together; the robot looks at each in a tick.
pub const FENCE_CORNERS_MAX: usize = 1_000;

/// A stop that is in force on a robot until an operator clears it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct StopLatch {
    /// The newest stop; a clear must name it.
    pub id: StopId,
    /// Who stopped the robot, for people.
    #[serde(deserialize_with = "crate::text::bounded::<_, {crate::stop::STOP_TEXT_MAX}>")]
    pub by: String,
    /// Why, for people.
    #[serde(deserialize_with = "crate::text::bounded::<_, {crate::mission::REASON_LENGTH_MAX}>")]
    pub reason: String,
    /// When the robot latched it, by its own wall clock.
    pub since: Timestamp,
}

/// Who wants to teleoperate the robot.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Driver {
    /// One connection of one driver.
    pub client: Uuid,
    /// Name for people, at most [`BY_LENGTH_MAX`] characters.
    #[serde(deserialize_with = "crate::text::bounded::<_, {BY_LENGTH_MAX}>")]
    pub name: String,
}

/// A teleoperation lease, as the robot granted it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Lease {
    /// Rises with every lease that is given, and never falls in a run of the agent.
    pub epoch: u64,
    /// Who drives.
    pub driver: Driver,
}

/// Why a command was reduced before it reached the wheels; later values are stricter.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, ToSchema,
)]
#[serde(rename_all = "snake_case")]
pub enum GateCause {
    /// The command changed faster than the wheels may.
    Acceleration,
    /// The command was above a limit of the robot.
    Speed,
    /// Drive commands come late: the slower the link, the slower the robot.
    CommandAge,
    /// An external limit slows the robot.
    ExternalLimit,
    /// A fence is near, or has been crossed.
    Fence,
    /// The command was not a number.
    NotFinite,
    /// There was no command.
    NoCommand,
    /// The teleoperator is silent, or the lease has ended.
    Lease,
    /// The server has been silent for longer than the mission allows.
    LinkPolicy,
    /// An external limit holds the robot, or a required owner is silent.
    ExternalHold,
    /// The robot's control loop does not keep its rate.
    LoopOverrun,
    /// Sensors contradict each other: the robot is held, or slowed down.
    SensorFault,
    /// The robot does not know where it is.
    StalePosition,
    /// The robot leans too far.
    Tilt,
    /// The base has not been heard for too long.
    StaleFeedback,
    /// A stop is in force.
    Stop,
    /// Any cause of a newer peer.
    #[serde(other)]
    Other,
}

/// How often the gate began to reduce for one cause.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct GateCount {
    /// The cause.
    pub cause: GateCause,
    /// How often it began to be the strictest one, since the agent's start.
    pub times: u64,
}

/// What the last stage before the wheels does.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize, ToSchema)]
pub struct GateStatus {
    /// The strictest cause in the last tick; `null` while commands pass whole.
    pub cause: Option<GateCause>,
    /// Ticks since the agent's start in which a command was reduced.
    pub reduced_ticks: u64,
    /// How often each cause began; those that never did are absent.
    #[serde(default)]
    pub counts: Vec<GateCount>,
}

/// What became of drive commands since the agent's start.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, ToSchema)]
pub struct DriveCounts {
    /// Taken.
    pub accepted: u64,
    /// Of these: above a limit, and reduced to it.
    pub over_limit: u64,
    /// Refused: they do not parse, are too large, or are no numbers.
    pub malformed: u64,
    /// Refused: another run of the agent, or another lease.
    pub foreign: u64,
    /// Refused: not newer than one taken before.
    pub out_of_order: u64,
    /// Refused: past their expiry, or with an expiry too far in the future.
    pub expired: u64,
}

/// Teleoperation, as the robot reports it.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, ToSchema)]
pub struct DriveStatus {
    /// Age of drive commands on arrival, milliseconds, the worst of late; `null` without one.
    pub command_age_ms: Option<f64>,
    /// Share of the robot's speed that this age allows, 0 to 1.
    pub speed_share: f64,
    /// What became of the commands.
    pub counts: DriveCounts,
}

/// An external limit that a robot has.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct LimitStatus {
    /// Who limits.
    #[serde(alias = "holder")]
    pub owner: OwnerId,
    /// Whether the robot must hear this owner to move; it stays on hold while the owner is silent.
    pub required: bool,
    /// Whether the robot is on hold now: because the owner requested it, or because a required owner is
    /// silent.
    pub hold: bool,
    /// Fastest speed, m/s, if one was given.
    pub linear_max_m_s: Option<f64>,
    /// Time until it expires, milliseconds; `null` for a required owner that is silent.
    pub ends_in_ms: Option<u64>,
}

/// Whether a robot that is commanded to rest does: by wheels, odometry, gyro and position.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, ToSchema)]
pub struct StandingStatus {
    /// What is measured.
    pub state: StandingState,
    /// Time from the command of rest until the robot stood, milliseconds; `null` until then.
    pub took_ms: Option<u64>,
}

/// What is measured of a robot that is commanded to rest.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum StandingState {
    /// It brakes, or has not stood for long enough to be sure.
    #[default]
    Stopping,
    /// It stands.
    Standing,
    /// It should stand by now and moves: its base does not obey.
    DoesNotStand,
    /// It stood and moves again: it is pushed, rolls away, or somebody else drives it.
    Moves,
    /// Anything else, of a newer peer.
    #[serde(other)]
    Other,
}

/// Everything on a robot that may only slow it down.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, ToSchema)]
pub struct SafetyStatus {
    /// The stop in force.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stop: Option<StopLatch>,
    /// Who teleoperates the robot.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lease: Option<Lease>,
    /// Teleoperation; absent before the first lease.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub drive: Option<DriveStatus>,
    /// The gate.
    #[serde(default)]
    pub gate: GateStatus,
    /// External limits, at most [`LIMITS_MAX`].
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub limits: Vec<LimitStatus>,
    /// External limits refused since the agent's start.
    #[serde(default)]
    pub limits_refused: u64,
    /// Whether the robot stands, as measured; absent while it may drive.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub standing: Option<StandingStatus>,
    /// The revision of the geofence that the robot has; absent before it knows its site.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fence_revision: Option<u64>,
}

/// Where the robots of a site may be.
///
/// A robot keeps within one of the `keep_in` polygons, if there is any, and out of all `keep_out`
/// polygons; where it is to pass from one polygon into another, they overlap by its size.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, ToSchema)]
pub struct Geofence {
    /// Counts changes; 0 is a site that never had one.
    pub revision: u64,
    /// Where robots may be; anywhere when empty.
    pub keep_in: Vec<Polygon>,
    /// Where robots may not be.
    pub keep_out: Vec<Polygon>,
}

/// Why polygons make no geofence.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum InvalidGeofence {
    /// More than [`FENCE_POLYGONS_MAX`] polygons.
    #[error("a geofence has at most {FENCE_POLYGONS_MAX} polygons, this one has {0}")]
    Polygons(usize),
    /// More than [`FENCE_CORNERS_MAX`] corners.
    #[error("a geofence has at most {FENCE_CORNERS_MAX} corners, this one has {0}")]
    Corners(usize),
}

/// The body of `PUT /v1/sites/{site}/geofence`: replaces the whole of it.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, ToSchema)]
pub struct ReplaceGeofence {
    /// Where robots may be; anywhere when empty.
    #[serde(default)]
    pub keep_in: Vec<Polygon>,
    /// Where robots may not be.
    #[serde(default)]
    pub keep_out: Vec<Polygon>,
}

/// The body of `PUT /v1/sites/{site}/robots/{robot}/limits/{owner}`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct SetLimit {
    /// Whether the robot is to stand.
    #[serde(default)]
    pub hold: bool,
    /// Fastest speed, m/s, not negative; as before when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub linear_max_m_s: Option<f64>,
    /// How long it lasts, milliseconds, at most an hour; renew it before it ends.
    #[schema(minimum = 1, maximum = 3_600_000)]
    pub for_ms: u64,
}

impl Geofence {
    /// Whether it bounds nothing.
    pub fn is_empty(&self) -> bool {
        self.keep_in.is_empty() && self.keep_out.is_empty()
    }

    /// Checks its size.
    ///
    /// # Errors
    /// [`InvalidGeofence`]: more than a robot can look at in a tick.
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
}
