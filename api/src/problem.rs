//! Errors over REST: problem details by RFC 9457, with a closed list of problem types.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::mission::MissionState;
use crate::trajectory::Place;

/// Media type of a problem.
pub const PROBLEM_MEDIA_TYPE: &str = "application/problem+json";

/// Type of a problem that the API reports.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
#[expect(missing_docs, reason = "titles say it")]
pub enum ProblemType {
    #[serde(rename = "/problems/malformed-body")]
    MalformedBody,
    #[serde(rename = "/problems/invalid-body")]
    InvalidBody,
    #[serde(rename = "/problems/unknown-field")]
    UnknownField,
    #[serde(rename = "/problems/body-timeout")]
    BodyTimeout,
    #[serde(rename = "/problems/body-too-large")]
    BodyTooLarge,
    #[serde(rename = "/problems/unsupported-media-type")]
    UnsupportedMediaType,
    #[serde(rename = "/problems/not-acceptable")]
    NotAcceptable,
    #[serde(rename = "/problems/invalid-path")]
    InvalidPath,
    #[serde(rename = "/problems/invalid-query")]
    InvalidQuery,
    #[serde(rename = "/problems/not-found")]
    NotFound,
    #[serde(rename = "/problems/method-not-allowed")]
    MethodNotAllowed,
    #[serde(rename = "/problems/unknown-site")]
    UnknownSite,
    #[serde(rename = "/problems/unknown-robot")]
    UnknownRobot,
    #[serde(rename = "/problems/unknown-terrain")]
    UnknownTerrain,
    #[serde(rename = "/problems/unknown-mission")]
    UnknownMission,
    #[serde(rename = "/problems/already-exists")]
    AlreadyExists,
    #[serde(rename = "/problems/beyond-limits")]
    BeyondLimits,
    #[serde(rename = "/problems/turn-too-sharp")]
    TurnTooSharp,
    #[serde(rename = "/problems/mission-ended")]
    MissionEnded,
    #[serde(rename = "/problems/mission-state")]
    MissionState,
    #[serde(rename = "/problems/robot-busy")]
    RobotBusy,
    #[serde(rename = "/problems/robot-retired")]
    RobotRetired,
    #[serde(rename = "/problems/robot-cannot")]
    RobotCannot,
    #[serde(rename = "/problems/unknown-alert")]
    UnknownAlert,
    #[serde(rename = "/problems/unknown-stop")]
    UnknownStop,
    #[serde(rename = "/problems/stop-not-cleared")]
    StopNotCleared,
    #[serde(rename = "/problems/robot-unreachable")]
    RobotUnreachable,
    #[serde(rename = "/problems/robot-refused")]
    RobotRefused,
    #[serde(rename = "/problems/crosses-geofence")]
    CrossesGeofence,
    #[serde(rename = "/problems/robot-outside-geofence")]
    RobotOutsideGeofence,
    #[serde(rename = "/problems/precondition-failed")]
    PreconditionFailed,
    #[serde(rename = "/problems/idempotency-key-in-flight")]
    IdempotencyKeyInFlight,
    #[serde(rename = "/problems/idempotency-key-reused")]
    IdempotencyKeyReused,
    #[serde(rename = "/problems/invalid-header")]
    InvalidHeader,
    #[serde(rename = "/problems/unauthenticated")]
    Unauthenticated,
    #[serde(rename = "/problems/forbidden")]
    Forbidden,
    #[serde(rename = "/problems/too-many-attempts")]
    TooManyAttempts,
    #[serde(rename = "/problems/too-many-requests")]
    TooManyRequests,
    #[serde(rename = "/problems/foreign-origin")]
    ForeignOrigin,
    #[serde(rename = "/problems/unknown-host")]
    UnknownHost,
    #[serde(rename = "/problems/unknown-token")]
    UnknownToken,
    #[serde(rename = "/problems/unknown-session")]
    UnknownSession,
    #[serde(rename = "/problems/unknown-webhook")]
    UnknownWebhook,
    #[serde(rename = "/problems/sign-in-failed")]
    SignInFailed,
    #[serde(rename = "/problems/sign-in-refused")]
    SignInRefused,
    #[serde(rename = "/problems/request-too-long")]
    RequestTooLong,
    #[serde(rename = "/problems/enrolment-disabled")]
    EnrolmentDisabled,
    #[serde(rename = "/problems/authority-rotation")]
    AuthorityRotation,
    #[serde(rename = "/problems/robots-left")]
    RobotsLeft,
    #[serde(rename = "/problems/too-many")]
    TooMany,
    #[serde(rename = "/problems/timeout")]
    Timeout,
    #[serde(rename = "/problems/unavailable")]
    Unavailable,
    #[serde(rename = "/problems/internal")]
    Internal,
}

impl ProblemType {
    /// Every problem type.
    pub const ALL: [Self; 53] = [
        Self::MalformedBody,
        Self::InvalidBody,
        Self::UnknownField,
        Self::BodyTimeout,
        Self::BodyTooLarge,
        Self::UnsupportedMediaType,
        Self::NotAcceptable,
        Self::InvalidPath,
        Self::InvalidQuery,
        Self::NotFound,
        Self::MethodNotAllowed,
        Self::UnknownSite,
        Self::UnknownRobot,
        Self::UnknownTerrain,
        Self::UnknownMission,
        Self::AlreadyExists,
        Self::BeyondLimits,
        Self::TurnTooSharp,
        Self::MissionEnded,
        Self::MissionState,
        Self::RobotBusy,
        Self::RobotRetired,
        Self::RobotCannot,
        Self::UnknownAlert,
        Self::UnknownStop,
        Self::StopNotCleared,
        Self::RobotUnreachable,
        Self::RobotRefused,
        Self::CrossesGeofence,
        Self::RobotOutsideGeofence,
        Self::PreconditionFailed,
        Self::IdempotencyKeyInFlight,
        Self::IdempotencyKeyReused,
        Self::InvalidHeader,
        Self::Unauthenticated,
        Self::Forbidden,
        Self::TooManyAttempts,
        Self::TooManyRequests,
        Self::ForeignOrigin,
        Self::UnknownHost,
        Self::UnknownToken,
        Self::UnknownSession,
        Self::UnknownWebhook,
        Self::SignInFailed,
        Self::SignInRefused,
        Self::RequestTooLong,
        Self::EnrolmentDisabled,
        Self::AuthorityRotation,
        Self::RobotsLeft,
        Self::TooMany,
        Self::Timeout,
        Self::Unavailable,
        Self::Internal,
    ];

    /// Returns the title for people, the same for every problem of this type.
    pub const fn title(self) -> &'static str {
        match self {
            Self::MalformedBody => "The body is not JSON",
            Self::InvalidBody => "The body has an invalid value",
            Self::UnknownField => "The body has an unknown field",
            Self::BodyTimeout => "The body took too long to arrive",
            Self::BodyTooLarge => "The body is too large",
            Self::UnsupportedMediaType => "The body must be application/json",
            Self::NotAcceptable => "None of the accepted response formats is available",
            Self::InvalidPath => "The path has an invalid identifier",
            Self::InvalidQuery => "The query has an invalid value",
            Self::NotFound => "The resource does not exist",
            Self::MethodNotAllowed => "This path does not support the method",
            Self::UnknownSite => "The site is not known",
            Self::UnknownRobot => "The robot is not known",
            Self::UnknownTerrain => "The terrain is not known",
            Self::UnknownMission => "The mission is not known",
            Self::AlreadyExists => "The identifier is in use",
            Self::BeyondLimits => "The request is impossible for this robot",
            Self::TurnTooSharp => "The path turns too sharply",
            Self::MissionEnded => "The mission has ended",
            Self::MissionState => "The mission's present state does not allow this",
            Self::RobotBusy => "The robot has another mission",
            Self::RobotRetired => "The robot is retired",
            Self::RobotCannot => "The robot does not support this",
            Self::UnknownAlert => "The alert is not known",
            Self::UnknownStop => "The stop is not known",
            Self::StopNotCleared => "The robot has not cleared the stop",
            Self::RobotUnreachable => "The robot does not answer",
            Self::RobotRefused => "The robot refused the command",
            Self::CrossesGeofence => "The path leaves the geofence",
            Self::RobotOutsideGeofence => "A robot would be outside the geofence",
            Self::PreconditionFailed => "The resource has been changed meanwhile",
            Self::IdempotencyKeyInFlight => "A request with this idempotency key is in progress",
            Self::IdempotencyKeyReused => "The idempotency key was used for another request",
            Self::InvalidHeader => "A header has an invalid value",
            Self::Unauthenticated => "A valid token is required",
            Self::Forbidden => "The caller's rights do not allow this here",
            Self::TooManyAttempts => "There were too many failed attempts",
            Self::TooManyRequests => "There are too many requests",
            Self::ForeignOrigin => "A page of another origin may not send this request",
            Self::UnknownHost => "The host name is not one of this server",
            Self::UnknownToken => "The token is not known",
            Self::UnknownSession => "The session is not known",
            Self::UnknownWebhook => "The webhook is not known",
            Self::SignInFailed => "The sign-in has failed",
            Self::SignInRefused => "You have no rights on this server",
            Self::RequestTooLong => "The path or query is too long",
            Self::EnrolmentDisabled => "This server does not enrol robots",
            Self::AuthorityRotation => "The authority's rotation does not allow this",
            Self::RobotsLeft => "Robots still hold certificates of the former authority",
            Self::TooMany => "The maximum number of these objects is reached",
            Self::Timeout => "The answer took too long",
            Self::Unavailable => "The server is temporarily unavailable",
            Self::Internal => "Internal server error",
        }
    }
}

/// Error response: problem details by RFC 9457.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct ProblemBody {
    /// Type of the problem, a stable URI reference for programs.
    #[serde(rename = "type")]
    pub kind: ProblemType,
    /// Title of the problem type, for people.
    pub title: String,
    /// HTTP status of the response.
    pub status: u16,
    /// What is wrong with this request, and how to correct it, for people.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub detail: Option<String>,
    /// Field of the body that is wrong, as a path such as `trajectory.circle.radius_m`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub field: Option<String>,
    /// Present state of the mission, if it does not allow the request.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub state: Option<MissionState>,
    /// Place along the path beyond which the robot cannot drive it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub place: Option<Place>,
}
