//! The fleet's network. The only module that calls zenoh.
//!
//! The server's session is itself the router that robots connect to. Callbacks run on zenoh's own
//! threads, where anything slow would stop the whole network: they only `try_send` into bounded
//! channels, and what does not fit is counted and dropped. Robots send again what matters.

pub mod commands;
mod inbox;
pub mod presence;
mod pulse;
mod requests;
mod router;
pub mod teleop;

use std::net::{SocketAddr, TcpListener};
use std::sync::Arc;
use std::time::Duration;

use tokio::sync::mpsc;
use tracing::{info, warn};
use zenoh::{Config, Session, Wait as _};

use self::commands::{Commands, Network};
use self::router::Current;
use self::teleop::Teleop;
use crate::app::App;
use crate::app::ingest::Upload;
use crate::supervisor::Supervisor;

/// Most robots that may be connected; zenoh's own default is 1000.
const SESSIONS_MAX: u32 = 10_000;
/// After this silence a robot takes the server for gone and connects anew, milliseconds. TCP sends
/// what was lost again after ever longer pauses; a new connection is there sooner.
const LEASE_MS: u32 = 3_000;
/// Most connections that may be in the middle of their opening.
const ACCEPT_PENDING_MAX: u32 = 1_000;
/// What the system may keep of what is sent to one robot, bytes. Priorities act only above it: on
/// a narrow link a larger one would let drive commands wait behind everything else.
const SEND_BUFFER_BYTES: u32 = 16 * 1024;
/// Most bytes that are sent at once, for the same reason.
const BATCH_BYTES: u32 = 8 * 1024;
/// How long the session may take to open, and to close.
const SESSION_TIMEOUT: Duration = Duration::from_secs(10);

/// Why the network cannot be opened.
#[derive(Debug, thiserror::Error)]
pub enum FleetError {
    /// Zenoh refused.
    #[error("cannot open the zenoh router on {address}: {reason}")]
    Open {
        /// Where.
        address: SocketAddr,
        /// What zenoh says.
        reason: String,
    },
    /// Another program listens there.
    #[error("cannot listen for robots on {address}")]
    InUse {
        /// Where.
        address: SocketAddr,
        /// Why.
        #[source]
        cause: std::io::Error,
    },
    /// No port is free.
    #[error("no port is free on {address}")]
    NoPort {
        /// Where.
        address: SocketAddr,
        /// Why.
        #[source]
        cause: std::io::Error,
    },
}

/// The open network.
#[derive(Debug)]
pub struct Fleet {
    session: Arc<Current>,
    supervisor: Supervisor,
    address: SocketAddr,
    probe_period: Duration,
}

impl Fleet {
    /// Opens the router. Port 0 takes a free one.
    ///
    /// # Errors
    /// [`FleetError`]: the address is in use, or zenoh refuses it.
    pub async fn open(address: SocketAddr, supervisor: Supervisor) -> Result<Self, FleetError> {
        let address = with_free_port(address)?;
        // Asked here because the operating system's own words are clearer than zenoh's.
        drop(TcpListener::bind(address).map_err(|cause| FleetError::InUse { address, cause })?);
        let session = open_session(address, &supervisor).await?;
        info!("zenoh router listens on tcp/{address}");
        Ok(Self {
            session: Arc::new(Current::new(session)),
            supervisor,
            address,
            probe_period: router::PROBE_PERIOD,
        })
    }

    /// Where robots connect.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// The way to command the robots that an app knows.
    pub fn commands(&self, app: &App) -> Commands {
        let network = Network {
            session: Arc::clone(&self.session),
            supervisor: self.supervisor.clone(),
        };
        Commands::new(Arc::new(network), Arc::clone(app.presences()))
    }

    /// The way of drive commands.
    pub fn teleop(&self) -> Teleop {
        Teleop::new(Arc::clone(&self.session), self.supervisor.clone())
    }

    /// Begins to listen to robots, to beat the pulse and to look after the router.
    ///
    /// # Errors
    /// [`FleetError::Open`] if zenoh refuses a declaration.
    pub async fn listen(&self, app: &App, uploads: mpsc::Sender<Upload>) -> Result<(), FleetError> {
        let channels = inbox::Channels::new(&self.supervisor, app, uploads);
        declare(
            self.session.get(),
            &channels,
            self.address,
            &self.supervisor,
        )
        .await?;
        let stop = || self.supervisor.stop_token();
        let pulse = pulse::run(app.clone(), Arc::clone(&self.session), stop());
        self.supervisor.spawn_vital("pulse", pulse);
        let watching = router::watch(router::Watch {
            app: app.clone(),
            session: Arc::clone(&self.session),
            channels,
            supervisor: self.supervisor.clone(),
            address: self.address,
            period: self.probe_period,
            stop: stop(),
        });
        self.supervisor.spawn_vital("router", watching);
        Ok(())
    }

    /// Closes the network; robots keep trying to come back.
    pub async fn close(self) {
        close(self.session.get()).await;
    }
}

async fn open_session(address: SocketAddr, supervisor: &Supervisor) -> Result<Session, FleetError> {
    let failed = |reason: String| FleetError::Open { address, reason };
    let config = config(address).map_err(|error| failed(error.to_string()))?;
    let opening = supervisor.blocking(move || zenoh::open(config).wait());
    tokio::time::timeout(SESSION_TIMEOUT, opening)
        .await
        .map_err(|_elapsed| failed("it took too long".to_owned()))?
        .ok_or_else(|| failed("it panicked".to_owned()))?
        .map_err(|error| failed(error.to_string()))
}

async fn declare(
    session: Session,
    channels: &inbox::Channels,
    address: SocketAddr,
    supervisor: &Supervisor,
) -> Result<(), FleetError> {
    let channels = channels.clone();
    let declaring = supervisor.blocking(move || {
        inbox::declare(&session, &channels)?;
        router::declare_probe(&session)
    });
    let reason = match declaring.await {
        Some(Ok(())) => return Ok(()),
        Some(Err(error)) => error.to_string(),
        None => "it panicked".to_owned(),
    };
    Err(FleetError::Open { address, reason })
}

async fn close(session: Session) {
    let closing = tokio::task::spawn_blocking(move || session.close().wait());
    match tokio::time::timeout(SESSION_TIMEOUT, closing).await {
        Ok(Ok(Ok(()))) => {}
        Ok(Ok(Err(error))) => warn!("zenoh did not close cleanly: {error}"),
        Ok(Err(_panic)) => warn!("zenoh panicked while closing"),
        Err(_elapsed) => warn!("zenoh did not close in time"),
    }
}

/// Zenoh does not say which port it took for 0, so a free one is looked for first.
fn with_free_port(address: SocketAddr) -> Result<SocketAddr, FleetError> {
    if address.port() != 0 {
        return Ok(address);
    }
    TcpListener::bind(address)
        .and_then(|listener| listener.local_addr())
        .map_err(|cause| FleetError::NoPort { address, cause })
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
        ("transport/link/tx/lease", LEASE_MS.to_string()),
        // Nothing is discovered and nothing is advertised.
        ("scouting/multicast/enabled", "false".to_owned()),
        ("scouting/gossip/enabled", "false".to_owned()),
        (
            "timestamping/enabled",
            "{ router: true, peer: true, client: true }".to_owned(),
        ),
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
    use std::net::Ipv4Addr;

    use super::*;

    #[test]
    fn the_router_takes_more_robots_than_zenoh_does_by_itself() {
        let sessions = |config: &Config| -> u32 {
            let said = config.get_json("transport/unicast/max_sessions").unwrap();
            said.parse().unwrap()
        };
        let ours = config(SocketAddr::from((Ipv4Addr::LOCALHOST, 7447))).unwrap();
        assert_eq!(sessions(&ours), SESSIONS_MAX);
        assert!(sessions(&Config::default()) < sessions(&ours));
    }
}
