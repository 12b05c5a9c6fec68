//! `/v1/authority`: the fleet's authority and its rotation.

use axum::extract::State;
use axum::http::StatusCode;
use tread_api::enrolment::{FinishRotation, FleetAuthority};
use tread_api::problem::ProblemBody;

use super::guard::Subject;
use crate::app::App;
use crate::http::extract::Json;
use crate::http::problem::Problem;

/// Show the fleet's authority and, during a rotation, which robots still hold certificates of the
/// former one.
#[utoipa::path(get, path = "/v1/authority", tag = "identity", operation_id = "get_authority",
    security(("token" = ["read"])),
    responses((status = 200, body = FleetAuthority), (status = 409, body = ProblemBody)))]
pub(in crate::http) async fn get(State(app): State<App>) -> Result<Json<FleetAuthority>, Problem> {
    Ok(Json(app.fleet_authority().await?))
}

/// Start a rotation of the fleet's authority: another one signs from now on, both are trusted, and
/// robots get certificates of the new one as they are on the network.
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

/// Finish the rotation: the former authority is retired. While robots hold certificates of it this is
/// refused and names them, unless it is forced; they must join again then.
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
    let finished = app.finish_rotation(request.force, &subject.name).await?;
    Ok(Json(finished))
}
