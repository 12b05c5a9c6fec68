//! `/v1/sites/{site}/friction` and `/v1/sites/{site}/segments`.

use axum::extract::State;
use serde::Deserialize;
use tread_api::friction::{CellFriction, StoredSegment, TerrainFriction};
use tread_api::geometry::{COORDINATE_MAX_M, Point};
use tread_api::ids::{RobotId, SiteId, TerrainId};
use tread_api::page::Page;
use tread_api::problem::ProblemBody;
use utoipa::IntoParams;

use super::extract::{Json, Path, Query, cursor, page_limit};
use super::problem::Problem;
use super::sites::PageQuery;
use crate::app::App;
use crate::app::friction::Area;
use crate::db::segments::SegmentFilter;

/// Friction of every terrain of a site.
#[utoipa::path(get, path = "/v1/sites/{site}/friction/terrains", tag = "friction",
    security(("token" = ["viewer"])),
    operation_id = "list_terrain_friction", params(("site" = SiteId, Path), PageQuery),
    responses((status = 200, body = Page<TerrainFriction>), (status = 404, body = ProblemBody)))]
pub(super) async fn terrains(
    State(app): State<App>,
    Path(site): Path<SiteId>,
    Query(query): Query<PageQuery>,
) -> Result<Json<Page<TerrainFriction>>, Problem> {
    let limit = page_limit(query.limit)?;
    Ok(Json(
        app.friction_of_terrains(&site, query.cursor.as_deref(), limit)
            .await?,
    ))
}

/// Friction of one terrain, per robot model.
#[utoipa::path(get, path = "/v1/sites/{site}/friction/terrains/{terrain}", tag = "friction",
    security(("token" = ["viewer"])),
    operation_id = "get_terrain_friction",
    params(("site" = SiteId, Path), ("terrain" = TerrainId, Path)),
    responses((status = 200, body = TerrainFriction), (status = 404, body = ProblemBody)))]
pub(super) async fn terrain(
    State(app): State<App>,
    Path((site, terrain)): Path<(SiteId, TerrainId)>,
) -> Result<Json<TerrainFriction>, Problem> {
    Ok(Json(app.friction_of_terrain(&site, &terrain).await?))
}

/// Which cells, and which page of them.
#[derive(Debug, Clone, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(super) struct CellQuery {
    /// Lowest x of the area, metres; the whole map when absent.
    x_min_m: Option<f64>,
    /// Lowest y of the area, metres.
    y_min_m: Option<f64>,
    /// Highest x of the area, metres.
    x_max_m: Option<f64>,
    /// Highest y of the area, metres.
    y_max_m: Option<f64>,
    /// `next_cursor` of the page before.
    cursor: Option<String>,
    /// Most cells of the page, 1 to 1000; 100 when absent. A cell has one entry per terrain and
    /// robot model.
    limit: Option<u32>,
}

/// Friction per cell.
#[utoipa::path(get, path = "/v1/sites/{site}/friction/cells", tag = "friction",
    security(("token" = ["viewer"])),
    operation_id = "list_cell_friction", params(("site" = SiteId, Path), CellQuery),
    responses((status = 200, body = Page<CellFriction>), (status = 400, body = ProblemBody),
        (status = 404, body = ProblemBody)))]
pub(super) async fn cells(
    State(app): State<App>,
    Path(site): Path<SiteId>,
    Query(query): Query<CellQuery>,
) -> Result<Json<Page<CellFriction>>, Problem> {
    let limit = page_limit(query.limit)?;
    let area = Area {
        min: Point {
            x_m: query.x_min_m.unwrap_or(-COORDINATE_MAX_M),
            y_m: query.y_min_m.unwrap_or(-COORDINATE_MAX_M),
        },
        max: Point {
            x_m: query.x_max_m.unwrap_or(COORDINATE_MAX_M),
            y_m: query.y_max_m.unwrap_or(COORDINATE_MAX_M),
        },
    };
    let cursor = query.cursor.as_deref();
    Ok(Json(
        app.friction_of_cells(&site, area, cursor, limit).await?,
    ))
}

/// Which raw measurements, and which page of them.
#[derive(Debug, Clone, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(super) struct SegmentQuery {
    /// Only those of this robot.
    #[param(value_type = Option<String>)]
    robot: Option<RobotId>,
    /// Only those on this terrain.
    #[param(value_type = Option<String>)]
    terrain: Option<TerrainId>,
    /// `next_cursor` of the page before.
    cursor: Option<String>,
    /// Most entries of the page, 1 to 1000; 100 when absent.
    limit: Option<u32>,
}

/// Raw measurements in the order of their commits.
#[utoipa::path(get, path = "/v1/sites/{site}/segments", tag = "friction",
    security(("token" = ["viewer"])),
    operation_id = "list_segments", params(("site" = SiteId, Path), SegmentQuery),
    responses((status = 200, body = Page<StoredSegment>), (status = 400, body = ProblemBody),
        (status = 404, body = ProblemBody)))]
pub(super) async fn segments(
    State(app): State<App>,
    Path(site): Path<SiteId>,
    Query(query): Query<SegmentQuery>,
) -> Result<Json<Page<StoredSegment>>, Problem> {
    let limit = page_limit(query.limit)?;
    let after = cursor(query.cursor.as_deref())?.unwrap_or(0);
    let SegmentQuery { robot, terrain, .. } = query;
    let filter = SegmentFilter {
        robot,
        terrain,
        after,
    };
    Ok(Json(app.segments(&site, &filter, limit).await?))
}
