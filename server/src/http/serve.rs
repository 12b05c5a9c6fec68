//! The accept loop. Ours, because half-sent headers must not hold a connection for ever, and
//! because the number of connections has a bound.

use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use axum::http::Request;
use hyper::body::Incoming;
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Semaphore;
use tokio_util::sync::CancellationToken;
use tower::ServiceExt as _;
use tracing::{debug, warn};

use super::events::Cut;
use crate::app::App;
use crate::supervisor::Supervisor;

/// How long the headers of a request may take to arrive.
pub const HEADER_TIMEOUT: Duration = Duration::from_secs(10);
/// Connections that may be open at once.
pub const CONNECTIONS_MAX: usize = 2_048;
/// How long open requests may take after the stop.
const DRAIN_TIMEOUT: Duration = Duration::from_secs(5);
/// Rest after the machine refused a connection, such as for want of file handles.
const ACCEPT_REST: Duration = Duration::from_millis(100);

/// Serves connections until the stop.
pub async fn run(
    listener: TcpListener,
    router: Router,
    app: App,
    supervisor: Supervisor,
    stop: CancellationToken,
) {
    let slots = Arc::new(Semaphore::new(CONNECTIONS_MAX));
    loop {
        let accepted = tokio::select! {
            biased;
            () = stop.cancelled() => return,
            accepted = listener.accept() => accepted,
        };
        let stream = match accepted {
            Ok((stream, _peer)) => stream,
            Err(error) => {
                warn!("cannot accept a connection: {error}");
                tokio::time::sleep(ACCEPT_REST).await;
                continue;
            }
        };
        let Ok(slot) = Arc::clone(&slots).try_acquire_owned() else {
            app.counters().http_connections_refused.one();
            continue;
        };
        let serving = connection(stream, router.clone(), stop.clone());
        supervisor.spawn_passing("connection", async move {
            serving.await;
            drop(slot);
        });
    }
}

async fn connection(stream: TcpStream, router: Router, stop: CancellationToken) {
    // Answers are small and wanted at once.
    if let Err(error) = stream.set_nodelay(true) {
        debug!("cannot send at once: {error}");
    }
    // Whoever finds that the peer does not read may cut the connection.
    let cut = Cut::default();
    let handle = cut.clone();
    let service = router.map_request(move |mut request: Request<Incoming>| {
        request.extensions_mut().insert(handle.clone());
        request
    });
    let service = TowerToHyperService::new(service);
    let connection = http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(HEADER_TIMEOUT)
        .serve_connection(TokioIo::new(stream), service)
        // A drive socket begins as a request.
        .with_upgrades();
    let mut connection = std::pin::pin!(connection);
    let ended = tokio::select! {
        ended = connection.as_mut() => Ok(ended),
        () = cut.0.cancelled() => return debug!("a connection whose peer does not read was cut"),
        () = stop.cancelled() => {
            connection.as_mut().graceful_shutdown();
            tokio::time::timeout(DRAIN_TIMEOUT, connection).await
        }
    };
    if let Ok(Err(error)) = ended {
        debug!("a connection broke: {error}");
    }
}
