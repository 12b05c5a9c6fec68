//! The guard before every route: host, origin, token, right, site and robot; then the audit log.
//!
//! The guard works on the matched route, so no handler can be reached without it. A token that is
//! wrong, expired or revoked gets the same response.

use std::net::{IpAddr, Ipv4Addr};
use std::sync::Arc;

use axum::body::{Body, HttpBody as _};
use axum::extract::{MatchedPath, Request, State};
use axum::http::{HeaderMap, HeaderValue, Method, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use futures_util::StreamExt as _;
use serde_json::Value;
use tokio_util::sync::CancellationToken;
use tread_api::identity::AuditEntry;
use tread_api::problem::ProblemType;
use tread_api::rights::Right;

use super::access::{Access, RouteRequirement};
use super::{browser, place};
use crate::app::identity::{Credential, CredentialKind, SignInError};
use crate::app::{App, AppError};
use crate::connections::{Purpose, Slot};
use crate::counters::Counter;
use crate::http::REQUEST_ID;
use crate::http::events::Cut;
use crate::http::guarded::Guarded;
use crate::http::problem::Problem;
use crate::http::subject::{AuditSlot, Subject};
use crate::identity::origin::{Names, Provenance};

/// Route that stops all robots.
const STOP_ALL: &str = "/v1/stop";
const STOP_ONE: &str = "/v1/sites/{site}/robots/{robot}/stop";
/// Maximum length of a request's query, bytes.
const QUERY_MAX: usize = 4_096;
/// Maximum length of a request's path, bytes.
const PATH_MAX: usize = 2_048;
/// Maximum size of a request's head, bytes. The HTTP library reads up to twice as much when all of it
/// arrives at once.
pub(in crate::http) const HEAD_MAX: usize = 64 * 1024;
/// Maximum length of path and request id in the audit log, characters.
const AUDIT_TEXT_MAX: usize = 200;

/// Source address of a request, an extension set by the accept loop: that of the peer, or of the
/// client that a trusted proxy names.
#[derive(Debug, Clone, Copy)]
pub(in crate::http) struct Peer(pub(in crate::http) IpAddr);

/// Who signed in with this request, an extension of the answer.
#[derive(Debug, Clone)]
pub(super) struct SignedIn(pub(super) Arc<Credential>);

/// What the audit log says of this request instead of its body, an extension of the answer.
#[derive(Debug, Clone)]
pub(super) struct Audited(pub(super) Value);

/// State of the guard.
#[derive(Debug, Clone)]
pub(in crate::http) struct Guard {
    app: App,
    access: Arc<Access>,
    names: Arc<Names>,
}

/// A refusal: the response, and the counter.
struct Refusal {
    response: Box<Response>,
    who: Option<Arc<Credential>>,
    is_audited: bool,
}

impl Refusal {
    fn of(response: Response) -> Self {
        Self {
            response: Box::new(response),
            who: None,
            is_audited: true,
        }
    }

    fn counted(counter: &Counter, problem: Problem) -> Self {
        counter.one();
        Self::of(problem.into_response())
    }
}

impl Guard {
    pub(in crate::http) fn new(app: App, access: Access, names: Arc<Names>) -> Self {
        let access = Arc::new(access);
        Self { app, access, names }
    }

    /// Refuses malformed requests before authentication.
    fn check_form(&self, request: &Request) -> Result<(), Refusal> {
        let counters = self.app.counters();
        let uri = request.uri();
        let query_length = uri.query().map_or(0, str::len);
        if query_length > QUERY_MAX || uri.path().len() > PATH_MAX {
            let detail = format!("a path may have at most {PATH_MAX} bytes, a query {QUERY_MAX}");
            let problem = Problem::new(ProblemType::RequestTooLong).detail(detail);
            return Err(Refusal::counted(&counters.refused_too_long, problem));
        }
        let headers = request.headers().iter();
        let headers_length = headers.map(|(name, value)| name.as_str().len() + value.len());
        if headers_length.sum::<usize>() > HEAD_MAX {
            counters.refused_too_long.one();
            // Without a body, as the HTTP library answers to a longer one.
            let refusal = StatusCode::REQUEST_HEADER_FIELDS_TOO_LARGE.into_response();
            return Err(Refusal::of(refusal));
        }
        let host = provenance(request.headers()).host;
        if !host.is_some_and(|host| self.names.knows(host)) {
            let detail = "the `host` header must be an address of this server, `localhost`, or one \
                          of `hosts` in its configuration";
            let problem = Problem::new(ProblemType::UnknownHost).detail(detail);
            return Err(Refusal::counted(&counters.refused_host, problem));
        }
        Ok(())
    }

    fn check_origin(
        &self,
        method: &Method,
        headers: &HeaderMap,
        by: Option<CredentialKind>,
    ) -> Result<(), Refusal> {
        let from = provenance(headers);
        let is_browser = from.origin.is_some() || from.fetch_site.is_some();
        let is_upgrade = headers.contains_key(header::UPGRADE);
        let may = match by {
            // A browser sends its cookie with requests of any page.
            Some(CredentialKind::Session) if is_upgrade || is_change(method) => {
                self.names.is_own_page(&from)
            }
            _ if is_upgrade => self.names.may_open_socket(&from),
            // For the sign-in: a foreign page must not sign a person in as somebody else.
            None if is_browser && is_change(method) => self.names.is_own_page(&from),
            None | Some(_) => true,
        };
        if may {
            return Ok(());
        }
        let detail = "send the request from this server's dashboard, or with a token from an \
                      origin in `allowed_origins` of its configuration";
        let problem = Problem::new(ProblemType::ForeignOrigin).detail(detail);
        Err(Refusal::counted(
            &self.app.counters().refused_origin,
            problem,
        ))
    }

    async fn check_subject(
        &self,
        method: &Method,
        headers: &HeaderMap,
        address: IpAddr,
        (needed, purpose): (Right, Purpose),
    ) -> Result<Arc<Credential>, Refusal> {
        let counters = self.app.counters();
        let Some((text, shown)) = shown(headers, self.names.is_tls) else {
            let mut refusal = Refusal::counted(&counters.refused_no_token, unauthenticated());
            // Whoever shows nothing has tried nothing.
            refusal.is_audited = false;
            add_challenge(&mut refusal.response);
            return Err(refusal);
        };
        self.check_origin(method, headers, Some(shown))?;
        let found = self.app.authenticate(address, text, shown, purpose).await;
        let credential = found.map_err(|error| {
            let mut response = sign_in_problem(&self.app, &error);
            if shown == CredentialKind::Session && response.status() == 401 {
                // Makes the browser drop a cookie that is no longer valid.
                browser::remove_session_cookie(response.headers_mut(), self.names.is_tls);
            }
            Refusal::of(response)
        })?;
        if let Some(credential) = credential.for_right(needed) {
            return Ok(credential);
        }
        let detail = format!(
            "this request needs the right `{needed}`, and `{}` has {}",
            credential.name,
            credential.all_rights()
        );
        Err(self.forbidden(credential, detail))
    }

    fn forbidden(&self, who: Arc<Credential>, detail: String) -> Refusal {
        let problem = Problem::new(ProblemType::Forbidden).detail(detail);
        let mut refusal = Refusal::counted(&self.app.counters().refused_role, problem);
        refusal.who = Some(who);
        refusal
    }

    /// Refuses a request for a site or robot outside the token's scope.
    async fn check_place(
        &self,
        request: &mut Request,
        needed: (&str, Right),
        who: &Arc<Credential>,
    ) -> Result<(), Refusal> {
        if let Err(error) = place::check(&self.app, request, needed, who).await {
            let is_outside = matches!(error, AppError::OutsideScope(_));
            let mut refusal = Refusal::of(Problem::from(error).into_response());
            refusal.who = Some(Arc::clone(who));
            if is_outside {
                self.app.counters().refused_scope.one();
            }
            return Err(refusal);
        }
        match place::foreign_owner(request, needed.1, who).await {
            None => Ok(()),
            Some(owner) => {
                let (right, name, own) = (Right::ReleaseHold, &who.name, who.own_name());
                let detail = format!(
                    "this needs the right `{right}`: `{name}` sets and ends the limit of the \
                     owner `{own}` alone, not that of `{owner}`"
                );
                Err(self.forbidden(Arc::clone(who), detail))
            }
        }
    }

    fn record(&self, audited: AuditedRequest, response: &Response, who: Option<&Arc<Credential>>) {
        let recorded = response.extensions().get::<Audited>();
        let recorded = recorded.map(|Audited(what)| what.clone());
        let left = audited.slot.left().cloned();
        let entry = AuditEntry {
            id: 0,
            at: self.app.clock().now(),
            since: None,
            count: 1,
            who: who.map(|who| who.name.clone()),
            token: who.and_then(|who| who.subject.token()),
            person: who.and_then(|who| who.person.clone()),
            role: who.and_then(|who| who.role),
            address: audited.address.to_string(),
            method: audited.method,
            route: audited.route,
            path: audited.path,
            status: response.status().as_u16(),
            request_id: audited.request_id,
            what: recorded.or(left).filter(|what| !what.is_null()),
            previous_hash: None,
            hash: None,
        };
        self.app.audit(entry);
    }
}

/// Description of a request for the audit log.
struct AuditedRequest {
    address: IpAddr,
    method: String,
    route: String,
    path: String,
    request_id: String,
    slot: AuditSlot,
}

fn audited_request(request: &Request, route: &str) -> AuditedRequest {
    let short = |text: &str| text.chars().take(AUDIT_TEXT_MAX).collect();
    let request_id = request.headers().get(REQUEST_ID);
    AuditedRequest {
        address: address(request),
        method: short(request.method().as_str()),
        route: route.to_owned(),
        path: short(request.uri().path()),
        request_id: short(
            request_id
                .and_then(|id| id.to_str().ok())
                .unwrap_or_default(),
        ),
        slot: AuditSlot::default(),
    }
}

/// Middleware that lets permitted requests through.
pub(in crate::http) async fn authorize(
    State(guard): State<Guard>,
    mut request: Request,
    next: Next,
) -> Response {
    let route = request.extensions().get::<MatchedPath>();
    let route = route.map(|route| route.as_str().to_owned());
    let audited = audited_request(&request, route.as_deref().unwrap_or("none"));
    let admitted = match guard.check_form(&request) {
        Ok(()) => match &route {
            Some(route) => guard.admit(&mut request, route).await,
            // An unmatched path is answered by the fallback.
            None => return next.run(request).await,
        },
        Err(refusal) => Err(refusal),
    };
    let subject = match admitted {
        Ok(subject) => subject,
        Err(refusal) => {
            if refusal.is_audited {
                guard.record(audited, &refusal.response, refusal.who.as_ref());
            }
            return *refusal.response;
        }
    };
    let is_change = is_change(request.method());
    let cut = request.extensions().get::<Cut>().cloned();
    if is_change {
        request.extensions_mut().insert(audited.slot.clone());
    }
    let response = next.run(request).await;
    if response.status() == StatusCode::FORBIDDEN && subject.is_some() {
        // The handler has compared the body with the token's scope.
        guard.app.counters().refused_scope.one();
    }
    // A sign-in that returns from the provider is audited, although it is no change.
    let is_audited = response.extensions().get::<Audited>().is_some();
    if is_change || is_audited {
        let signed_in = response.extensions().get::<SignedIn>().cloned();
        let who = subject.clone().or(signed_in.map(|SignedIn(who)| who));
        guard.record(audited, &response, who.as_ref());
    }
    match subject {
        Some(subject) => end_with(&guard.app, subject, cut, response),
        None => response,
    }
}

impl Guard {
    /// Authenticates and authorises a request; `None` for the identity on a public route.
    async fn admit(
        &self,
        request: &mut Request,
        route: &str,
    ) -> Result<Option<Arc<Credential>>, Refusal> {
        match self.access.needed(request.method(), route) {
            Some(RouteRequirement::Nothing) => {
                self.check_origin(request.method(), request.headers(), None)?;
                Ok(None)
            }
            Some(RouteRequirement::Right(needed)) => {
                let address = address(request);
                let (method, headers) = (request.method(), request.headers());
                let purpose = purpose(method, route);
                let checked = self.check_subject(method, headers, address, (needed, purpose));
                let credential = checked.await?;
                // From here on the connection counts as at work, however long its body takes.
                if let Some(slot) = request.extensions().get::<Arc<Slot>>()
                    && let Err(full) = slot.prove(credential.subject, purpose)
                {
                    let problem = Problem::new(ProblemType::TooManyRequests);
                    let problem = problem.detail(full.to_string());
                    let counter = &self.app.counters().http_requests_without_room;
                    let mut refusal = Refusal::counted(counter, problem);
                    (refusal.who, refusal.is_audited) = (Some(credential), false);
                    return Err(refusal);
                }
                self.check_place(request, (route, needed), &credential)
                    .await?;
                request
                    .extensions_mut()
                    .insert(Subject(Arc::clone(&credential)));
                Ok(Some(credential))
            }
            None => {
                let detail = "the API is described at /docs";
                let methods = self.access.methods(route);
                let kind = match methods {
                    Some(_) => ProblemType::MethodNotAllowed,
                    None => ProblemType::NotFound,
                };
                let mut response = Problem::new(kind).detail(detail).into_response();
                if let Some(methods) = methods.and_then(|names| HeaderValue::try_from(names).ok()) {
                    response.headers_mut().insert(header::ALLOW, methods);
                }
                let mut refusal = Refusal::of(response);
                refusal.is_audited = false;
                Err(refusal)
            }
        }
    }
}

/// Ends the body of a response when its token or session ends: a stream of events closes, and the
/// connection of a download is cut, so that a client does not take a part for the whole.
fn end_with(app: &App, subject: Arc<Credential>, cut: Option<Cut>, response: Response) -> Response {
    let body = response.body();
    if body.is_end_stream() || body.size_hint().exact().is_some() {
        // The body is complete already.
        return response;
    }
    let left = subject.expires_at.duration_since(app.clock().now());
    let left = std::time::Duration::try_from(left).unwrap_or_default();
    let over = async move {
        let ended = subject.ended();
        tokio::select! {
            () = ended.cancelled() => {}
            () = tokio::time::sleep(left) => {}
        }
    };
    let media_type = response.headers().get(header::CONTENT_TYPE);
    if media_type.is_some_and(|media_type| media_type == "text/event-stream") {
        let until = |body: Body| body.into_data_stream().take_until(Box::pin(over));
        return response.map(|body| Body::from_stream(until(body)));
    }
    // A body is not polled while the client reads slowly, so a separate task watches.
    let given = CancellationToken::new();
    let guard = given.clone().drop_guard();
    app.spawn_background("download", async move {
        tokio::select! {
            () = given.cancelled() => {}
            () = over => {
                if let Some(Cut(cut)) = cut {
                    cut.cancel();
                }
            }
        }
    });
    response.map(|body| Guarded::body(body, guard))
}

/// Returns the response to an invalid secret; counts the cause.
pub(super) fn sign_in_problem(app: &App, error: &SignInError) -> Response {
    let counters = app.counters();
    let counter = match error {
        SignInError::Malformed => &counters.refused_token_malformed,
        SignInError::Unknown => &counters.refused_token_unknown,
        SignInError::Expired => &counters.refused_token_expired,
        SignInError::Revoked => &counters.refused_token_revoked,
        SignInError::Locked(left) => return locked(app, *left, error.to_string()),
        SignInError::Storage(cause) => {
            return Problem::storage(cause).into_response();
        }
    };
    counter.one();
    let mut response = unauthenticated().into_response();
    add_challenge(&mut response);
    response
}

/// Returns the response after too many failures.
pub(super) fn locked(app: &App, left: std::time::Duration, detail: String) -> Response {
    app.counters().refused_locked.one();
    let problem = Problem::new(ProblemType::TooManyAttempts).detail(detail);
    let mut response = problem.into_response();
    let seconds = HeaderValue::from(left.as_secs() + 1);
    response.headers_mut().insert(header::RETRY_AFTER, seconds);
    response
}

pub(super) fn unauthenticated() -> Problem {
    Problem::new(ProblemType::Unauthenticated)
        .detail("send a valid token as `authorization: Bearer …`, or sign in at /v1/session")
}

fn add_challenge(response: &mut Response) {
    let how = HeaderValue::from_static("Bearer realm=\"tread\"");
    response.headers_mut().insert(header::WWW_AUTHENTICATE, how);
}

/// Returns the secret in a request, and how it was shown; a header takes precedence over a cookie.
pub(in crate::http) fn shown(headers: &HeaderMap, is_tls: bool) -> Option<(&str, CredentialKind)> {
    if let Some(value) = headers.get(header::AUTHORIZATION) {
        let text = value.to_str().unwrap_or_default();
        let (scheme, secret) = text.split_once(' ').unwrap_or_default();
        let is_bearer = scheme.eq_ignore_ascii_case("bearer");
        let secret = if is_bearer { secret.trim() } else { "" };
        return Some((secret, CredentialKind::Token));
    }
    browser::shown_cookie(headers, is_tls).map(|secret| (secret, CredentialKind::Session))
}

/// Returns the source address of a request.
pub(super) fn address(request: &Request) -> IpAddr {
    let peer = request.extensions().get::<Peer>();
    peer.map_or(IpAddr::V4(Ipv4Addr::UNSPECIFIED), |Peer(address)| *address)
}

/// Returns the purpose of a request before routing, from its path alone.
pub(in crate::http) fn purpose_of_path(method: &Method, path: &str) -> Purpose {
    if method == Method::POST && path.starts_with("/v1/") && path.ends_with("/stop") {
        Purpose::Stop
    } else {
        Purpose::Other
    }
}

/// Returns whether a request is for a Stop, which has reserved capacity.
fn purpose(method: &Method, route: &str) -> Purpose {
    let is_stop = method == Method::POST && (route == STOP_ALL || route == STOP_ONE);
    if is_stop {
        Purpose::Stop
    } else {
        Purpose::Other
    }
}

fn is_change(method: &Method) -> bool {
    !(method == Method::GET || method == Method::HEAD || method == Method::OPTIONS)
}

/// Returns the headers that tell where a request comes from.
pub(super) fn provenance(headers: &HeaderMap) -> Provenance<'_> {
    let text = |name: &str| {
        let mut values = headers.get_all(name).iter();
        let first = values.next()?;
        // With two values of a header neither counts.
        let only = if values.next().is_some() {
            None
        } else {
            first.to_str().ok()
        };
        Some(only.unwrap_or_default())
    };
    Provenance {
        host: text("host"),
        origin: text("origin"),
        fetch_site: text("sec-fetch-site"),
    }
}
