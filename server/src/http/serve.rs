//! The accept loop. Ours, because half-sent headers must not hold a connection for ever, and
//! because the number of connections has bounds (see [`crate::connections`]).

use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use axum::body::Body;
use axum::http::{HeaderName, Request};
use hyper::body::Incoming;
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::{TcpListener, TcpSocket, TcpStream};
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;
use tower::ServiceExt as _;
use tracing::{debug, warn};

use super::events::Cut;
use super::guarded::Guarded;
use super::identity::guard::{HEAD_MAX, Peer, purpose_of_path};
use super::tls::Tls;
use crate::app::App;
use crate::connections::{ACCEPT_REST, BOUNDS, Connections, Slot};
use crate::identity::address::TrustedProxies;
use crate::supervisor::Supervisor;

/// Maximum time until the first byte of a connection.
pub const FIRST_BYTE_TIMEOUT: Duration = Duration::from_secs(5);
/// Maximum time for a TLS handshake.
pub const TLS_TIMEOUT: Duration = Duration::from_secs(5);
/// Maximum time for a request's headers to arrive, and for a connection to be idle.
pub const HEADER_TIMEOUT: Duration = Duration::from_secs(10);
/// Maximum time for open requests after the stop.
const DRAIN_TIMEOUT: Duration = Duration::from_secs(5);
/// Header in which proxies name their client.
pub(super) const FORWARDED_FOR: HeaderName = HeaderName::from_static("x-forwarded-for");
/// Connections that the system may keep until they are accepted: as many as may be open. One that finds
/// no room there tries again after a second.
const BACKLOG: u32 = 4_096;
/// Connections that are accepted before those that were get to show who they are: in a rush that is longer
/// than the room of the unproven, nobody is to be displaced unread.
const ACCEPTED_AT_ONCE: usize = 16;

/// What is served where.
#[derive(Debug)]
pub struct Serving {
    /// Where connections come in.
    pub listener: TcpListener,
    /// What answers.
    pub router: Router,
    /// TLS on it, if any.
    pub tls: Option<Arc<Tls>>,
    /// Proxies whose header is trusted.
    pub proxies: Arc<TrustedProxies>,
}

/// Listens on an address, with room for thousands who come at once.
///
/// # Errors
/// The address is in use.
pub fn listen(address: SocketAddr) -> std::io::Result<TcpListener> {
    let socket = if address.is_ipv4() {
        TcpSocket::new_v4()?
    } else {
        TcpSocket::new_v6()?
    };
    // After a restart, connections of the former process may still exist.
    socket.set_reuseaddr(true)?;
    socket.bind(address)?;
    socket.listen(BACKLOG)
}

/// Serves connections until the stop.
pub async fn run(serving: Serving, app: App, supervisor: Supervisor, stop: CancellationToken) {
    let connections = Connections::new(BOUNDS);
    for number in 1_usize.. {
        if number.is_multiple_of(ACCEPTED_AT_ONCE) {
            tokio::task::yield_now().await;
        }
        let accepted = tokio::select! {
            biased;
            () = stop.cancelled() => return,
            accepted = serving.listener.accept() => accepted,
        };
        let (stream, peer) = match accepted {
            Ok(accepted) => accepted,
            Err(error) => {
                warn!("cannot accept a connection: {error}");
                tokio::time::sleep(ACCEPT_REST).await;
                continue;
            }
        };
        let cut = CancellationToken::new();
        let address = peer.ip().to_canonical();
        let is_shared = address.is_loopback() || serving.proxies.contains(address);
        let admitted = connections.admit_from(address, is_shared, cut.clone());
        let Some(admitted) = admitted else {
            app.counters().http_connections_refused.one();
            continue;
        };
        let displaced = u64::try_from(admitted.displaced).unwrap_or_default();
        app.counters().http_connections_displaced.add(displaced);
        let connection = Connection {
            peer: address,
            proxies: Arc::clone(&serving.proxies),
            slot: admitted.slot,
            cut,
            router: serving.router.clone(),
            tls: serving.tls.clone(),
            app: app.clone(),
            stop: stop.clone(),
        };
        supervisor.spawn_passing("connection", connection.serve(stream));
    }
}

/// One connection.
struct Connection {
    peer: IpAddr,
    proxies: Arc<TrustedProxies>,
    slot: Arc<Slot>,
    cut: CancellationToken,
    router: Router,
    tls: Option<Arc<Tls>>,
    app: App,
    stop: CancellationToken,
}

impl Connection {
    async fn serve(self, stream: TcpStream) {
        // Answers are small and wanted at once.
        if let Err(error) = stream.set_nodelay(true) {
            debug!("cannot send at once: {error}");
        }
        let (cut, stop) = (self.cut.clone(), self.stop.clone());
        tokio::select! {
            () = self.begin(stream) => {}
            () = cut.cancelled() => debug!("a connection was cut to make room, or is not read"),
            () = async {
                stop.cancelled().await;
                tokio::time::sleep(DRAIN_TIMEOUT).await;
            } => {}
        }
    }

    async fn begin(self, stream: TcpStream) {
        let counters = self.app.counters();
        let first = tokio::time::timeout(FIRST_BYTE_TIMEOUT, stream.peek(&mut [0])).await;
        if !matches!(first, Ok(Ok(1))) {
            counters.http_connections_silent.one();
            return;
        }
        let Some(tls) = self.tls.clone() else {
            return self.answer(stream).await;
        };
        let handshake = tls.acceptor().accept(stream);
        match tokio::time::timeout(TLS_TIMEOUT, handshake).await {
            Ok(Ok(stream)) => self.answer(stream).await,
            Ok(Err(error)) => {
                counters.http_tls_failed.one();
                debug!("a TLS handshake failed: {error}");
            }
            Err(_elapsed) => counters.http_connections_silent.one(),
        }
    }

    async fn answer(self, stream: impl AsyncRead + AsyncWrite + Send + Unpin + 'static) {
        let Self {
            peer,
            proxies,
            slot,
            cut,
            ..
        } = self;
        let (app, router) = (self.app.clone(), self.router.clone());
        let service = tower::service_fn(move |request: Request<Incoming>| {
            let client = client_of(&request, peer, &proxies);
            let (slot, cut, app) = (Arc::clone(&slot), cut.clone(), app.clone());
            let router = router.clone();
            async move {
                let purpose = purpose_of_path(request.method(), request.uri().path());
                let delay = slot.delay(purpose, Instant::now());
                // It is no idle connection that may be cut for another one.
                let waiting = slot.hold();
                if !delay.is_zero() {
                    tokio::time::sleep(delay).await;
                }
                let (at_work, displaced) = slot.begin((client != peer).then_some(client));
                drop(waiting);
                let displaced = u64::try_from(displaced).unwrap_or_default();
                app.counters().http_connections_displaced.add(displaced);
                let mut request = request.map(Body::new);
                let extensions = request.extensions_mut();
                // Whoever finds that the peer does not read may cut the connection.
                extensions.insert(Cut(cut));
                extensions.insert(Peer(client));
                extensions.insert(slot);
                let answer = router.oneshot(request).await?;
                // The connection is at work until its answer has been given.
                let answer = answer.map(|body| Guarded::body(body, at_work));
                Ok::<_, std::convert::Infallible>(answer)
            }
        });
        let connection = http1::Builder::new()
            .timer(TokioTimer::new())
            .header_read_timeout(HEADER_TIMEOUT)
            .max_buf_size(HEAD_MAX)
            .serve_connection(TokioIo::new(stream), TowerToHyperService::new(service))
            .with_upgrades();
        let mut connection = std::pin::pin!(connection);
        let ended = tokio::select! {
            ended = connection.as_mut() => ended,
            () = self.stop.cancelled() => {
                connection.as_mut().graceful_shutdown();
                connection.await
            }
        };
        if let Err(error) = ended {
            debug!("a connection broke: {error}");
        }
    }
}

/// Where a request comes from, as far as the proxies before this server are believed.
fn client_of(request: &Request<Incoming>, peer: IpAddr, proxies: &TrustedProxies) -> IpAddr {
    let forwarded = request.headers().get_all(FORWARDED_FOR).iter();
    // A value that is not text is not an address.
    let forwarded: Vec<&str> = forwarded
        .map(|value| value.to_str().unwrap_or("?"))
        .collect();
    proxies.client(peer, forwarded.into_iter())
}
