//! A server and its robots, each a process, in a folder of their own.

mod pair;

use std::collections::HashMap;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitStatus};

use anyhow::Context;
use serde_json::json;
use tempfile::TempDir;
use tread_agent::clock::{Clock as _, SystemClock};
use tread_agent::membership::{self, Enrolment, Membership, Trust};
use tread_api::ids::{RobotId, SiteId};
use tread_api::robot::LinkState;

use crate::database::FleetDatabase;
use crate::ports::free_address;
use crate::process::{Process, Usage};
use crate::relay::Relay;
use crate::rest::Rest;
use crate::wait::{SHORT, eventually};
use pair::{Network, Other};

/// The site of every fleet.
pub const SITE: &str = "yard";
/// The terrain under every robot.
pub const GROUND: &str = "slab";
/// The true θ of that terrain.
pub const GROUND_THETA: f64 = 0.4;
/// Lines of a log that are shown when something went wrong.
const LOG_TAIL_LINES: usize = 60;
/// Half of its side, metres.
const GROUND_HALF_M: f64 = 500.0;

/// Addresses of a server, and its network in a pair.
struct ServerPlace<'fleet> {
    http: SocketAddr,
    zenoh: SocketAddr,
    network: Option<&'fleet Network>,
}

/// A running fleet; everything ends when it is dropped.
#[derive(Debug)]
pub struct Fleet {
    /// A client of the server.
    pub rest: Rest,
    token: String,
    node: PathBuf,
    /// Executable of the server, if it is another one.
    server_node: Option<PathBuf>,
    /// A `tread-agent` that every agent runs, if it is another one.
    agent_program: Option<PathBuf>,
    folder: TempDir,
    database: FleetDatabase,
    /// The same, as the server reaches it.
    database_of_server: FleetDatabase,
    http: SocketAddr,
    zenoh: SocketAddr,
    server: Option<Process>,
    /// Name of the server's log.
    server_name: &'static str,
    /// The other server of a pair.
    other: Option<Other>,
    /// The network of the server, in a pair.
    network: Option<Network>,
    /// Whether the servers of a pair say where their REST API is, so that a standby forwards to it.
    is_advertised: bool,
    agents: HashMap<RobotId, Process>,
    agent_flags: Vec<String>,
    server_environment: Vec<(String, String)>,
    /// Variables that agents get in their environment from now on.
    pub agent_environment: Vec<(String, String)>,
    config: Option<PathBuf>,
    /// Whether robots need certificates.
    has_certificates: bool,
}

impl Fleet {
    /// Starts a server with `node`, the executable that is a server or an agent, and draws the
    /// terrain of the simulated ground.
    ///
    /// # Panics
    /// If the server does not get ready.
    pub async fn start_with(node: &Path) -> Self {
        Self::start_configured(node, None).await
    }

    /// The same, but robots must join, and show certificates that are good for so many seconds.
    ///
    /// # Panics
    /// If the server does not get ready.
    pub async fn start_secure_with(node: &Path, certificate_s: u32) -> Self {
        let text =
            format!("[robots]\nauthority = \"authority\"\ncertificate_s = {certificate_s}\n");
        Self::start_configured(node, Some(&text)).await
    }

    /// The same, on what an earlier fleet left: `lay_out` puts `tread.db`, `authority` and the robots'
    /// folders into this one's. No terrain is drawn, and raw measurements of any age are kept.
    ///
    /// # Panics
    /// If the server does not get ready.
    pub async fn start_secure_on(node: &Path, lay_out: impl FnOnce(&Path)) -> Self {
        let text = "[robots]\nauthority = \"authority\"\n[retention]\nsegments_days = 36500\n";
        let folder = tempfile::tempdir().expect("a temporary folder");
        lay_out(folder.path());
        // An admin's token of another name, so that those that are there stay as they are.
        let mut fleet = Self::new(node, folder, Some(text), &["--force", "--name=harness"]);
        fleet.start_server().await;
        fleet
    }

    /// The same, with this configuration of the server, and these variables in its environment.
    ///
    /// # Panics
    /// If the server does not get ready.
    pub async fn start_in_environment(
        node: &Path,
        config: &str,
        environment: &[(&str, &str)],
    ) -> Self {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let mut fleet = Self::new(node, folder, Some(config), &[]);
        let owned = |(name, value): &(&str, &str)| ((*name).to_owned(), (*value).to_owned());
        fleet.server_environment = environment.iter().map(owned).collect();
        fleet.start_server().await;
        fleet
    }

    /// The same, whose server sends its traces to this collector; robots show certificates that are good
    /// for so many seconds, if given.
    ///
    /// # Panics
    /// If the server does not get ready.
    pub async fn start_traced(node: &Path, collector: &str, certificate_s: Option<u32>) -> Self {
        let robots = certificate_s.map(|seconds| {
            format!("[robots]\nauthority = \"authority\"\ncertificate_s = {seconds}\n")
        });
        let robots = robots.unwrap_or_default();
        let text = format!("{robots}[tracing]\nendpoint = \"{collector}\"\n");
        Self::start_configured(node, Some(&text)).await
    }

    async fn start_configured(node: &Path, config: Option<&str>) -> Self {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let mut fleet = Self::new(node, folder, config, &[]);
        fleet.start_server().await;
        fleet.draw_ground().await;
        fleet
    }

    /// A fleet of which nothing runs yet.
    fn new(node: &Path, folder: TempDir, config: Option<&str>, init: &[&str]) -> Self {
        let (http, zenoh) = (free_address(), free_address());
        let has_certificates = config.is_some_and(|text| text.contains("[robots]"));
        let config = config.map(|text| {
            let path = folder.path().join("tread.toml");
            let authority = folder.path().join("authority");
            let text = text.replace("\"authority\"", &format!("\"{}\"", authority.display()));
            std::fs::write(&path, text).expect("the temporary folder can be written");
            path
        });
        let database = FleetDatabase::of(folder.path());
        let token = first_token(node, &database, config.as_deref(), init);
        Self {
            rest: Rest::new(format!("http://{http}"), &token),
            token,
            node: node.to_owned(),
            server_node: None,
            agent_program: None,
            folder,
            database_of_server: database.clone(),
            database,
            http,
            zenoh,
            server: None,
            server_name: "server",
            other: None,
            network: None,
            is_advertised: false,
            agents: HashMap::new(),
            agent_flags: Vec::new(),
            server_environment: Vec::new(),
            agent_environment: Vec::new(),
            config,
            has_certificates,
        }
    }

    /// Draws the terrain under every robot.
    async fn draw_ground(&self) {
        let corner = |x: f64, y: f64| json!({"x_m": GROUND_HALF_M * x, "y_m": GROUND_HALF_M * y});
        let polygon = [
            corner(-1.0, -1.0),
            corner(1.0, -1.0),
            corner(1.0, 1.0),
            corner(-1.0, 1.0),
        ];
        let terrain = json!({"id": GROUND, "class": "concrete", "polygon": polygon});
        self.rest
            .post(&format!("/v1/sites/{SITE}/terrains"), &terrain)
            .await;
    }

    /// The fleet's site.
    pub fn site(&self) -> SiteId {
        SITE.parse().expect("it is an identifier")
    }

    /// Where the server's router listens, and that of the other server if there is one.
    pub fn zenoh_endpoint(&self) -> String {
        let is_tls = self.has_certificates && self.config.is_some();
        let protocol = if is_tls { "tls" } else { "tcp" };
        match self.network.as_ref().zip(self.other.as_ref()) {
            Some((own, other)) => {
                let (own, other) = (own.robots.address(), other.network.robots.address());
                format!("{protocol}/{own},{protocol}/{other}")
            }
            None => format!("{protocol}/{}", self.zenoh),
        }
    }

    /// Where robots connect.
    pub fn zenoh_address(&self) -> SocketAddr {
        self.zenoh
    }

    /// Whether robots need certificates.
    pub fn has_certificates(&self) -> bool {
        self.has_certificates
    }

    /// A new join token, for that robot or for any new one.
    pub async fn join_token(&self, robot: Option<&RobotId>) -> String {
        let request = json!({"site": SITE, "robot": robot});
        let created = self.rest.post("/v1/join-tokens", &request).await;
        let secret = created["secret"].as_str().expect("a secret is a text");
        secret.to_owned()
    }

    /// Lets a robot join by a token, as one does on the robot: its words, and how it ended.
    ///
    /// # Panics
    /// If the node cannot be started.
    pub async fn enroll(&self, robot: &RobotId, token: &str) -> (ExitStatus, String) {
        let mut command = Command::new(&self.node);
        command
            .args(["agent", "enroll"])
            .arg(format!("--server=http://{}", self.http))
            .arg(format!("--robot={robot}"))
            .arg(format!("--data-dir={}", self.robot_folder(robot).display()))
            .env("TREAD_JOIN_TOKEN", token);
        let ended = tokio::task::spawn_blocking(move || command.output()).await;
        let ended = ended.ok().and_then(Result::ok);
        let ended = ended.expect("the node can be started");
        let said = String::from_utf8_lossy(&ended.stderr).into_owned();
        (ended.status, said)
    }

    /// Joins as a robot from within this process.
    ///
    /// # Panics
    /// If it is not let in.
    pub async fn membership(&self, robot: &RobotId) -> Membership {
        let enrolment = Enrolment {
            server: format!("http://{}", self.http),
            trust: Trust::Machine,
            token: self.join_token(Some(robot)).await,
            robot: Some(robot.clone()),
            endpoint: Some(self.zenoh_endpoint()),
        };
        let joined = membership::enrol(&enrolment, SystemClock::new().wall()).await;
        joined.expect("the robot is let in")
    }

    /// Lets a robot join by a token of its own.
    ///
    /// # Panics
    /// If it is not let in.
    pub async fn join(&self, robot: &RobotId) {
        let token = self.join_token(Some(robot)).await;
        let (status, said) = self.enroll(robot, &token).await;
        assert!(status.success(), "{robot} was not let in: {said}");
    }

    /// Puts a robot out of the fleet.
    ///
    /// # Panics
    /// If the server refuses.
    pub async fn revoke(&self, robot: &RobotId) {
        let path = format!("/v1/sites/{SITE}/enrolments/{robot}");
        let answer = self.rest.call(reqwest::Method::DELETE, &path, None).await;
        let (status, answer) = answer.expect("the server answers");
        assert!(status.is_success(), "{answer}");
    }

    /// The server's counters.
    pub async fn counter(&self, name: &str) -> u64 {
        let status: serde_json::Value = self.rest.get("/v1/server").await;
        status["counters"][name]
            .as_u64()
            .unwrap_or_else(|| panic!("no counter {name}: {status}"))
    }

    /// Where the server answers HTTP.
    pub fn http_address(&self) -> SocketAddr {
        self.http
    }

    /// An admin's token.
    pub fn token(&self) -> &str {
        &self.token
    }

    /// The database.
    pub fn database(&self) -> &FleetDatabase {
        &self.database
    }

    /// The file of the database.
    ///
    /// # Panics
    /// It is a PostgreSQL database.
    pub fn database_file(&self) -> PathBuf {
        self.database.file().to_owned()
    }

    /// Lets the server reach its PostgreSQL database through a relay, by starting it again; `None` if the
    /// database is a file.
    ///
    /// # Panics
    /// The server does not get ready.
    pub async fn put_database_behind_relay(&mut self) -> Option<Relay> {
        let relay = Relay::start(self.database.server()?).await;
        let relay = relay.expect("a free port");
        self.database_of_server = self.database.reached_at(relay.address());
        self.kill_server();
        self.start_server().await;
        Some(relay)
    }

    /// What the server process has used; `None` when it does not run.
    pub fn server_usage(&self) -> Option<Usage> {
        self.server.as_ref()?.usage()
    }

    /// Whether the server has ended, by itself or otherwise.
    pub fn has_server_ended(&self) -> bool {
        self.server.as_ref().is_none_or(Process::has_ended)
    }

    /// The server's process and those of agents.
    pub fn processes(&self) -> impl Iterator<Item = &Process> {
        self.server.iter().chain(self.agents.values())
    }

    /// Does something while the server lets robots in without certificates, by starting it twice.
    ///
    /// # Errors
    /// The server does not stop.
    pub async fn without_certificates<T>(
        &mut self,
        act: impl AsyncFnOnce(&Self) -> anyhow::Result<T>,
    ) -> anyhow::Result<T> {
        self.stop_server().await?;
        let config = self.config.take();
        self.start_server().await;
        let done = act(self).await;
        self.stop_server().await?;
        self.config = config;
        self.start_server().await;
        done
    }

    /// How many bytes a process has logged.
    pub fn log_bytes(&self, name: &str) -> u64 {
        let log = self.folder.path().join(format!("{name}.log"));
        std::fs::metadata(log).map_or(0, |log| log.len())
    }

    /// A file of that name in the fleet's own folder.
    pub fn file(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// The server's executable from its next start on.
    pub fn upgrade_server_to(&mut self, node: &Path) {
        self.server_node = Some(node.to_owned());
    }

    /// The program `tread-agent` of every agent that is started from now on, as one of another
    /// release.
    pub fn agents_run(&mut self, program: &Path) {
        self.agent_program = Some(program.to_owned());
    }

    /// Starts the server on the same ports and database as before, and waits until it is ready.
    ///
    /// # Panics
    /// If it does not get ready.
    pub async fn start_server(&mut self) {
        self.server = Some(self.server_process(self.server_name, self.place()));
        let log = self.folder.path().join(format!("{}.log", self.server_name));
        let look = || async {
            let ready = self.rest.call(reqwest::Method::GET, "/readyz", None).await;
            match ready {
                Some((status, _)) if status.is_success() => Ok(()),
                _ => Err(std::fs::read_to_string(&log)),
            }
        };
        _ = eventually("the server is ready", SHORT, look, Result::is_ok).await;
    }

    fn place(&self) -> ServerPlace<'_> {
        ServerPlace {
            http: self.http,
            zenoh: self.zenoh,
            network: self.network.as_ref(),
        }
    }

    /// Starts the process of a server.
    fn server_process(
        &self,
        name: &str,
        ServerPlace {
            http,
            zenoh,
            network,
        }: ServerPlace<'_>,
    ) -> Process {
        let database = match network {
            Some(network) => self.database.reached_at(network.database.address()),
            None => self.database_of_server.clone(),
        };
        let mut arguments = vec![
            "server".to_owned(),
            format!("--http={http}"),
            format!("--zenoh={zenoh}"),
            format!("--database={}", database.argument()),
            format!("--site={SITE}"),
        ];
        if self.is_advertised {
            let path = self.folder.path().join(format!("{name}.toml"));
            let text = format!("[web]\nadvertise_url = \"http://{http}\"\n");
            std::fs::write(&path, text).expect("the temporary folder can be written");
            arguments.push(format!("--config={}", path.display()));
        } else if let Some(config) = &self.config {
            arguments.push(format!("--config={}", config.display()));
        }
        if self.other.is_some() {
            arguments.push("--standby".to_owned());
        }
        let node = self.server_node.as_ref().unwrap_or(&self.node);
        self.start_process(name, (node, &arguments), &self.server_environment)
    }

    /// Ends the server as a power cut would.
    pub fn kill_server(&mut self) {
        self.server = None;
    }

    /// Asks the server to stop.
    ///
    /// # Errors
    /// It does not run, or did not stop in time.
    pub async fn stop_server(&mut self) -> anyhow::Result<ExitStatus> {
        self.server.take().context("no server runs")?.stop().await
    }

    /// Starts an agent whose robot stands at `(x_m, 0)` heading along x, and waits until the
    /// server hears it.
    ///
    /// # Panics
    /// If it is not heard.
    pub async fn start_agent(&mut self, robot: &RobotId, x_m: f64) {
        self.spawn_agent(robot, x_m);
        self.robot_is_online(robot).await;
    }

    /// Starts an agent without waiting.
    pub fn spawn_agent(&mut self, robot: &RobotId, x_m: f64) {
        let endpoint = self.zenoh_endpoint();
        self.spawn_agent_to(robot, x_m, &endpoint);
    }

    /// Starts an agent that reaches the server only through a relay.
    ///
    /// # Panics
    /// If it is not heard.
    pub async fn start_agent_behind_relay(&mut self, robot: &RobotId, x_m: f64) -> Relay {
        let relay = Relay::start(self.zenoh).await.expect("a free port");
        self.spawn_agent_to(robot, x_m, &format!("tcp/{}", relay.address()));
        self.robot_is_online(robot).await;
        relay
    }

    /// Waits until the server hears a robot and knows where it is.
    ///
    /// # Panics
    /// If it is not heard.
    pub async fn robot_is_online(&self, robot: &RobotId) {
        let look = || self.rest.robot(robot);
        eventually(&format!("{robot} is online"), SHORT, look, |seen| {
            seen.as_ref().is_some_and(|seen| {
                let placed = seen.live.as_ref().is_some_and(|live| live.pose.is_some());
                seen.link == LinkState::Online && placed
            })
        })
        .await;
    }

    /// Starts an agent behind a relay that is there already, without waiting.
    pub fn spawn_agent_behind(&mut self, robot: &RobotId, x_m: f64, relay: &Relay) {
        self.spawn_agent_to(robot, x_m, &format!("tcp/{}", relay.address()));
    }

    /// Starts a second agent under a robot's name, on a disk of its own, without waiting. From
    /// here on it is what the harness calls `{robot}-second`.
    ///
    /// # Panics
    /// If the robot's name is too long for that.
    pub fn spawn_second_agent(&mut self, robot: &RobotId, x_m: f64) -> RobotId {
        let second = format!("{robot}-second").parse().expect("a longer name");
        let endpoint = self.zenoh_endpoint();
        self.spawn_named(&second, robot, x_m, &endpoint);
        second
    }

    /// Flags that every agent gets from now on, beside its usual ones.
    pub fn agents_get(&mut self, flags: &[&str]) {
        self.agent_flags = flags.iter().map(|flag| (*flag).to_owned()).collect();
    }

    /// Where an agent keeps what outlives it.
    pub fn robot_folder(&self, robot: &RobotId) -> PathBuf {
        self.folder.path().join(robot.as_str())
    }

    /// All that the runs of a process have logged.
    pub fn log(&self, name: &str) -> String {
        std::fs::read_to_string(self.file(&format!("{name}.log"))).unwrap_or_default()
    }

    /// The last lines that a process logged.
    pub fn log_tail(&self, name: &str) -> Vec<String> {
        let text = self.log(name);
        let lines: Vec<&str> = text.lines().collect();
        let from = lines.len().saturating_sub(LOG_TAIL_LINES);
        lines[from..]
            .iter()
            .map(|line| format!("{name}: {line}"))
            .collect()
    }

    fn spawn_agent_to(&mut self, robot: &RobotId, x_m: f64, endpoint: &str) {
        self.spawn_named(robot, robot, x_m, endpoint);
    }

    /// Starts an agent of `robot` that the harness knows as `name`.
    fn spawn_named(&mut self, name: &RobotId, robot: &RobotId, x_m: f64, endpoint: &str) {
        let scenario = self.folder.path().join(format!("{name}.scenario.toml"));
        let stiffness = GROUND_THETA.recip();
        let text = format!(
            "site = \"{SITE}\"\ncell_m = 1.0\nterrains = []\n[ground]\nstiffness = {stiffness}\n\
             [[robots]]\nid = \"{robot}\"\nx_m = {x_m:?}\ny_m = 0.0\nheading_rad = 0.0\nseed = 7\n"
        );
        std::fs::write(&scenario, text).expect("the temporary folder can be written");
        let (node, first) = match &self.agent_program {
            Some(program) => (program, None),
            None => (&self.node, Some("agent".to_owned())),
        };
        let mut arguments: Vec<String> = first.into_iter().collect();
        arguments.extend([
            format!("--site={SITE}"),
            format!("--robot={robot}"),
            format!("--server={endpoint}"),
            format!("--data-dir={}", self.robot_folder(name).display()),
            format!("--scenario={}", scenario.display()),
        ]);
        arguments.extend(self.agent_flags.iter().cloned());
        let process =
            self.start_process(name.as_str(), (node, &arguments), &self.agent_environment);
        self.agents.insert(name.clone(), process);
    }

    /// Ends an agent as a power cut would.
    pub fn kill_agent(&mut self, robot: &RobotId) {
        self.agents.remove(robot);
    }

    /// Asks an agent to stop.
    ///
    /// # Errors
    /// It does not run, or did not stop in time.
    pub async fn stop_agent(&mut self, robot: &RobotId) -> anyhow::Result<ExitStatus> {
        self.agents
            .remove(robot)
            .context("no such agent runs")?
            .stop()
            .await
    }

    fn start_process(
        &self,
        name: &str,
        (node, arguments): (&Path, &[String]),
        environment: &[(String, String)],
    ) -> Process {
        let log = self.folder.path().join(format!("{name}.log"));
        let how = (log.as_path(), environment);
        Process::start_with_environment(name, node, arguments, how)
            .expect("the node can be started")
    }
}

/// Makes the database with an admin's token in it, as one does before a server's first start.
fn first_token(
    node: &Path,
    database: &FleetDatabase,
    config: Option<&Path>,
    flags: &[&str],
) -> String {
    let made = Command::new(node)
        .args(["server", "init"])
        .args(flags)
        .arg(format!("--database={}", database.argument()))
        .args(config.map(|config| format!("--config={}", config.display())))
        .output()
        .expect("the node can be started");
    let said = String::from_utf8_lossy(&made.stderr);
    assert!(made.status.success(), "no token was made: {said}");
    let token = String::from_utf8(made.stdout).expect("a token is text");
    token.trim().to_owned()
}
