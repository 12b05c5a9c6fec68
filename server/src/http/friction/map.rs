//! `GET …/friction/map`: the map in the formats of other programs.

use axum::body::Bytes;
use axum::extract::State;
use axum::http::{HeaderMap, HeaderName, HeaderValue};
use axum::response::Response;
use jiff::Timestamp;
use serde::Deserialize;
use tread_api::friction::CellFriction;
use tread_api::ids::{ConfigurationId, SiteId};
use tread_api::page::MapPage;
use tread_api::problem::{ProblemBody, ProblemType};
use tread_api::site::Site;
use utoipa::IntoParams;

use super::streamed::{CSV_MEDIA_TYPE, JSON_MEDIA_TYPE, PARQUET_MEDIA_TYPE, streamed};
use crate::app::friction::{
    Area, AreaBounds, CellExport, Picture, PictureRequest, ReadingParameters,
};
use crate::app::{App, AppError};
use crate::formats::nav2::{self, SpeedScale};
use crate::formats::png::{self, PngError};
use crate::formats::table::{self, TableError, Writer, cells};
use crate::formats::{json, tile};
use crate::friction::Raster;
use crate::http::etag;
use crate::http::extract::{Path, Query};
use crate::http::negotiate::{ResponseFormat, choose};
use crate::http::problem::Problem;

/// Header: robot model (configuration) to which θ of a response refers.
const CONFIGURATION: HeaderName = HeaderName::from_static("tread-configuration");
/// Header: normalisation that was used.
const NORMALISATION: HeaderName = HeaderName::from_static("tread-normalisation");
/// Header: time to which ages refer; with `as_of` in the request, all measurements included were
/// made before it.
const AS_OF: HeaderName = HeaderName::from_static("tread-as-of");
/// Default speed of the value 100 in a speed mask, metres per second.
const SPEED_MAX_DEFAULT_M_S: f64 = 2.0;
/// Default stopping distance, metres.
const STOPPING_DEFAULT_M: f64 = 1.0;

/// Formats of the map.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Format {
    Picture(PictureFormat),
    List(ListFormat),
}

/// Formats that show one value of each square.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum PictureFormat {
    Png,
    Tile,
    Nav2,
    Pgm,
}

/// Formats that list all values of each square.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum ListFormat {
    Json,
    GeoJson,
    Csv,
    Parquet,
}

/// PNG first, so that a browser which accepts everything shows it.
const OFFERED: [(&str, Format); 8] = [
    ("png", Format::Picture(PictureFormat::Png)),
    ("json", Format::List(ListFormat::Json)),
    ("tile", Format::Picture(PictureFormat::Tile)),
    ("geojson", Format::List(ListFormat::GeoJson)),
    ("nav2", Format::Picture(PictureFormat::Nav2)),
    ("pgm", Format::Picture(PictureFormat::Pgm)),
    ("csv", Format::List(ListFormat::Csv)),
    ("parquet", Format::List(ListFormat::Parquet)),
];

impl ResponseFormat for Format {
    fn media_type(self) -> &'static str {
        match self {
            Self::Picture(PictureFormat::Png) => png::MEDIA_TYPE,
            Self::Picture(PictureFormat::Tile) => tread_api::tile::MEDIA_TYPE,
            Self::Picture(PictureFormat::Nav2) => nav2::YAML_MEDIA_TYPE,
            Self::Picture(PictureFormat::Pgm) => nav2::PGM_MEDIA_TYPE,
            Self::List(ListFormat::Json) => JSON_MEDIA_TYPE,
            Self::List(ListFormat::GeoJson) => json::GEOJSON_MEDIA_TYPE,
            Self::List(ListFormat::Csv) => CSV_MEDIA_TYPE,
            Self::List(ListFormat::Parquet) => PARQUET_MEDIA_TYPE,
        }
    }
}

/// Query parameters of the map.
#[derive(Debug, Clone, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(in crate::http) struct MapQuery {
    /// `png`, `tile` (compact binary), `nav2` (YAML of a speed mask), `pgm` (its picture), or with
    /// all values of every cell: `json`, `geojson`, `csv`, `parquet`. When absent, `Accept` selects
    /// the format.
    format: Option<String>,
    /// Lowest x of the area in the site frame, metres; that of the measured area when no bound is
    /// given, else that of the whole map when absent.
    x_min_m: Option<f64>,
    /// Lowest y of the area in the site frame, metres.
    y_min_m: Option<f64>,
    /// Highest x of the area in the site frame, metres.
    x_max_m: Option<f64>,
    /// Highest y of the area in the site frame, metres.
    y_max_m: Option<f64>,
    /// Side of the squares, metres, a multiple of the grid's; the grid's own when absent. The area
    /// may have at most 1 048 576 squares.
    resolution_m: Option<f64>,
    /// Time up to which measurements are included, rounded down to a minute, or to the end of an
    /// epoch whose raw measurements are missing or too many; all measurements when absent.
    as_of: Option<Timestamp>,
    /// Configuration (robot model and tyres) of θ; the one with most measurements when absent.
    configuration: Option<ConfigurationId>,
    /// Include other robot models too, by this normalisation of the server's configuration.
    normalisation: Option<String>,
    /// Side of a square in a PNG, pixels, 1 to 32; when absent, for a picture of about 768 pixels.
    scale: Option<usize>,
    /// Speed of the value 100 in a speed mask, m/s, 0.01 to 50; 2 when absent.
    speed_max_m_s: Option<f64>,
    /// Distance within which a robot must be able to stop, metres, 0.01 to 1000; 1 when absent.
    stopping_m: Option<f64>,
}

fn within(
    parameter: &'static str,
    value: f64,
    range: std::ops::RangeInclusive<f64>,
) -> Result<f64, Problem> {
    if range.contains(&value) {
        return Ok(value);
    }
    let detail = format!(
        "{parameter} must be {} to {}, not {value}",
        range.start(),
        range.end()
    );
    Err(Problem::new(ProblemType::InvalidQuery)
        .detail(detail)
        .field(parameter))
}

impl MapQuery {
    fn request(&self) -> Result<PictureRequest, Problem> {
        let bounds = AreaBounds {
            x_min_m: self.x_min_m,
            y_min_m: self.y_min_m,
            x_max_m: self.x_max_m,
            y_max_m: self.y_max_m,
        };
        let area = if bounds == AreaBounds::default() {
            None
        } else {
            Some(Area::new(bounds)?)
        };
        Ok(PictureRequest {
            parameters: ReadingParameters {
                as_of: self.as_of,
                configuration: self.configuration,
                normalisation: self.normalisation.clone(),
            },
            area,
            resolution_m: self.resolution_m,
        })
    }

    fn speeds(&self) -> Result<SpeedScale, Problem> {
        let speed = self.speed_max_m_s.unwrap_or(SPEED_MAX_DEFAULT_M_S);
        let stopping = self.stopping_m.unwrap_or(STOPPING_DEFAULT_M);
        Ok(SpeedScale {
            speed_max_m_s: within("speed_max_m_s", speed, 0.01..=50.0)?,
            stopping_m: within("stopping_m", stopping, 0.01..=1_000.0)?,
        })
    }

    fn scale(&self) -> Result<Option<usize>, Problem> {
        if self
            .scale
            .is_none_or(|scale| (1..=png::SCALE_MAX).contains(&scale))
        {
            return Ok(self.scale);
        }
        let detail = format!("scale must be 1 to {}", png::SCALE_MAX);
        Err(Problem::new(ProblemType::InvalidQuery)
            .detail(detail)
            .field("scale"))
    }
}

/// Encodes a raster in a format.
type Write = Box<dyn Fn(&Raster) -> Result<Vec<u8>, AppError> + Send + Sync>;

fn writer(format: PictureFormat, query: &MapQuery) -> Result<(String, Write), Problem> {
    let (scale, speeds) = (query.scale()?, query.speeds()?);
    Ok(match format {
        PictureFormat::Png => (
            format!("png {scale:?}"),
            Box::new(move |raster| png::encode(raster, scale).map_err(refused)),
        ),
        PictureFormat::Tile => (
            "tile".to_owned(),
            Box::new(|raster| Ok(tile::encode(raster))),
        ),
        PictureFormat::Nav2 => (
            format!("nav2 {speeds:?}"),
            Box::new(move |raster| Ok(nav2::yaml(raster, speeds))),
        ),
        PictureFormat::Pgm => (
            format!("pgm {speeds:?}"),
            Box::new(move |raster| Ok(nav2::pgm(raster, speeds))),
        ),
    })
}

fn refused(error: PngError) -> AppError {
    match error {
        PngError::TooLarge(_) => AppError::InvalidQuery {
            parameter: "scale",
            detail: error.to_string(),
        },
        PngError::Encode(cause) => AppError::Unwritable(cause.to_string()),
    }
}

/// Get the friction map.
///
/// The formats `png`, `tile` and the speed mask for Nav2 show one robot model. The others list all
/// values of every cell, for each terrain and robot model, without pages; the server streams them.
/// With the first ones, the header `tread-configuration` names the robot model for which θ holds,
/// and `tread-normalisation` the applied normalisation. The header `tread-as-of` has the time of
/// the map.
#[utoipa::path(get, path = "/v1/sites/{site}/friction/map", tag = "friction",
    security(("token" = ["read"])),
    operation_id = "get_friction_map", params(("site" = SiteId, Path), MapQuery),
    responses((status = 200, description = "The map in the selected format", content(
            (Vec<u8> = "image/png"), (MapPage<CellFriction> = "application/json"),
            (Vec<u8> = "application/vnd.tread.friction-tile"), (Value = "application/geo+json"),
            (String = "application/yaml"), (Vec<u8> = "image/x-portable-graymap"),
            (String = "text/csv"), (Vec<u8> = "application/vnd.apache.parquet"))),
        (status = 304), (status = 400, body = ProblemBody), (status = 404, body = ProblemBody),
        (status = 406, body = ProblemBody)))]
pub(in crate::http) async fn map(
    State(app): State<App>,
    Path(site): Path<SiteId>,
    Query(query): Query<MapQuery>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let format = choose(&OFFERED, query.format.as_deref(), &headers)?;
    let media_type = format.media_type();
    match format {
        Format::Picture(format) => {
            let (name, write) = writer(format, &query)?;
            let picture = app.picture(&site, query.request()?, name, write).await?;
            Ok(answer(&headers, media_type, picture))
        }
        Format::List(format) => {
            let request = query.request()?;
            let writer_of =
                |site: &Site, as_of| list_writer(format, site, (&request.parameters, as_of));
            let export = app.export_cells(&site, &request, writer_of).await?;
            let (state, as_of) = ((query.format, export.state()), export.as_of());
            let begun = streamed(media_type, export, CellExport::next);
            let response = etag::streamed(&headers, media_type, state, begun).await?;
            Ok(add_as_of_header(response, as_of))
        }
    }
}

fn list_writer(
    format: ListFormat,
    site: &Site,
    (parameters, as_of): (&ReadingParameters, Option<Timestamp>),
) -> Result<Box<dyn Writer<CellFriction>>, TableError> {
    Ok(match format {
        ListFormat::Json => json::page(as_of),
        ListFormat::GeoJson => json::features(site, as_of),
        ListFormat::Csv => table::comma(cells::COLUMNS, cells::row),
        ListFormat::Parquet => {
            let mut metadata = vec![
                ("tread:site".to_owned(), site.id.to_string()),
                ("tread:cell_m".to_owned(), site.grid.cell_m.to_string()),
            ];
            let normalisation = parameters.normalisation.clone();
            metadata.extend(normalisation.map(|name| ("tread:normalisation".to_owned(), name)));
            metadata.extend(as_of.map(|as_of| ("tread:as_of".to_owned(), as_of.to_string())));
            table::parquet(cells::COLUMNS, cells::row, metadata)?
        }
    })
}

/// Adds the header with the time of the map, if the request gave one.
pub(super) fn add_as_of_header(mut response: Response, as_of: Option<Timestamp>) -> Response {
    let as_of = as_of.and_then(|as_of| HeaderValue::try_from(as_of.to_string()).ok());
    if let Some(as_of) = as_of {
        response.headers_mut().insert(AS_OF, as_of);
    }
    response
}

fn answer(headers: &HeaderMap, media_type: &'static str, picture: Picture) -> Response {
    let of = picture.of;
    let mut response = etag::bytes(headers, media_type, Bytes::from_owner(picture.bytes));
    let headers = response.headers_mut();
    // A cache must not return one format for another.
    headers.insert(axum::http::header::VARY, HeaderValue::from_static("accept"));
    let as_of = Timestamp::from_microsecond(of.as_of_us).unwrap_or(Timestamp::MAX);
    let mut set_header = |name: HeaderName, value: Option<String>| {
        if let Some(value) = value.and_then(|value| HeaderValue::try_from(value).ok()) {
            headers.insert(name, value);
        }
    };
    set_header(AS_OF, Some(as_of.to_string()));
    set_header(
        CONFIGURATION,
        of.configuration.map(|found| found.to_string()),
    );
    set_header(NORMALISATION, of.normalisation.clone());
    response
}
