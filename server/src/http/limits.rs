//! `/v1/sites/{site}/robots/{robot}/limits`: limits by which other programs hold or slow a robot.

use axum::extract::State;
use axum::http::StatusCode;
use tread_api::ids::{OwnerId, RobotId, SiteId};
use tread_api::page::Page;
use tread_api::problem::ProblemBody;
use tread_api::safety::{LimitStatus, SetLimit};

use super::extract::{Json, Path};
use super::problem::Problem;
use crate::app::App;

/// List the external limits that a robot reports.
#[utoipa::path(get, path = "/v1/sites/{site}/robots/{robot}/limits", tag = "safety",
    security(("token" = ["read"])),
    operation_id = "list_limits", params(("site" = SiteId, Path), ("robot" = RobotId, Path)),
    responses((status = 200, body = Page<LimitStatus>), (status = 404, body = ProblemBody)))]
pub(super) async fn list(
    State(app): State<App>,
    Path((site, robot)): Path<(SiteId, RobotId)>,
) -> Result<Json<Page<LimitStatus>>, Problem> {
    Ok(Json(app.limits(&site, &robot).await?))
}

/// Hold or slow a robot for a limited time.
///
/// Repeat the request before the limit expires to keep it.
#[utoipa::path(put, path = "/v1/sites/{site}/robots/{robot}/limits/{owner}", tag = "safety",
    security(("token" = ["hold"])),
    operation_id = "set_limit", params(("site" = SiteId, Path), ("robot" = RobotId, Path),
        ("owner" = OwnerId, Path)),
    request_body = SetLimit,
    responses((status = 204, description = "The robot has accepted the limit"),
        (status = 404, body = ProblemBody), (status = 409, body = ProblemBody),
        (status = 422, body = ProblemBody), (status = 503, body = ProblemBody)))]
pub(super) async fn set(
    State(app): State<App>,
    Path((site, robot, owner)): Path<(SiteId, RobotId, OwnerId)>,
    Json(request): Json<SetLimit>,
) -> Result<StatusCode, Problem> {
    app.set_limit((&site, &robot), owner, request).await?;
    Ok(StatusCode::NO_CONTENT)
}

/// End an external limit.
///
/// If the robot's configuration requires this owner, the robot is on hold from then on.
#[utoipa::path(delete, path = "/v1/sites/{site}/robots/{robot}/limits/{owner}", tag = "safety",
    security(("token" = ["hold"])),
    operation_id = "end_limit", params(("site" = SiteId, Path), ("robot" = RobotId, Path),
        ("owner" = OwnerId, Path)),
    responses((status = 204, description = "The robot has ended the limit"),
        (status = 404, body = ProblemBody), (status = 409, body = ProblemBody),
        (status = 503, body = ProblemBody)))]
pub(super) async fn end(
    State(app): State<App>,
    Path((site, robot, owner)): Path<(SiteId, RobotId, OwnerId)>,
) -> Result<StatusCode, Problem> {
    app.end_limit((&site, &robot), owner).await?;
    Ok(StatusCode::NO_CONTENT)
}
