//! The fleet's network. The only module that calls zenoh.
//!
//! The server's session is itself the router that robots connect to: in the clear on this machine
//! alone, or through the [`gate`], which takes TLS with robots' certificates. Callbacks run on zenoh's own
//! threads, where anything slow would stop the whole network: they only `try_send` into bounded
//! channels, and what does not fit is counted and dropped. Robots send again what matters.

mod access;
#[cfg(test)]
mod access_tests;
mod changes;
mod client;
mod commands;
mod credentials;
mod gate;
mod inbox;
#[cfg(test)]
mod link_tests;
mod opening;
mod probe;
mod publishers;
mod pulse;
mod rate_limits;
mod received;
mod republish;
mod requests;
mod router;
mod router_groups;
mod router_pool;
mod routers;
mod teleop;
#[cfg(test)]
mod test_client;
mod tokens;

use std::net::{SocketAddr, TcpListener};
use std::num::NonZeroUsize;
use std::sync::Arc;
use std::sync::atomic::AtomicU64;
use std::time::Duration;

use tokio::sync::{Mutex, mpsc};
use tracing::info;
use tread_api::wire::PAYLOAD_BYTES_MAX;

use self::commands::ZenohCommands;
use self::gate::Gate;
use self::opening::{Opener, with_free_port};
use self::republish::Republisher;
use self::router_pool::RouterPool;
use self::routers::Routers;
use self::teleop::ZenohDrive;
use crate::app::App;
use crate::app::enrolment::FLEET_ROBOTS_MAX;
use crate::app::ingest::Upload;
use crate::app::robot_link::RobotLink;
use crate::app::stops::STOP_CONFIRM_MAX;
use crate::authority::Authorities;
use crate::clock::Clock;
use crate::rate_limit::RateLimit;
use crate::supervisor::Supervisor;

/// Maximum number of connected robots; zenoh's default is 1000.
const SESSIONS_MAX: u32 = FLEET_ROBOTS_MAX;
/// Maximum number of connections that are being opened.
const ACCEPT_PENDING_MAX: u32 = 1_000;
/// Send buffer of the system per robot, bytes. Priorities have no effect within it: a larger one
/// would delay drive commands on a narrow link.
const SEND_BUFFER_BYTES: u32 = 16 * 1024;
/// Maximum size of a message reassembled from fragments, with its key, bytes; zenoh's default is 1
/// GiB.
const MESSAGE_BYTES_MAX: usize = PAYLOAD_BYTES_MAX + 64 * 1024;
/// Maximum time for the session to open, and to close.
const SESSION_TIMEOUT: Duration = Duration::from_secs(10);

/// Reason why the network cannot be opened.
#[derive(Debug, thiserror::Error)]
pub enum FleetError {
    /// Zenoh refused.
    #[error("cannot open the zenoh router on {address}: {reason}")]
    Open {
        /// The address.
        address: SocketAddr,
        /// Zenoh's error.
        reason: String,
    },
    /// The certificates of the robots' port cannot be used.
    #[error("cannot use the certificates of the robots' port")]
    Certificates(#[source] anyhow::Error),
    /// Another program listens on the address.
    #[error(
        "cannot listen for robots on {address}: another program has it, or it is no address of this \
         machine; `tread-server doctor` examines the ports"
    )]
    InUse {
        /// The address.
        address: SocketAddr,
        /// The cause.
        #[source]
        cause: std::io::Error,
    },
    /// No port is free.
    #[error("no port is free on {address}")]
    NoPort {
        /// The address.
        address: SocketAddr,
        /// The cause.
        #[source]
        cause: std::io::Error,
    },
}

/// Certificates of the robots' port.
#[derive(Debug, Clone)]
pub struct Security {
    /// Authorities that sign robots' certificates and the port's.
    pub authorities: Arc<Authorities>,
    /// Host names of the port, for its certificate.
    pub names: Vec<String>,
    /// Maximum number of robots of a router.
    pub robots_per_router: NonZeroUsize,
}

/// The open network.
#[derive(Debug)]
pub struct Fleet {
    routers: Arc<Routers>,
    opener: std::sync::Mutex<Option<Opener>>,
    gate: std::sync::Mutex<Option<Gate>>,
    supervisor: Supervisor,
    address: SocketAddr,
    is_tls: bool,
    probe_period: Duration,
    /// Limit of the bytes read from one robot.
    byte_rate: RateLimit,
}

impl Fleet {
    /// Binds the address that robots connect to; port 0 takes a free one. Without `security`
    /// connections are unencrypted, and any client may act as any robot.
    ///
    /// # Errors
    /// [`FleetError`]: the address is in use, or the certificates cannot be used.
    pub fn open(
        address: SocketAddr,
        security: Option<Security>,
        clock: Clock,
        supervisor: Supervisor,
    ) -> Result<Self, FleetError> {
        let routers = Arc::new(Routers::default());
        let is_tls = security.is_some();
        let robots_max = security
            .as_ref()
            .map_or(usize::MAX, |it| it.robots_per_router.get());
        let (address, authorities, gate) = match security {
            None => {
                let address = with_free_port(address)?;
                // Checked here because the operating system's error is clearer than zenoh's.
                let in_use = |cause| FleetError::InUse { address, cause };
                drop(TcpListener::bind(address).map_err(in_use)?);
                (address, None, None)
            }
            Some(security) => {
                let authorities = Arc::clone(&security.authorities);
                let gate = Gate::open(address, security, clock)?;
                (gate.address(), Some(authorities), Some(gate))
            }
        };
        Ok(Self {
            opener: std::sync::Mutex::new(Some(Opener {
                address,
                authorities,
                robots_max,
                supervisor: supervisor.clone(),
                next: AtomicU64::new(0),
            })),
            gate: std::sync::Mutex::new(gate),
            routers,
            supervisor,
            address,
            is_tls,
            probe_period: router::PROBE_PERIOD,
            byte_rate: gate::BYTE_RATE,
        })
    }

    /// Returns the address that robots connect to.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Returns that address as a zenoh endpoint.
    pub fn endpoint(&self) -> String {
        let protocol = if self.is_tls { "tls" } else { "tcp" };
        format!("{protocol}/{}", self.address)
    }

    /// Returns the connections to the robots of this network; they work as soon as it listens.
    pub fn robot_link(&self) -> RobotLink {
        let (routers, supervisor) = (&self.routers, &self.supervisor);
        RobotLink {
            commands: Arc::new(ZenohCommands {
                routers: Arc::clone(routers),
                supervisor: supervisor.clone(),
            }),
            drive: Arc::new(ZenohDrive {
                routers: Arc::clone(routers),
                supervisor: supervisor.clone(),
            }),
            supervisor: supervisor.clone(),
            stop_confirm_max: STOP_CONFIRM_MAX,
        }
    }

    /// Opens the router and starts the tasks of the network: listening to robots, the heartbeat of
    /// the server, and the watch of the routers. States, friction and map changes are also published at the
    /// zenoh router `republish_at`. Only the first call has an effect.
    ///
    /// # Errors
    /// [`FleetError::Open`] if zenoh refuses.
    pub async fn listen(
        &self,
        app: &App,
        uploads: mpsc::Sender<Upload>,
        republish_at: Option<SocketAddr>,
    ) -> Result<(), FleetError> {
        let opener = self.opener.lock().ok().and_then(|mut opener| opener.take());
        let Some(opener) = opener else {
            return Ok(());
        };
        let gate = self.gate.lock().ok().and_then(|mut gate| gate.take());
        let links = gate.as_ref().map(|_| gate::Links::new(self.byte_rate));
        let republisher =
            republish_at.map(|router| Republisher::start(router, app, &self.supervisor));
        let pool = Arc::new(RouterPool {
            app: app.clone(),
            routers: Arc::clone(&self.routers),
            opener,
            channels: inbox::Channels::new(
                &self.supervisor,
                app,
                uploads,
                links.clone(),
                republisher.clone(),
            ),
            turn: Mutex::new(()),
        });
        pool.open_for_all().await?;
        let stop = || self.supervisor.stop_token();
        let pulse = pulse::run(app.clone(), Arc::clone(&self.routers), stop());
        self.supervisor.spawn_vital("pulse", pulse);
        let changes = changes::run(app.clone(), Arc::clone(&self.routers), republisher, stop());
        self.supervisor.spawn_vital("changes", changes);
        if let (Some(gate), Some(links)) = (gate, links) {
            let keeping = Arc::clone(&pool).run(stop());
            self.supervisor.spawn_vital("routers", keeping);
            let (routers, supervisor) = (Arc::clone(&self.routers), self.supervisor.clone());
            let running = gate.run(app.clone(), routers, links, supervisor, stop());
            self.supervisor.spawn_vital("gate", running);
        }
        let watching = router::watch(router::Watch {
            pool,
            supervisor: self.supervisor.clone(),
            period: self.probe_period,
            stop: stop(),
        });
        self.supervisor.spawn_vital("router", watching);
        info!("robots connect to {}", self.endpoint());
        Ok(())
    }

    /// Closes the network; robots keep trying to come back.
    pub async fn close(self) {
        for router in self.routers.all() {
            client::close(router.session.clone()).await;
        }
    }
}
