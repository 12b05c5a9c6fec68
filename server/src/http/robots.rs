//! `/v1/sites/{site}/robots`.

use axum::extract::State;
use tread_api::ids::{RobotId, SiteId};
use tread_api::page::Page;
use tread_api::problem::ProblemBody;
use tread_api::robot::Robot;

use super::extract::{Json, Path, Query, page_limit};
use super::problem::Problem;
use super::sites::PageQuery;
use crate::app::App;

/// The robots of a site, with their live state.
#[utoipa::path(get, path = "/v1/sites/{site}/robots", tag = "robots",
    operation_id = "list_robots", params(("site" = SiteId, Path), PageQuery),
    responses((status = 200, body = Page<Robot>), (status = 404, body = ProblemBody)))]
pub(super) async fn list(
    State(app): State<App>,
    Path(site): Path<SiteId>,
    Query(query): Query<PageQuery>,
) -> Result<Json<Page<Robot>>, Problem> {
    let limit = page_limit(query.limit)?;
    Ok(Json(
        app.robots(&site, query.cursor.as_deref(), limit).await?,
    ))
}

/// One robot with its live state and the age of every value.
#[utoipa::path(get, path = "/v1/sites/{site}/robots/{robot}", tag = "robots",
    operation_id = "get_robot", params(("site" = SiteId, Path), ("robot" = RobotId, Path)),
    responses((status = 200, body = Robot), (status = 404, body = ProblemBody)))]
pub(super) async fn get(
    State(app): State<App>,
    Path((site, robot)): Path<(SiteId, RobotId)>,
) -> Result<Json<Robot>, Problem> {
    Ok(Json(app.robot(&site, &robot).await?))
}
