//! The processes of a demo: this executable again, as server and as agents.

use std::fs::File;
use std::net::{Ipv4Addr, SocketAddr, TcpListener};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use anyhow::{Context, bail};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use tokio::time::Instant;
use tread_agent::sim::scenario::ScenarioRobot;
use tread_api::ids::SiteId;

/// Port of the zenoh router, if it is free.
const ZENOH_PORT: u16 = 7447;
/// Days that a demo's token is valid.
const TOKEN_VALID_DAYS: u32 = 7;
/// Ports that are tried from the one that was asked for.
const PORTS_TRIED: u16 = 50;
/// Longest wait for processes that were asked to stop.
const STOP_WAIT_MAX: Duration = Duration::from_secs(10);
/// Time between two looks at processes that are to stop.
const LOOK_EVERY: Duration = Duration::from_millis(20);
/// Lines of a log that are shown when its process has died.
const LOG_LINES_SHOWN: usize = 15;

/// One child process and its log.
struct Part {
    name: String,
    child: Child,
    log: PathBuf,
}

/// All child processes; they are killed if this is dropped without having been stopped.
pub(super) struct Processes {
    http: SocketAddr,
    zenoh: SocketAddr,
    token_file: PathBuf,
    parts: Vec<Part>,
}

impl Processes {
    /// Starts the server on loopback ports that are free.
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

    /// Makes the database and an admin's token in it, as one does before a server's first start.
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

    /// The file with an admin's token.
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

    /// An error, with the end of its log, if any process has ended by itself.
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

    /// Asks all to stop, the agents first, and waits until they have; kills who does not.
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
            // Both fail only if it has ended already.
            _ = part.child.kill();
            _ = part.child.wait();
        }
    }
}

async fn stop_all(parts: &mut [Part]) {
    for part in parts.iter() {
        // It fails only if the process has ended already.
        _ = kill(
            Pid::from_raw(part.child.id().cast_signed()),
            Signal::SIGTERM,
        );
    }
    let deadline = Instant::now() + STOP_WAIT_MAX;
    for part in parts {
        while Instant::now() < deadline && matches!(part.child.try_wait(), Ok(None)) {
            tokio::time::sleep(LOOK_EVERY).await;
        }
        _ = part.child.kill();
        _ = part.child.wait();
    }
}

/// The first free port of the loopback from the one that is wanted.
fn free_address(wanted: u16) -> anyhow::Result<SocketAddr> {
    let last = wanted.saturating_add(PORTS_TRIED);
    for port in wanted..=last {
        if let Ok(listener) = TcpListener::bind((Ipv4Addr::LOCALHOST, port)) {
            return listener.local_addr().context("a bound port has an address");
        }
    }
    bail!("no port from {wanted} to {last} is free on the loopback: choose another with --port")
}
