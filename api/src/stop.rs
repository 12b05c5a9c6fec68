//! Stops over REST: stop a robot or a fleet, read the progress of a stop, clear it.
//!
//! A stop is not a safety-rated emergency stop: it depends on a network and on software.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::ids::{RobotId, SiteId, StopId};

/// Time in which a robot confirms a stop, milliseconds; a stop without confirmation counts as
/// unconfirmed afterwards.
pub const STOP_CONFIRM_MAX_MS: u64 = 300;
/// Maximum length of the author's name and of the reason of a stop, characters; the rest is cut
/// off.
pub const STOP_TEXT_MAX: usize = 200;

/// Body of `POST /v1/sites/{site}/robots/{robot}/stop`. It is optional, and an invalid body stops
/// the robot too.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize, ToSchema)]
pub struct StopRobot {
    /// Name of the person who requests the stop; the server puts the token's name before it.
    #[serde(
        default,
        skip_serializing_if = "Option::is_none",
        deserialize_with = "crate::text::bounded_option::<_, {STOP_TEXT_MAX}>"
    )]
    pub by: Option<String>,
    /// Reason, for people.
    #[serde(
        default,
        skip_serializing_if = "Option::is_none",
        deserialize_with = "crate::text::bounded_option::<_, {STOP_TEXT_MAX}>"
    )]
    pub reason: Option<String>,
}

/// Body of `POST /v1/stop`. It is optional, and an invalid body stops every robot too; only a
/// `site` that is not an identifier is refused.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize, ToSchema)]
pub struct StopFleet {
    /// Site whose robots are stopped; the robots of all sites when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub site: Option<SiteId>,
    /// Name of the person who requests the stop; the server puts the token's name before it.
    #[serde(
        default,
        skip_serializing_if = "Option::is_none",
        deserialize_with = "crate::text::bounded_option::<_, {STOP_TEXT_MAX}>"
    )]
    pub by: Option<String>,
    /// Reason, for people.
    #[serde(
        default,
        skip_serializing_if = "Option::is_none",
        deserialize_with = "crate::text::bounded_option::<_, {STOP_TEXT_MAX}>"
    )]
    pub reason: Option<String>,
}

/// Body of `POST /v1/sites/{site}/robots/{robot}/stop/clear`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct ClearStop {
    /// Newest stop of the robot. The request is refused if there is a newer one, so that no unseen
    /// stop is cleared.
    pub stop: StopId,
    /// Name of the person who clears the stop; the server puts the token's name before it.
    #[serde(
        default,
        skip_serializing_if = "Option::is_none",
        deserialize_with = "crate::text::bounded_option::<_, {STOP_TEXT_MAX}>"
    )]
    pub by: Option<String>,
}

/// Stop of one robot, with its confirmation and its clearing.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Stop {
    /// Identifier of the stop; required to clear it.
    pub id: StopId,
    /// Site of the robot.
    pub site: SiteId,
    /// Robot that is stopped.
    pub robot: RobotId,
    /// Name of the person or program that stopped the robot.
    pub by: String,
    /// Reason, for people.
    pub reason: String,
    /// Time when the server received the request.
    #[serde(alias = "wanted_at")]
    pub requested_at: Timestamp,
    /// Time when the robot confirmed the stop: its wheels are commanded to rest, and the stop
    /// survives a restart of the robot. `null` before that.
    pub confirmed_at: Option<Timestamp>,
    /// Time when the server received the robot's report that it is at standstill, measured by
    /// wheels, odometry, gyro and position; `null` before that. A robot that does not come to rest
    /// in time raises the alert `standstill-not-reached`.
    #[serde(alias = "standing_at")]
    pub standstill_at: Option<Timestamp>,
    /// Whether the robot has not confirmed the stop within 300 ms. The server repeats the stop
    /// until it is confirmed.
    pub unconfirmed: bool,
    /// Name of the person who last requested to clear the stop; `null` if nobody did.
    #[serde(alias = "clear_asked_by")]
    pub clear_requested_by: Option<String>,
    /// Time of that request; `null` if there was none.
    #[serde(alias = "clear_asked_at")]
    pub clear_requested_at: Option<Timestamp>,
    /// Time when the robot cleared it; `null` before that.
    pub cleared_at: Option<Timestamp>,
    /// Newer stop of the same robot that replaced this one, since a robot has at most one stop in
    /// force; `null` for the newest stop.
    #[serde(default)]
    pub replaced_by: Option<StopId>,
}

/// Answer to `POST /v1/stop`: one stop per robot.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct FleetStop {
    /// Number of robots that had confirmed the stop when the response was sent.
    pub confirmed: usize,
    /// Number of robots that had not confirmed it; the server repeats the stop until they do.
    pub unconfirmed: usize,
    /// Stops of all robots concerned.
    pub stops: Vec<Stop>,
}
