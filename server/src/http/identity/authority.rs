//! `/v1/authority`: the fleet's authority and its rotation.

use axum::extract::State;
use axum::http::StatusCode;
use tread_api::enrolment::{FinishRotation, FleetAuthority, ReplaceAuthority};
use tread_api::problem::ProblemBody;

use crate::app::App;
use crate::http::extract::Json;
use crate::http::problem::Problem;
use crate::http::subject::Subject;

/// Get the fleet's certificate authority.
///
/// During a rotation the response names the robots that still hold certificates of the former
/// authority, and those that must join again.
#[utoipa::path(get, path = "/v1/authority", tag = "identity", operation_id = "get_authority",
    security(("token" = ["read"])),
    responses((status = 200, body = FleetAuthority), (status = 409, body = ProblemBody)))]
pub(in crate::http) async fn get(State(app): State<App>) -> Result<Json<FleetAuthority>, Problem> {
    Ok(Json(app.fleet_authority().await?))
}

/// Start a rotation of the certificate authority.
///
/// From now on the new authority signs certificates. Both authorities are trusted, and connected
/// robots get certificates of the new one. The response contains the identifier of the rotation.
#[utoipa::path(post, path = "/v1/authority/rotation", tag = "identity",
    operation_id = "start_authority_rotation", security(("token" = ["administer"])),
    responses((status = 201, body = FleetAuthority), (status = 409, body = ProblemBody)))]
pub(in crate::http) async fn start(
    State(app): State<App>,
    Subject(subject): Subject,
) -> Result<(StatusCode, Json<FleetAuthority>), Problem> {
    let started = app.start_rotation(&subject.name).await?;
    Ok((StatusCode::CREATED, Json(started)))
}

/// Finish a rotation of the certificate authority.
///
/// The former authority is retired. The server refuses this while robots hold certificates of it,
/// and names them, unless `force` is given; those robots must join again.
#[utoipa::path(post, path = "/v1/authority/rotation/finish", tag = "identity",
    operation_id = "finish_authority_rotation", security(("token" = ["administer"])),
    request_body = FinishRotation,
    responses((status = 200, body = FleetAuthority), (status = 409, body = ProblemBody),
        (status = 422, body = ProblemBody)))]
pub(in crate::http) async fn finish(
    State(app): State<App>,
    Subject(subject): Subject,
    Json(request): Json<FinishRotation>,
) -> Result<Json<FleetAuthority>, Problem> {
    let finished = app.finish_rotation(&request, &subject.name).await?;
    Ok(Json(finished))
}

/// Replace a certificate authority whose key was stolen.
///
/// From now on a new authority signs certificates. Earlier certificates are refused, also for
/// renewal, and every robot must join again.
#[utoipa::path(post, path = "/v1/authority/replace", tag = "identity",
    operation_id = "replace_authority", security(("token" = ["administer"])),
    request_body = ReplaceAuthority,
    responses((status = 200, body = FleetAuthority), (status = 409, body = ProblemBody),
        (status = 422, body = ProblemBody)))]
pub(in crate::http) async fn replace(
    State(app): State<App>,
    Subject(subject): Subject,
    Json(request): Json<ReplaceAuthority>,
) -> Result<Json<FleetAuthority>, Problem> {
    let replaced = app.replace_authority(&request, &subject.name).await?;
    Ok(Json(replaced))
}
