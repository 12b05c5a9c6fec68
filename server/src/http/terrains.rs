//! `/v1/sites/{site}/terrains`.

use axum::extract::State;
use axum::http::{HeaderMap, StatusCode};
use axum::response::Response;
use tread_api::ids::{SiteId, TerrainId};
use tread_api::page::Page;
use tread_api::problem::ProblemBody;
use tread_api::terrain::{CreateTerrain, ReplaceTerrain, Terrain};

use super::extract::{Json, Path, Query, page_limit};
use super::problem::Problem;
use super::revision;
use super::sites::PageQuery;
use crate::app::App;

/// List the terrains of a site.
#[utoipa::path(get, path = "/v1/sites/{site}/terrains", tag = "terrains",
    security(("token" = ["read"])),
    operation_id = "list_terrains", params(("site" = SiteId, Path), PageQuery),
    responses((status = 200, body = Page<Terrain>), (status = 404, body = ProblemBody)))]
pub(super) async fn list(
    State(app): State<App>,
    Path(site): Path<SiteId>,
    Query(query): Query<PageQuery>,
) -> Result<Json<Page<Terrain>>, Problem> {
    let limit = page_limit(query.limit)?;
    Ok(Json(
        app.terrains(&site, query.cursor.as_deref(), limit).await?,
    ))
}

/// Get a terrain.
#[utoipa::path(get, path = "/v1/sites/{site}/terrains/{terrain}", tag = "terrains",
    security(("token" = ["read"])),
    operation_id = "get_terrain", params(("site" = SiteId, Path), ("terrain" = TerrainId, Path)),
    responses((status = 200, body = Terrain), (status = 404, body = ProblemBody)))]
pub(super) async fn get(
    State(app): State<App>,
    Path((site, terrain)): Path<(SiteId, TerrainId)>,
) -> Result<Response, Problem> {
    let found = app.terrain(&site, &terrain).await?;
    Ok(tagged(StatusCode::OK, found))
}

/// Create a terrain.
#[utoipa::path(post, path = "/v1/sites/{site}/terrains", tag = "terrains",
    security(("token" = ["configure"])),
    operation_id = "create_terrain", params(("site" = SiteId, Path)),
    request_body = CreateTerrain,
    responses((status = 201, body = Terrain), (status = 404, body = ProblemBody),
        (status = 409, body = ProblemBody), (status = 422, body = ProblemBody)))]
pub(super) async fn create(
    State(app): State<App>,
    Path(site): Path<SiteId>,
    Json(request): Json<CreateTerrain>,
) -> Result<Response, Problem> {
    let created = app.create_terrain(&site, request).await?;
    Ok(tagged(StatusCode::CREATED, created))
}

/// Replace a terrain.
///
/// With `If-Match`, the request is refused unless the revision is still the given one.
#[utoipa::path(put, path = "/v1/sites/{site}/terrains/{terrain}", tag = "terrains",
    security(("token" = ["configure"])),
    operation_id = "replace_terrain",
    params(("site" = SiteId, Path), ("terrain" = TerrainId, Path),
        ("if-match" = Option<String>, Header, description = "Revision that the request may replace")),
    request_body = ReplaceTerrain,
    responses((status = 200, body = Terrain), (status = 404, body = ProblemBody),
        (status = 412, body = ProblemBody), (status = 422, body = ProblemBody)))]
pub(super) async fn replace(
    State(app): State<App>,
    Path((site, terrain)): Path<(SiteId, TerrainId)>,
    headers: HeaderMap,
    Json(request): Json<ReplaceTerrain>,
) -> Result<Response, Problem> {
    let expected = revision::expected(&headers)?;
    let replacing = app.replace_terrain(&site, &terrain, request, &expected);
    Ok(tagged(StatusCode::OK, replacing.await?))
}

/// Delete a terrain; its measurements stay.
///
/// With `If-Match`, the request is refused unless the revision is still the given one.
#[utoipa::path(delete, path = "/v1/sites/{site}/terrains/{terrain}", tag = "terrains",
    security(("token" = ["configure"])),
    operation_id = "delete_terrain",
    params(("site" = SiteId, Path), ("terrain" = TerrainId, Path),
        ("if-match" = Option<String>, Header, description = "Revision that the request may delete")),
    responses((status = 204), (status = 404, body = ProblemBody),
        (status = 412, body = ProblemBody)))]
pub(super) async fn delete(
    State(app): State<App>,
    Path((site, terrain)): Path<(SiteId, TerrainId)>,
    headers: HeaderMap,
) -> Result<StatusCode, Problem> {
    let expected = revision::expected(&headers)?;
    app.delete_terrain(&site, &terrain, &expected).await?;
    Ok(StatusCode::NO_CONTENT)
}

fn tagged(status: StatusCode, terrain: Terrain) -> Response {
    revision::tagged(status, terrain.revision.into(), terrain)
}
