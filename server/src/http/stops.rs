//! Stops: of one robot, of all, their list and their clearing.
//!
//! A stop is the only request that is executed with a missing or invalid body. Any part of the body
//! that can be parsed applies, whatever the rest and the `content-type` are:
//!
//! | the body | stops |
//! |---|---|
//! | none, or not a JSON object, or one that does not arrive within [`STOP_BODY_TIMEOUT`] | all robots |
//! | an object without `site`, or with `null` | all robots |
//! | an object with a `site` that can be one | the robots of that site; 404 if it is not known, 403 if it is not the token's |
//! | an object with any other `site` | none: 422 at once |
//!
//! "All robots" are those within the scope of the token.
//!
//! A `site` that cannot be parsed shows that the caller meant some robots, but not which. To stop
//! all robots would stop those of other sites; to stop none without an error would be worse. So the
//! request is refused at once, as with an unknown site. Any other body that cannot be parsed may
//! come from an emergency, and stops all robots.

use std::time::Duration;

use axum::extract::{FromRequest, Request, State};
use serde::Deserialize;
use serde_json::{Map, Value};
use tread_api::ids::{RobotId, SiteId};
use tread_api::page::Page;
use tread_api::problem::{ProblemBody, ProblemType};
use tread_api::stop::{ClearStop, FleetStop, STOP_TEXT_MAX, Stop, StopFleet, StopRobot};
use tread_api::text::cleaned;
use utoipa::IntoParams;

use super::extract::{BodyLimit, Json, Path, Query, cursor, page_limit, read};
use super::problem::Problem;
use super::subject::{AuditSlot, Subject};
use crate::app::App;
use crate::app::identity::Credential;
use crate::app::stops::StopFilter;
use crate::app::stops::StopReason;

/// Maximum time for the body of a stop to arrive; after it the stop is executed without the body.
const STOP_BODY_TIMEOUT: Duration = Duration::from_millis(500);

/// The part of a stop's body that could be parsed.
pub(super) struct StopBody(Map<String, Value>);

impl<S: Send + Sync> FromRequest<S> for StopBody {
    type Rejection = std::convert::Infallible;

    async fn from_request(request: Request, _state: &S) -> Result<Self, Self::Rejection> {
        let slot = request.extensions().get::<AuditSlot>().cloned();
        let reading = read(request.into_body(), BodyLimit(super::BODY_MAX));
        let arrived = tokio::time::timeout(STOP_BODY_TIMEOUT, reading).await;
        let text = arrived.ok().and_then(Result::ok).unwrap_or_default();
        let Ok(fields) = serde_json::from_slice(&text) else {
            return Ok(Self(Map::new()));
        };
        if let Some(slot) = slot {
            slot.leave(&text);
        }
        Ok(Self(fields))
    }
}

impl StopBody {
    fn text(&self, field: &str) -> Option<String> {
        let text = self.0.get(field)?.as_str()?;
        Some(cleaned(text, STOP_TEXT_MAX))
    }

    /// Returns author and reason; the token's name precedes any name given in the body.
    fn stop_reason(&self, subject: &Credential) -> StopReason {
        StopReason {
            by: Some(subject.author(self.text("by").as_deref())),
            reason: self.text("reason"),
        }
    }

    /// Returns the site whose robots are to stop; `None` for all sites.
    fn site(&self) -> Result<Option<SiteId>, Problem> {
        let site = match self.0.get("site") {
            None | Some(Value::Null) => return Ok(None),
            Some(site) => site.as_str().and_then(|site| site.parse().ok()),
        };
        let unreadable = || {
            let detail = "nothing was stopped: this is no site's identifier; leave `site` out, or \
                          the whole body, to stop every robot";
            let problem = Problem::new(ProblemType::InvalidBody).detail(detail);
            problem.field("site")
        };
        site.map(Some).ok_or_else(unreadable)
    }
}

/// Query parameters of the list of stops.
#[derive(Debug, Clone, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(super) struct StopQuery {
    /// Only stops of this site.
    site: Option<SiteId>,
    /// Only stops of robots with this identifier.
    robot: Option<RobotId>,
    /// Only stops that are not cleared.
    #[serde(default)]
    #[param(required = false)]
    in_force: bool,
    /// `next_cursor` of the previous page.
    cursor: Option<String>,
    /// Maximum number of entries of the page, 1 to 1000; 100 when absent.
    limit: Option<u32>,
}

/// Stop a robot, whatever its state and whoever drives it.
///
/// The response is sent when the robot has confirmed the stop, or after 300 ms. The server then
/// repeats the stop until the robot confirms it.
#[utoipa::path(post, path = "/v1/sites/{site}/robots/{robot}/stop", tag = "safety",
    security(("token" = ["stop"])),
    operation_id = "stop_robot", params(("site" = SiteId, Path), ("robot" = RobotId, Path)),
    request_body = Option<StopRobot>,
    responses((status = 200, body = Stop), (status = 404, body = ProblemBody)))]
pub(super) async fn stop(
    State(app): State<App>,
    Subject(subject): Subject,
    Path((site, robot)): Path<(SiteId, RobotId)>,
    body: StopBody,
) -> Result<Json<Stop>, Problem> {
    let stop_reason = body.stop_reason(&subject);
    Ok(Json(app.stop_robot(&site, &robot, stop_reason).await?))
}

/// Stop all robots, of one site or of all sites within the token's scope.
///
/// Includes every robot that was ever connected. A body that cannot be parsed stops all of them;
/// one whose `site` cannot be parsed stops none and is refused.
#[utoipa::path(post, path = "/v1/stop", tag = "safety", operation_id = "stop_fleet",
    security(("token" = ["stop"])),
    request_body = Option<StopFleet>,
    responses((status = 200, body = FleetStop), (status = 404, body = ProblemBody),
        (status = 422, body = ProblemBody)))]
pub(super) async fn stop_fleet(
    State(app): State<App>,
    Subject(subject): Subject,
    body: StopBody,
) -> Result<Json<FleetStop>, Problem> {
    let (site, stop_reason) = (body.site()?, body.stop_reason(&subject));
    if let Some(site) = &site {
        subject.check_site(site)?;
    }
    let stopped = app.stop_fleet(&subject.scope, site.as_ref(), stop_reason);
    Ok(Json(stopped.await?))
}

/// Clear a robot's newest stop, if the robot is at rest.
///
/// The robot stays at rest: its active and queued missions stay on hold until they are resumed.
#[utoipa::path(post, path = "/v1/sites/{site}/robots/{robot}/stop/clear", tag = "safety",
    security(("token" = ["clear_stop"])),
    operation_id = "clear_stop", params(("site" = SiteId, Path), ("robot" = RobotId, Path)),
    request_body = ClearStop,
    responses((status = 200, body = Stop), (status = 404, body = ProblemBody),
        (status = 409, body = ProblemBody), (status = 503, body = ProblemBody)))]
pub(super) async fn clear(
    State(app): State<App>,
    Subject(subject): Subject,
    Path((site, robot)): Path<(SiteId, RobotId)>,
    Json(request): Json<ClearStop>,
) -> Result<Json<Stop>, Problem> {
    let ClearStop { stop, by } = request;
    let by = subject.author(by.as_deref());
    Ok(Json(app.clear_stop(&site, &robot, stop, Some(by)).await?))
}

/// List stops, newest first.
#[utoipa::path(get, path = "/v1/stops", tag = "safety", operation_id = "list_stops",
    security(("token" = ["read"])),
    params(StopQuery),
    responses((status = 200, body = Page<Stop>), (status = 400, body = ProblemBody)))]
pub(super) async fn list(
    State(app): State<App>,
    Subject(subject): Subject,
    Query(query): Query<StopQuery>,
) -> Result<Json<Page<Stop>>, Problem> {
    let limit = page_limit(query.limit)?;
    let before = cursor(query.cursor.as_deref())?;
    let StopQuery {
        site,
        robot,
        in_force,
        ..
    } = query;
    let filter = StopFilter {
        site,
        robot,
        in_force,
        before,
        within: subject.scope.clone(),
    };
    Ok(Json(app.stops(&filter, limit).await?))
}
