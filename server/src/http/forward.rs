//! Forwards requests to the server that has the database, as a reverse proxy does.

use std::net::IpAddr;
use std::pin::pin;
use std::sync::{Arc, Mutex, PoisonError, RwLock};
use std::time::Duration;

use axum::body::{Body, HttpBody as _};
use axum::extract::Request;
use axum::http::uri::PathAndQuery;
use axum::http::{HeaderMap, HeaderName, HeaderValue, Response, StatusCode, Uri, header};
use axum::response::IntoResponse as _;
use hyper::upgrade::OnUpgrade;
use hyper_util::rt::TokioIo;
use reqwest::{Certificate, Url, redirect};
use tokio::io::{AsyncRead, AsyncWrite, AsyncWriteExt as _};
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;
use tracing::{debug, warn};
use tread_api::problem::ProblemType;

use super::forward_body::{EndTokens, cut_short};
use super::identity::guard::Peer;
use super::problem::Problem;
use super::serve::FORWARDED_FOR;
use crate::app::App;
use crate::connections::{RequestGuard, Slot};
use crate::error_text;

/// Maximum time for a connection, TLS included.
const CONNECT_MAX: Duration = Duration::from_secs(2);
/// Maximum time until an answer begins: longer than the other server has for a request.
const ANSWER_MAX: Duration = Duration::from_secs(17);
/// Maximum number of idle connections.
const IDLE_MAX: usize = 32;
/// Time after which an idle connection is closed: before the other server does.
const IDLE_TIMEOUT: Duration = Duration::from_secs(8);
/// Maximum time to close a forwarded connection after one side has.
const CLOSE_MAX: Duration = Duration::from_secs(1);
/// Interval of checks of the other server.
const CHECK_EVERY: Duration = Duration::from_secs(1);
/// Silence of the other server after which a standby is not ready.
pub(super) const SILENCE_MAX: Duration = Duration::from_secs(5);
/// Interval at which CA certificates are read again while the other server does not answer.
const RENEW_EVERY: Duration = Duration::from_secs(10);
/// Interval of log lines about a server that cannot be asked.
const LOG_EVERY: Duration = Duration::from_secs(10);
/// Name by which forwarded requests are recognised (RFC 9110, `Via`).
const VIA: &str = "1.1 tread-standby";
/// Headers of one connection, not of the request (RFC 9110, section 7.6.1).
const OF_CONNECTION: [HeaderName; 7] = [
    header::CONNECTION,
    HeaderName::from_static("keep-alive"),
    header::PROXY_AUTHENTICATE,
    header::PROXY_AUTHORIZATION,
    header::TE,
    header::TRAILER,
    header::TRANSFER_ENCODING,
];

/// Reason why a request was not forwarded.
#[derive(Debug, thiserror::Error)]
pub enum ForwardError {
    /// The other server has not said where it is.
    #[error(
        "this server is a standby, and the active server has no `[web] advertise_url` at which it can be \
         reached"
    )]
    NoAddress,
    /// The other server is a standby too, so that nobody has the database at the moment.
    #[error(
        "this server is a standby, and so is the server to which it forwards requests; try again"
    )]
    Loop,
    /// The other server does not answer a change that it may have received.
    #[error(
        "the active server does not answer, and may have executed the request: check that before you \
         try again"
    )]
    Uncertain,
    /// The path is written in an unusual way.
    #[error("this path cannot be forwarded: write it without `..`, `\\` and similar sequences")]
    Path,
    /// The other server does not answer.
    #[error("this server is a standby, and the active server does not answer; try again")]
    NoAnswer,
}

impl From<ForwardError> for Problem {
    fn from(error: ForwardError) -> Self {
        let kind = match error {
            ForwardError::Path => ProblemType::InvalidPath,
            ForwardError::NoAddress
            | ForwardError::Loop
            | ForwardError::NoAnswer
            | ForwardError::Uncertain => ProblemType::Unavailable,
        };
        Self::new(kind).detail(error.to_string())
    }
}

/// How a request may share connections with others: the other server limits the rate of a connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Sharing {
    /// With those of all whose tokens or sessions are valid.
    Known,
    /// With none: a stop, or whoever is not known.
    Alone,
}

/// Client of the server that has the database.
#[derive(Debug, Clone)]
pub struct Forwarder {
    inner: Arc<Inner>,
}

#[derive(Debug)]
struct Inner {
    clients: RwLock<Clients>,
    /// Cancelled when answers of the other server are not awaited any more.
    given_up: CancellationToken,
    /// When it answered last.
    reached_at: Mutex<Option<Instant>>,
    /// When a failure was logged last.
    logged_at: Mutex<Option<Instant>>,
}

#[derive(Debug)]
struct Clients {
    known: reqwest::Client,
    alone: reqwest::Client,
}

impl Clients {
    fn new(authorities_pem: Option<&[u8]>) -> Result<Self, reqwest::Error> {
        let client = |idle_max| {
            let mut builder = reqwest::Client::builder()
                .connect_timeout(CONNECT_MAX)
                .pool_max_idle_per_host(idle_max)
                .pool_idle_timeout(IDLE_TIMEOUT)
                .redirect(redirect::Policy::none())
                .no_proxy()
                .tcp_nodelay(true);
            if let Some(pem) = authorities_pem {
                builder = builder.tls_certs_only(Certificate::from_pem_bundle(pem)?);
            }
            builder.build()
        };
        Ok(Self {
            known: client(IDLE_MAX)?,
            alone: client(0)?,
        })
    }
}

impl Forwarder {
    /// Creates a client that trusts these CA certificates (PEM); those of the machine if `None`. When
    /// `given_up` is cancelled, answers are not awaited any more.
    ///
    /// # Errors
    /// The certificates cannot be read.
    pub fn new(
        authorities_pem: Option<&[u8]>,
        given_up: CancellationToken,
    ) -> Result<Self, reqwest::Error> {
        // Fails if a provider is installed already, which is then the same one.
        let _first = rustls::crypto::ring::default_provider().install_default();
        let inner = Inner {
            clients: RwLock::new(Clients::new(authorities_pem)?),
            given_up,
            reached_at: Mutex::default(),
            logged_at: Mutex::default(),
        };
        Ok(Self {
            inner: Arc::new(inner),
        })
    }

    /// Trusts other CA certificates from now on.
    ///
    /// # Errors
    /// As [`Forwarder::new`]; the former ones stay.
    pub fn renew(&self, authorities_pem: Option<&[u8]>) -> Result<(), reqwest::Error> {
        let clients = Clients::new(authorities_pem)?;
        let mut present = self.inner.clients.write();
        *present
            .as_deref_mut()
            .unwrap_or_else(|poisoned| poisoned.get_mut()) = clients;
        Ok(())
    }

    fn client(&self, sharing: Sharing) -> reqwest::Client {
        let clients = self
            .inner
            .clients
            .read()
            .unwrap_or_else(PoisonError::into_inner);
        match sharing {
            Sharing::Known => clients.known.clone(),
            Sharing::Alone => clients.alone.clone(),
        }
    }

    /// Asks the other server whether it lives.
    pub async fn check(&self, app: &App) {
        let Some(leader) = app.leader_url() else {
            return;
        };
        let request = self.client(Sharing::Known).get(format!("{leader}/healthz"));
        // A standby says then that it is none.
        let request = request.header(header::VIA, VIA).timeout(CONNECT_MAX).send();
        match request.await.and_then(reqwest::Response::error_for_status) {
            Ok(_answer) => self.reached(),
            Err(cause) => self.failed(&leader, &cause),
        }
    }

    fn reached(&self) {
        let mut reached_at = lock(&self.inner.reached_at);
        *reached_at = Some(Instant::now());
    }

    /// Returns for how long the other server has not answered; `None` if it never has.
    pub fn silence(&self) -> Option<Duration> {
        lock(&self.inner.reached_at).map(|at| at.elapsed())
    }

    /// Logs why the other server cannot be asked, now and then.
    fn failed(&self, leader: &str, cause: &dyn std::error::Error) {
        let mut logged_at = lock(&self.inner.logged_at);
        if logged_at.is_none_or(|at| at.elapsed() >= LOG_EVERY) {
            *logged_at = Some(Instant::now());
            let cause = error_text::chain(cause);
            warn!("the server that has the database cannot be asked at {leader}: {cause}");
        }
    }

    /// Forwards a request, and returns the answer as soon as it begins; a `WebSocket` is forwarded until
    /// one side closes it.
    ///
    /// # Errors
    /// [`ForwardError`].
    pub(super) async fn forward(
        &self,
        app: &App,
        sharing: Sharing,
        request: Request,
    ) -> Result<Response<Body>, ForwardError> {
        let (mut parts, body) = request.into_parts();
        if is_forwarded(&parts.headers) {
            return Err(ForwardError::Loop);
        }
        let is_safe = parts.method.is_safe();
        let unanswered = if is_safe {
            ForwardError::NoAnswer
        } else {
            ForwardError::Uncertain
        };
        let Some(leader) = app.leader_url() else {
            // After the takeover this server is the other one.
            return Err(if self.inner.given_up.is_cancelled() {
                ForwardError::NoAnswer
            } else {
                ForwardError::NoAddress
            });
        };
        let url = url_at(&leader, &parts.uri)?;
        let upgrade = parts.extensions.remove::<OnUpgrade>();
        let protocol = parts.headers.get(header::UPGRADE).cloned();
        let peer = parts.extensions.get::<Peer>().map(|peer| peer.0);
        let slot = parts.extensions.get::<Arc<Slot>>().map(Slot::hold);
        let mut headers = parts.headers;
        remove_those_of_connection(&mut headers);
        if let Some(protocol) = protocol {
            headers.insert(header::UPGRADE, protocol);
            headers.insert(header::CONNECTION, HeaderValue::from_static("upgrade"));
        }
        headers.append(header::VIA, HeaderValue::from_static(VIA));
        name_client(&mut headers, peer);
        let client = self.client(sharing);
        let mut request = client.request(parts.method, url).headers(headers);
        if !body.is_end_stream() {
            request = request.body(reqwest::Body::wrap_stream(body.into_data_stream()));
        }
        let answer = tokio::select! {
            biased;
            // The client asks again, and this server answers then.
            () = self.inner.given_up.cancelled() => return Err(unanswered),
            answer = tokio::time::timeout(ANSWER_MAX, request.send()) => answer,
        };
        let answer = match answer {
            Ok(Ok(answer)) => answer,
            Ok(Err(cause)) => {
                self.failed(&leader, &cause);
                let is_sent = !cause.is_connect();
                return Err(if is_sent {
                    unanswered
                } else {
                    ForwardError::NoAnswer
                });
            }
            Err(elapsed) => {
                self.failed(&leader, &elapsed);
                return Err(unanswered);
            }
        };
        if answer.status() == StatusCode::SWITCHING_PROTOCOLS {
            return Ok(join(app, (upgrade, slot), answer));
        }
        let mut answer = Response::from(answer).map(Body::new);
        remove_those_of_connection(answer.headers_mut());
        let tokens = EndTokens {
            stop: app.supervisor().stop_token(),
            given_up: self.inner.given_up.clone(),
        };
        Ok(cut_short(answer, tokens))
    }
}

fn lock<T>(of: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    of.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Returns whether a standby has forwarded a request.
pub(super) fn is_forwarded(headers: &HeaderMap) -> bool {
    let is_own = |via: &HeaderValue| via.to_str().is_ok_and(|via| via.contains(VIA));
    headers.get_all(header::VIA).iter().any(is_own)
}

/// Returns the same path at another server. A path that a URL would write in another way is refused, since a
/// filter before this server has seen it as it came.
fn url_at(leader: &str, requested: &Uri) -> Result<Url, ForwardError> {
    let path = requested.path_and_query().map_or("/", PathAndQuery::as_str);
    let url = Url::parse(&format!("{leader}{path}"));
    let url = url.map_err(|_malformed| ForwardError::Path)?;
    if url.path() == requested.path() {
        Ok(url)
    } else {
        Err(ForwardError::Path)
    }
}

/// Keeps asking the other server whether it lives, and reads again by what to recognise it while it does not
/// answer, until the stop.
pub async fn run(
    forwarder: Forwarder,
    app: App,
    renew: impl Fn(&Forwarder) -> anyhow::Result<()>,
    stop: CancellationToken,
) {
    let mut renewed_at = Instant::now();
    loop {
        tokio::select! {
            biased;
            () = stop.cancelled() => return,
            () = forwarder.check(&app) => {}
        }
        let is_silent = forwarder
            .silence()
            .is_none_or(|silence| silence >= SILENCE_MAX);
        if is_silent && renewed_at.elapsed() >= RENEW_EVERY {
            renewed_at = Instant::now();
            if let Err(cause) = renew(&forwarder) {
                warn!("cannot read by which authorities to recognise the other server: {cause:#}");
            }
        }
        tokio::select! {
            biased;
            () = stop.cancelled() => return,
            () = tokio::time::sleep(CHECK_EVERY) => {}
        }
    }
}

/// Forwards both directions of a connection that has changed its protocol, which counts as at work as long
/// as that lasts.
fn join(
    app: &App,
    (upgrade, at_work): (Option<OnUpgrade>, Option<RequestGuard>),
    answer: reqwest::Response,
) -> Response<Body> {
    let Some(upgrade) = upgrade else {
        return Problem::new(ProblemType::Internal).into_response();
    };
    let mut response = Response::new(Body::empty());
    *response.status_mut() = StatusCode::SWITCHING_PROTOCOLS;
    *response.headers_mut() = answer.headers().clone();
    let stop = app.supervisor().stop_token();
    app.spawn_background("forwarded connection", async move {
        let (Ok(ours), Ok(theirs)) = tokio::join!(upgrade, answer.upgrade()) else {
            debug!("a connection that was to be forwarded is closed");
            return;
        };
        tokio::select! {
            () = stop.cancelled() => {}
            () = copy_both(TokioIo::new(ours), theirs) => {}
        }
        drop(at_work);
    });
    response
}

/// Copies both directions. When one has ended, the other ends soon: a side that does not close keeps nothing
/// open.
async fn copy_both(
    ours: impl AsyncRead + AsyncWrite + Unpin,
    theirs: impl AsyncRead + AsyncWrite + Unpin,
) {
    let (mut from_client, mut to_client) = tokio::io::split(ours);
    let (mut from_server, mut to_server) = tokio::io::split(theirs);
    let upstream = async {
        _ = tokio::io::copy(&mut from_client, &mut to_server).await;
        _ = to_server.shutdown().await;
    };
    let downstream = async {
        _ = tokio::io::copy(&mut from_server, &mut to_client).await;
        _ = to_client.shutdown().await;
    };
    let (mut upstream, mut downstream) = (pin!(upstream), pin!(downstream));
    let rest = tokio::select! {
        () = upstream.as_mut() => tokio::time::timeout(CLOSE_MAX, downstream).await,
        () = downstream.as_mut() => tokio::time::timeout(CLOSE_MAX, upstream).await,
    };
    if rest.is_err() {
        debug!("one side of a forwarded connection does not close it");
    }
}

/// Removes the headers that concern a connection alone, also those that it names itself.
fn remove_those_of_connection(headers: &mut HeaderMap) {
    let named: Vec<HeaderName> = headers
        .get_all(header::CONNECTION)
        .iter()
        .filter_map(|value| value.to_str().ok())
        .flat_map(|value| value.split(','))
        .filter_map(|name| name.trim().parse().ok())
        .collect();
    for name in OF_CONNECTION.iter().chain(&named) {
        headers.remove(name);
    }
    headers.remove(header::UPGRADE);
}

/// Adds the client to those that the request came from.
fn name_client(headers: &mut HeaderMap, peer: Option<IpAddr>) {
    if let Some(client) = peer.and_then(|peer| peer.to_string().parse().ok()) {
        headers.append(FORWARDED_FOR, client);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_path_is_forwarded_as_it_came_or_refused() {
        let at = |path: &str| url_at("https://a.example.org:8420", &path.parse().unwrap());
        for path in [
            "/v1/missions?limit=3&site=a%20b",
            "/",
            "/docs/",
            "/v1/x?",
            "/c?cursor=-40,-70",
        ] {
            let url = at(path).unwrap();
            assert_eq!(url.as_str(), format!("https://a.example.org:8420{path}"));
        }
        let named = at("/v1/audit?who=O'Brien").unwrap();
        assert_eq!(named.query_pairs().next().unwrap().1, "O'Brien");
        for path in ["/v1/../metrics", "/a/%2e%2e/b", "*", "/a\\b"] {
            assert!(matches!(at(path), Err(ForwardError::Path)), "{path}");
        }
    }

    #[test]
    fn headers_of_the_connection_are_not_forwarded_and_all_others_are() {
        let mut headers = HeaderMap::new();
        for (name, value) in [
            ("connection", "close, x-own"),
            ("x-own", "1"),
            ("keep-alive", "timeout=5"),
            ("transfer-encoding", "chunked"),
            ("upgrade", "h2c"),
            ("authorization", "Bearer secret"),
            ("host", "fleet.example.org"),
        ] {
            headers.insert(name, HeaderValue::from_static(value));
        }
        remove_those_of_connection(&mut headers);
        let mut left: Vec<&str> = headers.keys().map(HeaderName::as_str).collect();
        left.sort_unstable();
        assert_eq!(left, ["authorization", "host"]);
    }
}
