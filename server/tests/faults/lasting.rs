//! A disk that is full for a while, under a whole server.

use std::time::Duration;

use serde_json::Value;
use tread_server::app::identity::tokens::FirstAdmin;
use tread_server::config::{FrictionConfig, MapConfig, RetentionConfig, StorageConfig, WebConfig};
use tread_server::db::stops::StopFilter;
use tread_server::{Config, RunningServer, Server};

use crate::ground::{hello, mission};
use crate::interposer::{Fault, Interposer};

const PATIENCE: Duration = Duration::from_secs(30);
const LOOK_AGAIN: Duration = Duration::from_millis(50);

struct Client {
    http: reqwest::Client,
    base: String,
}

impl Client {
    async fn get(&self, path: &str) -> (u16, Value) {
        self.send(self.http.get(format!("{}{path}", self.base)))
            .await
    }

    async fn post(&self, path: &str, body: &Value) -> (u16, Value) {
        let url = format!("{}{path}", self.base);
        self.send(self.http.post(url).json(body)).await
    }

    async fn send(&self, request: reqwest::RequestBuilder) -> (u16, Value) {
        let response = request.send().await.unwrap();
        let status = response.status().as_u16();
        let text = response.text().await.unwrap();
        (
            status,
            serde_json::from_str(&text).unwrap_or(Value::String(text)),
        )
    }

    /// Waits until a look is as wanted.
    async fn until(&self, path: &str, what: &str, is_so: impl Fn(u16, &Value) -> bool) -> Value {
        let mut last = (0, Value::Null);
        let waiting = async {
            loop {
                last = self.get(path).await;
                if is_so(last.0, &last.1) {
                    return;
                }
                tokio::time::sleep(LOOK_AGAIN).await;
            }
        };
        let came = tokio::time::timeout(PATIENCE, waiting).await;
        assert!(
            came.is_ok(),
            "not within {PATIENCE:?}: {what}; last: {last:?}"
        );
        last.1
    }
}

pub(crate) fn full_disk(interposer: &Interposer) {
    let _ = rustls::crypto::ring::default_provider().install_default();
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .enable_all()
        .build()
        .unwrap();
    runtime.block_on(fill_and_empty(interposer));
}

async fn fill_and_empty(interposer: &Interposer) {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(config(folder.path())).await.unwrap();
    let client = client(&server).await;
    let site = "yard".parse().unwrap();
    let robot = "rover-1".parse().unwrap();
    server.app().hello(&site, &hello(&robot, 1)).await.unwrap();
    let circle = serde_json::to_value(mission(&site, &robot)).unwrap();
    let (status, body) = client.post("/v1/missions", &circle).await;
    assert_eq!(status, 201, "{body}");
    client
        .until("/readyz", "ready", |status, _| status == 200)
        .await;

    interposer.arm(Fault::WriteFull, 1, true);
    let (status, body) = client.post("/v1/missions", &circle).await;
    assert_eq!(
        (status, &body["type"]),
        (503, &"/problems/unavailable".into()),
        "{body}"
    );
    let body = client
        .until("/readyz", "not ready on a full disk", |status, _| {
            status == 503
        })
        .await;
    assert!(
        body["detail"].as_str().unwrap().contains("disk is full"),
        "{body}"
    );
    let alerts = client
        .until("/v1/alerts?raised=true", "an alert", |_, body| {
            body["items"][0]["code"] == "storage-unwritable"
        })
        .await;
    assert_eq!(alerts["items"][0]["robot"], Value::Null, "{alerts}");
    let path = "/v1/sites/yard/robots/rover-1/stop";
    let (status, stop) = client
        .post(path, &Value::Object(serde_json::Map::new()))
        .await;
    assert_eq!(status, 200, "{stop}");
    let is_listed = |body: &Value| {
        let listed = body["items"].as_array().into_iter().flatten();
        listed.into_iter().any(|one| one["id"] == stop["id"])
    };
    let (status, listed) = client.get("/v1/stops").await;
    assert!(status == 200 && is_listed(&listed), "{listed}");
    let (status, robots) = client.get("/v1/sites/yard/robots").await;
    assert_eq!(
        (status, &robots["items"][0]["id"]),
        (200, &"rover-1".into()),
        "{robots}"
    );

    assert!(interposer.disarm() > 0);
    client
        .until("/readyz", "ready when there is room", |status, _| {
            status == 200
        })
        .await;
    let (status, body) = client.post("/v1/missions", &circle).await;
    assert_eq!(status, 201, "{body}");
    let path = "/v1/alerts?raised=true";
    client
        .until(path, "the alert is over", |_, body| {
            let raised = body["items"].as_array().into_iter().flatten();
            raised
                .into_iter()
                .all(|one| one["code"] != "storage-unwritable")
        })
        .await;
    let filter = StopFilter {
        robot: Some(robot),
        ..StopFilter::default()
    };
    let recorded = async {
        loop {
            let mut tx = server.app().db().read("test").await.unwrap();
            let found = tread_server::db::stops::list(&mut tx, &filter, 10)
                .await
                .unwrap();
            if !found.is_empty() {
                return found;
            }
            drop(tx);
            tokio::time::sleep(LOOK_AGAIN).await;
        }
    };
    let found = tokio::time::timeout(PATIENCE, recorded).await.unwrap();
    assert_eq!(Value::String(found[0].id.to_string()), stop["id"]);
    server.stop().await.unwrap();
}

async fn client(server: &RunningServer) -> Client {
    let admin = FirstAdmin {
        name: "tests".to_owned(),
        valid_days: 1,
        force: true,
    };
    let token = server.app().create_first_admin(admin).await.unwrap().secret;
    let mut headers = reqwest::header::HeaderMap::new();
    let value = format!("Bearer {token}").parse().unwrap();
    headers.insert(reqwest::header::AUTHORIZATION, value);
    let http = reqwest::Client::builder()
        .default_headers(headers)
        .tls_certs_only([])
        .build()
        .unwrap();
    Client {
        http,
        base: format!("http://{}", server.http_address()),
    }
}

fn config(folder: &std::path::Path) -> Config {
    Config {
        http: "127.0.0.1:0".parse().unwrap(),
        metrics: None,
        zenoh: "127.0.0.1:0".parse().unwrap(),
        database: folder.join("tread.db").into(),
        site: "yard".parse().unwrap(),
        friction: FrictionConfig::default(),
        normalisations: Vec::new(),
        retention: RetentionConfig::default(),
        storage: StorageConfig::default(),
        map: MapConfig::default(),
        tls: None,
        robots: None,
        oidc: None,
        webhooks: tread_server::config::webhooks::WebhooksConfig::default(),
        backup: None,
        republish: None,
        standby: false,
        audit: tread_server::config::AuditConfig::default(),
        tracing: tread_server::config::TracingConfig::default(),
        web: WebConfig::default(),
    }
}
