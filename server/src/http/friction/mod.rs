//! `/v1/sites/{site}/friction` and `/v1/sites/{site}/segments`.
//!
//! Every answer about the map has an `ETag` and takes `as_of`: the map as it was known then, with the
//! ages of then. The answer says as of when it is.

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

/// What is asked for of a terrain.
#[derive(Debug, Clone, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(super) struct ReadingQuery {
    /// As of when, rounded down to a minute, or to the end of an epoch whose raw measurements are
    /// missing or too many; all that has come when absent.
    as_of: Option<Timestamp>,
    /// Only measurements of this robot model and tyres.
    #[param(value_type = Option<String>)]
    configuration: Option<ConfigurationId>,
    /// A declared normalisation that joins robot models.
    normalisation: Option<String>,
    /// `next_cursor` of the page before.
    cursor: Option<String>,
    /// Most entries of the page, 1 to 1000; 100 when absent.
    limit: Option<u32>,
}

/// What a question asks for besides the place.
///
/// Each query has these fields of its own: they cannot be flattened into one, since numbers do not
/// survive that.
fn asked(
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

/// List friction of every terrain of a site.
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
    let asked = asked(query.as_of, query.configuration, query.normalisation);
    let cursor = query.cursor.as_deref();
    let found = app
        .friction_of_terrains(&site, &asked, cursor, limit)
        .await?;
    let as_of = found.items.first().and_then(|terrain| terrain.as_of);
    Ok(add_as_of_header(etag::json(&headers, &found), as_of))
}

/// What is asked for of one terrain.
#[derive(Debug, Clone, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(super) struct TerrainReadingQuery {
    /// As of when, rounded down to a minute, or to the end of an epoch whose raw measurements are
    /// missing or too many; all that has come when absent.
    as_of: Option<Timestamp>,
    /// Only measurements of this robot model and tyres.
    #[param(value_type = Option<String>)]
    configuration: Option<ConfigurationId>,
    /// A declared normalisation that joins robot models.
    normalisation: Option<String>,
}

/// Get friction of a terrain, per robot model.
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
    let asked = asked(query.as_of, query.configuration, query.normalisation);
    let found = app.friction_of_terrain(&site, &terrain, &asked).await?;
    Ok(add_as_of_header(etag::json(&headers, &found), found.as_of))
}

/// List what each robot contributed to the map.
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
    /// Most entries of the page, 1 to 1000; 100 when absent. CSV and Parquet have no pages.
    limit: Option<u32>,
    /// `json`, or everything after the cursor as `csv` or `parquet`; what `Accept` asks for when
    /// absent.
    format: Option<String>,
}

/// What measurements can be given as.
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

/// List raw measurements in the order of their commits.
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
            let said = vec![("tread:site".to_owned(), site.to_string())];
            let writer = table::parquet(segments::COLUMNS, segments::row, said);
            writer.map_err(AppError::from)?
        }
    };
    let export = app.export_segments(&site, filter, writer).await?;
    let (state, media_type) = (export.state(), format.media_type());
    let begun = streamed(media_type, export, SegmentExport::next);
    etag::streamed(&headers, media_type, state, begun).await
}
