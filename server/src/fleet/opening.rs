//! Opens routers: unencrypted on the loopback, or behind the gate.
//!
//! Behind the gate a router listens on the loopback and demands a user name and a password of every
//! session; its access rules are by user name. TLS connects agent and gate. Zenoh's own TLS link,
//! which is not compiled in, reads and writes one rustls stream from two tasks at once, which is
//! undefined behaviour.

use std::net::{Ipv4Addr, SocketAddr, TcpListener};
use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use tread_api::wire::{BATCH_BYTES, SESSION_LEASE_MS};
use uuid::Uuid;
use zenoh::{Config, Session, Wait as _};

use super::access::control;
use super::credentials::{CredentialDerivation, Dictionary};
use super::inbox::{self, Channels};
use super::probe;
use super::routers::Router;
use super::{
    ACCEPT_PENDING_MAX, FleetError, MESSAGE_BYTES_MAX, SEND_BUFFER_BYTES, SESSION_TIMEOUT,
    SESSIONS_MAX,
};
use crate::app::presence::RobotKey;
use crate::authority::Authorities;
use crate::supervisor::Supervisor;

/// Opens routers.
#[derive(Debug)]
pub(super) struct Opener {
    /// Address of a router without a gate.
    pub(super) address: SocketAddr,
    /// Authorities, from whose keys the passwords of robots derive; `None` without a gate.
    pub(super) authorities: Option<Arc<Authorities>>,
    /// Maximum number of robots of a router behind the gate.
    pub(super) robots_max: usize,
    pub(super) supervisor: Supervisor,
    pub(super) next: AtomicU64,
}

impl Opener {
    /// Opens a router whose rules include these robots.
    ///
    /// # Errors
    /// [`FleetError`].
    pub(super) async fn open(&self, robots: Vec<RobotKey>) -> Result<Arc<Router>, FleetError> {
        let address = match self.authorities {
            Some(_) => with_free_port(SocketAddr::from((Ipv4Addr::LOCALHOST, 0)))?,
            None => self.address,
        };
        let failed = |reason: String| FleetError::Open { address, reason };
        // Passwords derive from the authority that signs now; those of a former one end with its
        // routers.
        let signing = self
            .authorities
            .as_ref()
            .map(|it| Arc::clone(it.present().signing()));
        let credentials = signing.map(|signing| Arc::new(CredentialDerivation::new(&signing)));
        let (needed, supervisor) = (credentials.clone(), &self.supervisor);
        let known = robots.clone();
        // Parsing many rules takes a while.
        let opening = supervisor.blocking(move || -> zenoh::Result<Session> {
            let config = config(address)?;
            // The file of passwords must exist until the router has read it.
            let (config, _dictionary) = match &needed {
                Some(credentials) => {
                    let (config, dictionary) = with_access_control(&config, credentials, &known)?;
                    (config, Some(dictionary))
                }
                None => (config, None),
            };
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
            credentials,
            robots: robots.into_iter().collect(),
        }))
    }

    /// Declares the server's subscriptions and queryables on a router.
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
            probe::declare_probe(&session)
        });
        let reason = match declaring.await {
            Some(Ok(())) => return Ok(()),
            Some(Err(error)) => error.to_string(),
            None => "it panicked".to_owned(),
        };
        Err(FleetError::Open { address, reason })
    }
}

/// Size of the receive buffers that zenoh keeps for each session, bytes: it allocates as many of
/// [`BATCH_BYTES`] as fit, and further ones while these are in use. Its default of 64 KiB kept seven
/// for each robot, however little this says.
const RECEIVE_BUFFERS_BYTES: usize = 2 * BATCH_BYTES as usize;

/// Range for free ports, below those that the system uses for outgoing connections.
const PORTS: Range<u16> = 20_000..32_768;
/// Number of ports that are tried before the system is asked for one.
const PORT_TRIES_MAX: u32 = 32;

/// Finds a free port, since zenoh does not report the one it chose for 0. The range is one from
/// which the system takes no ports for outgoing connections, so that the port is still free when
/// zenoh listens.
pub(super) fn with_free_port(address: SocketAddr) -> Result<SocketAddr, FleetError> {
    if address.port() != 0 {
        return Ok(address);
    }
    let somewhere = || {
        let within = Uuid::new_v4().as_u128() % u128::from(PORTS.end - PORTS.start);
        let port = PORTS.start + u16::try_from(within).unwrap_or_default();
        SocketAddr::new(address.ip(), port)
    };
    let free = (0..PORT_TRIES_MAX).find_map(|_| TcpListener::bind(somewhere()).ok());
    // Otherwise the system chooses, or gives the error.
    free.map_or_else(|| TcpListener::bind(address), Ok)
        .and_then(|listener| listener.local_addr())
        .map_err(|cause| FleetError::NoPort { address, cause })
}

/// Returns a configuration whose router demands passwords and restricts robots to their own keys. The
/// rules are not inserted as text: parsing takes three times as long and 90 KB a robot.
fn with_access_control(
    config: &Config,
    credentials: &CredentialDerivation,
    robots: &[RobotKey],
) -> zenoh::Result<(Config, Dictionary)> {
    let dictionary = credentials.dictionary(robots)?;
    let mut values = serde_json::to_value(config)?;
    values["transport"]["auth"]["usrpwd"]["dictionary_file"] = dictionary.path().into();
    values["access_control"] = control(robots);
    Ok((serde_json::from_value(values)?, dictionary))
}

fn config(address: SocketAddr) -> zenoh::Result<Config> {
    let mut config = Config::default();
    let settings = [
        ("mode", "\"router\"".to_owned()),
        (
            "listen/endpoints",
            format!("[\"tcp/{address}#so_sndbuf={SEND_BUFFER_BYTES}\"]"),
        ),
        ("transport/link/tx/batch_size", BATCH_BYTES.to_string()),
        ("transport/link/tx/lease", SESSION_LEASE_MS.to_string()),
        (
            "transport/link/rx/buffer_size",
            RECEIVE_BUFFERS_BYTES.to_string(),
        ),
        (
            "transport/link/rx/max_message_size",
            MESSAGE_BYTES_MAX.to_string(),
        ),
        // Discovery and advertising are disabled.
        ("scouting/multicast/enabled", "false".to_owned()),
        ("scouting/gossip/enabled", "false".to_owned()),
        // Else every router waits half a second for others, which there are none of.
        ("scouting/delay", "0".to_owned()),
        // A router with timestamping compares the time of every message with its clock, and logs an
        // error for each after the machine's clock was set back. These times are not used.
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
        let ours = config(address).unwrap();
        assert_eq!(sessions(&ours), SESSIONS_MAX);
        assert!(sessions(&Config::default()) < sessions(&ours));
    }
}
