//! Stops: of one robot, of all, their list and their clearing.
//!
//! A stop is the one request whose body may be missing or wrong: it stops all the same.

use axum::extract::State;
use serde::Deserialize;
use tread_api::ids::{RobotId, SiteId};
use tread_api::page::Page;
use tread_api::problem::ProblemBody;
use tread_api::stop::{ClearStop, FleetStop, Stop, StopFleet, StopRobot};
use utoipa::IntoParams;

use super::extract::{Json, Path, Query, cursor, page_limit};
use super::identity::guard::Subject;
use super::problem::Problem;
use crate::app::App;
use crate::app::stops::StopWords;
use crate::db::stops::StopFilter;

/// Which stops, and which page of them.
#[derive(Debug, Clone, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(super) struct StopQuery {
    /// Only those of this site.
    #[param(value_type = Option<String>)]
    site: Option<SiteId>,
    /// Only those of robots of this name.
    #[param(value_type = Option<String>)]
    robot: Option<RobotId>,
    /// Only those that are not cleared.
    #[serde(default)]
    #[param(required = false)]
    in_force: bool,
    /// `next_cursor` of the page before.
    cursor: Option<String>,
    /// Most entries of the page, 1 to 1000; 100 when absent.
    limit: Option<u32>,
}

/// Stops a robot, in any state and whoever drives it. Answers when the robot has confirmed, or
/// after 300 ms: then it is told again until it does.
#[utoipa::path(post, path = "/v1/sites/{site}/robots/{robot}/stop", tag = "safety",
    security(("token" = ["viewer"])),
    operation_id = "stop_robot", params(("site" = SiteId, Path), ("robot" = RobotId, Path)),
    request_body = Option<StopRobot>,
    responses((status = 200, body = Stop), (status = 404, body = ProblemBody)))]
pub(super) async fn stop(
    State(app): State<App>,
    Subject(subject): Subject,
    Path((site, robot)): Path<(SiteId, RobotId)>,
    request: Result<Json<StopRobot>, Problem>,
) -> Result<Json<Stop>, Problem> {
    let StopRobot { by, reason } = request.map(|Json(request)| request).unwrap_or_default();
    let by = by.or_else(|| Some(subject.name.clone()));
    let words = StopWords { by, reason };
    Ok(Json(app.stop_robot(&site, &robot, words).await?))
}

/// Stops every robot that has ever said hello, of all sites or of one.
#[utoipa::path(post, path = "/v1/stop", tag = "safety", operation_id = "stop_fleet",
    security(("token" = ["viewer"])),
    request_body = Option<StopFleet>,
    responses((status = 200, body = FleetStop), (status = 404, body = ProblemBody)))]
pub(super) async fn stop_fleet(
    State(app): State<App>,
    Subject(subject): Subject,
    request: Result<Json<StopFleet>, Problem>,
) -> Result<Json<FleetStop>, Problem> {
    let request = request.map(|Json(request)| request).unwrap_or_default();
    let StopFleet { site, by, reason } = request;
    let by = by.or_else(|| Some(subject.name.clone()));
    let words = StopWords { by, reason };
    Ok(Json(app.stop_fleet(site.as_ref(), words).await?))
}

/// Clears a robot's newest stop, if the robot stands. Nothing starts by it: what the robot had in
/// hand or in its queue is held until somebody resumes it.
#[utoipa::path(post, path = "/v1/sites/{site}/robots/{robot}/stop/clear", tag = "safety",
    security(("token" = ["operator"])),
    operation_id = "clear_stop", params(("site" = SiteId, Path), ("robot" = RobotId, Path)),
    request_body = ClearStop,
    responses((status = 200, body = Stop), (status = 404, body = ProblemBody),
        (status = 409, body = ProblemBody), (status = 503, body = ProblemBody)))]
pub(super) async fn clear(
    State(app): State<App>,
    Subject(subject): Subject,
    Path((site, robot)): Path<(SiteId, RobotId)>,
    Json(request): Json<ClearStop>,
) -> Result<Json<Stop>, Problem> {
    let ClearStop { stop, by } = request;
    let by = by.or_else(|| Some(subject.name.clone()));
    Ok(Json(app.clear_stop(&site, &robot, stop, by).await?))
}

/// Stops, newest first.
#[utoipa::path(get, path = "/v1/stops", tag = "safety", operation_id = "list_stops",
    security(("token" = ["viewer"])),
    params(StopQuery),
    responses((status = 200, body = Page<Stop>), (status = 400, body = ProblemBody)))]
pub(super) async fn list(
    State(app): State<App>,
    Query(query): Query<StopQuery>,
) -> Result<Json<Page<Stop>>, Problem> {
    let limit = page_limit(query.limit)?;
    let before = cursor(query.cursor.as_deref())?;
    let StopQuery {
        site,
        robot,
        in_force,
        ..
    } = query;
    let filter = StopFilter {
        site,
        robot,
        in_force,
        before,
    };
    Ok(Json(app.stops(&filter, limit).await?))
}
