//! Errors of use cases, in terms of the domain.

use tread_api::geometry::Point;
use tread_api::ids::{
    AlertId, JoinTokenId, MissionId, RobotId, SessionId, SiteId, StopId, TerrainId, TokenId,
    WebhookId,
};
use tread_api::mission::MissionState;
use tread_api::trajectory::Place;

use crate::archive::SegmentArchiveError;
use crate::authority::{AuthorityError, RotationRefused};
use crate::db::DbError;

/// Reason why a use case failed.
#[derive(Debug, thiserror::Error)]
pub enum AppError {
    /// No site of that name.
    #[error("site `{0}` is not known")]
    UnknownSite(SiteId),
    /// No robot of that name in the site.
    #[error("robot `{1}` has never connected to site `{0}`")]
    UnknownRobot(SiteId, RobotId),
    /// No terrain of that name in the site.
    #[error("terrain `{1}` does not exist in site `{0}`")]
    UnknownTerrain(SiteId, TerrainId),
    /// No mission of that identifier.
    #[error("mission `{0}` is not known")]
    UnknownMission(MissionId),
    /// The identifier is already in use.
    #[error("{what} `{id}` exists already")]
    AlreadyExists {
        /// What kind of thing.
        what: &'static str,
        /// Its identifier.
        id: String,
    },
    /// The request exceeds a limit of the robot.
    #[error("robot `{robot}` cannot do this: {detail}")]
    BeyondLimits {
        /// The robot.
        robot: RobotId,
        /// Which limit.
        detail: String,
        /// Path of the value in the request's body, if it is a single one.
        field: Option<Box<str>>,
    },
    /// The mission has ended and cannot be changed.
    #[error("mission `{id}` has ended: it is {}", state.as_str())]
    MissionEnded {
        /// The mission.
        id: MissionId,
        /// How it ended.
        state: MissionState,
    },
    /// The mission's state does not permit the requested action.
    #[error("mission `{id}` is {} and cannot be {action} now", state.as_str())]
    MissionState {
        /// The mission.
        id: MissionId,
        /// Its present state.
        state: MissionState,
        /// The requested change.
        action: &'static str,
    },
    /// The robot has another open mission, and the start policy does not allow to wait.
    #[error("robot `{robot}` has mission `{mission}`, which is {}", state.as_str())]
    RobotBusy {
        /// The robot.
        robot: RobotId,
        /// The other mission.
        mission: MissionId,
        /// The state of that mission.
        state: MissionState,
    },
    /// The robot is retired.
    #[error("robot `{0}` is retired and gets no missions")]
    RobotRetired(RobotId),
    /// The robot lacks a capability.
    #[error("robot `{robot}` does not report that it can {what}")]
    RobotCannot {
        /// The robot.
        robot: RobotId,
        /// The capability.
        what: &'static str,
    },
    /// The trajectory cannot be driven.
    #[error("robot `{robot}` cannot drive this: {detail}")]
    Impossible {
        /// The robot.
        robot: RobotId,
        /// Why.
        detail: String,
        /// Path of the value at fault in the request's body, if it is a single one.
        field: Option<Box<str>>,
        /// Where.
        place: Option<Place>,
    },
    /// The trajectory turns more sharply than any robot can.
    #[error("robot `{robot}` cannot drive this: {detail}")]
    TurnTooSharp {
        /// The robot.
        robot: RobotId,
        /// Near which waypoint.
        detail: String,
        /// That waypoint; `None` on the approach to a circle.
        place: Option<Place>,
    },
    /// No alert of that identifier.
    #[error("alert `{0}` is not known")]
    UnknownAlert(AlertId),
    /// No token of that identifier.
    #[error("token `{0}` is not known")]
    UnknownToken(TokenId),
    /// No session of that identifier.
    #[error("session `{0}` is not known")]
    UnknownSession(SessionId),
    /// No webhook of that identifier.
    #[error("webhook `{0}` is not known")]
    UnknownWebhook(WebhookId),
    /// No join token of that identifier.
    #[error("join token `{0}` is not known")]
    UnknownJoinToken(JoinTokenId),
    /// The request concerns a site or robot outside the token's scope.
    #[error("{0}")]
    OutsideScope(String),
    /// The request would grant rights that its sender does not have.
    #[error("{0}")]
    BeyondRights(String),
    /// This server has no authority, so robots cannot join it.
    #[error("robots do not join this server: its configuration has no `[robots]`")]
    NoAuthority,
    /// The state of the rotation forbids the request.
    #[error(transparent)]
    Rotation(RotationRefused),
    /// Robots still hold certificates of the authority that is to be retired.
    #[error(
        "{count} robots still hold certificates of the former authority: {first}; wait until they \
         have connected; if you force it, each of them must join again"
    )]
    RobotsLeft {
        /// How many.
        count: usize,
        /// The first of them.
        first: String,
    },
    /// The authority's files cannot be written.
    #[error("the files of the fleet's authority cannot be written: {}", .0.effect_clause())]
    AuthorityFiles(#[source] AuthorityError),
    /// The operating system provides no random numbers.
    #[error("the operating system provides no random numbers: {0}")]
    NoRandomness(String),
    /// No stop of that identifier.
    #[error("stop `{0}` is not known for this robot")]
    UnknownStop(StopId),
    /// The robot did not clear a stop.
    #[error("robot `{robot}` has not cleared the stop: {detail}")]
    StopNotCleared {
        /// The robot.
        robot: RobotId,
        /// Why.
        detail: String,
    },
    /// The robot does not answer.
    #[error("robot `{0}` does not answer; it is unknown whether it received the command")]
    RobotUnreachable(RobotId),
    /// The robot refused the command.
    #[error("robot `{robot}` refuses: {detail}")]
    RobotRefused {
        /// The robot.
        robot: RobotId,
        /// Why.
        detail: String,
    },
    /// The path leaves the area that the site's geofence allows.
    #[error("robot `{robot}` may not drive this: {detail}")]
    CrossesGeofence {
        /// The robot.
        robot: RobotId,
        /// Which polygon.
        detail: String,
        /// Where.
        place: Place,
    },
    /// A robot would be outside a new geofence.
    #[error(
        "robot `{robot}` stands at {point} and reaches {reach_m:.2} m around it: {depth_m:.2} m \
         beyond the border of {polygon} at {border}"
    )]
    OutsideGeofence {
        /// The robot.
        robot: RobotId,
        /// Position of the robot's centre in the site frame.
        point: Point,
        /// Half the diagonal of its outline, metres.
        reach_m: f64,
        /// The violated polygon, named as in the request.
        polygon: String,
        /// Nearest point of that polygon's border, in the site frame.
        border: Point,
        /// Distance by which the robot's disc crosses that border, metres.
        depth_m: f64,
    },
    /// The object was changed meanwhile: its revision is not the expected one.
    #[error("the {what} is at revision {present} now, not {}", one_of(.expected))]
    PreconditionFailed {
        /// The kind of object.
        what: &'static str,
        /// Its revision.
        present: u64,
        /// The revisions that were named.
        expected: Vec<u64>,
    },
    /// A request with the same idempotency key is being answered.
    #[error("a request with this idempotency key is in progress; try again in a moment")]
    KeyInFlight,
    /// The idempotency key was used for another request.
    #[error("this idempotency key was used for another request; use a new one")]
    KeyReused,
    /// A limit on a number is reached.
    #[error("there are already {count} {what}, which is the maximum")]
    TooMany {
        /// What is counted.
        what: &'static str,
        /// The limit.
        count: usize,
    },
    /// A field of the request has an impossible value.
    #[error("{detail}")]
    Invalid {
        /// Which field.
        field: &'static str,
        /// What is wrong.
        detail: String,
    },
    /// A query parameter has an impossible value.
    #[error("{detail}")]
    InvalidQuery {
        /// Which parameter.
        parameter: &'static str,
        /// What is wrong.
        detail: String,
    },
    /// An answer needs more of the map in memory at once than one request may have.
    #[error(
        "this would need more than {mib_max} MiB of the map at once: request a smaller area, or \
         raise `memory_max_mib` in the server's `[map]`"
    )]
    MapReadTooLarge {
        /// What one request may have, MiB.
        mib_max: usize,
    },
    /// Nobody waits for the answer any more.
    #[error("the client no longer waits for the response")]
    Abandoned,
    /// The answer cannot be encoded in the requested format.
    #[error("the response cannot be written: {0}")]
    Unwritable(String),
    /// Archived measurements cannot be read or written.
    #[error("the archive of measurements failed: {0}")]
    Archive(#[source] SegmentArchiveError),
    /// The database failed.
    #[error("the database failed")]
    Storage(#[from] DbError),
}

impl AppError {
    /// Returns the state of the mission that forbids the request.
    pub fn state(&self) -> Option<MissionState> {
        if let Self::MissionEnded { state, .. }
        | Self::MissionState { state, .. }
        | Self::RobotBusy { state, .. } = *self
        {
            Some(state)
        } else {
            None
        }
    }

    /// Returns the place on the path that cannot be driven.
    pub fn place(&self) -> Option<Place> {
        if let Self::Impossible { place, .. } | Self::TurnTooSharp { place, .. } = *self {
            place
        } else if let Self::CrossesGeofence { place, .. } = *self {
            Some(place)
        } else if let Self::OutsideGeofence { point, .. } = *self {
            Some(Place {
                arc_m: None,
                waypoint: None,
                point,
            })
        } else {
            None
        }
    }

    /// Returns the field or parameter with an impossible value.
    pub fn field(&self) -> Option<&str> {
        match self {
            Self::Invalid { field, .. } => Some(field),
            Self::BeyondLimits { field, .. } | Self::Impossible { field, .. } => field.as_deref(),
            Self::InvalidQuery { parameter, .. } => Some(parameter),
            Self::UnknownSite(_)
            | Self::UnknownRobot(..)
            | Self::UnknownTerrain(..)
            | Self::UnknownMission(_)
            | Self::AlreadyExists { .. }
            | Self::MissionEnded { .. }
            | Self::MissionState { .. }
            | Self::RobotBusy { .. }
            | Self::RobotRetired(_)
            | Self::RobotCannot { .. }
            | Self::TurnTooSharp { .. }
            | Self::UnknownAlert(_)
            | Self::UnknownToken(_)
            | Self::UnknownSession(_)
            | Self::UnknownWebhook(_)
            | Self::UnknownJoinToken(_)
            | Self::NoAuthority
            | Self::Rotation(_)
            | Self::RobotsLeft { .. }
            | Self::AuthorityFiles(_)
            | Self::OutsideScope(_)
            | Self::BeyondRights(_)
            | Self::NoRandomness(_)
            | Self::UnknownStop(_)
            | Self::StopNotCleared { .. }
            | Self::RobotUnreachable(_)
            | Self::RobotRefused { .. }
            | Self::CrossesGeofence { .. }
            | Self::OutsideGeofence { .. }
            | Self::PreconditionFailed { .. }
            | Self::KeyInFlight
            | Self::KeyReused
            | Self::TooMany { .. }
            | Self::MapReadTooLarge { .. }
            | Self::Abandoned
            | Self::Unwritable(_)
            | Self::Archive(_)
            | Self::Storage(_) => None,
        }
    }
}

/// Returns revisions as words of a sentence.
fn one_of(expected: &[u64]) -> String {
    if expected.is_empty() {
        return "one that the request names".to_owned();
    }
    let expected: Vec<String> = expected.iter().map(u64::to_string).collect();
    expected.join(" or ")
}
