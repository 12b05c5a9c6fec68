//! Stops over REST: stop a robot or a fleet at once, see what became of it, clear it.
//!
//! A stop is not a safety-rated emergency stop: it goes over a network and through programs.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::ids::{RobotId, SiteId, StopId};

/// How long a robot may take to confirm a stop before the stop is shown as unconfirmed,
/// milliseconds.
pub const STOP_CONFIRM_MAX_MS: u64 = 300;
/// Longest name of who stops, and longest reason, in characters; what is longer is cut.
pub const STOP_TEXT_MAX: usize = 200;

/// The body of `POST /v1/sites/{site}/robots/{robot}/stop`; it may be left out, and one that does
/// not read stops the robot all the same.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize, ToSchema)]
pub struct StopRobot {
    /// Who stops, for people; the token's name stands before it.
    #[serde(
        default,
        skip_serializing_if = "Option::is_none",
        deserialize_with = "crate::text::bounded_option::<_, {STOP_TEXT_MAX}>"
    )]
    pub by: Option<String>,
    /// Why, for people.
    #[serde(
        default,
        skip_serializing_if = "Option::is_none",
        deserialize_with = "crate::text::bounded_option::<_, {STOP_TEXT_MAX}>"
    )]
    pub reason: Option<String>,
}

/// The body of `POST /v1/stop`; it may be left out, and one that does not read stops every robot, but
/// for a `site` that is no identifier: that is refused.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize, ToSchema)]
pub struct StopFleet {
    /// Only the robots of this site.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub site: Option<SiteId>,
    /// Who stops, for people; the token's name stands before it.
    #[serde(
        default,
        skip_serializing_if = "Option::is_none",
        deserialize_with = "crate::text::bounded_option::<_, {STOP_TEXT_MAX}>"
    )]
    pub by: Option<String>,
    /// Why, for people.
    #[serde(
        default,
        skip_serializing_if = "Option::is_none",
        deserialize_with = "crate::text::bounded_option::<_, {STOP_TEXT_MAX}>"
    )]
    pub reason: Option<String>,
}

/// The body of `POST /v1/sites/{site}/robots/{robot}/stop/clear`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct ClearStop {
    /// The newest stop of the robot: a clear never clears one that its author has not seen.
    pub stop: StopId,
    /// Who clears, for people; the token's name stands before it.
    #[serde(
        default,
        skip_serializing_if = "Option::is_none",
        deserialize_with = "crate::text::bounded_option::<_, {STOP_TEXT_MAX}>"
    )]
    pub by: Option<String>,
}

/// A stop of one robot with what became of it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Stop {
    /// The stop's identifier; needed to clear it.
    pub id: StopId,
    /// The robot's site.
    pub site: SiteId,
    /// The robot.
    pub robot: RobotId,
    /// Who stopped.
    pub by: String,
    /// Why.
    pub reason: String,
    /// When the server received the request.
    pub wanted_at: Timestamp,
    /// When it was commanded: the robot has confirmed that its wheels are commanded to rest
    /// and that the stop lasts over a restart; `null` until then.
    pub confirmed_at: Option<Timestamp>,
    /// When the robot reported that it was measured to stand, by wheels, odometry, gyro and
    /// position; `null` until then. A robot that does not stand in time raises the alert
    /// `does-not-stand`.
    pub standing_at: Option<Timestamp>,
    /// Whether the robot has not confirmed within 300 ms. The server repeats the stop until it
    /// does.
    pub unconfirmed: bool,
    /// Who requested last to clear it.
    pub clear_asked_by: Option<String>,
    /// When that was.
    pub clear_asked_at: Option<Timestamp>,
    /// When the robot had cleared it.
    pub cleared_at: Option<Timestamp>,
    /// The stop of the same robot that came after it and took its place: a robot has at most one
    /// stop in force. `null` for the newest.
    #[serde(default)]
    pub replaced_by: Option<StopId>,
}

/// The answer to `POST /v1/stop`: one stop for each robot.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct FleetStop {
    /// How many robots had confirmed when the answer was made.
    pub confirmed: usize,
    /// How many had not; the server repeats the stop until they do.
    pub unconfirmed: usize,
    /// The stops.
    pub stops: Vec<Stop>,
}
