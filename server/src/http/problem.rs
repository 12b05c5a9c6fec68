//! Errors as RFC 9457 problems. The only place that knows status codes.

use axum::body::Body;
use axum::http::{HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use tracing::error;
use tread_api::problem::{PROBLEM_MEDIA_TYPE, ProblemBody, ProblemType};

use crate::app::AppError;
use crate::app::DbError;
use crate::archive::SegmentArchiveError;
use crate::error_text::chain;

/// `Retry-After` of responses when the server could not do its work, seconds.
const RETRY_AFTER_S: u32 = 5;

/// An error response.
#[derive(Debug, Clone, PartialEq)]
pub struct Problem {
    body: Box<ProblemBody>,
}

/// Marks an answer as a problem of that type.
#[derive(Debug, Clone, Copy)]
pub(super) struct Refused(pub(super) ProblemType);

impl Problem {
    /// Creates a problem of a type.
    pub fn new(kind: ProblemType) -> Self {
        let body = Box::new(ProblemBody {
            kind,
            title: kind.title().to_owned(),
            status: status(kind).as_u16(),
            detail: None,
            field: None,
            state: None,
            place: None,
        });
        Self { body }
    }

    /// Creates the problem of a database error, and logs the cause, which is not in the response.
    pub(super) fn storage(cause: &DbError) -> Self {
        error!("a request failed: {cause:?}");
        match cause.failure() {
            Some(failure) => Self::new(ProblemType::Unavailable).detail(format!(
                "{}; try again later, with the same idempotency key if there is one",
                failure.explanation()
            )),
            None => Self::new(ProblemType::Internal)
                .detail("the cause is in the server's log, under this response's `x-request-id`"),
        }
    }

    /// Creates the problem of archived measurements that cannot be read, and logs the cause.
    fn archive(cause: &SegmentArchiveError) -> Self {
        error!("a request failed: {}", chain(cause));
        Self::new(ProblemType::Unavailable).detail(format!("archived measurements: {cause}"))
    }

    /// Sets the explanation for people.
    #[must_use]
    pub fn detail(mut self, detail: impl Into<String>) -> Self {
        self.body.detail = Some(detail.into());
        self
    }

    /// Sets the field of the body or query.
    #[must_use]
    pub fn field(mut self, field: impl Into<String>) -> Self {
        self.body.field = Some(field.into());
        self
    }
}

const fn status(kind: ProblemType) -> StatusCode {
    match kind {
        ProblemType::MalformedBody
        | ProblemType::InvalidPath
        | ProblemType::InvalidQuery
        | ProblemType::InvalidHeader
        | ProblemType::SignInFailed => StatusCode::BAD_REQUEST,
        ProblemType::InvalidBody
        | ProblemType::UnknownField
        | ProblemType::BeyondLimits
        | ProblemType::TurnTooSharp
        | ProblemType::CrossesGeofence
        | ProblemType::RobotOutsideGeofence
        | ProblemType::IdempotencyKeyReused => StatusCode::UNPROCESSABLE_ENTITY,
        ProblemType::BodyTimeout => StatusCode::REQUEST_TIMEOUT,
        ProblemType::BodyTooLarge => StatusCode::PAYLOAD_TOO_LARGE,
        ProblemType::UnsupportedMediaType => StatusCode::UNSUPPORTED_MEDIA_TYPE,
        ProblemType::NotAcceptable => StatusCode::NOT_ACCEPTABLE,
        ProblemType::NotFound
        | ProblemType::UnknownSite
        | ProblemType::UnknownRobot
        | ProblemType::UnknownTerrain
        | ProblemType::UnknownMission
        | ProblemType::UnknownAlert
        | ProblemType::UnknownToken
        | ProblemType::UnknownSession
        | ProblemType::UnknownWebhook
        | ProblemType::UnknownStop => StatusCode::NOT_FOUND,
        ProblemType::MethodNotAllowed => StatusCode::METHOD_NOT_ALLOWED,
        ProblemType::AlreadyExists
        | ProblemType::MissionEnded
        | ProblemType::MissionState
        | ProblemType::RobotBusy
        | ProblemType::RobotRetired
        | ProblemType::RobotCannot
        | ProblemType::RobotRefused
        | ProblemType::StopNotCleared
        | ProblemType::IdempotencyKeyInFlight
        | ProblemType::EnrolmentDisabled
        | ProblemType::AuthorityRotation
        | ProblemType::RobotsLeft
        | ProblemType::TooMany => StatusCode::CONFLICT,
        ProblemType::Unauthenticated => StatusCode::UNAUTHORIZED,
        ProblemType::Forbidden | ProblemType::ForeignOrigin | ProblemType::SignInRefused => {
            StatusCode::FORBIDDEN
        }
        ProblemType::TooManyAttempts | ProblemType::TooManyRequests => {
            StatusCode::TOO_MANY_REQUESTS
        }
        ProblemType::UnknownHost => StatusCode::MISDIRECTED_REQUEST,
        ProblemType::RequestTooLong => StatusCode::URI_TOO_LONG,
        ProblemType::PreconditionFailed => StatusCode::PRECONDITION_FAILED,
        ProblemType::Unavailable | ProblemType::Timeout | ProblemType::RobotUnreachable => {
            StatusCode::SERVICE_UNAVAILABLE
        }
        ProblemType::Internal => StatusCode::INTERNAL_SERVER_ERROR,
    }
}

impl From<AppError> for Problem {
    fn from(app_error: AppError) -> Self {
        let kind = match &app_error {
            AppError::UnknownSite(_) => ProblemType::UnknownSite,
            AppError::UnknownRobot(..) => ProblemType::UnknownRobot,
            AppError::UnknownTerrain(..) => ProblemType::UnknownTerrain,
            AppError::UnknownMission(_) => ProblemType::UnknownMission,
            AppError::AlreadyExists { .. } => ProblemType::AlreadyExists,
            AppError::BeyondLimits { .. } | AppError::Impossible { .. } => {
                ProblemType::BeyondLimits
            }
            AppError::TurnTooSharp { .. } => ProblemType::TurnTooSharp,
            AppError::MissionEnded { .. } => ProblemType::MissionEnded,
            AppError::MissionState { .. } => ProblemType::MissionState,
            AppError::RobotBusy { .. } => ProblemType::RobotBusy,
            AppError::RobotRetired(_) => ProblemType::RobotRetired,
            AppError::RobotCannot { .. } => ProblemType::RobotCannot,
            AppError::UnknownAlert(_) => ProblemType::UnknownAlert,
            AppError::UnknownToken(_) | AppError::UnknownJoinToken(_) => ProblemType::UnknownToken,
            AppError::UnknownSession(_) => ProblemType::UnknownSession,
            AppError::UnknownWebhook(_) => ProblemType::UnknownWebhook,
            AppError::OutsideScope(_) | AppError::BeyondRights(_) => ProblemType::Forbidden,
            AppError::NoAuthority => ProblemType::EnrolmentDisabled,
            AppError::Rotation(_) => ProblemType::AuthorityRotation,
            AppError::RobotsLeft { .. } => ProblemType::RobotsLeft,
            AppError::UnknownStop(_) => ProblemType::UnknownStop,
            AppError::StopNotCleared { .. } => ProblemType::StopNotCleared,
            AppError::RobotUnreachable(_) => ProblemType::RobotUnreachable,
            AppError::RobotRefused { .. } => ProblemType::RobotRefused,
            AppError::CrossesGeofence { .. } => ProblemType::CrossesGeofence,
            AppError::OutsideGeofence { .. } => ProblemType::RobotOutsideGeofence,
            AppError::PreconditionFailed { .. } => ProblemType::PreconditionFailed,
            AppError::KeyInFlight => ProblemType::IdempotencyKeyInFlight,
            AppError::KeyReused => ProblemType::IdempotencyKeyReused,
            AppError::TooMany { .. } => ProblemType::TooMany,
            AppError::Invalid { .. } => ProblemType::InvalidBody,
            AppError::InvalidQuery { .. } | AppError::MapReadTooLarge { .. } => {
                ProblemType::InvalidQuery
            }
            AppError::Abandoned => ProblemType::Unavailable,
            AppError::NoRandomness(_) | AppError::Unwritable(_) | AppError::AuthorityFiles(_) => {
                error!("a request failed: {app_error}");
                ProblemType::Internal
            }
            AppError::Archive(cause) => return Self::archive(cause),
            AppError::Storage(cause) => return Self::storage(cause),
        };
        let mut problem = Self::new(kind).detail(app_error.to_string());
        problem.body.state = app_error.state();
        problem.body.place = app_error.place();
        match app_error.field() {
            Some(field) => problem.field(field),
            None => problem,
        }
    }
}

impl IntoResponse for Problem {
    fn into_response(self) -> Response {
        let status = StatusCode::from_u16(self.body.status).unwrap_or_default();
        let text = serde_json::to_vec(&self.body).unwrap_or_default();
        let mut response = Response::new(Body::from(text));
        *response.status_mut() = status;
        let media_type = HeaderValue::from_static(PROBLEM_MEDIA_TYPE);
        response
            .headers_mut()
            .insert(header::CONTENT_TYPE, media_type);
        let is_of_now = status == StatusCode::SERVICE_UNAVAILABLE
            || self.body.kind == ProblemType::TooManyRequests;
        if is_of_now {
            let seconds = HeaderValue::from(RETRY_AFTER_S);
            response.headers_mut().insert(header::RETRY_AFTER, seconds);
        }
        response.extensions_mut().insert(Refused(self.body.kind));
        response
    }
}
