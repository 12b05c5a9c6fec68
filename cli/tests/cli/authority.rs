//! The fleet's authority by commands: rotated by its name, and replaced when its key was stolen.

use std::net::{IpAddr, Ipv4Addr};

use rcgen::{CertificateParams, KeyPair};
use serde_json::Value;
use tempfile::TempDir;
use tread_api::enrolment::{CreateJoinToken, EnrolRobot};
use tread_api::rights::Scope;
use tread_server::app::identity::tokens::FirstAdmin;
use tread_server::authority::Authority;
use tread_server::config::{
    FrictionConfig, MapConfig, RetentionConfig, RobotsConfig, StorageConfig, WebConfig,
};
use tread_server::{Config, RunningServer, Server};

use crate::yard::{ROBOT, Ran};

/// A server that robots join.
struct ServerWithRobots {
    folder: TempDir,
    server: RunningServer,
}

impl ServerWithRobots {
    async fn start() -> Self {
        let _first = rustls::crypto::ring::default_provider().install_default();
        let folder = tempfile::tempdir().unwrap();
        let authority = folder.path().join("authority");
        Authority::create(&authority, "2026-11-02T10:00:00Z".parse().unwrap()).unwrap();
        let server = Server::start(Config {
            http: "127.0.0.1:0".parse().unwrap(),
            metrics: None,
            zenoh: "127.0.0.1:0".parse().unwrap(),
            database: folder.path().join("tread.db").into(),
            site: "yard".parse().unwrap(),
            friction: FrictionConfig::default(),
            retention: RetentionConfig::default(),
            storage: StorageConfig::default(),
            map: MapConfig::default(),
            normalisations: Vec::new(),
            tls: None,
            robots: Some(RobotsConfig {
                authority,
                names: Vec::new(),
                certificate_s: 3_600,
                robots_per_router: 256,
            }),
            backup: None,
            republish: None,
            standby: false,
            audit: tread_server::config::AuditConfig::default(),
            tracing: tread_server::config::TracingConfig::default(),
            web: WebConfig::default(),
            oidc: None,
            webhooks: tread_server::config::webhooks::WebhooksConfig::default(),
        });
        let server = server.await.unwrap();
        let admin = server.app().create_first_admin(FirstAdmin {
            name: "tests".to_owned(),
            valid_days: 1,
            force: true,
        });
        std::fs::write(folder.path().join("token"), admin.await.unwrap().secret).unwrap();
        Self { folder, server }
    }

    /// A robot that joins by the secret of a join token.
    async fn join(&self, secret: String) {
        let request = CertificateParams::default();
        let request = request.serialize_request(&KeyPair::generate().unwrap());
        let request = EnrolRobot {
            token: secret,
            robot: Some(ROBOT.parse().unwrap()),
            certificate_request: request.unwrap().pem().unwrap(),
        };
        let here = IpAddr::V4(Ipv4Addr::LOCALHOST);
        let joined = self.server.app().enrol_robot(here, &request).await;
        joined.unwrap();
    }

    async fn run(&self, words: &[&str]) -> Ran {
        let token = self.folder.path().join("token").display().to_string();
        let server = format!("http://{}", self.server.http_address());
        let shown = [
            "--server",
            &server,
            "--token-file",
            &token,
            "--site",
            "yard",
        ];
        Ran::of(
            words
                .iter()
                .chain(&shown)
                .map(|word| (*word).to_owned())
                .collect(),
        )
        .await
    }

    async fn json(&self, words: &[&str]) -> Value {
        let ran = self.run(&[words, &["--json"]].concat()).await;
        assert_eq!(ran.code, Some(0), "{words:?}: {}", ran.errors);
        serde_json::from_str(&ran.text).unwrap()
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_rotation_is_finished_by_its_name_and_a_stolen_authority_replaced_after_a_question() {
    let running = ServerWithRobots::start().await;
    let request = CreateJoinToken {
        site: "yard".parse().unwrap(),
        robot: None,
        valid_minutes: None,
    };
    let app = running.server.app();
    let made = app.create_join_token(request, ("tests", &Scope::EVERYWHERE));
    running.join(made.await.unwrap().secret).await;

    let started = running.json(&["authority", "start"]).await;
    let rotation = started["rotation"]["id"].as_str().unwrap();
    let shown = running.run(&["authority"]).await;
    assert!(shown.text.contains(rotation), "{}", shown.text);
    let nameless = running.run(&["authority", "finish"]).await;
    assert_eq!(nameless.code, Some(2), "{}", nameless.errors);
    let another = ["authority", "finish", "0011223344556677", "--force"];
    let another = running.run(&another).await;
    assert_eq!(another.code, Some(6), "{}", another.errors);
    assert!(another.errors.contains(rotation), "{}", another.errors);
    let left = running.run(&["authority", "finish", rotation]).await;
    assert_eq!(left.code, Some(6), "{}", left.errors);

    // Without a terminal nobody can be asked, and nothing is done.
    let before = running.json(&["authority"]).await;
    let refused = running.run(&["authority", "replace"]).await;
    assert_eq!(refused.code, Some(1), "{}", refused.errors);
    assert!(
        refused.errors.contains("yard/rover-1"),
        "{}",
        refused.errors
    );
    assert!(refused.errors.contains("--yes"), "{}", refused.errors);
    assert_eq!(
        running.json(&["authority"]).await["signing"],
        before["signing"]
    );

    let replaced = running.run(&["authority", "replace", "--yes"]).await;
    assert_eq!(replaced.code, Some(0), "{}", replaced.errors);
    assert!(
        replaced.text.contains("must join again: 1"),
        "{}",
        replaced.text
    );
    let after = running.json(&["authority"]).await;
    assert_ne!(after["signing"], before["signing"]);
    assert_eq!(after["rotation"], Value::Null);
    assert_eq!(after["to_join"][0]["robot"], ROBOT);
    let tokens = running.json(&["robots", "join-token", "--all"]).await;
    let token = &tokens.as_array().unwrap()[0];
    assert_eq!(token["join_token"]["robot"], ROBOT);
    running
        .join(token["secret"].as_str().unwrap().to_owned())
        .await;
    let after = running.json(&["authority"]).await;
    assert_eq!(after["robots_to_join"], 0);
    let nobody = running.run(&["robots", "join-token", "--all"]).await;
    assert!(nobody.errors.contains("no robot must join again"));
    running.server.stop().await.unwrap();
}
