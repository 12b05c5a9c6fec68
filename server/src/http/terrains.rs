//! `/v1/sites/{site}/terrains`.

use axum::extract::State;
use axum::http::StatusCode;
use tread_api::ids::{SiteId, TerrainId};
use tread_api::page::Page;
use tread_api::problem::ProblemBody;
use tread_api::terrain::{CreateTerrain, ReplaceTerrain, Terrain};

use super::extract::{Json, Path, Query, page_limit};
use super::problem::Problem;
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
) -> Result<Json<Terrain>, Problem> {
    Ok(Json(app.terrain(&site, &terrain).await?))
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
) -> Result<(StatusCode, Json<Terrain>), Problem> {
    Ok((
        StatusCode::CREATED,
        Json(app.create_terrain(&site, request).await?),
    ))
}

/// Replace a terrain.
#[utoipa::path(put, path = "/v1/sites/{site}/terrains/{terrain}", tag = "terrains",
    security(("token" = ["configure"])),
    operation_id = "replace_terrain",
    params(("site" = SiteId, Path), ("terrain" = TerrainId, Path)),
    request_body = ReplaceTerrain,
    responses((status = 200, body = Terrain), (status = 404, body = ProblemBody),
        (status = 422, body = ProblemBody)))]
pub(super) async fn replace(
    State(app): State<App>,
    Path((site, terrain)): Path<(SiteId, TerrainId)>,
    Json(request): Json<ReplaceTerrain>,
) -> Result<Json<Terrain>, Problem> {
    Ok(Json(app.replace_terrain(&site, &terrain, request).await?))
}

/// Delete a terrain; its measurements stay.
#[utoipa::path(delete, path = "/v1/sites/{site}/terrains/{terrain}", tag = "terrains",
    security(("token" = ["configure"])),
    operation_id = "delete_terrain",
    params(("site" = SiteId, Path), ("terrain" = TerrainId, Path)),
    responses((status = 204), (status = 404, body = ProblemBody)))]
pub(super) async fn delete(
    State(app): State<App>,
    Path((site, terrain)): Path<(SiteId, TerrainId)>,
) -> Result<StatusCode, Problem> {
    app.delete_terrain(&site, &terrain).await?;
    Ok(StatusCode::NO_CONTENT)
}
