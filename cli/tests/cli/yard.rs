//! A server over TLS with one robot, and the command line for it.

use std::process::{Command, Output, Stdio};

use rcgen::{CertifiedKey, generate_simple_self_signed};
use serde_json::Value;
use tempfile::TempDir;
use tread_agent::sim::scenario::Scenario;
use tread_agent::{Agent, AgentConfig, RunningAgent};
use tread_server::app::identity::tokens::FirstAdmin;
use tread_server::config::webhooks::WebhooksConfig;
use tread_server::config::{
    FrictionConfig, MapConfig, RetentionConfig, StorageConfig, TlsFiles, TlsSource, WebConfig,
};
use tread_server::{Config, RunningServer, Server};

use crate::terminal::{PATIENCE, Terminal, eventually};

const PROGRAM: &str = env!("CARGO_BIN_EXE_tread");
pub(crate) const ROBOT: &str = "rover-1";

/// A server over TLS with one robot, in a folder of their own.
pub(crate) struct Yard {
    pub(crate) folder: TempDir,
    pub(crate) server: RunningServer,
    pub(crate) agent: RunningAgent,
}

impl Yard {
    pub(crate) async fn start() -> Self {
        let _first = rustls::crypto::ring::default_provider().install_default();
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        let names = vec!["localhost".to_owned()];
        let CertifiedKey { cert, signing_key } = generate_simple_self_signed(names).unwrap();
        std::fs::write(at("cert.pem"), cert.pem()).unwrap();
        std::fs::write(at("key.pem"), signing_key.serialize_pem()).unwrap();
        let server = Server::start(Config {
            http: "127.0.0.1:0".parse().unwrap(),
            metrics: None,
            zenoh: "127.0.0.1:0".parse().unwrap(),
            database: at("tread.db").into(),
            site: "yard".parse().unwrap(),
            friction: FrictionConfig::default(),
            retention: RetentionConfig::default(),
            storage: StorageConfig::default(),
            map: MapConfig::default(),
            normalisations: Vec::new(),
            tls: Some(TlsSource::Files(TlsFiles {
                certificate: at("cert.pem"),
                key: at("key.pem"),
            })),
            robots: None,
            oidc: None,
            webhooks: WebhooksConfig {
                allow_http: true,
                allowed_networks: vec!["127.0.0.1".parse().unwrap()],
                ..WebhooksConfig::default()
            },
            backup: None,
            republish: None,
            standby: false,
            audit: tread_server::config::AuditConfig::default(),
            tracing: tread_server::config::TracingConfig::default(),
            web: WebConfig::default(),
        });
        let server = server.await.unwrap();
        let admin = server.app().create_first_admin(FirstAdmin {
            name: "tests".to_owned(),
            valid_days: 1,
            force: true,
        });
        std::fs::write(at("token"), admin.await.unwrap().secret).unwrap();
        let config = AgentConfig::simulated(
            Scenario::built_in().unwrap(),
            ROBOT.parse().unwrap(),
            server.zenoh_endpoint(),
            at("robot"),
        );
        let agent = Agent::start(config.unwrap()).unwrap();
        let yard = Self {
            folder,
            server,
            agent,
        };
        // The connection alone does not mean that the server has its hello.
        let key = ("yard".parse().unwrap(), ROBOT.parse().unwrap());
        let presences = yard.server.app().presences();
        eventually("the robot is there", || presences.is_known(&key)).await;
        yard
    }

    /// A whole command line for the server at this port.
    fn line(&self, port: u16, words: &[&str]) -> Vec<String> {
        let at = |name: &str| self.folder.path().join(name).display().to_string();
        let shown = [
            ("--server", format!("https://localhost:{port}")),
            ("--ca", at("cert.pem")),
            ("--token-file", at("token")),
            ("--site", "yard".to_owned()),
        ];
        let shown = shown.map(|(name, value)| [name.to_owned(), value]);
        let words = words.iter().map(|word| (*word).to_owned());
        words.chain(shown.into_iter().flatten()).collect()
    }

    /// `tread` in a terminal, for the server at this port.
    pub(crate) fn tread(&self, port: u16, words: &[&str]) -> Terminal {
        let line = self.line(port, words);
        let line: Vec<&str> = line.iter().map(String::as_str).collect();
        Terminal::run(PROGRAM, &line)
    }

    /// Runs `tread` to its end, without a terminal.
    pub(crate) async fn run(&self, words: &[&str]) -> Ran {
        Ran::of(self.line(self.port(), words)).await
    }

    /// Runs `tread` with `--json`; what it printed.
    pub(crate) async fn json(&self, words: &[&str]) -> Value {
        let ran = self.run(&[words, &["--json"]].concat()).await;
        assert_eq!(ran.code, Some(0), "{words:?}: {}", ran.errors);
        serde_json::from_str(&ran.text).unwrap()
    }

    /// Runs `tread`; the table that it printed.
    pub(crate) async fn table(&self, words: &[&str]) -> String {
        let ran = self.run(words).await;
        assert_eq!(ran.code, Some(0), "{words:?}: {}", ran.errors);
        ran.text
    }

    /// The table once it says this.
    pub(crate) async fn table_that_says(&self, words: &[&str], said: &str) -> String {
        let looking = async {
            loop {
                let table = self.table(words).await;
                if table.contains(said) {
                    break table;
                }
            }
        };
        let shown = tokio::time::timeout(PATIENCE, looking).await;
        shown.unwrap_or_else(|_| panic!("{words:?} never says `{said}`"))
    }

    pub(crate) async fn end(self) {
        self.agent.stop().await;
        self.server.stop().await.unwrap();
    }

    pub(crate) fn port(&self) -> u16 {
        self.server.http_address().port()
    }
}

/// A command that has ended.
pub(crate) struct Ran {
    pub(crate) code: Option<i32>,
    pub(crate) text: String,
    pub(crate) errors: String,
}

impl Ran {
    /// Runs `tread` to its end.
    pub(crate) async fn of(line: Vec<String>) -> Self {
        let mut program = Command::new(PROGRAM);
        program.args(line).env_remove("TREAD_TOKEN");
        program.stdin(Stdio::null());
        let ran = tokio::task::spawn_blocking(move || program.output());
        let Output {
            status,
            stdout,
            stderr,
        } = ran.await.unwrap().unwrap();
        Self {
            code: status.code(),
            text: String::from_utf8(stdout).unwrap(),
            errors: String::from_utf8(stderr).unwrap(),
        }
    }
}
