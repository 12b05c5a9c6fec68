//! Two servers on one PostgreSQL database, one of which stands by.

use std::net::SocketAddr;
use std::path::Path;
use std::time::Duration;

use anyhow::Context as _;
use nix::sys::signal::Signal;
use reqwest::Method;
use tokio::time::timeout;

use super::{Fleet, ServerPlace};
use crate::ports::free_address;
use crate::process::{Process, Usage};
use crate::relay::Relay;
use crate::rest::Rest;
use crate::wait::{SHORT, eventually};

/// Longest time for an answer of a server that is ready.
const READY_MAX: Duration = Duration::from_secs(1);

/// The server of a pair that stands by, or does not run.
#[derive(Debug)]
pub(super) struct Other {
    name: &'static str,
    http: SocketAddr,
    zenoh: SocketAddr,
    pub(super) network: Network,
    process: Option<Process>,
}

/// The network of one server of a pair.
#[derive(Debug)]
pub(super) struct Network {
    /// Between the server and the database.
    pub(super) database: Relay,
    /// Between robots and the server.
    pub(super) robots: Relay,
    /// Whether the server is cut off from both, until it is connected again.
    is_cut_off: bool,
}

impl Network {
    async fn start(database: SocketAddr, zenoh: SocketAddr) -> anyhow::Result<Self> {
        Ok(Self {
            database: Relay::start(database).await?,
            robots: Relay::start(zenoh).await?,
            is_cut_off: false,
        })
    }
}

impl Network {
    /// Ends the time in which the server is cut off, if it is.
    fn reconnect(&mut self) {
        if std::mem::take(&mut self.is_cut_off) {
            self.database.heal();
            self.robots.heal();
        }
    }
}

impl Fleet {
    /// Starts two servers, of which the first works. Agents know both.
    ///
    /// # Errors
    /// The environment names no PostgreSQL server.
    ///
    /// # Panics
    /// The first does not get ready.
    pub async fn start_pair_with(node: &Path) -> anyhow::Result<Self> {
        Self::start_pair(node, false).await
    }

    /// The same, and the one that stands by answers requests: it forwards to the other what it cannot answer.
    ///
    /// # Errors
    /// As [`Fleet::start_pair_with`].
    ///
    /// # Panics
    /// One of them does not get ready.
    pub async fn start_forwarding_pair_with(node: &Path) -> anyhow::Result<Self> {
        let fleet = Self::start_pair(node, true).await?;
        let standby = fleet.standby().context("there are two servers")?;
        let look = || async {
            let answer = standby.call(Method::GET, "/readyz", None).await;
            answer.is_some_and(|(status, _)| status.is_success())
        };
        eventually("the standby is ready", SHORT, look, |is_ready| *is_ready).await;
        Ok(fleet)
    }

    async fn start_pair(node: &Path, is_advertised: bool) -> anyhow::Result<Self> {
        let folder = tempfile::tempdir()?;
        let mut fleet = Self::new(node, folder, None, &[]);
        fleet.is_advertised = is_advertised;
        let database = fleet.database.server().context(
            "two servers need PostgreSQL: put `TREAD_TEST_ENGINE=postgres store-postgres/with-postgres` \
             before the command",
        )?;
        fleet.network = Some(Network::start(database, fleet.zenoh).await?);
        let zenoh = free_address();
        fleet.other = Some(Other {
            name: "other-server",
            http: free_address(),
            zenoh,
            network: Network::start(database, zenoh).await?,
            process: None,
        });
        fleet.start_server().await;
        fleet.draw_ground().await;
        fleet.start_other_server();
        Ok(fleet)
    }

    /// Starts the server that does not work, which stands by then.
    pub fn start_other_server(&mut self) {
        if let Some(other) = &self.other {
            let place = ServerPlace {
                http: other.http,
                zenoh: other.zenoh,
                network: Some(&other.network),
            };
            let started = self.server_process(other.name, place);
            if let Some(other) = &mut self.other {
                other.process = Some(started);
            }
        }
    }

    /// Returns a client of the server that stands by.
    pub fn standby(&self) -> Option<Rest> {
        let other = self.other.as_ref()?;
        Some(self.rest.at(format!("http://{}", other.http)))
    }

    /// What the processes of both servers have used so far.
    pub fn servers_usage(&self) -> Vec<Usage> {
        let other = self.other.as_ref().and_then(|other| other.process.as_ref());
        let both = self.server.iter().chain(other);
        both.filter_map(Process::usage).collect()
    }

    /// Whether there are two servers.
    pub fn is_pair(&self) -> bool {
        self.other.is_some()
    }

    /// Exchanges the two servers: [`Fleet::rest`] asks the one that stood by from now on.
    pub fn exchange_servers(&mut self) {
        let (Some(other), Some(network)) = (&mut self.other, &mut self.network) else {
            return;
        };
        std::mem::swap(network, &mut other.network);
        std::mem::swap(&mut self.server_name, &mut other.name);
        std::mem::swap(&mut self.http, &mut other.http);
        std::mem::swap(&mut self.zenoh, &mut other.zenoh);
        std::mem::swap(&mut self.server, &mut other.process);
        self.rest = self.rest.at(format!("http://{}", self.http));
    }

    /// Stops the server's process in its tracks, or lets it go on.
    pub fn signal_server(&self, signal: Signal) {
        if let Some(server) = &self.server {
            server.signal(signal);
        }
    }

    /// Does what service managers and a load balancer would: starts a server that has ended, and from
    /// now on [`Fleet::rest`] asks the one that is ready.
    pub async fn tend_pair(&mut self) {
        if self.other.is_none() {
            return;
        }
        if self.has_server_ended() {
            self.server = Some(self.server_process(self.server_name, self.place()));
        }
        if self.has_other_server_ended() {
            self.start_other_server();
        }
        if self.is_ready().await {
            return;
        }
        self.exchange_servers();
        if !self.is_ready().await {
            self.exchange_servers();
        }
    }

    async fn is_ready(&self) -> bool {
        // A frozen server takes connections, and says nothing.
        let asked = self.rest.call(Method::GET, "/readyz", None);
        let ready = timeout(READY_MAX, asked).await;
        ready.is_ok_and(|ready| ready.is_some_and(|(status, _)| status.is_success()))
    }

    /// The network between the server and the database.
    pub fn database_network(&self) -> Option<&Relay> {
        self.network.as_ref().map(|network| &network.database)
    }

    /// The networks between the database and the servers that are not cut off.
    pub fn database_networks(&self) -> impl Iterator<Item = &Relay> {
        self.networks_in_use().map(|network| &network.database)
    }

    /// The networks between robots and the servers that are not cut off.
    pub fn robot_networks(&self) -> impl Iterator<Item = &Relay> {
        self.networks_in_use().map(|network| &network.robots)
    }

    fn networks_in_use(&self) -> impl Iterator<Item = &Network> {
        let other = self.other.iter().map(|other| &other.network);
        let both = self.network.iter().chain(other);
        both.filter(|network| !network.is_cut_off)
    }

    /// Lets servers go on that were stopped in their tracks, and connects those again that were cut off.
    pub fn resume_servers(&mut self) {
        self.signal_server(Signal::SIGCONT);
        self.wake_other_server();
        let other = self.other.iter_mut().map(|other| &mut other.network);
        for network in self.network.iter_mut().chain(other) {
            network.reconnect();
        }
    }

    /// Cuts the server off from database and robots, without telling anybody.
    pub fn cut_server_off(&mut self) {
        if let Some(network) = &mut self.network {
            network.is_cut_off = true;
            network.database.cut();
            network.robots.cut();
        }
    }

    /// Connects the other server again that was cut off.
    pub fn reconnect_other_server(&mut self) {
        if let Some(other) = &mut self.other {
            other.network.reconnect();
        }
    }

    /// Lets the other server go on that was stopped in its tracks.
    pub fn wake_other_server(&self) {
        if let Some(process) = self.other.iter().find_map(|other| other.process.as_ref()) {
            process.signal(Signal::SIGCONT);
        }
    }

    /// Whether the other server's process has ended.
    pub fn has_other_server_ended(&self) -> bool {
        let mut processes = self.other.iter().filter_map(|other| other.process.as_ref());
        processes.all(Process::has_ended)
    }

    /// The last lines that both servers logged.
    pub fn servers_log_tail(&self) -> Vec<String> {
        let other = self.other.iter().map(|other| other.name);
        let names = [self.server_name].into_iter().chain(other);
        names.flat_map(|name| self.log_tail(name)).collect()
    }
}
