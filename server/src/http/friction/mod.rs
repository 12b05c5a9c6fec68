//! `/v1/sites/{site}/friction` and `/v1/sites/{site}/segments`.
//!
//! Every route of the map returns an `ETag` and has the parameter `as_of`, which selects the map as
//! it was known at that time, with the ages at that time. The response contains that time.

pub(super) mod history;
pub(super) mod map;
pub(super) mod places;
mod streamed;

use axum::extract::State;
use axum::http::HeaderMap;
use axum::response::Response;
use jiff::Timestamp;
use serde::Deserialize;
use tread_api::friction::{RobotContribution, StoredSegment, TerrainFriction};
use tread_api::ids::{ConfigurationId, RobotId, SiteId, TerrainId};
use tread_api::page::Page;
use tread_api::problem::ProblemBody;
use utoipa::IntoParams;

use self::map::add_as_of_header;
use self::streamed::{CSV_MEDIA_TYPE, JSON_MEDIA_TYPE, PARQUET_MEDIA_TYPE, streamed};
use super::etag;
use super::extract::{Path, Query, cursor, page_limit};
use super::negotiate::{ResponseFormat, choose};
use super::problem::Problem;
use super::sites::PageQuery;
use super::subject::Subject;
use crate::app::friction::{ReadingParameters, SegmentExport};
use crate::app::segments::SegmentFilter;
use crate::app::{App, AppError};
use crate::formats::table::{self, segments};

/// Query parameters of the list of terrains' friction.
#[derive(Debug, Clone, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(super) struct ReadingQuery {
    /// Time up to which measurements are included, rounded down to a minute, or to the end of an
    /// epoch whose raw measurements are missing or too many; all measurements when absent.
    as_of: Option<Timestamp>,
    /// Include only measurements of this configuration (robot model and tyres).
    configuration: Option<ConfigurationId>,
    /// Include other robot models too, by this normalisation of the server's configuration.
    normalisation: Option<String>,
    /// `next_cursor` of the previous page.
    cursor: Option<String>,
    /// Maximum number of entries of the page, 1 to 1000; 100 when absent.
    limit: Option<u32>,
}

/// Returns the parameters that all queries of friction have in common.
///
/// Each query type repeats these fields: they cannot be a shared type with `#[serde(flatten)]`, which
/// fails to parse numbers in query strings.
fn parameters(
    as_of: Option<Timestamp>,
    configuration: Option<ConfigurationId>,
    normalisation: Option<String>,
) -> ReadingParameters {
    ReadingParameters {
        as_of,
        configuration,
        normalisation,
    }
}

/// List the friction of every terrain of a site.
#[utoipa::path(get, path = "/v1/sites/{site}/friction/terrains", tag = "friction",
    security(("token" = ["read"])),
    operation_id = "list_terrain_friction", params(("site" = SiteId, Path), ReadingQuery),
    responses((status = 200, body = Page<TerrainFriction>), (status = 304),
        (status = 400, body = ProblemBody), (status = 404, body = ProblemBody)))]
pub(super) async fn terrains(
    State(app): State<App>,
    Path(site): Path<SiteId>,
    Query(query): Query<ReadingQuery>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let limit = page_limit(query.limit)?;
    let parameters = parameters(query.as_of, query.configuration, query.normalisation);
    let cursor = query.cursor.as_deref();
    let found = app
        .friction_of_terrains(&site, &parameters, cursor, limit)
        .await?;
    let as_of = found.items.first().and_then(|terrain| terrain.as_of);
    Ok(add_as_of_header(etag::json(&headers, &found), as_of))
}

/// Query parameters of the friction of one terrain.
#[derive(Debug, Clone, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(super) struct TerrainReadingQuery {
    /// Time up to which measurements are included, rounded down to a minute, or to the end of an
    /// epoch whose raw measurements are missing or too many; all measurements when absent.
    as_of: Option<Timestamp>,
    /// Include only measurements of this configuration (robot model and tyres).
    configuration: Option<ConfigurationId>,
    /// Include other robot models too, by this normalisation of the server's configuration.
    normalisation: Option<String>,
}

/// Get the friction of a terrain for each robot model.
#[utoipa::path(get, path = "/v1/sites/{site}/friction/terrains/{terrain}", tag = "friction",
    security(("token" = ["read"])),
    operation_id = "get_terrain_friction",
    params(("site" = SiteId, Path), ("terrain" = TerrainId, Path), TerrainReadingQuery),
    responses((status = 200, body = TerrainFriction), (status = 304),
        (status = 400, body = ProblemBody), (status = 404, body = ProblemBody)))]
pub(super) async fn terrain(
    State(app): State<App>,
    Path((site, terrain)): Path<(SiteId, TerrainId)>,
    Query(query): Query<TerrainReadingQuery>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let parameters = parameters(query.as_of, query.configuration, query.normalisation);
    let found = app
        .friction_of_terrain(&site, &terrain, &parameters)
        .await?;
    Ok(add_as_of_header(etag::json(&headers, &found), found.as_of))
}

/// List the contribution of each robot to the friction map.
#[utoipa::path(get, path = "/v1/sites/{site}/friction/robots", tag = "friction",
    security(("token" = ["read"])),
    operation_id = "list_contributions", params(("site" = SiteId, Path), PageQuery),
    responses((status = 200, body = Page<RobotContribution>), (status = 304),
        (status = 404, body = ProblemBody)))]
pub(super) async fn robots(
    State(app): State<App>,
    Subject(subject): Subject,
    Path(site): Path<SiteId>,
    Query(query): Query<PageQuery>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let limit = page_limit(query.limit)?;
    let found = app.contributions((&site, &subject.scope), query.cursor.as_deref(), limit);
    Ok(etag::json(&headers, &found.await?))
}

/// Query parameters of the list of raw measurements.
#[derive(Debug, Clone, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(super) struct SegmentQuery {
    /// Only measurements of this robot.
    robot: Option<RobotId>,
    /// Only measurements on this terrain.
    terrain: Option<TerrainId>,
    /// `next_cursor` of the previous page.
    cursor: Option<String>,
    /// Maximum number of entries of the page, 1 to 1000; 100 when absent; not for CSV and Parquet.
    limit: Option<u32>,
    /// `json`, or everything after the cursor as `csv` or `parquet`; when absent, `Accept` selects
    /// the format.
    format: Option<String>,
}

/// Formats of raw measurements.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum SegmentFormat {
    Json,
    Csv,
    Parquet,
}

const SEGMENT_FORMATS: [(&str, SegmentFormat); 3] = [
    ("json", SegmentFormat::Json),
    ("csv", SegmentFormat::Csv),
    ("parquet", SegmentFormat::Parquet),
];

impl ResponseFormat for SegmentFormat {
    fn media_type(self) -> &'static str {
        match self {
            Self::Json => JSON_MEDIA_TYPE,
            Self::Csv => CSV_MEDIA_TYPE,
            Self::Parquet => PARQUET_MEDIA_TYPE,
        }
    }
}

/// List raw measurements in the order in which the server stored them.
#[utoipa::path(get, path = "/v1/sites/{site}/segments", tag = "friction",
    security(("token" = ["read"])),
    operation_id = "list_segments", params(("site" = SiteId, Path), SegmentQuery),
    responses((status = 200, description = "The measurements", content(
            (Page<StoredSegment> = "application/json"), (String = "text/csv"),
            (Vec<u8> = "application/vnd.apache.parquet"))),
        (status = 304), (status = 400, body = ProblemBody), (status = 404, body = ProblemBody),
        (status = 406, body = ProblemBody)))]
pub(super) async fn segments(
    State(app): State<App>,
    Subject(subject): Subject,
    Path(site): Path<SiteId>,
    Query(query): Query<SegmentQuery>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let format = choose(&SEGMENT_FORMATS, query.format.as_deref(), &headers)?;
    let limit = page_limit(query.limit)?;
    let after = cursor(query.cursor.as_deref())?.unwrap_or(0);
    let SegmentQuery { robot, terrain, .. } = query;
    let filter = SegmentFilter {
        robot,
        terrain,
        robots: subject.scope.limit_of(&site),
        after,
    };
    let writer = match format {
        SegmentFormat::Json => {
            let found = app.segments(&site, &filter, limit).await?;
            return Ok(etag::json(&headers, &found));
        }
        SegmentFormat::Csv => table::comma(segments::COLUMNS, segments::row),
        SegmentFormat::Parquet => {
            let metadata = vec![("tread:site".to_owned(), site.to_string())];
            let writer = table::parquet(segments::COLUMNS, segments::row, metadata);
            writer.map_err(AppError::from)?
        }
    };
    let export = app.export_segments(&site, filter, writer).await?;
    let (state, media_type) = (export.state(), format.media_type());
    let begun = streamed(media_type, export, SegmentExport::next);
    etag::streamed(&headers, media_type, state, begun).await
}
