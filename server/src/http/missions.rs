//! `/v1/missions`.

use axum::extract::State;
use axum::http::StatusCode;
use serde::Deserialize;
use tread_api::ids::{MissionId, RobotId, SiteId};
use tread_api::mission::{CreateMission, Mission, MissionDetail, MissionState};
use tread_api::page::Page;
use tread_api::problem::ProblemBody;
use utoipa::IntoParams;

use super::extract::{Json, Path, Query, cursor, page_limit};
use super::problem::Problem;
use crate::app::App;
use crate::db::missions::MissionFilter;

/// Which missions, and which page of them.
#[derive(Debug, Clone, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(super) struct MissionQuery {
    /// Only those of this site.
    #[param(value_type = Option<String>)]
    site: Option<SiteId>,
    /// Only those of this robot.
    #[param(value_type = Option<String>)]
    robot: Option<RobotId>,
    /// Only those in this state.
    state: Option<MissionState>,
    /// `next_cursor` of the page before.
    cursor: Option<String>,
    /// Most entries of the page, 1 to 1000; 100 when absent.
    limit: Option<u32>,
}

/// Missions, newest first.
#[utoipa::path(get, path = "/v1/missions", tag = "missions", operation_id = "list_missions",
    params(MissionQuery),
    responses((status = 200, body = Page<Mission>), (status = 400, body = ProblemBody)))]
pub(super) async fn list(
    State(app): State<App>,
    Query(query): Query<MissionQuery>,
) -> Result<Json<Page<Mission>>, Problem> {
    let limit = page_limit(query.limit)?;
    let before = cursor(query.cursor.as_deref())?;
    let MissionQuery {
        site, robot, state, ..
    } = query;
    let filter = MissionFilter {
        site,
        robot,
        state,
        before,
    };
    Ok(Json(app.missions(&filter, limit).await?))
}

/// Asks a robot to drive a circle or waypoints. It waits in the robot's queue.
#[utoipa::path(post, path = "/v1/missions", tag = "missions", operation_id = "create_mission",
    request_body = CreateMission,
    responses((status = 201, body = Mission), (status = 404, body = ProblemBody),
        (status = 409, body = ProblemBody), (status = 413, body = ProblemBody),
        (status = 415, body = ProblemBody), (status = 422, body = ProblemBody)))]
pub(super) async fn create(
    State(app): State<App>,
    Json(request): Json<CreateMission>,
) -> Result<(StatusCode, Json<Mission>), Problem> {
    Ok((
        StatusCode::CREATED,
        Json(app.create_mission(request).await?),
    ))
}

/// One mission with its history.
#[utoipa::path(get, path = "/v1/missions/{mission}", tag = "missions",
    operation_id = "get_mission", params(("mission" = MissionId, Path)),
    responses((status = 200, body = MissionDetail), (status = 404, body = ProblemBody)))]
pub(super) async fn get(
    State(app): State<App>,
    Path(mission): Path<MissionId>,
) -> Result<Json<MissionDetail>, Problem> {
    Ok(Json(app.mission(mission).await?))
}

/// Wants a mission to end. One that waits ends at once, one in hand when its robot has answered.
#[utoipa::path(post, path = "/v1/missions/{mission}/cancel", tag = "missions",
    operation_id = "cancel_mission", params(("mission" = MissionId, Path)),
    responses((status = 202, body = MissionDetail), (status = 404, body = ProblemBody),
        (status = 409, body = ProblemBody)))]
pub(super) async fn cancel(
    State(app): State<App>,
    Path(mission): Path<MissionId>,
) -> Result<(StatusCode, Json<MissionDetail>), Problem> {
    Ok((
        StatusCode::ACCEPTED,
        Json(app.cancel_mission(mission).await?),
    ))
}
