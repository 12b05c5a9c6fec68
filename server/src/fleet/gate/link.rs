//! One connection to the robots' port, from its first byte to its end.

use std::net::SocketAddr;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncWrite, copy_bidirectional_with_sizes};
use tokio::net::{TcpSocket, TcpStream};
use tokio_rustls::{TlsAcceptor, client, server};
use tracing::{debug, info, warn};

use super::Failures;
use crate::app::App;
use crate::app::enrolment::roll::Standing;
use crate::authority::{RobotName, named_in};
use crate::connections::Slot;
use crate::fleet::SEND_BUFFER_BYTES;
use crate::fleet::opening::Inside;
use crate::fleet::presence::RobotKey;
use crate::fleet::routers::{Router, Routers};

/// How long the first byte may take.
const FIRST_BYTE_TIMEOUT: Duration = Duration::from_secs(2);
/// How long the handshake may take.
const HANDSHAKE_TIMEOUT: Duration = Duration::from_secs(5);
/// How long a robot that has just joined waits for the router that will know it.
const ROUTER_TIMEOUT: Duration = Duration::from_secs(10);
/// How long the router may take to take a connection.
const INSIDE_TIMEOUT: Duration = Duration::from_secs(5);
/// Bytes on their way within the gate, each way: what stands here has lost its priority.
const BUFFER_BYTES: usize = 4 * 1024;
/// Bytes of a connection that are looked at before anything else is done.
const LOOKED_AT_BYTES: usize = 6;

/// A connection and what it needs.
pub(super) struct Link {
    pub(super) app: App,
    pub(super) peer: SocketAddr,
    pub(super) slot: Arc<Slot>,
    pub(super) acceptor: TlsAcceptor,
    pub(super) inside: Arc<Inside>,
    pub(super) routers: Arc<Routers>,
    pub(super) failures: Arc<Mutex<Failures>>,
}

/// Whether a connection may be the begin of TLS: a record of a handshake, whose first message is
/// a client's hello.
fn may_be_tls(begin: &[u8]) -> bool {
    let fits = |at: usize, is_right: fn(u8) -> bool| begin.get(at).copied().is_none_or(is_right);
    !begin.is_empty()
        && fits(0, |byte| byte == 0x16)
        && fits(1, |byte| byte == 0x03)
        && fits(2, |byte| byte <= 0x04)
        && fits(5, |byte| byte == 0x01)
}

impl Link {
    /// Serves the connection to its end.
    pub(super) async fn serve(self, stream: TcpStream) {
        if let Err(error) = stream.set_nodelay(true) {
            debug!("cannot send at once: {error}");
        }
        let Some((robot, name, left, outside)) = self.let_in(stream).await else {
            return;
        };
        // From here on it is a robot's, and not displaced for others.
        let _at_work = self.slot.work();
        let counters = self.app.counters();
        let inside = match self.enter(&robot).await {
            Ok(inside) => inside,
            Err(cause) => {
                counters.gate_router_failed.one();
                return warn!(robot.id = %robot.1, "the router did not take robot `{}`: {cause:#}", robot.1);
            }
        };
        tokio::select! {
            () = join(outside, inside) => {}
            () = tokio::time::sleep(left) => {
                counters.gate_expired.one();
                info!(robot.id = %robot.1, "the certificate of robot `{}` is over", robot.1);
            }
            () = self.put_out(&robot, name.enrolment) => {
                counters.gate_revoked.one();
                warn!(robot.id = %robot.1, "the link of robot `{}` was cut: it was put out", robot.1);
            }
        }
    }

    /// Checks who it is: whom, and for how long.
    async fn let_in(
        &self,
        stream: TcpStream,
    ) -> Option<(RobotKey, RobotName, Duration, server::TlsStream<TcpStream>)> {
        let counters = self.app.counters();
        let mut begin = [0; LOOKED_AT_BYTES];
        let first = tokio::time::timeout(FIRST_BYTE_TIMEOUT, stream.peek(&mut begin)).await;
        let Ok(Ok(length @ 1..)) = first else {
            counters.gate_silent.one();
            self.failed();
            return None;
        };
        if !may_be_tls(&begin[..length]) {
            counters.gate_garbage.one();
            self.failed();
            return None;
        }
        let handshake = self.acceptor.accept(stream);
        let stream = match tokio::time::timeout(HANDSHAKE_TIMEOUT, handshake).await {
            Ok(Ok(stream)) => stream,
            Ok(Err(error)) => {
                counters.gate_tls_failed.one();
                self.failed();
                debug!("a handshake with {} failed: {error}", self.peer);
                return None;
            }
            Err(_elapsed) => {
                counters.gate_silent.one();
                self.failed();
                return None;
            }
        };
        let shown = stream.get_ref().1.peer_certificates();
        let named = shown.and_then(|chain| chain.first()).map(named_in);
        let Some(Ok((name, expires_at))) = named else {
            counters.gate_tls_failed.one();
            self.failed();
            return None;
        };
        let robot = (name.site.clone(), name.robot.clone());
        if !self.app.roll().is_in_force(&robot, name.enrolment) {
            counters.gate_revoked.one();
            debug!(
                "{} showed a certificate that is no longer in force",
                self.peer
            );
            // Its successor may be well; people are told only of one that has none.
            if self.app.roll().standing(&robot) == Some(Standing::Revoked(name.enrolment)) {
                self.app.note_outsider(&robot).await;
            }
            return None;
        }
        let left = expires_at.duration_since(self.app.clock().now());
        let left = Duration::try_from(left).unwrap_or_default();
        Some((robot, name, left, stream))
    }

    fn failed(&self) {
        let mut failures = self.failures.lock().unwrap_or_else(PoisonError::into_inner);
        failures.failed(self.peer.ip(), self.app.clock().elapsed());
    }

    /// Connects to the newest router as that robot.
    async fn enter(&self, robot: &RobotKey) -> anyhow::Result<client::TlsStream<TcpStream>> {
        let router = tokio::time::timeout(ROUTER_TIMEOUT, self.router_of(robot)).await?;
        let connecting = async {
            let socket = TcpSocket::new_v4()?;
            socket.set_recv_buffer_size(SEND_BUFFER_BYTES)?;
            let stream = socket.connect(router.address).await?;
            stream.set_nodelay(true)?;
            let connector = self.inside.connector(robot)?;
            anyhow::Ok(connector.connect(Inside::router_name(), stream).await?)
        };
        tokio::time::timeout(INSIDE_TIMEOUT, connecting).await?
    }

    /// Waits for a router whose rules know the robot.
    async fn router_of(&self, robot: &RobotKey) -> Arc<Router> {
        let mut changes = self.routers.changes();
        loop {
            changes.mark_unchanged();
            let newest = self.routers.newest();
            if let Some(router) = newest.filter(|router| router.robots.contains(robot)) {
                return router;
            }
            if changes.changed().await.is_err() {
                // The routers outlive every link; there is nothing to wait for.
                std::future::pending::<()>().await;
            }
        }
    }

    /// Waits until the robot is put out, or has joined again.
    async fn put_out(&self, robot: &RobotKey, enrolment: u32) {
        let mut changes = self.app.roll().changes();
        while self.app.roll().is_in_force(robot, enrolment) {
            if changes.changed().await.is_err() {
                std::future::pending::<()>().await;
            }
        }
    }
}

async fn join(
    mut outside: impl AsyncRead + AsyncWrite + Unpin,
    mut inside: impl AsyncRead + AsyncWrite + Unpin,
) {
    let copying =
        copy_bidirectional_with_sizes(&mut outside, &mut inside, BUFFER_BYTES, BUFFER_BYTES);
    if let Err(error) = copying.await {
        debug!("a robot's link broke: {error}");
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_clients_hello_passes_and_other_protocols_do_not() {
        assert!(may_be_tls(&[0x16, 0x03, 0x01, 0x02, 0x00, 0x01]));
        assert!(may_be_tls(&[0x16]) && may_be_tls(&[0x16, 0x03, 0x03]));
        for other in [
            &b""[..],
            b"GET / ",
            b"SSH-2.",
            &[0x16, 0x04, 0x01, 0, 0, 1],
            &[0x16, 0x03, 0x09],
            &[0x16, 0x03, 0x03, 0, 0, 2],
            &[0x15, 0x03, 0x03, 0, 2, 1],
        ] {
            assert!(!may_be_tls(other), "{other:?}");
        }
    }
}
