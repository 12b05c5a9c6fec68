//! The REST API of a standby: it answers requests that read only the map, and forwards all others to the
//! active server.
//!
//! It also forwards requests that it would refuse, so that the active server decides about them, counts them
//! and records them in the audit log.

use std::sync::Arc;
use std::time::Duration;

use axum::body::Body;
use axum::extract::Request;
use axum::http::request::Parts;
use axum::http::{HeaderMap, Method, StatusCode};
use axum::response::{IntoResponse as _, Response};
use axum::routing::get;
use axum::{Extension, Router};
use tower::ServiceExt as _;
use tread_api::problem::ProblemType;

use super::extract::{BodyLimit, Json};
use super::forward::{self, ForwardError, Forwarder, SILENCE_MAX, Sharing};
use super::health::Health;
use super::identity::guard::{self, Peer};
use super::problem::Problem;
use super::{Access, BODY_MAX, behind_guard, map_routes, with_request_id};
use crate::app::App;
use crate::connections::{Purpose, Slot};
use crate::identity::origin::Names;

/// Maximum age of the map of a standby that is ready, and answers from it.
const MAP_AGE_MAX: Duration = Duration::from_secs(2);
/// Maximum time to find out whose a request is.
const PROVE_MAX: Duration = Duration::from_millis(250);

/// What answers the requests to a standby.
#[derive(Debug, Clone)]
struct Standby {
    app: App,
    map: Router,
    forwarder: Forwarder,
    is_tls: bool,
}

/// Creates the router of a standby with these host names.
pub fn router(app: App, names: Names, forwarder: Forwarder) -> Router {
    let (map, openapi) = map_routes()
        .layer(Extension(BodyLimit(BODY_MAX)))
        .split_for_parts();
    let is_tls = names.is_tls;
    let map = map
        .fallback(async || StatusCode::NOT_FOUND)
        .method_not_allowed_fallback(async || StatusCode::NOT_FOUND);
    let map = behind_guard(map, &app, (Access::of(&openapi), Arc::new(names)));
    let map = map.with_state(app.clone());
    let standby = Standby {
        app: app.clone(),
        map,
        forwarder,
        is_tls,
    };
    let checked = standby.clone();
    let router = Router::new()
        .route("/healthz", get(healthz))
        .route(
            "/readyz",
            get(async move || ready(&checked.app, &checked.forwarder)),
        )
        .fallback(move |request: Request| answer(standby.clone(), request));
    with_request_id(router).with_state(app)
}

/// Answers from the map if that is up to date, or forwards the request.
async fn answer(standby: Standby, request: Request) -> Response {
    let is_read = matches!(*request.method(), Method::GET | Method::HEAD);
    let (parts, body) = request.into_parts();
    // While the database does not answer, neither the map nor who may read it is known.
    let own = if is_read && standby.is_up_to_date() {
        let copy = Request::from_parts(parts.clone(), Body::empty());
        let Ok(own) = standby.map.clone().oneshot(copy).await;
        if own.status().is_success() || own.status() == StatusCode::NOT_MODIFIED {
            return own;
        }
        Some(own)
    } else {
        None
    };
    let sharing = match standby.prove(&parts).await {
        Ok(sharing) => sharing,
        Err(full) => return full.into_response(),
    };
    let request = Request::from_parts(parts, body);
    let forwarded = standby.forwarder.forward(&standby.app, sharing, request);
    match (forwarded.await, own) {
        (Ok(answer), _) => answer,
        (Err(error), Some(own)) if own.status() != StatusCode::NOT_FOUND => {
            tracing::debug!("a refused request was not forwarded: {error}");
            own
        }
        (Err(error), _) => Problem::from(error).into_response(),
    }
}

impl Standby {
    fn is_up_to_date(&self) -> bool {
        let ages = [self.app.map_age(), self.app.tokens_age()];
        ages.iter()
            .all(|age| age.is_some_and(|age| age <= MAP_AGE_MAX))
    }

    /// Authenticates a request, and counts its connection as one of its token or session, so that a flood of
    /// unauthenticated connections does not displace it. A request that cannot be authenticated within
    /// [`PROVE_MAX`] is forwarded without this. Permissions are checked by the active server.
    ///
    /// # Errors
    /// The token or session has its maximum number of connections.
    async fn prove(&self, parts: &Parts) -> Result<Sharing, Problem> {
        let (Some(slot), Some(&Peer(address)), Some((text, shown))) = (
            parts.extensions.get::<Arc<Slot>>(),
            parts.extensions.get::<Peer>(),
            guard::shown(&parts.headers, self.is_tls),
        ) else {
            return Ok(Sharing::Alone);
        };
        let purpose = guard::purpose_of_path(&parts.method, parts.uri.path());
        let looking = self.app.authenticate(address, text, shown, purpose);
        let Ok(Ok(credential)) = tokio::time::timeout(PROVE_MAX, looking).await else {
            return Ok(Sharing::Alone);
        };
        slot.prove(credential.subject, purpose)
            .map_err(|full| Problem::new(ProblemType::TooManyRequests).detail(full.to_string()))?;
        Ok(match purpose {
            Purpose::Stop => Sharing::Alone,
            Purpose::Other => Sharing::Known,
        })
    }
}

/// Says that the process lives, and to another standby that this is not the server.
async fn healthz(headers: HeaderMap) -> Result<Json<Health>, Problem> {
    if forward::is_forwarded(&headers) {
        return Err(ForwardError::Loop.into());
    }
    Ok(super::health::ok())
}

/// Returns whether this standby can answer all requests, by itself or by forwarding them.
fn ready(app: &App, forwarder: &Forwarder) -> Result<Json<Health>, Problem> {
    let unavailable = |detail: String| Err(Problem::new(ProblemType::Unavailable).detail(detail));
    match app.map_age() {
        Some(age) if age <= MAP_AGE_MAX => {}
        Some(age) => {
            let seconds = age.as_secs();
            return unavailable(format!(
                "standby: its map was last up to date {seconds} s ago"
            ));
        }
        None => return unavailable("standby: it is still reading the map".to_owned()),
    }
    if app.leader_url().is_none() {
        return unavailable(ForwardError::NoAddress.to_string());
    }
    if forwarder
        .silence()
        .is_none_or(|silence| silence >= SILENCE_MAX)
    {
        return unavailable(ForwardError::NoAnswer.to_string());
    }
    Ok(super::health::ok())
}
