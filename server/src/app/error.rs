//! Why a use case did not do it, in the words of the domain.

use tread_api::geometry::Point;
use tread_api::ids::{
    AlertId, JoinTokenId, MissionId, RobotId, SessionId, SiteId, StopId, TerrainId, TokenId,
};
use tread_api::mission::MissionState;
use tread_api::trajectory::Place;

use crate::authority::{AuthorityError, RotationRefused};
use crate::db::DbError;

/// Why a use case did not do it.
#[derive(Debug, thiserror::Error)]
pub enum AppError {
    /// No site of that name.
    #[error("site `{0}` is not known")]
    UnknownSite(SiteId),
    /// No robot of that name in the site.
    #[error("robot `{1}` has never said hello in site `{0}`")]
    UnknownRobot(SiteId, RobotId),
    /// No terrain of that name in the site.
    #[error("terrain `{1}` is not drawn in site `{0}`")]
    UnknownTerrain(SiteId, TerrainId),
    /// No mission of that identifier.
    #[error("mission `{0}` is not known")]
    UnknownMission(MissionId),
    /// The identifier is in use.
    #[error("{what} `{id}` exists already")]
    AlreadyExists {
        /// What kind of thing.
        what: &'static str,
        /// Its identifier.
        id: String,
    },
    /// The robot cannot do what is asked.
    #[error("robot `{robot}` cannot do this: {detail}")]
    BeyondLimits {
        /// The robot.
        robot: RobotId,
        /// Which limit.
        detail: String,
    },
    /// The mission has ended and cannot be changed.
    #[error("mission `{id}` has ended: it is {}", state.as_str())]
    MissionEnded {
        /// The mission.
        id: MissionId,
        /// How it ended.
        state: MissionState,
    },
    /// The mission's state does not allow what is asked.
    #[error("mission `{id}` is {} and cannot be {asked} now", state.as_str())]
    MissionState {
        /// The mission.
        id: MissionId,
        /// Where it stands.
        state: MissionState,
        /// What was asked.
        asked: &'static str,
    },
    /// The robot has another mission, and the new one was not to wait.
    #[error("robot `{robot}` has mission `{mission}`, which is {}", state.as_str())]
    RobotBusy {
        /// The robot.
        robot: RobotId,
        /// The other mission.
        mission: MissionId,
        /// Where it stands.
        state: MissionState,
    },
    /// The robot is retired.
    #[error("robot `{0}` is retired and gets no missions")]
    RobotRetired(RobotId),
    /// The robot has no such ability.
    #[error("robot `{robot}` does not say that it can {what}")]
    RobotCannot {
        /// The robot.
        robot: RobotId,
        /// Which ability.
        what: &'static str,
    },
    /// The trajectory cannot be driven.
    #[error("robot `{robot}` cannot drive this: {detail}")]
    Impossible {
        /// The robot.
        robot: RobotId,
        /// Why.
        detail: String,
        /// Where.
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
    /// No join token of that identifier.
    #[error("join token `{0}` is not known")]
    UnknownJoinToken(JoinTokenId),
    /// It is about a site or robot that the token is not for.
    #[error("{0}")]
    OutsideScope(String),
    /// Somebody would give more than he has.
    #[error("{0}")]
    BeyondRights(String),
    /// Robots do not join this server.
    #[error("robots do not join this server: its configuration has no `[robots]`")]
    NoAuthority,
    /// A rotation of the authority is under way, or none is.
    #[error(transparent)]
    Rotation(RotationRefused),
    /// Robots still hold certificates of the authority that is to be retired.
    #[error(
        "{count} robots still hold certificates of the former authority: {first}; wait until they were \
         on the network, or force it, and each of them must join again"
    )]
    RobotsLeft {
        /// How many.
        count: usize,
        /// The first of them.
        first: String,
    },
    /// The authority's files cannot be written.
    #[error("the files of the fleet's authority cannot be written: {}", .0.what_became())]
    AuthorityFiles(#[source] AuthorityError),
    /// The operating system gives no random numbers.
    #[error("the operating system gives no random numbers: {0}")]
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
    #[error("robot `{0}` does not answer; nobody knows whether it has heard")]
    RobotUnreachable(RobotId),
    /// The robot will not.
    #[error("robot `{robot}` refuses: {detail}")]
    RobotRefused {
        /// The robot.
        robot: RobotId,
        /// Why.
        detail: String,
    },
    /// The path leaves where robots of the site may be.
    #[error("robot `{robot}` may not drive this: {detail}")]
    CrossesGeofence {
        /// The robot.
        robot: RobotId,
        /// Which polygon.
        detail: String,
        /// Where.
        place: Place,
    },
    /// A geofence would leave a robot outside.
    #[error(
        "robot `{robot}` stands at {point} and reaches {reach_m:.2} m around it: {depth_m:.2} m \
         beyond the border of {polygon} at {border}"
    )]
    OutsideGeofence {
        /// The robot.
        robot: RobotId,
        /// Where it stands.
        point: Point,
        /// Half the diagonal of its outline, metres.
        reach_m: f64,
        /// The polygon that forbids it, as in the request.
        polygon: String,
        /// The point of its border that is nearest.
        border: Point,
        /// How far the robot reaches over it, metres.
        depth_m: f64,
    },
    /// Somebody else changed it first.
    #[error("the {what} is at revision {present} now, not {expected}")]
    ChangedMeanwhile {
        /// What was to be changed.
        what: &'static str,
        /// Its revision.
        present: u64,
        /// The revision that was named.
        expected: u64,
    },
    /// A request with the same key is being answered.
    #[error("a request with this idempotency key is being answered; ask again in a moment")]
    KeyInFlight,
    /// The key was used for another request.
    #[error("this idempotency key was used for another request; take a new one")]
    KeyReused,
    /// A bound on how many there may be is reached.
    #[error("there are already {count} {what}; that is the most")]
    TooMany {
        /// What there are too many of.
        what: &'static str,
        /// The bound.
        count: usize,
    },
    /// A field of the request says something impossible.
    #[error("{detail}")]
    Invalid {
        /// Which field.
        field: &'static str,
        /// What is wrong.
        detail: String,
    },
    /// A parameter of the query says something impossible.
    #[error("{detail}")]
    InvalidQuery {
        /// Which parameter.
        parameter: &'static str,
        /// What is wrong.
        detail: String,
    },
    /// An answer cannot be written in its format.
    #[error("the answer cannot be written: {0}")]
    Unwritable(String),
    /// The database failed.
    #[error("the database failed")]
    Storage(#[from] DbError),
}

impl AppError {
    /// The mission's state that forbids what is asked.
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

    /// Where along the path it cannot be driven.
    pub fn place(&self) -> Option<Place> {
        if let Self::Impossible { place, .. } = *self {
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

    /// The field or parameter that says something impossible.
    pub fn field(&self) -> Option<&'static str> {
        match self {
            Self::Invalid { field, .. } => Some(field),
            Self::InvalidQuery { parameter, .. } => Some(parameter),
            Self::UnknownSite(_)
            | Self::UnknownRobot(..)
            | Self::UnknownTerrain(..)
            | Self::UnknownMission(_)
            | Self::AlreadyExists { .. }
            | Self::BeyondLimits { .. }
            | Self::MissionEnded { .. }
            | Self::MissionState { .. }
            | Self::RobotBusy { .. }
            | Self::RobotRetired(_)
            | Self::RobotCannot { .. }
            | Self::Impossible { .. }
            | Self::UnknownAlert(_)
            | Self::UnknownToken(_)
            | Self::UnknownSession(_)
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
            | Self::ChangedMeanwhile { .. }
            | Self::KeyInFlight
            | Self::KeyReused
            | Self::TooMany { .. }
            | Self::Unwritable(_)
            | Self::Storage(_) => None,
        }
    }
}

impl From<sqlx::Error> for AppError {
    fn from(error: sqlx::Error) -> Self {
        Self::Storage(error.into())
    }
}
