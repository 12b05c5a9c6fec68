//! `/v1/sites/{site}/robots`.

use axum::extract::State;
use serde::Deserialize;
use tread_api::ids::{RobotId, SiteId};
use tread_api::page::Page;
use tread_api::problem::ProblemBody;
use tread_api::robot::{Robot, UpdateRobot};
use utoipa::IntoParams;

use super::extract::{Json, Path, Query, page_limit};
use super::problem::Problem;
use super::subject::Subject;
use crate::app::App;

/// Query parameters of the list of robots.
#[derive(Debug, Clone, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(super) struct RobotQuery {
    /// Whether to include retired robots; false when absent.
    #[serde(default)]
    #[param(required = false)]
    retired: bool,
    /// `next_cursor` of the previous page.
    cursor: Option<String>,
    /// Maximum number of entries of the page, 1 to 1000; 100 when absent.
    limit: Option<u32>,
}

/// List the robots of a site with their live state.
#[utoipa::path(get, path = "/v1/sites/{site}/robots", tag = "robots",
    security(("token" = ["read"])),
    operation_id = "list_robots", params(("site" = SiteId, Path), RobotQuery),
    responses((status = 200, body = Page<Robot>), (status = 404, body = ProblemBody)))]
pub(super) async fn list(
    State(app): State<App>,
    Subject(subject): Subject,
    Path(site): Path<SiteId>,
    Query(query): Query<RobotQuery>,
) -> Result<Json<Page<Robot>>, Problem> {
    let limit = page_limit(query.limit)?;
    let (place, cursor) = ((&site, &subject.scope), query.cursor.as_deref());
    Ok(Json(app.robots(place, cursor, query.retired, limit).await?))
}

/// Get a robot with its live state and the age of every value.
#[utoipa::path(get, path = "/v1/sites/{site}/robots/{robot}", tag = "robots",
    security(("token" = ["read"])),
    operation_id = "get_robot", params(("site" = SiteId, Path), ("robot" = RobotId, Path)),
    responses((status = 200, body = Robot), (status = 404, body = ProblemBody)))]
pub(super) async fn get(
    State(app): State<App>,
    Path((site, robot)): Path<(SiteId, RobotId)>,
) -> Result<Json<Robot>, Problem> {
    Ok(Json(app.robot(&site, &robot).await?))
}

/// Release a robot after the server was restored from a backup.
///
/// What happened after the backup is unknown, so no mission is sent to a robot until it is
/// released. The request has no effect on a robot that does not await its release.
#[utoipa::path(post, path = "/v1/sites/{site}/robots/{robot}/release", tag = "robots",
    security(("token" = ["dispatch"])),
    operation_id = "release_robot", params(("site" = SiteId, Path), ("robot" = RobotId, Path)),
    responses((status = 200, body = Robot), (status = 404, body = ProblemBody)))]
pub(super) async fn release(
    State(app): State<App>,
    Path((site, robot)): Path<(SiteId, RobotId)>,
) -> Result<Json<Robot>, Problem> {
    Ok(Json(app.release_robot(&site, &robot).await?))
}

/// Rename, tag, retire or restore a robot.
///
/// Retiring a robot cancels all its missions.
#[utoipa::path(patch, path = "/v1/sites/{site}/robots/{robot}", tag = "robots",
    security(("token" = ["configure"])),
    operation_id = "update_robot", params(("site" = SiteId, Path), ("robot" = RobotId, Path)),
    request_body = UpdateRobot,
    responses((status = 200, body = Robot), (status = 404, body = ProblemBody),
        (status = 422, body = ProblemBody)))]
pub(super) async fn change(
    State(app): State<App>,
    Path((site, robot)): Path<(SiteId, RobotId)>,
    Json(request): Json<UpdateRobot>,
) -> Result<Json<Robot>, Problem> {
    Ok(Json(app.update_robot(&site, &robot, request).await?))
}
