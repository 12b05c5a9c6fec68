//! `/v1/sites/{site}/withdrawals` and `/v1/sites/{site}/robots/{robot}/withdrawals`.

use axum::extract::State;
use axum::http::{HeaderMap, StatusCode};
use axum::response::Response;
use tread_api::friction::{CreateWithdrawal, Withdrawal};
use tread_api::ids::{RobotId, SiteId};
use tread_api::page::Page;
use tread_api::problem::ProblemBody;

use super::etag;
use super::extract::{Json, Path, Query, cursor, page_limit};
use super::problem::Problem;
use super::sites::PageQuery;
use super::subject::Subject;
use crate::app::App;

/// Withdraw a robot's measurements of a period from the map.
///
/// This is final: the map is as if they had never arrived, and measurements of that period that
/// arrive later are ignored.
#[utoipa::path(post, path = "/v1/sites/{site}/robots/{robot}/withdrawals", tag = "friction",
    security(("token" = ["configure"])),
    operation_id = "withdraw_measurements",
    params(("site" = SiteId, Path), ("robot" = RobotId, Path)),
    request_body = CreateWithdrawal,
    responses((status = 201, body = Withdrawal), (status = 404, body = ProblemBody),
        (status = 409, body = ProblemBody), (status = 422, body = ProblemBody)))]
pub(super) async fn create(
    State(app): State<App>,
    Subject(subject): Subject,
    Path((site, robot)): Path<(SiteId, RobotId)>,
    Json(request): Json<CreateWithdrawal>,
) -> Result<(StatusCode, Json<Withdrawal>), Problem> {
    let withdrawal = app.withdraw((&site, &robot), request, &subject.name);
    Ok((StatusCode::CREATED, Json(withdrawal.await?)))
}

/// List withdrawals of measurements, oldest first.
#[utoipa::path(get, path = "/v1/sites/{site}/withdrawals", tag = "friction",
    security(("token" = ["read"])),
    operation_id = "list_withdrawals", params(("site" = SiteId, Path), PageQuery),
    responses((status = 200, body = Page<Withdrawal>), (status = 304),
        (status = 404, body = ProblemBody)))]
pub(super) async fn list(
    State(app): State<App>,
    Subject(subject): Subject,
    Path(site): Path<SiteId>,
    Query(query): Query<PageQuery>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let limit = page_limit(query.limit)?;
    let after = cursor(query.cursor.as_deref())?;
    let found = app
        .withdrawals((&site, &subject.scope), after, limit)
        .await?;
    Ok(etag::json(&headers, &found))
}
