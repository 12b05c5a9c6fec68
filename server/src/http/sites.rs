//! `/v1/sites`.

use axum::extract::State;
use axum::http::StatusCode;
use serde::Deserialize;
use tread_api::ids::SiteId;
use tread_api::page::Page;
use tread_api::problem::ProblemBody;
use tread_api::site::{CreateSite, GeoOrigin, Site};
use utoipa::IntoParams;

use super::extract::{Json, Path, Query, page_limit};
use super::problem::Problem;
use super::subject::Subject;
use crate::app::App;

/// Query parameters of a list.
#[derive(Debug, Clone, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(super) struct PageQuery {
    /// `next_cursor` of the previous page.
    pub(super) cursor: Option<String>,
    /// Maximum number of entries of the page, 1 to 1000; 100 when absent.
    pub(super) limit: Option<u32>,
}

/// List sites.
#[utoipa::path(get, path = "/v1/sites", tag = "sites", operation_id = "list_sites",
    security(("token" = ["read"])),
    params(PageQuery),
    responses((status = 200, body = Page<Site>), (status = 400, body = ProblemBody)))]
pub(super) async fn list(
    State(app): State<App>,
    Subject(subject): Subject,
    Query(query): Query<PageQuery>,
) -> Result<Json<Page<Site>>, Problem> {
    let limit = page_limit(query.limit)?;
    let cursor = query.cursor.as_deref();
    Ok(Json(app.sites(&subject.scope, cursor, limit).await?))
}

/// Get a site.
#[utoipa::path(get, path = "/v1/sites/{site}", tag = "sites", operation_id = "get_site",
    security(("token" = ["read"])),
    params(("site" = SiteId, Path)),
    responses((status = 200, body = Site), (status = 404, body = ProblemBody)))]
pub(super) async fn get(
    State(app): State<App>,
    Path(site): Path<SiteId>,
) -> Result<Json<Site>, Problem> {
    Ok(Json(app.site(&site).await?))
}

/// Create a site.
#[utoipa::path(post, path = "/v1/sites", tag = "sites", operation_id = "create_site",
    security(("token" = ["administer"])),
    request_body = CreateSite,
    responses((status = 201, body = Site), (status = 409, body = ProblemBody),
        (status = 422, body = ProblemBody)))]
pub(super) async fn create(
    State(app): State<App>,
    Json(request): Json<CreateSite>,
) -> Result<(StatusCode, Json<Site>), Problem> {
    Ok((StatusCode::CREATED, Json(app.create_site(request).await?)))
}

/// Set the position of a site's origin in WGS 84, which exports of its map in WGS 84 need.
#[utoipa::path(put, path = "/v1/sites/{site}/origin", tag = "sites", operation_id = "set_site_origin",
    security(("token" = ["configure"])),
    params(("site" = SiteId, Path)), request_body = GeoOrigin,
    responses((status = 200, body = Site), (status = 404, body = ProblemBody),
        (status = 422, body = ProblemBody)))]
pub(super) async fn set_origin(
    State(app): State<App>,
    Path(site): Path<SiteId>,
    Json(origin): Json<GeoOrigin>,
) -> Result<Json<Site>, Problem> {
    Ok(Json(app.set_site_origin(&site, Some(origin)).await?))
}

/// Remove the position of a site's origin in WGS 84.
#[utoipa::path(delete, path = "/v1/sites/{site}/origin", tag = "sites",
    operation_id = "remove_site_origin", security(("token" = ["configure"])),
    params(("site" = SiteId, Path)),
    responses((status = 200, body = Site), (status = 404, body = ProblemBody)))]
pub(super) async fn remove_origin(
    State(app): State<App>,
    Path(site): Path<SiteId>,
) -> Result<Json<Site>, Problem> {
    Ok(Json(app.set_site_origin(&site, None).await?))
}
