//! Histories of a terrain and of a point.

use axum::extract::State;
use axum::http::HeaderMap;
use axum::response::Response;
use jiff::{SignedDuration, Timestamp};
use serde::Deserialize;
use tread_api::friction::{PointHistory, TerrainHistory};
use tread_api::geometry::Point;
use tread_api::ids::{ConfigurationId, SiteId, TerrainId};
use tread_api::problem::{ProblemBody, ProblemType};
use utoipa::IntoParams;

use super::parameters;
use crate::app::App;
use crate::app::friction::Times;
use crate::http::etag;
use crate::http::extract::{Path, Query};
use crate::http::problem::Problem;

/// Step of a history where none is asked for, seconds.
const STEP_S: i64 = 3_600;
/// Shortest step of a history, seconds: the map is known by the minute.
const STEP_MIN_S: i64 = 60;
/// Longest step of a history, seconds: a year.
const STEP_MAX_S: i64 = 366 * 86_400;

fn times(from: Timestamp, to: Option<Timestamp>, step_s: Option<i64>) -> Result<Times, Problem> {
    let step_s = step_s.unwrap_or(STEP_S);
    if !(STEP_MIN_S..=STEP_MAX_S).contains(&step_s) {
        let detail = format!("step_s must be {STEP_MIN_S} to {STEP_MAX_S}, not {step_s}");
        return Err(Problem::new(ProblemType::InvalidQuery)
            .detail(detail)
            .field("step_s"));
    }
    let step = SignedDuration::from_secs(step_s);
    Ok(Times { from, to, step })
}

/// Query parameters of the history of a terrain.
#[derive(Debug, Clone, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(in crate::http) struct HistoryQuery {
    /// First time.
    from: Timestamp,
    /// Last time; the present when absent.
    to: Option<Timestamp>,
    /// Seconds between two times, at least 60; 3600 when absent. At most 1000 times are allowed.
    step_s: Option<i64>,
    /// Include only measurements of this configuration (robot model and tyres).
    configuration: Option<ConfigurationId>,
    /// Include other robot models too, by this normalisation of the server's configuration.
    normalisation: Option<String>,
}

/// Get the friction of a terrain at equally spaced times.
#[utoipa::path(get, path = "/v1/sites/{site}/friction/terrains/{terrain}/history",
    tag = "friction", security(("token" = ["read"])),
    operation_id = "get_terrain_history",
    params(("site" = SiteId, Path), ("terrain" = TerrainId, Path), HistoryQuery),
    responses((status = 200, body = TerrainHistory), (status = 304),
        (status = 400, body = ProblemBody), (status = 404, body = ProblemBody)))]
pub(in crate::http) async fn terrain_history(
    State(app): State<App>,
    Path((site, terrain)): Path<(SiteId, TerrainId)>,
    Query(query): Query<HistoryQuery>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let times = times(query.from, query.to, query.step_s)?;
    let parameters = parameters(None, query.configuration, query.normalisation);
    let found = app.history_of_terrain((&site, &terrain), &parameters, times);
    Ok(etag::json(&headers, &found.await?))
}

/// Query parameters of the history of a point.
#[derive(Debug, Clone, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(in crate::http) struct PointHistoryQuery {
    /// East-like coordinate in the site frame, metres.
    x_m: f64,
    /// North-like coordinate in the site frame, metres.
    y_m: f64,
    /// First time.
    from: Timestamp,
    /// Last time; the present when absent.
    to: Option<Timestamp>,
    /// Seconds between two times, at least 60; 3600 when absent. At most 1000 times are allowed.
    step_s: Option<i64>,
    /// Include only measurements of this configuration (robot model and tyres).
    configuration: Option<ConfigurationId>,
    /// Include other robot models too, by this normalisation of the server's configuration.
    normalisation: Option<String>,
}

/// Get the friction at a point, on the terrain there, at equally spaced times.
#[utoipa::path(get, path = "/v1/sites/{site}/friction/point/history", tag = "friction",
    security(("token" = ["read"])),
    operation_id = "get_point_history", params(("site" = SiteId, Path), PointHistoryQuery),
    responses((status = 200, body = PointHistory), (status = 304),
        (status = 400, body = ProblemBody), (status = 404, body = ProblemBody)))]
pub(in crate::http) async fn point_history(
    State(app): State<App>,
    Path(site): Path<SiteId>,
    Query(query): Query<PointHistoryQuery>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let times = times(query.from, query.to, query.step_s)?;
    let parameters = parameters(None, query.configuration, query.normalisation);
    let point = Point {
        x_m: query.x_m,
        y_m: query.y_m,
    };
    let found = app.history_of_point(&site, &parameters, point, times);
    Ok(etag::json(&headers, &found.await?))
}
