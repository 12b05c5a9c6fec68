//! One connection to the robots' port, from its first byte to its end.

use std::net::SocketAddr;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use rustls::{AlertDescription, CertificateError, ServerConnection};
use sha2::{Digest as _, Sha256};
use socket2::SockRef;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::{TcpSocket, TcpStream};
use tokio_rustls::{TlsAcceptor, server};
use tracing::{debug, info, warn};
use tread_api::tunnel::{ALPN, NOT_SENT_BYTES_MAX, RouterCredentials, UNANSWERED_MAX, splice};

use super::Failures;
use super::links::{CertificateHash, Entry, Links};
use super::session::{Init, pass_opening, read_init};
use super::throttle::{BYTES_PER_S, Throttled};
use crate::app::App;
use crate::app::enrolment::registry::EnrolmentStatus;
use crate::app::presence::RobotKey;
use crate::authority::{Authorities, RobotName, named_in};
use crate::connections::Slot;
use crate::fleet::SEND_BUFFER_BYTES;
use crate::fleet::routers::{Router, Routers};

/// Maximum time until the first byte.
const FIRST_BYTE_TIMEOUT: Duration = Duration::from_secs(2);
/// Maximum time for the TLS handshake.
const HANDSHAKE_TIMEOUT: Duration = Duration::from_secs(5);
/// Maximum time that a robot that has just joined waits for a router whose rules include it.
const ROUTER_TIMEOUT: Duration = Duration::from_secs(10);
/// Maximum time until the router accepts a connection.
const INSIDE_TIMEOUT: Duration = Duration::from_secs(5);
/// Maximum time for opening a robot's session.
const OPENING_TIMEOUT: Duration = Duration::from_secs(5);
/// Polling interval until the router has closed a session.
const SESSION_GONE_EVERY: Duration = Duration::from_millis(5);
/// Bytes buffered within the gate, in each direction; buffered bytes are no longer ordered by
/// priority.
const BUFFER_BYTES: usize = 4 * 1024;
/// Maximum time and number of bytes for which a connection is read after a failed handshake.
const REFUSED_CLOSE_MAX: Duration = Duration::from_millis(500);
const REFUSED_BYTES_MAX: u64 = 16 * 1024;
/// Number of bytes of a connection that are inspected first.
const INSPECTED_BYTES: usize = 6;
/// What the log says of a robot whose certificate has expired.
const EXPIRED: &str = "admit a robot whose certificate has expired (it renews it while it reaches the REST API; otherwise \
     compare its clock with this one, or let it join again by `tread-agent enroll`)";

/// A connection with what it needs.
pub(super) struct Link {
    pub(super) app: App,
    pub(super) peer: SocketAddr,
    pub(super) slot: Arc<Slot>,
    pub(super) acceptor: TlsAcceptor,
    pub(super) authorities: Arc<Authorities>,
    pub(super) routers: Arc<Routers>,
    pub(super) failures: Arc<Mutex<Failures>>,
    pub(super) links: Links,
}

/// Returns whether a connection may begin with TLS: a handshake record whose first message is a
/// `ClientHello`.
fn may_be_tls(begin: &[u8]) -> bool {
    let fits = |at: usize, is_right: fn(u8) -> bool| begin.get(at).copied().is_none_or(is_right);
    !begin.is_empty()
        && fits(0, |byte| byte == 0x16)
        && fits(1, |byte| byte == 0x03)
        && fits(2, |byte| byte <= 0x04)
        && fits(5, |byte| byte == 0x01)
}

/// A robot that has shown its certificate.
struct Admitted {
    robot: RobotKey,
    name: RobotName,
    /// Hash of the certificate.
    certificate: CertificateHash,
    /// Fingerprint of the authority that signed the certificate.
    issuer: String,
    /// Remaining validity of the certificate.
    left: Duration,
    stream: server::TlsStream<TcpStream>,
}

impl Link {
    /// Serves the connection until its end.
    pub(super) async fn serve(self, stream: TcpStream) {
        let socket = SockRef::from(&stream);
        let set = socket
            .set_tcp_nodelay(true)
            .and_then(|()| socket.set_tcp_notsent_lowat(NOT_SENT_BYTES_MAX))
            .and_then(|()| socket.set_tcp_user_timeout(Some(UNANSWERED_MAX)));
        if let Err(error) = set {
            debug!("cannot send at once: {error}");
        }
        let Some(admitted) = self.authenticate_client(stream).await else {
            return;
        };
        let (robot, name, issuer) = (&admitted.robot, &admitted.name, &admitted.issuer);
        // From here on it counts as a robot's connection and is not displaced by others.
        let _at_work = self.slot.work();
        let counters = self.app.counters();
        let now = self.app.clock().elapsed();
        let entry = self.links.enter(robot.clone(), admitted.certificate, now);
        let mut outside = admitted.stream;
        let joined = async {
            self.app
                .record_shown_certificate(robot, name.enrolment, issuer)
                .await;
            let Some(inside) = self.open(robot, &entry, &mut outside).await else {
                return;
            };
            let (rate, clock) = (entry.byte_rate(), self.app.clock());
            let paused = |now| {
                counters.gate_throttled.one();
                if rate.should_log(now) {
                    warn!(robot.id = %robot.1, "robot `{}` sends more than {BYTES_PER_S} bytes a second, and is read no faster", robot.1);
                }
            };
            let outside = Throttled::new(outside, rate, clock, paused);
            if let Err(error) = splice(outside, inside, BUFFER_BYTES).await {
                debug!("a robot's link broke: {error}");
            }
        };
        tokio::select! {
            () = joined => {}
            () = entry.displaced() => {
                counters.gate_displaced.one();
                debug!(robot.id = %robot.1, "robot `{}` has newer links", robot.1);
            }
            () = entry.cut_off() => counters.gate_cut_off.one(),
            () = tokio::time::sleep(admitted.left) => {
                counters.gate_expired.one();
                info!(robot.id = %robot.1, "the certificate of robot `{}` is over", robot.1);
            }
            () = self.wait_for_revocation(robot, name.enrolment) => {
                counters.gate_revoked.one();
                warn!(robot.id = %robot.1, "the link of robot `{}` was cut: it was put out", robot.1);
            }
            () = self.retired(issuer) => {
                counters.gate_retired.one();
                warn!(robot.id = %robot.1, "the link of robot `{}` was cut: the authority of its certificate was retired", robot.1);
            }
        }
    }

    /// Authenticates the client; `None` if it is rejected.
    async fn authenticate_client(&self, stream: TcpStream) -> Option<Admitted> {
        let counters = self.app.counters();
        let mut begin = [0; INSPECTED_BYTES];
        let first = tokio::time::timeout(FIRST_BYTE_TIMEOUT, stream.peek(&mut begin)).await;
        let Ok(Ok(length @ 1..)) = first else {
            counters.gate_silent.one();
            self.failed();
            return None;
        };
        if !may_be_tls(&begin[..length]) {
            counters.gate_not_tls.one();
            self.failed();
            return None;
        }
        // rustls would otherwise buffer 64 KiB beyond the socket, unordered by priority.
        let bound = |tls: &mut ServerConnection| tls.set_buffer_limit(Some(BUFFER_BYTES));
        let handshake = self.acceptor.accept_with(stream, bound).into_fallible();
        let stream = match tokio::time::timeout(HANDSHAKE_TIMEOUT, handshake).await {
            Ok(Ok(stream)) => stream,
            Ok(Err((error, stream))) => {
                counters.gate_tls_failed.one();
                if is_distrust(&error) {
                    counters.gate_untrusted.one();
                }
                if is_expired(&error) {
                    counters.gate_expired.one();
                    self.app.log_failure(EXPIRED, &error);
                }
                self.failed();
                debug!("a handshake with {} failed: {error}", self.peer);
                close_refused(stream).await;
                return None;
            }
            Err(_elapsed) => {
                counters.gate_silent.one();
                self.failed();
                return None;
            }
        };
        if stream.get_ref().1.alpn_protocol() != Some(ALPN) {
            counters.gate_tls_failed.one();
            self.failed();
            debug!("{} speaks another version of the protocol", self.peer);
            return None;
        }
        self.identify(stream)
    }

    /// Returns the robot of the certificate that was shown, if the certificate counts.
    fn identify(&self, stream: server::TlsStream<TcpStream>) -> Option<Admitted> {
        let counters = self.app.counters();
        let now = self.app.clock().now();
        let shown = stream.get_ref().1.peer_certificates();
        let read = shown.and_then(|chain| chain.first()).and_then(|leaf| {
            let (name, expires_at) = named_in(leaf).ok()?;
            let trusted = self.authorities.present();
            let issuer = trusted.issuer_of(leaf, now.min(expires_at))?.to_owned();
            Some((name, expires_at, issuer, Sha256::digest(leaf).into()))
        });
        let Some((name, expires_at, issuer, certificate)) = read else {
            counters.gate_tls_failed.one();
            self.failed();
            return None;
        };
        let robot = (name.site.clone(), name.robot.clone());
        if !self
            .app
            .enrolment_registry()
            .is_in_force(&robot, name.enrolment)
        {
            counters.gate_revoked.one();
            debug!(
                "{} showed a certificate that is no longer in force",
                self.peer
            );
            // A renewed certificate may be valid; only a robot without one raises an alert.
            if self.app.enrolment_registry().status(&robot)
                == Some(EnrolmentStatus::Revoked(name.enrolment))
            {
                self.app.alert_revoked(&robot);
            }
            return None;
        }
        let left = expires_at.duration_since(now);
        Some(Admitted {
            robot,
            name,
            certificate,
            issuer,
            left: Duration::try_from(left).unwrap_or_default(),
            stream,
        })
    }

    fn failed(&self) {
        let mut failures = self.failures.lock().unwrap_or_else(PoisonError::into_inner);
        failures.failed(self.peer.ip(), self.app.clock().elapsed());
    }

    /// Sends the robot its credentials and opens its session at the newest router that knows it;
    /// returns the internal connection.
    async fn open(
        &self,
        robot: &RobotKey,
        entry: &Entry,
        outside: &mut server::TlsStream<TcpStream>,
    ) -> Option<TcpStream> {
        let counters = self.app.counters();
        let waiting = tokio::time::timeout(ROUTER_TIMEOUT, self.router_of(robot)).await;
        let Ok((router, credentials)) = waiting else {
            counters.gate_router_failed.one();
            warn!(robot.id = %robot.1, "no router took robot `{}` in time", robot.1);
            return None;
        };
        let begun = tokio::time::timeout(OPENING_TIMEOUT, begin(outside, &credentials)).await;
        let init = match begun.map_err(anyhow::Error::from).flatten() {
            Ok(init) => init,
            Err(refused) => return self.not_opened(robot, &refused),
        };
        if entry.take_over(init.session_id).await {
            let id = init.session_id;
            let session_end = session_gone(&router, id);
            if tokio::time::timeout(INSIDE_TIMEOUT, session_end)
                .await
                .is_err()
            {
                warn!(robot.id = %robot.1, "the former session of robot `{}` did not end", robot.1);
            }
        }
        let connected = tokio::time::timeout(INSIDE_TIMEOUT, connect(&router)).await;
        let mut inside = match connected.map_err(anyhow::Error::from).flatten() {
            Ok(inside) => inside,
            Err(cause) => {
                counters.gate_router_failed.one();
                warn!(robot.id = %robot.1, "the router did not take robot `{}`: {cause:#}", robot.1);
                return None;
            }
        };
        let opening = pass_opening(outside, &mut inside, &init, &credentials);
        match tokio::time::timeout(OPENING_TIMEOUT, opening).await {
            Ok(Ok(())) => Some(inside),
            Ok(Err(refused)) => self.not_opened(robot, &refused.into()),
            Err(elapsed) => self.not_opened(robot, &elapsed.into()),
        }
    }

    fn not_opened<T>(&self, robot: &RobotKey, refused: &anyhow::Error) -> Option<T> {
        self.app.counters().gate_session_failed.one();
        debug!(robot.id = %robot.1, "the session of robot `{}` did not open: {refused:#}", robot.1);
        None
    }

    /// Waits for a router whose rules include the robot; returns it with the robot's credentials.
    async fn router_of(&self, robot: &RobotKey) -> (Arc<Router>, RouterCredentials) {
        let mut changes = self.routers.changes();
        loop {
            changes.mark_unchanged();
            if let Some(router) = self.routers.of(robot)
                && let Some(derivation) = &router.credentials
            {
                let credentials = derivation.of_robot(robot);
                return (router, credentials);
            }
            if changes.changed().await.is_err() {
                // Not reached: the routers outlive every link.
                std::future::pending::<()>().await;
            }
        }
    }

    /// Waits until the robot is revoked or has joined again.
    async fn wait_for_revocation(&self, robot: &RobotKey, enrolment: u32) {
        let mut changes = self.app.enrolment_registry().changes();
        while self.app.enrolment_registry().is_in_force(robot, enrolment) {
            if changes.changed().await.is_err() {
                std::future::pending::<()>().await;
            }
        }
    }

    /// Waits until an authority is no longer trusted.
    async fn retired(&self, issuer: &str) {
        let mut changes = self.authorities.changes();
        while self.authorities.present().is_trusted(issuer) {
            if changes.changed().await.is_err() {
                std::future::pending::<()>().await;
            }
        }
    }
}

/// Returns whether the other side does not trust the port's authority.
fn is_distrust(error: &std::io::Error) -> bool {
    let cause = error.get_ref().and_then(|cause| cause.downcast_ref());
    matches!(
        cause,
        Some(rustls::Error::AlertReceived(AlertDescription::UnknownCA))
    )
}

/// Closes a connection after a failed handshake, so that the client receives the alert with the
/// reason. A close with unread data resets the connection, and the client loses the alert; a robot
/// sends its first message along with the end of the handshake.
async fn close_refused(mut stream: TcpStream) {
    let closing = async {
        stream.shutdown().await?;
        let mut rest = stream.take(REFUSED_BYTES_MAX);
        tokio::io::copy(&mut rest, &mut tokio::io::sink()).await
    };
    // A client that keeps the connection open is not waited for.
    let _ = tokio::time::timeout(REFUSED_CLOSE_MAX, closing).await;
}

/// Whether a robot's certificate was refused because of its validity.
fn is_expired(error: &std::io::Error) -> bool {
    let cause = error.get_ref().and_then(|cause| cause.downcast_ref());
    matches!(
        cause,
        Some(rustls::Error::InvalidCertificate(
            CertificateError::Expired
                | CertificateError::ExpiredContext { .. }
                | CertificateError::NotValidYet
                | CertificateError::NotValidYetContext { .. }
        ))
    )
}

/// Sends the credentials and reads the first message of the session.
async fn begin(
    outside: &mut server::TlsStream<TcpStream>,
    credentials: &RouterCredentials,
) -> anyhow::Result<Init> {
    outside.write_all(&credentials.to_bytes()?).await?;
    outside.flush().await?;
    Ok(read_init(outside, credentials).await?)
}

async fn connect(router: &Router) -> anyhow::Result<TcpStream> {
    let socket = TcpSocket::new_v4()?;
    socket.set_recv_buffer_size(SEND_BUFFER_BYTES)?;
    let stream = socket.connect(router.address).await?;
    stream.set_nodelay(true)?;
    Ok(stream)
}

/// Waits until a router has closed a session whose link has ended.
async fn session_gone(router: &Arc<Router>, session_id: u128) {
    loop {
        let checked_router = Arc::clone(router);
        let checking = tokio::task::spawn_blocking(move || checked_router.has_session(session_id));
        if !checking.await.unwrap_or(false) {
            return;
        }
        tokio::time::sleep(SESSION_GONE_EVERY).await;
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
