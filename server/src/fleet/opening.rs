//! How a router is opened: in the clear on this machine alone, or behind the gate.
//!
//! Behind the gate the router listens on the loopback, and demands of every connection a
//! certificate by an authority that lives in this process's memory only. The gate shows one that
//! names the robot whose own certificate it has checked, and the rules go by that name.

use std::net::{IpAddr, Ipv4Addr, SocketAddr, TcpListener};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use base64::Engine as _;
use base64::prelude::BASE64_STANDARD;
use rustls::pki_types::ServerName;
use rustls::{ClientConfig, RootCertStore};
use tokio_rustls::TlsConnector;
use tracing::warn;
use zenoh::{Config, Session, Wait as _};

use super::access::{PROBE_NAME, control, name_of};
use super::inbox::{self, Channels};
use super::presence::RobotKey;
use super::router;
use super::routers::Router;
use super::{
    ACCEPT_PENDING_MAX, BATCH_BYTES, FleetError, LEASE_MS, SEND_BUFFER_BYTES, SESSION_TIMEOUT,
    SESSIONS_MAX,
};
use crate::authority::Authority;
use crate::clock::Clock;
use crate::supervisor::Supervisor;

/// The way from the gate to a router.
#[derive(Debug)]
pub(super) struct Inside {
    authority: Authority,
    clock: Clock,
}

impl Inside {
    /// Makes the authority for the time that this process lives.
    ///
    /// # Errors
    /// The operating system gives no random numbers.
    pub(super) fn new(clock: Clock) -> Result<Self, rcgen::Error> {
        let authority = Authority::generate("Tread router", clock.machine_time())?;
        Ok(Self { authority, clock })
    }

    /// What connects to a router as a robot.
    ///
    /// # Errors
    /// There are no random numbers, or the certificate is not taken.
    pub(super) fn connector(&self, robot: &RobotKey) -> anyhow::Result<TlsConnector> {
        let identity = self
            .authority
            .client_identity(&name_of(robot), self.clock.machine_time())?;
        let mut roots = RootCertStore::empty();
        roots.add(self.authority.certificate().clone())?;
        let provider = Arc::new(rustls::crypto::ring::default_provider());
        let config = ClientConfig::builder_with_provider(provider)
            .with_safe_default_protocol_versions()?
            .with_root_certificates(roots)
            .with_client_auth_cert(identity.chain, identity.key)?;
        Ok(TlsConnector::from(Arc::new(config)))
    }

    /// The name that routers have inside.
    pub(super) fn router_name() -> ServerName<'static> {
        ServerName::IpAddress(IpAddr::from(Ipv4Addr::LOCALHOST).into())
    }

    fn listen(&self, config: &mut Config, robots: &[RobotKey]) -> zenoh::Result<()> {
        let identity = self
            .authority
            .port_identity(&[], self.clock.machine_time())?;
        let settings = [
            ("enable_mtls", "true".to_owned()),
            (
                "root_ca_certificate_base64",
                text(self.authority.certificate_pem()),
            ),
            ("listen_certificate_base64", text(&identity.certificate_pem)),
            ("listen_private_key_base64", text(&identity.key_pem)),
        ];
        for (key, value) in settings {
            config.insert_json5(&format!("transport/link/tls/{key}"), &value)?;
        }
        config.insert_json5("access_control", &control(robots).to_string())
    }

    fn connect(&self, config: &mut Config) -> zenoh::Result<()> {
        let identity = self
            .authority
            .client_identity(PROBE_NAME, self.clock.machine_time())?;
        let settings = [
            ("enable_mtls", "true".to_owned()),
            ("verify_name_on_connect", "true".to_owned()),
            (
                "root_ca_certificate_base64",
                text(self.authority.certificate_pem()),
            ),
            (
                "connect_certificate_base64",
                text(&identity.certificate_pem),
            ),
            ("connect_private_key_base64", text(&identity.key_pem)),
        ];
        for (key, value) in settings {
            config.insert_json5(&format!("transport/link/tls/{key}"), &value)?;
        }
        Ok(())
    }
}

/// PEM as zenoh's configuration has it: base64, as a JSON string.
fn text(pem: &str) -> String {
    format!("\"{}\"", BASE64_STANDARD.encode(pem))
}

/// Opens routers.
#[derive(Debug)]
pub(super) struct Opener {
    /// Where a router in the clear listens.
    pub(super) address: SocketAddr,
    /// Behind the gate, the way to it.
    pub(super) inside: Option<Arc<Inside>>,
    pub(super) supervisor: Supervisor,
    pub(super) next: AtomicU64,
}

impl Opener {
    /// Opens a router whose rules know these robots.
    ///
    /// # Errors
    /// [`FleetError`].
    pub(super) async fn open(&self, robots: Vec<RobotKey>) -> Result<Arc<Router>, FleetError> {
        let address = match self.inside {
            Some(_) => with_free_port(SocketAddr::from((Ipv4Addr::LOCALHOST, 0)))?,
            None => self.address,
        };
        let failed = |reason: String| FleetError::Open { address, reason };
        let (inside, supervisor) = (self.inside.clone(), &self.supervisor);
        let known = robots.clone();
        // Many rules take a while to read.
        let opening = supervisor.blocking(move || -> zenoh::Result<Session> {
            let config = config(address, inside.as_deref(), &known)?;
            zenoh::open(config).wait()
        });
        let session = tokio::time::timeout(SESSION_TIMEOUT, opening)
            .await
            .map_err(|_elapsed| failed("it took too long".to_owned()))?
            .ok_or_else(|| failed("it panicked".to_owned()))?
            .map_err(|error| failed(error.to_string()))?;
        Ok(Arc::new(Router {
            number: self.next.fetch_add(1, Ordering::Relaxed),
            session,
            address,
            robots: robots.into_iter().collect(),
        }))
    }

    /// Declares on a router what the server listens to.
    ///
    /// # Errors
    /// [`FleetError::Open`] if zenoh refuses a declaration.
    pub(super) async fn declare(
        &self,
        router: &Router,
        channels: &Channels,
    ) -> Result<(), FleetError> {
        let (channels, session) = (channels.clone(), router.session.clone());
        let (number, address) = (router.number, router.address);
        let declaring = self.supervisor.blocking(move || {
            inbox::declare(&session, &channels, number)?;
            router::declare_probe(&session)
        });
        let reason = match declaring.await {
            Some(Ok(())) => return Ok(()),
            Some(Err(error)) => error.to_string(),
            None => "it panicked".to_owned(),
        };
        Err(FleetError::Open { address, reason })
    }
}

/// Closes a session, as far as it lets itself be closed.
pub(super) async fn close(session: Session) {
    let closing = tokio::task::spawn_blocking(move || session.close().wait());
    match tokio::time::timeout(SESSION_TIMEOUT, closing).await {
        Ok(Ok(Ok(()))) => {}
        Ok(Ok(Err(error))) => warn!("zenoh did not close cleanly: {error}"),
        Ok(Err(_panic)) => warn!("zenoh panicked while closing"),
        Err(_elapsed) => warn!("zenoh did not close in time"),
    }
}

/// Zenoh does not say which port it took for 0, so a free one is looked for first.
pub(super) fn with_free_port(address: SocketAddr) -> Result<SocketAddr, FleetError> {
    if address.port() != 0 {
        return Ok(address);
    }
    TcpListener::bind(address)
        .and_then(|listener| listener.local_addr())
        .map_err(|cause| FleetError::NoPort { address, cause })
}

fn config(
    address: SocketAddr,
    inside: Option<&Inside>,
    robots: &[RobotKey],
) -> zenoh::Result<Config> {
    let mut config = Config::default();
    let protocol = if inside.is_some() { "tls" } else { "tcp" };
    let settings = [
        ("mode", "\"router\"".to_owned()),
        (
            "listen/endpoints",
            format!("[\"{protocol}/{address}#so_sndbuf={SEND_BUFFER_BYTES}\"]"),
        ),
        ("transport/link/tx/batch_size", BATCH_BYTES.to_string()),
        ("transport/link/tx/lease", LEASE_MS.to_string()),
        // Nothing is discovered and nothing is advertised.
        ("scouting/multicast/enabled", "false".to_owned()),
        ("scouting/gossip/enabled", "false".to_owned()),
        // A router with a clock of its own holds the time of every message against it, and logs an
        // error for each one once the machine's clock was set back. Nobody reads these times.
        ("timestamping/enabled", "false".to_owned()),
        ("transport/unicast/max_sessions", SESSIONS_MAX.to_string()),
        (
            "transport/unicast/accept_pending",
            ACCEPT_PENDING_MAX.to_string(),
        ),
    ];
    for (key, value) in settings {
        config.insert_json5(key, &value)?;
    }
    if let Some(inside) = inside {
        inside.listen(&mut config, robots)?;
    }
    Ok(config)
}

/// How a client on this machine connects to a router to look whether it answers.
///
/// # Errors
/// Zenoh refuses a setting, or there are no random numbers.
pub(super) fn client_config(
    address: SocketAddr,
    inside: Option<&Inside>,
    timeout_ms: u128,
) -> zenoh::Result<Config> {
    let mut config = Config::default();
    let protocol = if inside.is_some() { "tls" } else { "tcp" };
    for (key, value) in [
        ("mode", "\"client\"".to_owned()),
        ("connect/endpoints", format!("[\"{protocol}/{address}\"]")),
        ("connect/timeout_ms", timeout_ms.to_string()),
        ("scouting/multicast/enabled", "false".to_owned()),
        ("scouting/gossip/enabled", "false".to_owned()),
    ] {
        config.insert_json5(key, &value)?;
    }
    if let Some(inside) = inside {
        inside.connect(&mut config)?;
    }
    Ok(config)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_router_takes_more_robots_than_zenoh_does_by_itself() {
        let sessions = |config: &Config| -> u32 {
            let said = config.get_json("transport/unicast/max_sessions").unwrap();
            said.parse().unwrap()
        };
        let address = SocketAddr::from((Ipv4Addr::LOCALHOST, 7447));
        let ours = config(address, None, &[]).unwrap();
        assert_eq!(sessions(&ours), SESSIONS_MAX);
        assert!(sessions(&Config::default()) < sessions(&ours));
    }
}
