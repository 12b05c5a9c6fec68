//! Forwards requests to the server that has the database, as a reverse proxy does.

use std::net::IpAddr;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use axum::body::{Body, HttpBody as _};
use axum::extract::Request;
use axum::http::uri::PathAndQuery;
use axum::http::{HeaderMap, HeaderName, HeaderValue, Response, StatusCode, header};
use axum::response::IntoResponse as _;
use hyper::upgrade::OnUpgrade;
use hyper_util::rt::TokioIo;
use reqwest::{Certificate, Url, redirect};
use tokio::time::Instant;
use tracing::{debug, warn};
use tread_api::problem::ProblemType;

use super::identity::guard::Peer;
use super::problem::Problem;
use crate::app::App;
use crate::error_text;

/// Maximum time for a connection, TLS included.
const CONNECT_MAX: Duration = Duration::from_secs(2);
/// Maximum time until an answer begins: longer than the other server has for a request.
const ANSWER_MAX: Duration = Duration::from_secs(17);
/// Maximum number of idle connections.
const IDLE_MAX: usize = 32;
/// Interval of log lines about a server that cannot be asked.
const LOG_EVERY: Duration = Duration::from_secs(10);
/// Name by which forwarded requests are recognised (RFC 9110, `Via`).
const VIA: &str = "1.1 tread-standby";
/// Header in which proxies name their client.
const FORWARDED_FOR: HeaderName = HeaderName::from_static("x-forwarded-for");
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
        "this server is a standby, and the one that has the database says no `[web] advertise_url` at which it \
         can be asked"
    )]
    NoAddress,
    /// The other server is a standby too, so that nobody has the database at the moment.
    #[error(
        "this server is a standby, and so is the one that is said to have the database; try again"
    )]
    Loop,
    /// The address is none.
    #[error("`{0}` is no address of a server")]
    Address(String),
    /// The other server does not answer.
    #[error(
        "this server is a standby, and the one that has the database does not answer; try again"
    )]
    NoAnswer,
}

impl From<ForwardError> for Problem {
    fn from(error: ForwardError) -> Self {
        Self::new(ProblemType::Unavailable).detail(error.to_string())
    }
}

/// Client of the server that has the database.
#[derive(Debug, Clone)]
pub struct Forwarder {
    client: reqwest::Client,
    /// When a failure was logged last.
    logged_at: Arc<Mutex<Option<Instant>>>,
}

impl Forwarder {
    /// Creates a client that trusts these CA certificates (PEM); those of the machine if `None`.
    ///
    /// # Errors
    /// The certificates cannot be read.
    pub fn new(authorities_pem: Option<&[u8]>) -> Result<Self, reqwest::Error> {
        // Fails if a provider is installed already, which is then the same one.
        let _first = rustls::crypto::ring::default_provider().install_default();
        let mut builder = reqwest::Client::builder()
            .connect_timeout(CONNECT_MAX)
            .pool_max_idle_per_host(IDLE_MAX)
            .redirect(redirect::Policy::none())
            .no_proxy()
            .tcp_nodelay(true);
        if let Some(pem) = authorities_pem {
            builder = builder.tls_certs_only(Certificate::from_pem_bundle(pem)?);
        }
        let client = builder.build()?;
        Ok(Self {
            client,
            logged_at: Arc::default(),
        })
    }

    /// Logs why the other server cannot be asked, now and then.
    fn failed(&self, leader: &str, cause: &dyn std::error::Error) {
        let mut logged_at = self
            .logged_at
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
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
        request: Request,
    ) -> Result<Response<Body>, ForwardError> {
        let leader = app.leader_url().ok_or(ForwardError::NoAddress)?;
        let (mut parts, body) = request.into_parts();
        if parts
            .headers
            .get_all(header::VIA)
            .iter()
            .any(|via| via == VIA)
        {
            return Err(ForwardError::Loop);
        }
        let path = parts.uri.path_and_query().map_or("/", PathAndQuery::as_str);
        let url = Url::parse(&format!("{leader}{path}"));
        let url = url.map_err(|_malformed| ForwardError::Address(leader.clone()))?;
        let upgrade = parts.extensions.remove::<OnUpgrade>();
        let protocol = parts.headers.get(header::UPGRADE).cloned();
        let peer = parts.extensions.get::<Peer>().map(|peer| peer.0);
        let mut headers = parts.headers;
        remove_those_of_connection(&mut headers);
        if let Some(protocol) = protocol {
            headers.insert(header::UPGRADE, protocol);
            headers.insert(header::CONNECTION, HeaderValue::from_static("upgrade"));
        }
        headers.append(header::VIA, HeaderValue::from_static(VIA));
        name_client(&mut headers, peer);
        let mut asking = self.client.request(parts.method, url).headers(headers);
        if !body.is_end_stream() {
            asking = asking.body(reqwest::Body::wrap_stream(body.into_data_stream()));
        }
        let answer = tokio::time::timeout(ANSWER_MAX, asking.send()).await;
        let answer = match answer {
            Ok(Ok(answer)) => answer,
            Ok(Err(cause)) => {
                self.failed(&leader, &cause);
                return Err(ForwardError::NoAnswer);
            }
            Err(elapsed) => {
                self.failed(&leader, &elapsed);
                return Err(ForwardError::NoAnswer);
            }
        };
        if answer.status() == StatusCode::SWITCHING_PROTOCOLS {
            return Ok(join(app, upgrade, answer));
        }
        let mut answer = Response::from(answer).map(Body::new);
        remove_those_of_connection(answer.headers_mut());
        Ok(answer)
    }
}

/// Forwards both directions of a connection that has changed its protocol.
fn join(app: &App, upgrade: Option<OnUpgrade>, answer: reqwest::Response) -> Response<Body> {
    let Some(upgrade) = upgrade else {
        return Problem::new(ProblemType::Internal).into_response();
    };
    let mut response = Response::new(Body::empty());
    *response.status_mut() = StatusCode::SWITCHING_PROTOCOLS;
    *response.headers_mut() = answer.headers().clone();
    let stop = app.supervisor().stop_token();
    app.pass_by("forwarded connection", async move {
        let (Ok(ours), Ok(mut theirs)) = tokio::join!(upgrade, answer.upgrade()) else {
            debug!("a connection that was to be forwarded is closed");
            return;
        };
        let mut ours = TokioIo::new(ours);
        tokio::select! {
            () = stop.cancelled() => {}
            copied = tokio::io::copy_bidirectional(&mut ours, &mut theirs) => {
                if let Err(cause) = copied {
                    debug!("a forwarded connection broke: {cause}");
                }
            }
        }
    });
    response
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
