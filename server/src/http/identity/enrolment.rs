//! `/v1/join-tokens`, `/v1/enrolments` and `/v1/sites/{site}/enrolments`: robots of the fleet.

use axum::extract::{Extension, State};
use axum::http::StatusCode;
use axum::response::{IntoResponse, Response};
use base64::Engine as _;
use base64::prelude::BASE64_STANDARD;
use serde::Deserialize;
use serde_json::{Value, json};
use tread_api::enrolment::{
    CreateJoinToken, CreatedJoinToken, EnrolRobot, Enrolment, JoinToken, RenewCertificate,
    RobotCertificate,
};
use tread_api::ids::{JoinTokenId, RobotId, SiteId};
use tread_api::page::Page;
use tread_api::problem::{ProblemBody, ProblemType};
use utoipa::IntoParams;

use super::guard::{Audited, Peer, locked};
use crate::app::enrolment::EnrolError;
use crate::app::{App, AppError};
use crate::http::extract::{Json, Path, Query, cursor, page_limit};
use crate::http::problem::Problem;
use crate::http::subject::Subject;

/// Query parameters of a list.
#[derive(Debug, Clone, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(in crate::http) struct PageQuery {
    /// `next_cursor` of the previous page.
    cursor: Option<String>,
    /// Maximum number of entries of the page, 1 to 1000; 100 when absent.
    limit: Option<u32>,
}

/// List join tokens, newest first, including used, expired and revoked ones.
///
/// Secrets are shown only when a token is created.
#[utoipa::path(get, path = "/v1/join-tokens", tag = "identity", operation_id = "list_join_tokens",
    security(("token" = ["administer"])), params(PageQuery),
    responses((status = 200, body = Page<JoinToken>), (status = 400, body = ProblemBody)))]
pub(in crate::http) async fn list_tokens(
    State(app): State<App>,
    Subject(subject): Subject,
    Query(query): Query<PageQuery>,
) -> Result<Json<Page<JoinToken>>, Problem> {
    let limit = page_limit(query.limit)?;
    let before = cursor(query.cursor.as_deref())?;
    Ok(Json(app.join_tokens(&subject.scope, before, limit).await?))
}

/// Create a join token, which is valid for one robot once.
///
/// Only this response contains its secret.
#[utoipa::path(post, path = "/v1/join-tokens", tag = "identity",
    operation_id = "create_join_token",
    security(("token" = ["administer"])), request_body = CreateJoinToken,
    responses((status = 201, body = CreatedJoinToken), (status = 404, body = ProblemBody),
        (status = 409, body = ProblemBody), (status = 422, body = ProblemBody)))]
pub(in crate::http) async fn create_token(
    State(app): State<App>,
    Subject(subject): Subject,
    Json(request): Json<CreateJoinToken>,
) -> Result<(StatusCode, Json<CreatedJoinToken>), Problem> {
    match &request.robot {
        Some(robot) => subject.check_robot(&request.site, robot)?,
        None => subject.check_whole_site(&request.site)?,
    }
    let maker = (&*subject.name, &subject.scope);
    let created = app.create_join_token(request, maker).await?;
    Ok((StatusCode::CREATED, Json(created)))
}

/// Revoke a join token.
#[utoipa::path(delete, path = "/v1/join-tokens/{token}", tag = "identity",
    operation_id = "revoke_join_token", security(("token" = ["administer"])),
    params(("token" = JoinTokenId, Path)),
    responses((status = 200, body = JoinToken), (status = 404, body = ProblemBody)))]
pub(in crate::http) async fn revoke_token(
    State(app): State<App>,
    Path(token): Path<JoinTokenId>,
) -> Result<Json<JoinToken>, Problem> {
    Ok(Json(app.revoke_join_token(token).await?))
}

/// List the newest enrolment of every robot of a site.
#[utoipa::path(get, path = "/v1/sites/{site}/enrolments", tag = "identity",
    operation_id = "list_enrolments", security(("token" = ["read"])),
    params(("site" = SiteId, Path), PageQuery),
    responses((status = 200, body = Page<Enrolment>), (status = 404, body = ProblemBody)))]
pub(in crate::http) async fn list(
    State(app): State<App>,
    Subject(subject): Subject,
    Path(site): Path<SiteId>,
    Query(query): Query<PageQuery>,
) -> Result<Json<Page<Enrolment>>, Problem> {
    let limit = page_limit(query.limit)?;
    let after = query.cursor.unwrap_or_default();
    let place = (&site, &subject.scope);
    Ok(Json(app.enrolments(place, &after, limit).await?))
}

/// Revoke a robot's enrolment.
///
/// The server ignores its messages, cuts its connection and gives it no certificate until it joins
/// again with a token that names it.
#[utoipa::path(delete, path = "/v1/sites/{site}/enrolments/{robot}", tag = "identity",
    operation_id = "revoke_robot", security(("token" = ["administer"])),
    params(("site" = SiteId, Path), ("robot" = RobotId, Path)),
    responses((status = 200, body = Enrolment), (status = 404, body = ProblemBody)))]
pub(in crate::http) async fn revoke(
    State(app): State<App>,
    Subject(subject): Subject,
    Path((site, robot)): Path<(SiteId, RobotId)>,
) -> Result<Json<Enrolment>, Problem> {
    Ok(Json(app.revoke_robot(&site, &robot, &subject.name).await?))
}

/// Enrol a robot with a join token.
///
/// The join token cannot be used again. The request needs no credentials. The response is the same,
/// byte for byte, whether the token is wrong, expired, used, revoked or for another robot.
#[utoipa::path(post, path = "/v1/enrolments", tag = "identity", operation_id = "enrol_robot",
    request_body = EnrolRobot,
    responses((status = 201, body = RobotCertificate), (status = 401, body = ProblemBody),
        (status = 409, body = ProblemBody), (status = 422, body = ProblemBody),
        (status = 429, body = ProblemBody)))]
pub(in crate::http) async fn enrol(
    State(app): State<App>,
    peer: Option<Extension<Peer>>,
    Json(request): Json<EnrolRobot>,
) -> Response {
    let address = peer.map_or([0, 0, 0, 0].into(), |Extension(Peer(address))| address);
    match app.enrol_robot(address, &request).await {
        Ok(enrolled) => {
            let certificate = enrolled.certificate;
            let what = json!({
                "join_token": enrolled.join_token, "site": certificate.site,
                "robot": certificate.robot, "enrolment": certificate.enrolment,
            });
            let response = (StatusCode::CREATED, Json(certificate)).into_response();
            audited(response, what)
        }
        Err(error) => {
            let what = json!({
                "join_token": error.join_token(), "robot": request.robot,
                "refused": error.to_string(),
            });
            audited(refusal(&app, error), what)
        }
    }
}

/// Renew a robot's certificate.
///
/// The request proves that the robot has the keys of its present and of its next certificate. It
/// needs no credentials; every refusal has the same response, byte for byte.
#[utoipa::path(post, path = "/v1/enrolments/renew", tag = "identity",
    operation_id = "renew_certificate", request_body = RenewCertificate,
    responses((status = 200, body = RobotCertificate), (status = 401, body = ProblemBody),
        (status = 409, body = ProblemBody), (status = 422, body = ProblemBody)))]
pub(in crate::http) async fn renew(
    State(app): State<App>,
    Json(request): Json<RenewCertificate>,
) -> Response {
    // What is no base64 is no proof.
    let proof = BASE64_STANDARD.decode(&request.proof).unwrap_or_default();
    match app.renew_certificate(&request, &proof).await {
        Ok(certificate) => {
            let what = json!({"site": certificate.site, "robot": certificate.robot});
            audited(Json(certificate).into_response(), what)
        }
        Err(error) => {
            let mut what = json!({"refused": error.to_string()});
            if let EnrolError::Ended(name)
            | EnrolError::Retired(name)
            | EnrolError::NotIssued(name) = &error
            {
                what["site"] = json!(name.site);
                what["robot"] = json!(name.robot);
            }
            audited(refusal(&app, error), what)
        }
    }
}

fn audited(mut response: Response, what: Value) -> Response {
    response.extensions_mut().insert(Audited(what));
    response
}

/// Returns the response to a refused request for a certificate; counts the cause.
fn refusal(app: &App, error: EnrolError) -> Response {
    let counters = app.counters();
    let message = error.to_string();
    let counter = match error {
        EnrolError::Request(_) => {
            let problem = Problem::new(ProblemType::InvalidBody).detail(message);
            return problem.field("certificate_request").into_response();
        }
        EnrolError::Closed => return Problem::from(AppError::NoAuthority).into_response(),
        EnrolError::App(error) => return Problem::from(error).into_response(),
        EnrolError::Locked(left) => return locked(app, left, message),
        EnrolError::Malformed => &counters.join_token_malformed,
        EnrolError::Unknown => &counters.join_token_unknown,
        EnrolError::Expired(_) => &counters.join_token_expired,
        EnrolError::Used(_) => &counters.join_token_used,
        EnrolError::Revoked(_) => &counters.join_token_revoked,
        EnrolError::OtherRobot(_) | EnrolError::KnownRobot(_) | EnrolError::Nameless(_) => {
            &counters.join_token_other_robot
        }
        EnrolError::Certificate(_) => &counters.renewals_refused,
        EnrolError::Ended(_) => &counters.renewals_revoked,
        EnrolError::Retired(_) => &counters.renewals_retired,
        EnrolError::NotIssued(_) => &counters.renewals_not_issued,
    };
    counter.one();
    Problem::new(ProblemType::Unauthenticated)
        .detail("the request was refused: ask an administrator for a join token")
        .into_response()
}
