//! The gate: TLS port of the robots.
//!
//! ```text
//!  connection ─► its address failed too often? ─► refused
//!     │ too many open? ─► displaces one without a handshake, or is refused
//!     │ begins like TLS? ─no─► closed
//!     │ handshake with a certificate of the fleet's authority, in time? ─no─► closed
//!     │ the certificate's enrolment in force? ─no─► closed, and an alert is raised
//!     │ cut off a short time ago? ─► its end
//!     │ more than four links of this robot? ─► its oldest goes
//!     │ the gate sends the robot its user name and password
//!     │ the session begins as a client, with an id of the robot's own? ─no─► closed
//!     │ an older link of this session? ─► ends first, or the router would refuse the new one
//!     │ only now a connection inside is made; the session opens as that user? ─no─► closed
//!     ▼
//!  joined to the router, as the robot that the certificate names, until either side ends, the
//!  certificate is over, its authority is retired, or the robot is put out of the fleet; read no faster
//!  than the rate of bytes that all links of a robot share
//! ```
//!
//! zenoh's own TLS link is unsound: its reader and its writer use one rustls stream at the same
//! time, which has aborted servers. Its listener also sleeps for 0.1 s after each failed handshake,
//! does not tell who failed, reads its certificate once, and cannot end one robot's link. So TLS
//! ends here, many handshakes at a time, and a router sees sessions that have been checked.

mod failures;
mod link;
mod links;
mod session;
mod throttle;

use std::net::{IpAddr, SocketAddr};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use jiff::{SignedDuration, Timestamp};
use rustls::pki_types::UnixTime;
use rustls::server::{NoServerSessionStorage, WebPkiClientVerifier};
use rustls::time_provider::TimeProvider;
use rustls::{RootCertStore, ServerConfig};
use tokio::net::{TcpListener, TcpSocket};
use tokio_rustls::TlsAcceptor;
use tokio_util::sync::CancellationToken;
use tracing::{error, warn};
use tread_api::tunnel::ALPN;

use self::failures::Failures;
use self::link::Link;
#[cfg(test)]
pub(super) use self::links::LINKS_PER_ROBOT_MAX;
pub(super) use self::links::{CUT_OFF, Links};
pub(super) use self::throttle::BYTE_RATE;
use super::routers::Routers;
use super::{FleetError, SEND_BUFFER_BYTES, SESSIONS_MAX, Security};
use crate::app::App;
use crate::authority::{PORT_CERTIFICATE_VALIDITY, Trusted};
use crate::clock::Clock;
use crate::connections::{ACCEPT_REST, Bounds, Connections};
use crate::supervisor::Supervisor;

/// Limits on connections to the robots' port. A robot that has shown its certificate counts as at
/// work, and is never displaced.
const BOUNDS: Bounds = Bounds {
    all: SESSIONS_MAX as usize,
    per_address: 4_096,
    unproven: 1_024,
    unproven_per_address: 256,
};
/// Number of connections that the system queues until they are accepted.
const BACKLOG: u32 = 1_024;

/// The open port of the robots.
#[derive(Debug)]
pub(super) struct Gate {
    listener: TcpListener,
    address: SocketAddr,
    trust: PortTrust,
}

/// Certificate of the port and trusted authorities.
struct PortTrust {
    security: Security,
    clock: Clock,
    present: Mutex<Present>,
}

struct Present {
    config: Arc<ServerConfig>,
    made_at: Timestamp,
    trusted: Arc<Trusted>,
}

impl std::fmt::Debug for PortTrust {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.debug_struct("PortTrust").finish_non_exhaustive()
    }
}

impl PortTrust {
    fn new(security: Security, clock: Clock) -> anyhow::Result<Self> {
        let made_at = clock.machine_time();
        let trusted = security.authorities.present();
        let config = Arc::new(server_config(&trusted, &security.names, &clock)?);
        Ok(Self {
            security,
            clock,
            present: Mutex::new(Present {
                config,
                made_at,
                trusted,
            }),
        })
    }

    /// Returns the TLS acceptor. The port's certificate is renewed in time, and at once after a
    /// change of the trusted authorities; TLS sessions from before then cannot be resumed.
    fn acceptor(&self) -> TlsAcceptor {
        let now = self.clock.machine_time();
        let mut present = self.present.lock().unwrap_or_else(PoisonError::into_inner);
        let age = now.duration_since(present.made_at);
        let trusted = self.security.authorities.present();
        let is_rotated = !Arc::ptr_eq(&trusted, &present.trusted);
        if is_rotated || age > PORT_CERTIFICATE_VALIDITY / 3 || age < SignedDuration::ZERO {
            match server_config(&trusted, &self.security.names, &self.clock) {
                Ok(config) => {
                    *present = Present {
                        config: Arc::new(config),
                        made_at: now,
                        trusted,
                    };
                }
                Err(failed) => error!("the robots' port keeps its certificate: {failed:#}"),
            }
        }
        TlsAcceptor::from(Arc::clone(&present.config))
    }
}

/// Verifies robots' certificates by the server's clock, so that one made shortly before the
/// machine's clock was set back stays valid.
#[derive(Debug)]
struct ServerTime(Clock);

impl TimeProvider for ServerTime {
    fn current_time(&self) -> Option<UnixTime> {
        let seconds = u64::try_from(self.0.now().as_second()).ok()?;
        Some(UnixTime::since_unix_epoch(Duration::from_secs(seconds)))
    }
}

fn server_config(
    trusted: &Trusted,
    names: &[String],
    clock: &Clock,
) -> anyhow::Result<ServerConfig> {
    let now = clock.machine_time();
    let identity = trusted.of_port().port_identity(names, now)?;
    let mut roots = RootCertStore::empty();
    for authority in trusted.all() {
        roots.add(authority.certificate().clone())?;
    }
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let verifier =
        WebPkiClientVerifier::builder_with_provider(Arc::new(roots), Arc::clone(&provider))
            .build()?;
    let time = Arc::new(ServerTime(clock.clone()));
    let mut config = ServerConfig::builder_with_details(provider, time)
        .with_protocol_versions(&[&rustls::version::TLS13])?
        .with_client_cert_verifier(verifier)
        .with_single_cert(identity.chain, identity.key)?;
    config.alpn_protocols = vec![ALPN.to_vec()];
    // A resumed session is not verified again, so that a robot could come back with a certificate
    // that has expired since.
    config.session_storage = Arc::new(NoServerSessionStorage {});
    config.send_tls13_tickets = 0;
    Ok(config)
}

impl Gate {
    /// Opens the port.
    ///
    /// # Errors
    /// The address is in use, or the certificates cannot be used.
    pub(super) fn open(
        address: SocketAddr,
        security: Security,
        clock: Clock,
    ) -> Result<Self, FleetError> {
        let trust = PortTrust::new(security, clock).map_err(FleetError::Certificates)?;
        let listener = listen(address).map_err(|cause| FleetError::InUse { address, cause })?;
        let address = listener
            .local_addr()
            .map_err(|cause| FleetError::InUse { address, cause })?;
        Ok(Self {
            listener,
            address,
            trust,
        })
    }

    /// Returns the address of the port.
    pub(super) fn address(&self) -> SocketAddr {
        self.address
    }

    /// Accepts robots' connections until the stop.
    pub(super) async fn run(
        self,
        app: App,
        routers: Arc<Routers>,
        links: Links,
        supervisor: Supervisor,
        stop: CancellationToken,
    ) {
        let connections = Connections::new(BOUNDS);
        let failures = Arc::new(Mutex::new(Failures::default()));
        loop {
            let accepted = tokio::select! {
                biased;
                () = stop.cancelled() => return,
                accepted = self.listener.accept() => accepted,
            };
            let (stream, peer) = match accepted {
                Ok(accepted) => accepted,
                Err(error) => {
                    warn!("cannot accept a robot's connection: {error}");
                    tokio::time::sleep(ACCEPT_REST).await;
                    continue;
                }
            };
            let counters = app.counters();
            counters.gate_connections.one();
            if is_blocked(&failures, peer.ip(), app.clock().elapsed()) {
                counters.gate_rate_limited.one();
                continue;
            }
            let cut = CancellationToken::new();
            let Some(admitted) = connections.admit(peer.ip(), cut.clone()) else {
                counters.gate_full.one();
                continue;
            };
            let displaced = u64::try_from(admitted.displaced).unwrap_or_default();
            counters.gate_displaced.add(displaced);
            let link = Link {
                app: app.clone(),
                peer,
                slot: admitted.slot,
                acceptor: self.trust.acceptor(),
                authorities: Arc::clone(&self.trust.security.authorities),
                routers: Arc::clone(&routers),
                failures: Arc::clone(&failures),
                links: links.clone(),
            };
            let stop = stop.clone();
            supervisor.spawn_passing("robot's link", async move {
                tokio::select! {
                    () = link.serve(stream) => {}
                    () = cut.cancelled() => {}
                    () = stop.cancelled() => {}
                }
            });
        }
    }
}

fn is_blocked(failures: &Mutex<Failures>, address: IpAddr, now: Duration) -> bool {
    let failures = failures.lock().unwrap_or_else(PoisonError::into_inner);
    failures.is_blocked(address, now)
}

/// Receive buffer of the kernel per robot, bytes. Buffered bytes are no longer ordered by priority:
/// with a larger buffer a robot with a long outbox would confirm a Stop late.
const RECEIVE_BUFFER_BYTES: u32 = 64 * 1024;

/// Listens with small buffers, since buffered bytes are no longer ordered by priority.
fn listen(address: SocketAddr) -> std::io::Result<TcpListener> {
    let socket = if address.is_ipv4() {
        TcpSocket::new_v4()?
    } else {
        TcpSocket::new_v6()?
    };
    // After a restart, connections of the former process may still exist.
    socket.set_reuseaddr(true)?;
    socket.set_send_buffer_size(SEND_BUFFER_BYTES)?;
    socket.set_recv_buffer_size(RECEIVE_BUFFER_BYTES)?;
    socket.bind(address)?;
    socket.listen(BACKLOG)
}
