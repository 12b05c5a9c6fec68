//! The REST API. Knows HTTP and no SQL.
//!
//! Every route and its description in `/openapi.json` come from one `routes!`. All errors are
//! problems ([`problem`]); bodies, paths and queries are read by [`extract`] alone.

mod alerts;

mod description;
mod drive;
mod etag;
mod events;
pub mod extract;
pub mod forward;
pub(crate) mod forward_body;
mod friction;
mod geofence;
mod guarded;
pub mod health;
mod identity;
mod limits;
mod missions;
mod negotiate;
mod page;
pub mod problem;
mod revision;
mod robots;
pub mod serve;
mod sites;
pub mod standby;
mod stops;
mod subject;
mod terrains;
pub mod tls;
mod webhooks;
mod withdrawals;

use std::any::Any;
use std::sync::Arc;
use std::time::Duration;

use axum::extract::{MatchedPath, Request, State};
use axum::http::HeaderName;
use axum::middleware::{Next, from_fn, from_fn_with_state};
use axum::response::{IntoResponse, Response};
use axum::{Extension, Router, middleware};
use tower_http::catch_panic::CatchPanicLayer;
use tower_http::request_id::{
    MakeRequestUuid, PropagateRequestIdLayer, RequestId, SetRequestIdLayer,
};
use tower_http::trace::TraceLayer;
use tread_api::problem::ProblemType;
use utoipa::OpenApi as _;
use utoipa::openapi::OpenApi;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;
use utoipa_swagger_ui::SwaggerUi;

use self::extract::BodyLimit;
pub use self::identity::access::{Access, PUBLIC, RouteRequirement};
use self::identity::guard::{self, Guard};
use self::identity::{audit, authority, browser, enrolment, session, sessions, sign_in, tokens};
use self::problem::{Problem, Refused};
use crate::app::App;
use crate::app::metrics::MEDIA_TYPE;
use crate::identity::origin::Names;
use crate::metrics::AnsweredRequest;

/// Maximum size of the body of `POST /v1/missions`, bytes: the longest waypoint path.
pub const MISSION_BODY_MAX: usize = 16 * 1024 * 1024;
/// Maximum size of the body of a sign-in, bytes; it needs no credential.
pub const SIGN_IN_BODY_MAX: usize = 4 * 1024;
/// Maximum size of the body of a robot that joins or renews, bytes; it needs no credential.
pub const ENROLMENT_BODY_MAX: usize = 16 * 1024;
/// Maximum size of the body of other requests, bytes.
pub const BODY_MAX: usize = 1024 * 1024;
/// Maximum duration of a request.
pub const REQUEST_TIMEOUT: Duration = Duration::from_secs(15);
/// Header with the identifier of a request, in the response and the log.
const REQUEST_ID: HeaderName = HeaderName::from_static("x-request-id");

#[derive(utoipa::OpenApi)]
#[openapi(
    info(
        title = "Tread",
        description = "Missions for skid-steered robots, and the friction that they measure.",
    ),
    components(schemas(
        tread_api::drive::DriveRequest,
        tread_api::identity::AuditOrder,
        tread_api::webhook::AlertNotice,
    ))
)]
struct Description;

fn routes() -> OpenApiRouter<App> {
    let missions = OpenApiRouter::new()
        .routes(routes!(missions::list, missions::create))
        .routes(routes!(missions::replace))
        .routes(routes!(missions::check))
        .layer(Extension(BodyLimit(MISSION_BODY_MAX)));
    let session = OpenApiRouter::new()
        .routes(routes!(session::create, session::get, session::end))
        .routes(routes!(sign_in::methods))
        .routes(routes!(sign_in::begin))
        .routes(routes!(sign_in::finish))
        .layer(Extension(BodyLimit(SIGN_IN_BODY_MAX)));
    let joining = OpenApiRouter::new()
        .routes(routes!(enrolment::enrol))
        .routes(routes!(enrolment::renew))
        .layer(Extension(BodyLimit(ENROLMENT_BODY_MAX)));
    OpenApiRouter::with_openapi(Description::openapi())
        .routes(routes!(health::healthz))
        .routes(routes!(health::readyz))
        .routes(routes!(health::status))
        .routes(routes!(tokens::list, tokens::create))
        .routes(routes!(tokens::revoke))
        .routes(routes!(sessions::list))
        .routes(routes!(sessions::end))
        .routes(routes!(enrolment::list_tokens, enrolment::create_token))
        .routes(routes!(enrolment::revoke_token))
        .routes(routes!(enrolment::list))
        .routes(routes!(enrolment::revoke))
        .routes(routes!(authority::get))
        .routes(routes!(authority::start))
        .routes(routes!(authority::finish))
        .routes(routes!(authority::replace))
        .routes(routes!(webhooks::list, webhooks::create))
        .routes(routes!(webhooks::get, webhooks::replace, webhooks::delete))
        .routes(routes!(webhooks::rotate))
        .routes(routes!(webhooks::test))
        .routes(routes!(webhooks::deliveries))
        .routes(routes!(audit::list))
        .routes(routes!(audit::chain))
        .routes(routes!(sites::list, sites::create))
        .routes(routes!(sites::get))
        .routes(routes!(sites::set_origin, sites::remove_origin))
        .routes(routes!(terrains::list, terrains::create))
        .routes(routes!(terrains::get, terrains::replace, terrains::delete))
        .routes(routes!(robots::list))
        .routes(routes!(robots::get, robots::change))
        .routes(routes!(robots::release))
        .routes(routes!(alerts::list))
        .routes(routes!(alerts::get))
        .routes(routes!(alerts::acknowledge))
        .routes(routes!(events::stream))
        .routes(routes!(missions::get))
        .routes(routes!(missions::path))
        .routes(routes!(missions::cancel))
        .routes(routes!(missions::pause))
        .routes(routes!(missions::resume))
        .routes(routes!(stops::stop))
        .routes(routes!(stops::stop_fleet))
        .routes(routes!(stops::clear))
        .routes(routes!(stops::list))
        .routes(routes!(drive::drive))
        .routes(routes!(limits::list))
        .routes(routes!(limits::set, limits::end))
        .routes(routes!(geofence::get, geofence::replace))
        .routes(routes!(friction::robots))
        .routes(routes!(friction::segments))
        .routes(routes!(withdrawals::create))
        .routes(routes!(withdrawals::list))
        .merge(map_routes())
        .layer(Extension(BodyLimit(BODY_MAX)))
        .merge(missions)
        .merge(session)
        .merge(joining)
}

/// Routes that need nothing but the map and the database, which a standby has too.
fn map_routes() -> OpenApiRouter<App> {
    OpenApiRouter::new()
        .routes(routes!(friction::terrains))
        .routes(routes!(friction::terrain))
        .routes(routes!(friction::history::terrain_history))
        .routes(routes!(friction::history::point_history))
        .routes(routes!(friction::places::cells))
        .routes(routes!(friction::places::point))
        .routes(routes!(friction::places::path))
        .routes(routes!(friction::places::difference))
        .routes(routes!(friction::places::visits))
        .routes(routes!(friction::map::map))
}

/// Returns the OpenAPI description.
pub fn openapi() -> OpenApi {
    description::complete(routes().to_openapi())
}

/// Returns the requirements of every route, from the description.
pub fn access() -> Access {
    Access::of(&openapi())
}

/// Creates the router of the whole API, for a server with these host names.
pub fn router(app: App, names: Names) -> Router {
    let (router, openapi) = routes().split_for_parts();
    let openapi = description::complete(openapi);
    let access = Access::of(&openapi);
    let router = router
        .merge(page::routes())
        .merge(
            SwaggerUi::new("/docs")
                .url("/openapi.json", openapi)
                // Without this the page shows the description to a validator on another host.
                .config(utoipa_swagger_ui::Config::default().validator_url("none")),
        )
        .fallback(not_found)
        .method_not_allowed_fallback(method_not_allowed);
    let router = behind_guard(router, &app, (access, Arc::new(names)));
    with_request_id(router).with_state(app)
}

/// Puts the guard before routes with these requirements, and measures and bounds each request.
fn behind_guard(
    router: Router<App>,
    app: &App,
    (access, names): (Access, Arc<Names>),
) -> Router<App> {
    let guard = Guard::new(app.clone(), access, Arc::clone(&names));
    let router = router
        .layer(from_fn_with_state(guard, guard::authorize))
        .layer(Extension(Arc::clone(&names)));
    let router = match browser::foreign_pages(&names.allowed_origins) {
        Some(foreign_pages) => router.layer(foreign_pages),
        None => router,
    };
    router
        .layer(from_fn_with_state(app.clone(), measure))
        .layer(from_fn(bound_time))
        .layer(CatchPanicLayer::custom(broken))
        .layer(from_fn_with_state(app.clone(), count_panics))
        .layer(from_fn_with_state(names, browser::set_headers))
}

/// Names each request in its answer and in the log.
fn with_request_id(router: Router<App>) -> Router<App> {
    router
        .layer(TraceLayer::new_for_http().make_span_with(span))
        .layer(PropagateRequestIdLayer::new(REQUEST_ID))
        .layer(SetRequestIdLayer::new(REQUEST_ID, MakeRequestUuid))
}

/// Creates the router of the Prometheus metrics, for an address of its own.
pub fn metrics_router(app: App) -> Router {
    let guard = Guard::new(app.clone(), Access::open("/metrics"), Arc::default());
    Router::new()
        .route("/metrics", axum::routing::get(metrics))
        .fallback(not_found)
        .layer(from_fn_with_state(guard, guard::authorize))
        .layer(from_fn(bound_time))
        .with_state(app)
}

async fn metrics(State(app): State<App>) -> Result<Response, Problem> {
    let text = app.metrics_text().await;
    Ok(([(axum::http::header::CONTENT_TYPE, MEDIA_TYPE)], text).into_response())
}

/// Records the duration of each request by route.
async fn measure(State(app): State<App>, request: Request, next: Next) -> Response {
    let route = request.extensions().get::<MatchedPath>();
    let route = route.map_or("none", MatchedPath::as_str).to_owned();
    let method = request.method().clone();
    let asked_at = app.clock().elapsed();
    let response = next.run(request).await;
    app.metrics().request(&AnsweredRequest {
        method: method.as_str(),
        route: &route,
        status: response.status().as_u16(),
        took: app.clock().elapsed().saturating_sub(asked_at),
    });
    if let Some(Refused(kind)) = response.extensions().get() {
        app.metrics().request_refused(*kind);
    }
    response
}

async fn not_found() -> Problem {
    Problem::new(ProblemType::NotFound).detail("the API is described at /docs")
}

async fn method_not_allowed() -> Problem {
    Problem::new(ProblemType::MethodNotAllowed).detail("the API is described at /docs")
}

async fn bound_time(request: Request, next: Next) -> Response {
    match tokio::time::timeout(REQUEST_TIMEOUT, next.run(request)).await {
        Ok(response) => response,
        Err(_elapsed) => Problem::new(ProblemType::Timeout).into_response(),
    }
}

/// Marks the answer to a request whose handler panicked.
#[derive(Debug, Clone, Copy)]
struct Panicked;

#[expect(clippy::needless_pass_by_value, reason = "the layer's signature")]
fn broken(panic: Box<dyn Any + Send + 'static>) -> Response {
    let message = panic.downcast_ref::<&str>().copied();
    let message = message.or_else(|| panic.downcast_ref::<String>().map(String::as_str));
    tracing::error!(
        "a request's handler panicked: {}",
        message.unwrap_or("it did not say why")
    );
    let mut response = Problem::new(ProblemType::Internal).into_response();
    response.extensions_mut().insert(Panicked);
    response
}

async fn count_panics(
    State(app): State<App>,
    request: Request,
    next: middleware::Next,
) -> Response {
    let response = next.run(request).await;
    if response.extensions().get::<Panicked>().is_some() {
        app.counters().http_panics.one();
    }
    response
}

fn span(request: &Request) -> tracing::Span {
    let id = request.extensions().get::<RequestId>();
    let id = id
        .and_then(|id| id.header_value().to_str().ok())
        .unwrap_or_default();
    tracing::info_span!(
        "request", http.method = %request.method(), http.path = request.uri().path(), id,
    )
}
