//! `/v1/alerts`.

use axum::extract::State;
use serde::Deserialize;
use tread_api::ids::{AlertCode, AlertId, RobotId, SiteId};
use tread_api::page::Page;
use tread_api::problem::ProblemBody;
use tread_api::robot::Alert;
use utoipa::IntoParams;

use super::extract::{Json, Path, Query, cursor, page_limit};
use super::problem::Problem;
use super::subject::Subject;
use crate::app::App;
use crate::app::alerts::AlertFilter;

/// Query parameters of the list of alerts.
#[derive(Debug, Clone, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(super) struct AlertQuery {
    /// Only alerts of this site.
    site: Option<SiteId>,
    /// Only alerts of this robot.
    robot: Option<RobotId>,
    /// Only alerts of this kind, such as `robot-lost`.
    kind: Option<AlertCode>,
    /// Only alerts that have not cleared.
    #[serde(default)]
    #[param(required = false)]
    raised: bool,
    /// `next_cursor` of the previous page.
    cursor: Option<String>,
    /// Maximum number of entries of the page, 1 to 1000; 100 when absent.
    limit: Option<u32>,
}

/// List alerts with their history, newest first.
#[utoipa::path(get, path = "/v1/alerts", tag = "alerts", operation_id = "list_alerts",
    security(("token" = ["read"])),
    params(AlertQuery),
    responses((status = 200, body = Page<Alert>), (status = 400, body = ProblemBody)))]
pub(super) async fn list(
    State(app): State<App>,
    Subject(subject): Subject,
    Query(query): Query<AlertQuery>,
) -> Result<Json<Page<Alert>>, Problem> {
    let limit = page_limit(query.limit)?;
    let filter = AlertFilter {
        before: cursor(query.cursor.as_deref())?,
        site: query.site,
        robot: query.robot,
        kind: query.kind,
        raised: query.raised,
        within: subject.scope.clone(),
    };
    Ok(Json(app.alerts(&filter, limit).await?))
}

/// Get an alert.
#[utoipa::path(get, path = "/v1/alerts/{alert}", tag = "alerts", operation_id = "get_alert",
    security(("token" = ["read"])), params(("alert" = AlertId, Path)),
    responses((status = 200, body = Alert), (status = 404, body = ProblemBody)))]
pub(super) async fn get(
    State(app): State<App>,
    Path(alert): Path<AlertId>,
) -> Result<Json<Alert>, Problem> {
    Ok(Json(app.alert(alert).await?))
}

/// Acknowledge an alert.
#[utoipa::path(post, path = "/v1/alerts/{alert}/acknowledge", tag = "alerts",
    security(("token" = ["acknowledge"])),
    operation_id = "acknowledge_alert", params(("alert" = AlertId, Path)),
    responses((status = 200, body = Alert), (status = 404, body = ProblemBody)))]
pub(super) async fn acknowledge(
    State(app): State<App>,
    Path(alert): Path<AlertId>,
) -> Result<Json<Alert>, Problem> {
    Ok(Json(app.acknowledge_alert(alert).await?))
}
