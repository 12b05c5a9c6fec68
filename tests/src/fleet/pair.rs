//! Two servers on one PostgreSQL database, one of which stands by.

use std::net::SocketAddr;
use std::path::Path;

use anyhow::Context as _;
use nix::sys::signal::Signal;

use super::Fleet;
use crate::ports::free_address;
use crate::process::Process;

/// The server of a pair that stands by, or does not run.
#[derive(Debug)]
pub(super) struct Other {
    name: &'static str,
    http: SocketAddr,
    pub(super) zenoh: SocketAddr,
    process: Option<Process>,
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
        let folder = tempfile::tempdir()?;
        let mut fleet = Self::new(node, folder, None, &[]);
        fleet.database.server().context(
            "two servers need PostgreSQL: put `TREAD_TEST_ENGINE=postgres store-postgres/with-postgres` \
             before the command",
        )?;
        fleet.other = Some(Other {
            name: "other-server",
            http: free_address(),
            zenoh: free_address(),
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
            let started = self.server_process(other.name, (other.http, other.zenoh));
            if let Some(other) = &mut self.other {
                other.process = Some(started);
            }
        }
    }

    /// Exchanges the two servers: [`Fleet::rest`] asks the one that stood by from now on.
    pub fn exchange_servers(&mut self) {
        let Some(other) = &mut self.other else { return };
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
