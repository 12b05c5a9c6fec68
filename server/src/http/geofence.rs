//! `/v1/sites/{site}/geofence`.

use axum::extract::State;
use axum::http::{HeaderMap, StatusCode};
use axum::response::Response;
use tread_api::ids::SiteId;
use tread_api::problem::ProblemBody;
use tread_api::safety::{Geofence, ReplaceGeofence};

use super::extract::{Json, Path};
use super::problem::Problem;
use super::revision;
use crate::app::App;

/// Get the geofence of a site.
///
/// The `ETag` is the revision.
#[utoipa::path(get, path = "/v1/sites/{site}/geofence", tag = "safety",
    security(("token" = ["read"])),
    operation_id = "get_geofence", params(("site" = SiteId, Path)),
    responses((status = 200, body = Geofence), (status = 404, body = ProblemBody)))]
pub(super) async fn get(
    State(app): State<App>,
    Path(site): Path<SiteId>,
) -> Result<Response, Problem> {
    Ok(tagged(app.geofence(&site).await?))
}

/// Replace the geofence of a site.
///
/// With `If-Match`, the request is refused unless the revision is still the given one.
#[utoipa::path(put, path = "/v1/sites/{site}/geofence", tag = "safety",
    security(("token" = ["configure"])),
    operation_id = "replace_geofence", params(("site" = SiteId, Path),
        ("if-match" = Option<String>, Header, description = "Revision that the request may replace")),
    request_body = ReplaceGeofence,
    responses((status = 200, body = Geofence), (status = 404, body = ProblemBody),
        (status = 412, body = ProblemBody), (status = 422, body = ProblemBody)))]
pub(super) async fn replace(
    State(app): State<App>,
    Path(site): Path<SiteId>,
    headers: HeaderMap,
    Json(request): Json<ReplaceGeofence>,
) -> Result<Response, Problem> {
    let expected = revision::expected(&headers)?;
    Ok(tagged(
        app.replace_geofence(&site, request, &expected).await?,
    ))
}

fn tagged(geofence: Geofence) -> Response {
    revision::tagged(StatusCode::OK, geofence.revision, geofence)
}
