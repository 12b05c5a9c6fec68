//! Child processes of a demo: this executable as server and as agents.

use std::fs::File;
use std::net::{Ipv4Addr, SocketAddr, TcpListener};
use std::os::unix::process::CommandExt as _;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use anyhow::{Context, bail};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use tokio::time::Instant;
use tread_agent::sim::scenario::ScenarioRobot;
use tread_api::ids::SiteId;

/// Port of the zenoh router; if it is in use, the next free one.
const ZENOH_PORT: u16 = 7447;
/// Validity of the demo's token, days.
const TOKEN_VALID_DAYS: u32 = 7;
/// Number of ports to try after the requested one.
const PORTS_TRIED: u16 = 50;
/// Maximum time for processes to stop; afterwards they are killed.
const STOP_WAIT_MAX: Duration = Duration::from_secs(10);
/// Polling period of processes that are stopping.
const POLL_INTERVAL: Duration = Duration::from_millis(20);
/// Number of log lines to show when a process has ended unexpectedly.
const LOG_LINES_SHOWN: usize = 15;

/// Child process with its log.
struct Part {
    name: String,
    child: Child,
    log: PathBuf,
}

/// All child processes; dropping it kills those that are still running.
pub(super) struct Processes {
    http: SocketAddr,
    zenoh: SocketAddr,
    token_file: PathBuf,
    parts: Vec<Part>,
}

impl Processes {
    /// Starts the server on free loopback ports.
    pub(super) fn start_server(folder: &Path, port: u16, site: &SiteId) -> anyhow::Result<Self> {
        let http = free_address(port)?;
        let zenoh = free_address(ZENOH_PORT)?;
        let mut processes = Self {
            http,
            zenoh,
            token_file: folder.join("admin.token"),
            parts: Vec::new(),
        };
        processes.make_token(folder)?;
        let arguments = [
            "server".to_owned(),
            format!("--http={http}"),
            format!("--zenoh={zenoh}"),
            format!("--database={}", folder.join("tread.db").display()),
            format!("--site={site}"),
        ];
        processes.start("server", &arguments, folder)?;
        Ok(processes)
    }

    /// Creates the database with an admin token, as before the first start of any server.
    fn make_token(&self, folder: &Path) -> anyhow::Result<()> {
        let program = std::env::current_exe().context("cannot find this executable")?;
        let made = Command::new(program)
            .args(["server", "init", "--force", "--name=demo"])
            .arg(format!("--valid-days={TOKEN_VALID_DAYS}"))
            .arg(format!("--database={}", folder.join("tread.db").display()))
            .arg(format!("--token-file={}", self.token_file.display()))
            .stdin(Stdio::null())
            .output()
            .context("cannot make the demo's token")?;
        if !made.status.success() {
            bail!(
                "cannot make the demo's token: {}",
                String::from_utf8_lossy(&made.stderr).trim()
            );
        }
        Ok(())
    }

    /// Returns the path of the file with the admin token.
    pub(super) fn token_file(&self) -> PathBuf {
        self.token_file.clone()
    }

    /// Starts the agent of one robot.
    pub(super) fn start_agent(
        &mut self,
        folder: &Path,
        site: &SiteId,
        robot: &ScenarioRobot,
        scenario: Option<&Path>,
    ) -> anyhow::Result<()> {
        let name = format!("agent {}", robot.id);
        let mut arguments = vec![
            "agent".to_owned(),
            format!("--site={site}"),
            format!("--robot={}", robot.id),
            format!("--server={}", self.zenoh_endpoint()),
            format!("--data-dir={}", folder.join(robot.id.as_str()).display()),
        ];
        arguments.extend(scenario.map(|file| format!("--scenario={}", file.display())));
        self.start(&name, &arguments, folder)
    }

    fn start(&mut self, name: &str, arguments: &[String], folder: &Path) -> anyhow::Result<()> {
        let program = std::env::current_exe().context("cannot find this executable")?;
        let log = folder.join(format!("{}.log", name.replace(' ', "-")));
        let log_file = File::options().create(true).append(true).open(&log);
        let log_file = log_file.with_context(|| format!("cannot write {}", log.display()))?;
        let child = Command::new(program)
            .args(arguments)
            .stdin(Stdio::null())
            .stdout(log_file.try_clone()?)
            .stderr(log_file)
            // Ctrl-C is for the demo, which asks the server for the results before it stops it.
            .process_group(0)
            .spawn()
            .with_context(|| format!("cannot start the {name}"))?;
        self.parts.push(Part {
            name: name.to_owned(),
            child,
            log,
        });
        Ok(())
    }

    pub(super) fn api_address(&self) -> String {
        format!("http://{}", self.http)
    }

    pub(super) fn zenoh_endpoint(&self) -> String {
        format!("tcp/{}", self.zenoh)
    }

    /// Checks that no process has ended.
    ///
    /// # Errors
    /// A process has ended; the message contains the end of its log.
    pub(super) fn all_alive(&mut self) -> anyhow::Result<()> {
        for part in &mut self.parts {
            if let Some(status) = part.child.try_wait()? {
                let log = std::fs::read_to_string(&part.log).unwrap_or_default();
                let lines: Vec<&str> = log.lines().collect();
                let shown = lines[lines.len().saturating_sub(LOG_LINES_SHOWN)..].join("\n  ");
                bail!(
                    "the {} ended with {status}; the end of its log:\n  {shown}",
                    part.name
                );
            }
        }
        Ok(())
    }

    /// Stops all processes, the agents first, and waits until they have ended. Kills those that
    /// have not within [`STOP_WAIT_MAX`].
    pub(super) async fn stop(&mut self) {
        let (servers, agents) = self.parts.split_at_mut(1);
        stop_all(agents).await;
        stop_all(servers).await;
        self.parts.clear();
    }
}

impl Drop for Processes {
    fn drop(&mut self) {
        for part in &mut self.parts {
            // Both calls fail only if the process has ended already.
            _ = part.child.kill();
            _ = part.child.wait();
        }
    }
}

async fn stop_all(parts: &mut [Part]) {
    for part in parts.iter() {
        // Fails only if the process has ended already.
        _ = kill(
            Pid::from_raw(part.child.id().cast_signed()),
            Signal::SIGTERM,
        );
    }
    let deadline = Instant::now() + STOP_WAIT_MAX;
    for part in parts {
        while Instant::now() < deadline && matches!(part.child.try_wait(), Ok(None)) {
            tokio::time::sleep(POLL_INTERVAL).await;
        }
        _ = part.child.kill();
        _ = part.child.wait();
    }
}

/// Returns the loopback address with the first free port from `first` on.
fn free_address(first: u16) -> anyhow::Result<SocketAddr> {
    let last = first.saturating_add(PORTS_TRIED);
    for port in first..=last {
        if let Ok(listener) = TcpListener::bind((Ipv4Addr::LOCALHOST, port)) {
            return listener.local_addr().context("a bound port has an address");
        }
    }
    bail!("no port from {first} to {last} is free on the loopback: choose another with --port")
}
