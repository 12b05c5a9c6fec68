//! Friction at a point, in the cells of a box and along a path.

use axum::extract::State;
use axum::http::HeaderMap;
use axum::response::Response;
use jiff::Timestamp;
use serde::Deserialize;
use tread_api::friction::{
    CellDifference, CellFriction, PathFriction, PathFrictionRequest, PointFriction, VisitSuggestion,
};
use tread_api::geometry::Point;
use tread_api::ids::{ConfigurationId, SiteId};
use tread_api::page::{DifferencePage, MapPage};
use tread_api::problem::ProblemBody;
use utoipa::IntoParams;

use super::map::add_as_of_header;
use super::parameters;
use crate::app::App;
use crate::app::friction::{Area, AreaBounds, CellRequest};
use crate::http::etag;
use crate::http::extract::{Json, Path, Query, page_limit};
use crate::http::problem::Problem;
use crate::http::subject::Subject;

/// Query parameters of the friction of cells.
#[derive(Debug, Clone, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(in crate::http) struct CellQuery {
    /// Lowest x of the area in the site frame, metres; that of the whole map when absent.
    x_min_m: Option<f64>,
    /// Lowest y of the area in the site frame, metres.
    y_min_m: Option<f64>,
    /// Highest x of the area in the site frame, metres.
    x_max_m: Option<f64>,
    /// Highest y of the area in the site frame, metres.
    y_max_m: Option<f64>,
    /// Side of the squares into which cells are merged, metres, a multiple of the grid's; the area
    /// may have at most 4 194 304 squares. Cells on different terrains are never merged.
    resolution_m: Option<f64>,
    /// Time up to which measurements are included, rounded down to a minute, or to the end of an
    /// epoch whose raw measurements are missing or too many; all measurements when absent.
    as_of: Option<Timestamp>,
    /// Include only measurements of this configuration (robot model and tyres).
    configuration: Option<ConfigurationId>,
    /// Include other robot models too, by this normalisation of the server's configuration.
    normalisation: Option<String>,
    /// `next_cursor` of the previous page.
    cursor: Option<String>,
    /// Maximum number of cells of the page, 1 to 1000; 100 when absent. A cell has one entry per
    /// terrain and robot model.
    limit: Option<u32>,
}

/// List the friction of cells.
#[utoipa::path(get, path = "/v1/sites/{site}/friction/cells", tag = "friction",
    security(("token" = ["read"])),
    operation_id = "list_cell_friction", params(("site" = SiteId, Path), CellQuery),
    responses((status = 200, body = MapPage<CellFriction>), (status = 304),
        (status = 400, body = ProblemBody), (status = 404, body = ProblemBody)))]
pub(in crate::http) async fn cells(
    State(app): State<App>,
    Path(site): Path<SiteId>,
    Query(query): Query<CellQuery>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let parameters = parameters(query.as_of, query.configuration, query.normalisation);
    let cells = CellRequest {
        area: Area::new(AreaBounds {
            x_min_m: query.x_min_m,
            y_min_m: query.y_min_m,
            x_max_m: query.x_max_m,
            y_max_m: query.y_max_m,
        })?,
        resolution_m: query.resolution_m,
        cursor: query.cursor.as_deref(),
        limit: page_limit(query.limit)?,
    };
    let found = app.friction_of_cells(&site, &parameters, cells).await?;
    Ok(add_as_of_header(etag::json(&headers, &found), found.as_of))
}

/// Query parameters of the friction at a point.
#[derive(Debug, Clone, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(in crate::http) struct PointQuery {
    /// East-like coordinate in the site frame, metres.
    x_m: f64,
    /// North-like coordinate in the site frame, metres.
    y_m: f64,
    /// Time up to which measurements are included, rounded down to a minute, or to the end of an
    /// epoch whose raw measurements are missing or too many; all measurements when absent.
    as_of: Option<Timestamp>,
    /// Include only measurements of this configuration (robot model and tyres).
    configuration: Option<ConfigurationId>,
    /// Include other robot models too, by this normalisation of the server's configuration.
    normalisation: Option<String>,
}

/// Get the friction at a point, on the terrain there.
#[utoipa::path(get, path = "/v1/sites/{site}/friction/point", tag = "friction",
    security(("token" = ["read"])),
    operation_id = "get_point_friction", params(("site" = SiteId, Path), PointQuery),
    responses((status = 200, body = PointFriction), (status = 304),
        (status = 400, body = ProblemBody), (status = 404, body = ProblemBody)))]
pub(in crate::http) async fn point(
    State(app): State<App>,
    Path(site): Path<SiteId>,
    Query(query): Query<PointQuery>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let parameters = parameters(query.as_of, query.configuration, query.normalisation);
    let point = Point {
        x_m: query.x_m,
        y_m: query.y_m,
    };
    let found = app.friction_at(&site, &parameters, point).await?;
    Ok(add_as_of_header(etag::json(&headers, &found), found.as_of))
}

/// Get the friction along a path, with the speed that it permits a robot.
#[utoipa::path(post, path = "/v1/sites/{site}/friction/path", tag = "friction",
    security(("token" = ["read"])),
    operation_id = "get_path_friction", params(("site" = SiteId, Path)),
    request_body = PathFrictionRequest,
    responses((status = 200, body = PathFriction), (status = 304),
        (status = 404, body = ProblemBody), (status = 422, body = ProblemBody)))]
pub(in crate::http) async fn path(
    State(app): State<App>,
    Path(site): Path<SiteId>,
    Subject(subject): Subject,
    headers: HeaderMap,
    Json(request): Json<PathFrictionRequest>,
) -> Result<Response, Problem> {
    subject.check_robot(&site, &request.robot)?;
    let found = app.friction_along(&site, request).await?;
    Ok(add_as_of_header(etag::json(&headers, &found), found.as_of))
}

/// Query parameters of a comparison of two times.
#[derive(Debug, Clone, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(in crate::http) struct DifferenceQuery {
    /// First time.
    from: Timestamp,
    /// Second time; the present when absent.
    to: Option<Timestamp>,
    /// Lowest x of the area in the site frame, metres; that of the whole map when absent.
    x_min_m: Option<f64>,
    /// Lowest y of the area in the site frame, metres.
    y_min_m: Option<f64>,
    /// Highest x of the area in the site frame, metres.
    x_max_m: Option<f64>,
    /// Highest y of the area in the site frame, metres.
    y_max_m: Option<f64>,
    /// Include only measurements of this configuration (robot model and tyres).
    configuration: Option<ConfigurationId>,
    /// Include other robot models too, by this normalisation of the server's configuration.
    normalisation: Option<String>,
    /// `next_cursor` of the previous page.
    cursor: Option<String>,
    /// Maximum number of cells of the page, 1 to 1000; 100 when absent.
    limit: Option<u32>,
}

/// Compare the friction of cells at two times.
#[utoipa::path(get, path = "/v1/sites/{site}/friction/difference", tag = "friction",
    security(("token" = ["read"])),
    operation_id = "list_friction_differences",
    params(("site" = SiteId, Path), DifferenceQuery),
    responses((status = 200, body = DifferencePage<CellDifference>), (status = 304),
        (status = 400, body = ProblemBody), (status = 404, body = ProblemBody)))]
pub(in crate::http) async fn difference(
    State(app): State<App>,
    Path(site): Path<SiteId>,
    Query(query): Query<DifferenceQuery>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let parameters = parameters(None, query.configuration, query.normalisation);
    let cells = CellRequest {
        area: Area::new(AreaBounds {
            x_min_m: query.x_min_m,
            y_min_m: query.y_min_m,
            x_max_m: query.x_max_m,
            y_max_m: query.y_max_m,
        })?,
        resolution_m: None,
        cursor: query.cursor.as_deref(),
        limit: page_limit(query.limit)?,
    };
    let times = (query.from, query.to);
    let found = app
        .friction_difference(&site, &parameters, times, cells)
        .await?;
    Ok(add_as_of_header(etag::json(&headers, &found), found.as_of))
}

/// Query parameters of the suggestions of visits.
#[derive(Debug, Clone, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(in crate::http) struct VisitQuery {
    /// Lowest x of the area in the site frame, metres. The area may have at most 262 144 cells.
    x_min_m: f64,
    /// Lowest y of the area in the site frame, metres.
    y_min_m: f64,
    /// Highest x of the area in the site frame, metres.
    x_max_m: f64,
    /// Highest y of the area in the site frame, metres.
    y_max_m: f64,
    /// Time up to which measurements are included, rounded down to a minute, or to the end of an
    /// epoch whose raw measurements are missing or too many; all measurements when absent.
    as_of: Option<Timestamp>,
    /// Include only measurements of this configuration (robot model and tyres).
    configuration: Option<ConfigurationId>,
    /// Include other robot models too, by this normalisation of the server's configuration.
    normalisation: Option<String>,
    /// Maximum number of cells, 1 to 1000; 100 when absent.
    limit: Option<u32>,
}

/// List the cells whose measurement would reduce the uncertainty of θ most, best first.
#[utoipa::path(get, path = "/v1/sites/{site}/friction/visits", tag = "friction",
    security(("token" = ["read"])),
    operation_id = "list_visit_suggestions", params(("site" = SiteId, Path), VisitQuery),
    responses((status = 200, body = MapPage<VisitSuggestion>), (status = 304),
        (status = 400, body = ProblemBody), (status = 404, body = ProblemBody)))]
pub(in crate::http) async fn visits(
    State(app): State<App>,
    Path(site): Path<SiteId>,
    Query(query): Query<VisitQuery>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let parameters = parameters(query.as_of, query.configuration, query.normalisation);
    let area = Area::new(AreaBounds {
        x_min_m: Some(query.x_min_m),
        y_min_m: Some(query.y_min_m),
        x_max_m: Some(query.x_max_m),
        y_max_m: Some(query.y_max_m),
    })?;
    let limit = page_limit(query.limit)?;
    let found = app
        .visits_worth_most(&site, &parameters, area, limit)
        .await?;
    Ok(add_as_of_header(etag::json(&headers, &found), found.as_of))
}
