//! `/v1/missions`.

use axum::extract::State;
use axum::http::{HeaderMap, StatusCode};
use serde::Deserialize;
use tread_api::ids::{MissionId, RobotId, SiteId};
use tread_api::mission::{CreateMission, Mission, MissionDetail, MissionState, ReplaceMission};
use tread_api::page::Page;
use tread_api::problem::{ProblemBody, ProblemType};
use tread_api::trajectory::{CheckTrajectory, PlannedPath, TrajectoryCheck};
use utoipa::IntoParams;

use super::extract::{Json, Path, Query, cursor, page_limit};
use super::problem::Problem;
use super::subject::Subject;
use crate::app::App;
use crate::app::missions::MissionFilter;
use crate::app::missions::idempotency::KEY_LENGTH_MAX;

/// Query parameters of the list of missions.
#[derive(Debug, Clone, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(super) struct MissionQuery {
    /// Only missions of this site.
    site: Option<SiteId>,
    /// Only missions of this robot.
    robot: Option<RobotId>,
    /// Only missions in this state.
    state: Option<MissionState>,
    /// `next_cursor` of the previous page.
    cursor: Option<String>,
    /// Maximum number of entries of the page, 1 to 1000; 100 when absent.
    limit: Option<u32>,
}

/// List missions, newest first.
#[utoipa::path(get, path = "/v1/missions", tag = "missions", operation_id = "list_missions",
    security(("token" = ["read"])),
    params(MissionQuery),
    responses((status = 200, body = Page<Mission>), (status = 400, body = ProblemBody)))]
pub(super) async fn list(
    State(app): State<App>,
    Subject(subject): Subject,
    Query(query): Query<MissionQuery>,
) -> Result<Json<Page<Mission>>, Problem> {
    let limit = page_limit(query.limit)?;
    let before = cursor(query.cursor.as_deref())?;
    let MissionQuery {
        site, robot, state, ..
    } = query;
    let filter = MissionFilter {
        site: site.or_else(|| subject.scope.only_site().cloned()),
        robot,
        state,
        before,
        within: subject.scope.clone(),
    };
    Ok(Json(app.missions(&filter, limit).await?))
}

/// Create a mission, in which a robot drives a circle or waypoints.
///
/// The mission waits in the robot's queue until the robot is ready for it.
#[utoipa::path(post, path = "/v1/missions", tag = "missions", operation_id = "create_mission",
    security(("token" = ["dispatch"])),
    request_body = CreateMission,
    params(("idempotency-key" = Option<String>, Header,
        description = "Key chosen by the client. A repetition with the same token and key gets the same response, and has no further effect")),
    responses((status = 201, body = Mission), (status = 404, body = ProblemBody),
        (status = 409, body = ProblemBody), (status = 413, body = ProblemBody),
        (status = 415, body = ProblemBody), (status = 422, body = ProblemBody)))]
pub(super) async fn create(
    State(app): State<App>,
    Subject(subject): Subject,
    headers: HeaderMap,
    Json(request): Json<CreateMission>,
) -> Result<(StatusCode, Json<Mission>), Problem> {
    subject.check_robot(&request.site, &request.robot)?;
    let mission = match idempotency_key(&headers)? {
        Some(key) => {
            app.create_mission_once((subject.subject, key), request)
                .await?
        }
        None => app.create_mission(request).await?,
    };
    Ok((StatusCode::CREATED, Json(mission)))
}

fn idempotency_key(headers: &HeaderMap) -> Result<Option<&str>, Problem> {
    let Some(value) = headers.get("idempotency-key") else {
        return Ok(None);
    };
    let key = value.to_str().ok().map(str::trim);
    let usable = key.filter(|key| (1..=KEY_LENGTH_MAX).contains(&key.len()));
    usable.map(Some).ok_or_else(|| {
        let detail = format!("idempotency-key must have 1 to {KEY_LENGTH_MAX} visible characters");
        Problem::new(ProblemType::InvalidHeader)
            .detail(detail)
            .field("idempotency-key")
    })
}

/// Get a mission with its history.
#[utoipa::path(get, path = "/v1/missions/{mission}", tag = "missions",
    security(("token" = ["read"])),
    operation_id = "get_mission", params(("mission" = MissionId, Path)),
    responses((status = 200, body = MissionDetail), (status = 404, body = ProblemBody)))]
pub(super) async fn get(
    State(app): State<App>,
    Path(mission): Path<MissionId>,
) -> Result<Json<MissionDetail>, Problem> {
    Ok(Json(app.mission(mission).await?))
}

/// Get the planned path of a mission.
///
/// Once the robot has accepted the mission, the path starts at the pose from which the robot
/// planned. Until then it starts at the start of the trajectory.
#[utoipa::path(get, path = "/v1/missions/{mission}/path", tag = "missions",
    security(("token" = ["read"])),
    operation_id = "get_planned_path", params(("mission" = MissionId, Path)),
    responses((status = 200, body = PlannedPath), (status = 404, body = ProblemBody),
        (status = 422, body = ProblemBody)))]
pub(super) async fn path(
    State(app): State<App>,
    Path(mission): Path<MissionId>,
) -> Result<Json<PlannedPath>, Problem> {
    Ok(Json(app.planned_path(mission).await?))
}

/// Cancel a mission.
///
/// A queued mission ends at once, an active one when its robot has confirmed.
#[utoipa::path(post, path = "/v1/missions/{mission}/cancel", tag = "missions",
    security(("token" = ["dispatch"])),
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

/// Pause an active mission; the robot brakes and stays at rest.
#[utoipa::path(post, path = "/v1/missions/{mission}/pause", tag = "missions",
    security(("token" = ["dispatch"])),
    operation_id = "pause_mission", params(("mission" = MissionId, Path)),
    responses((status = 202, body = MissionDetail), (status = 404, body = ProblemBody),
        (status = 409, body = ProblemBody)))]
pub(super) async fn pause(
    State(app): State<App>,
    Path(mission): Path<MissionId>,
) -> Result<(StatusCode, Json<MissionDetail>), Problem> {
    Ok((
        StatusCode::ACCEPTED,
        Json(app.pause_mission(mission).await?),
    ))
}

/// Resume a paused mission.
#[utoipa::path(post, path = "/v1/missions/{mission}/resume", tag = "missions",
    security(("token" = ["dispatch"])),
    operation_id = "resume_mission", params(("mission" = MissionId, Path)),
    responses((status = 202, body = MissionDetail), (status = 404, body = ProblemBody),
        (status = 409, body = ProblemBody)))]
pub(super) async fn resume(
    State(app): State<App>,
    Path(mission): Path<MissionId>,
) -> Result<(StatusCode, Json<MissionDetail>), Problem> {
    Ok((
        StatusCode::ACCEPTED,
        Json(app.resume_mission(mission).await?),
    ))
}

/// Replace a mission's trajectory.
///
/// A queued mission changes at once. An active one changes when its robot has received the whole
/// revision; until then the robot drives the earlier one.
#[utoipa::path(post, path = "/v1/missions/{mission}/replace", tag = "missions",
    security(("token" = ["dispatch"])),
    operation_id = "replace_mission", params(("mission" = MissionId, Path)),
    request_body = ReplaceMission,
    responses((status = 202, body = MissionDetail), (status = 404, body = ProblemBody),
        (status = 409, body = ProblemBody), (status = 422, body = ProblemBody)))]
pub(super) async fn replace(
    State(app): State<App>,
    Path(mission): Path<MissionId>,
    Json(request): Json<ReplaceMission>,
) -> Result<(StatusCode, Json<MissionDetail>), Problem> {
    Ok((
        StatusCode::ACCEPTED,
        Json(app.replace_mission(mission, request).await?),
    ))
}

/// Plan a trajectory for a robot without moving it.
#[utoipa::path(post, path = "/v1/trajectories/check", tag = "missions",
    security(("token" = ["dispatch"])),
    operation_id = "check_trajectory", request_body = CheckTrajectory,
    responses((status = 200, body = TrajectoryCheck), (status = 404, body = ProblemBody),
        (status = 409, body = ProblemBody), (status = 422, body = ProblemBody)))]
pub(super) async fn check(
    State(app): State<App>,
    Subject(subject): Subject,
    Json(request): Json<CheckTrajectory>,
) -> Result<Json<TrajectoryCheck>, Problem> {
    subject.check_robot(&request.site, &request.robot)?;
    Ok(Json(app.check_trajectory(request).await?))
}
