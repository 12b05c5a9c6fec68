//! A server in a temporary folder, a client, and what is sent between them.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;
use reqwest::StatusCode;
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::{Value, json};
use tempfile::TempDir;
use tread_api::friction::{Information, Segment};
use tread_api::identity::{CreateToken, CreatedToken, Role};
use tread_api::ids::{MissionId, RobotId, SiteId};
use tread_api::mission::{Mission, MissionDetail, MissionState};
use tread_api::rights::{Right, Scope};
use tread_api::robot::RobotModel;
use tread_api::site::Cell;
use tread_api::terrain::TerrainRef;
use tread_api::wire::ingest::{MissionPhase, MissionReport, Record, RecordContent};
use tread_api::wire::{self, Refusal};
use tread_samples::rover;
use tread_server::app::identity::tokens::FirstAdmin;
use tread_server::authority::Authority;
use tread_server::clock::Clock;
use tread_server::config::webhooks::WebhooksConfig;
use tread_server::config::{
    FrictionConfig, MapConfig, RobotsConfig, StorageConfig, TlsFiles, TlsSource, WebConfig,
};
use tread_server::counters::CounterValues;
use tread_server::webhooks::Resolver;
use tread_server::{Config, RunningServer, Server};
use zenoh::Wait as _;

/// How long anything may take to come about.
pub(crate) const PATIENCE: Duration = Duration::from_secs(15);
const LOOK_AGAIN: Duration = Duration::from_millis(10);

/// Asked now: a test that was compiled elsewhere knows another folder.
pub(crate) fn folder_of_the_crate() -> PathBuf {
    std::env::var_os("CARGO_MANIFEST_DIR").unwrap().into()
}

pub(crate) fn site() -> SiteId {
    "yard".parse().unwrap()
}

pub(crate) fn time(text: &str) -> Timestamp {
    text.parse().unwrap()
}

/// Waits until a look gives something, and says what was seen last if it never does.
pub(crate) async fn eventually<T, S: std::fmt::Debug>(
    what: &str,
    mut look: impl AsyncFnMut() -> Result<T, S>,
) -> T {
    let mut last = None;
    let waiting = async {
        loop {
            match look().await {
                Ok(found) => return found,
                Err(seen) => last = Some(seen),
            }
            tokio::time::sleep(LOOK_AGAIN).await;
        }
    };
    let found = tokio::time::timeout(PATIENCE, waiting).await;
    found.unwrap_or_else(|_elapsed| panic!("not within {PATIENCE:?}: {what}; last seen: {last:?}"))
}

/// A server with its folder.
pub(crate) struct Yard {
    pub(crate) folder: Arc<TempDir>,
    pub(crate) server: RunningServer,
    client: reqwest::Client,
    admin: String,
}

/// A client that shows a token, if any.
pub(crate) fn client(token: Option<&str>) -> reqwest::Client {
    // The first call counts; all install the same.
    let _ = rustls::crypto::ring::default_provider().install_default();
    let mut headers = reqwest::header::HeaderMap::new();
    if let Some(token) = token {
        let value = format!("Bearer {token}").parse().unwrap();
        headers.insert(reqwest::header::AUTHORIZATION, value);
    }
    let builder = reqwest::Client::builder()
        .default_headers(headers)
        .tls_certs_only([]);
    builder.build().unwrap()
}

impl Yard {
    pub(crate) async fn start() -> Self {
        Self::start_in(Arc::new(tempfile::tempdir().unwrap()), "127.0.0.1:0").await
    }

    /// A server whose clock stands until it is moved.
    pub(crate) async fn start_at(wall: Timestamp) -> Self {
        Self::start_with(wall, |_config| {}).await
    }

    /// A server on a clock that the test moves.
    pub(crate) async fn start_on(clock: Clock) -> Self {
        let folder = Arc::new(tempfile::tempdir().unwrap());
        let config = config(folder.path(), "127.0.0.1:0");
        let server = Server::start_with_clock(config, clock);
        Self::of(folder, server.await.unwrap()).await
    }

    /// The same, with a configuration of one's own.
    pub(crate) async fn start_with(wall: Timestamp, change: impl FnOnce(&mut Config)) -> Self {
        let folder = Arc::new(tempfile::tempdir().unwrap());
        let mut config = config(folder.path(), "127.0.0.1:0");
        change(&mut config);
        let server = Server::start_with_clock(config, Clock::manual(wall));
        Self::of(folder, server.await.unwrap()).await
    }

    /// A server on the machine's clock, with a configuration of one's own.
    pub(crate) async fn start_configured(change: impl FnOnce(&mut Config, &Path)) -> Self {
        let folder = Arc::new(tempfile::tempdir().unwrap());
        let mut config = config(folder.path(), "127.0.0.1:0");
        change(&mut config, folder.path());
        Self::of(folder, Server::start(config).await.unwrap()).await
    }

    /// The same, and robots may join it.
    pub(crate) async fn start_joining_at(wall: Timestamp) -> Self {
        let folder = Arc::new(tempfile::tempdir().unwrap());
        let authority = folder.path().join("authority");
        Authority::create(&authority, wall).unwrap();
        let mut config = config(folder.path(), "127.0.0.1:0");
        config.robots = Some(RobotsConfig {
            authority,
            names: Vec::new(),
            certificate_s: 3_600,
            robots_per_router: 256,
        });
        let server = Server::start_with_clock(config, Clock::manual(wall));
        Self::of(folder, server.await.unwrap()).await
    }

    /// A server in a folder and on a clock, with a resolver of webhooks' host names and a
    /// configuration of one's own.
    pub(crate) async fn start_resolving(
        folder: Arc<TempDir>,
        clock: Clock,
        resolver: Arc<dyn Resolver>,
        webhooks: WebhooksConfig,
    ) -> Self {
        let mut config = config(folder.path(), "127.0.0.1:0");
        config.webhooks = webhooks;
        let server = Server::start_with(config, clock, resolver);
        Self::of(folder, server.await.unwrap()).await
    }

    pub(crate) async fn start_with_tls(tls: TlsFiles) -> Self {
        let folder = Arc::new(tempfile::tempdir().unwrap());
        let mut config = config(folder.path(), "127.0.0.1:0");
        config.tls = Some(TlsSource::Files(tls));
        Self::of(folder, Server::start(config).await.unwrap()).await
    }

    async fn start_in(folder: Arc<TempDir>, zenoh: &str) -> Self {
        let config = config(folder.path(), zenoh);
        Self::of(folder, Server::start(config).await.unwrap()).await
    }

    pub(crate) async fn of(folder: Arc<TempDir>, server: RunningServer) -> Self {
        let admin = FirstAdmin {
            name: "tests".to_owned(),
            valid_days: 1,
            force: true,
        };
        let admin = server.app().create_first_admin(admin).await.unwrap().secret;
        Self {
            folder,
            server,
            client: client(Some(&admin)),
            admin,
        }
    }

    /// The secret of an admin's token.
    pub(crate) fn admin(&self) -> &str {
        &self.admin
    }

    /// The secret of a new token.
    pub(crate) async fn token(&self, name: &str, role: Role) -> CreatedToken {
        self.given(CreateToken::of_role(name, role)).await
    }

    /// The secret of a new token with rights of its own, for what each name says: `site` or
    /// `site/robot`; everywhere without any.
    pub(crate) async fn limited(&self, name: &str, rights: &[Right], places: &[&str]) -> String {
        let scope = match places {
            [] => Scope::EVERYWHERE,
            places => Scope::from_names(places.iter().copied()).unwrap(),
        };
        let request = CreateToken {
            role: None,
            rights: Some(rights.to_vec()),
            sites: scope.into(),
            ..CreateToken::of_role(name, Role::Viewer)
        };
        self.given(request).await.secret
    }

    async fn given(&self, request: CreateToken) -> CreatedToken {
        let app = self.server.app();
        app.create_token(request, "test").await.unwrap()
    }

    /// Stops the server and starts another on the same database and network address.
    pub(crate) async fn restart(self) -> Self {
        let zenoh = self.server.zenoh_endpoint();
        self.server.stop().await.unwrap();
        Self::start_in(self.folder, zenoh.trim_start_matches("tcp/")).await
    }

    /// Stops the server, does something with its folder, and starts another on the same database
    /// and network address.
    pub(crate) async fn restart_after(self, act: impl FnOnce(&Path) + Send + 'static) -> Self {
        let zenoh = self.server.zenoh_endpoint();
        self.server.stop().await.unwrap();
        let folder = Arc::clone(&self.folder);
        tokio::task::spawn_blocking(move || act(folder.path()))
            .await
            .unwrap();
        let (_, address) = zenoh.split_once('/').unwrap();
        Self::start_in(self.folder, address).await
    }

    /// The same with a clock that stands at another time.
    pub(crate) async fn restart_at(self, wall: Timestamp) -> Self {
        self.restart_configured_at(wall, |_| {}).await
    }

    /// The same with a configuration of one's own.
    pub(crate) async fn restart_configured_at(
        self,
        wall: Timestamp,
        change: impl FnOnce(&mut Config),
    ) -> Self {
        let zenoh = self.server.zenoh_endpoint();
        self.server.stop().await.unwrap();
        let mut config = config(self.folder.path(), zenoh.trim_start_matches("tcp/"));
        change(&mut config);
        let server = Server::start_with_clock(config, Clock::manual(wall));
        Self::of(self.folder, server.await.unwrap()).await
    }

    pub(crate) fn url(&self, path: &str) -> String {
        format!("http://{}{path}", self.server.http_address())
    }

    pub(crate) fn client(&self) -> &reqwest::Client {
        &self.client
    }

    pub(crate) async fn send(&self, request: reqwest::RequestBuilder) -> (StatusCode, Value) {
        let response = request.send().await.unwrap();
        let (status, text) = (response.status(), response.text().await.unwrap());
        (
            status,
            serde_json::from_str(&text).unwrap_or(Value::String(text)),
        )
    }

    pub(crate) async fn get_value(&self, path: &str) -> (StatusCode, Value) {
        self.send(self.client.get(self.url(path))).await
    }

    pub(crate) async fn get<T: DeserializeOwned>(&self, path: &str) -> T {
        let (status, body) = self.get_value(path).await;
        assert_eq!(status, StatusCode::OK, "{path}: {body}");
        serde_json::from_value(body).unwrap()
    }

    pub(crate) async fn post(&self, path: &str, body: &impl Serialize) -> (StatusCode, Value) {
        self.send(self.client.post(self.url(path)).json(body)).await
    }

    pub(crate) async fn counters(&self) -> CounterValues {
        let (_status, body) = self.get_value("/v1/server").await;
        serde_json::from_value(body["counters"].clone()).unwrap()
    }

    /// Sends a circle mission.
    pub(crate) async fn create_mission(&self, robot: &RobotId) -> Mission {
        let (status, body) = self.post("/v1/missions", &circle(robot)).await;
        assert_eq!(status, StatusCode::CREATED, "{body}");
        serde_json::from_value(body).unwrap()
    }

    pub(crate) async fn mission(&self, id: MissionId) -> MissionDetail {
        self.get(&format!("/v1/missions/{id}")).await
    }

    pub(crate) async fn mission_becomes(
        &self,
        id: MissionId,
        state: MissionState,
    ) -> MissionDetail {
        let what = format!("mission is {}", state.as_str());
        eventually(&what, async || {
            let detail = self.mission(id).await;
            if detail.mission.state == state {
                Ok(detail)
            } else {
                Err(detail)
            }
        })
        .await
    }
}

pub(crate) fn config(folder: &Path, zenoh: &str) -> Config {
    Config {
        http: "127.0.0.1:0".parse().unwrap(),
        metrics: Some("127.0.0.1:0".parse().unwrap()),
        zenoh: zenoh.parse().unwrap(),
        database: crate::postgres::database_of(folder).unwrap_or_else(|| database(folder).into()),
        site: site(),
        friction: FrictionConfig::default(),
        normalisations: Vec::new(),
        retention: tread_server::config::RetentionConfig::default(),
        storage: StorageConfig::default(),
        // Each answer is read from the database, with the sums that are not stored yet.
        map: MapConfig { memory_max_mib: 0 },
        tls: None,
        robots: None,
        oidc: None,
        webhooks: WebhooksConfig::default(),
        backup: None,
        republish: None,
        standby: false,
        audit: tread_server::config::AuditConfig::default(),
        tracing: tread_server::config::TracingConfig::default(),
        web: WebConfig {
            hosts: vec!["tread.test".to_owned()],
            allowed_origins: vec!["https://dash.test".parse().unwrap()],
            behind_https: false,
            ..WebConfig::default()
        },
    }
}

pub(crate) fn database(folder: &Path) -> std::path::PathBuf {
    folder.join("tread.db")
}

pub(crate) fn circle(robot: &RobotId) -> Value {
    json!({
        "site": "yard",
        "robot": robot,
        "trajectory": {"circle": {"center": {"x_m": 1.0, "y_m": 2.0}, "radius_m": 3.0,
                                  "speed_m_s": 0.6}},
    })
}

pub(crate) fn model() -> RobotModel {
    rover("test rover")
}

/// A measurement of θ 0.2 with a standard deviation of 0.01, an hour apart for each 3600 of
/// `second`.
pub(crate) fn segment(cell: (i32, i32), theta: f64, second: i64) -> Segment {
    let at = Timestamp::from_second(1_793_000_000 + second).unwrap();
    Segment {
        configuration: model().configuration(),
        mission: None,
        started_at: at,
        ended_at: at,
        grid_revision: 1,
        cell: Cell {
            ix: cell.0,
            iy: cell.1,
        },
        terrain: Some(TerrainRef {
            id: "lawn".parse().unwrap(),
            revision: 1,
        }),
        theta: Information {
            information: 1e4,
            weighted: 1e4 * theta,
        },
        theta_errors: None,
        effective_track_ratio: None,
        rolling_resistance: None,
        mu_peak_lower_bound: Some(0.4),
        samples: 100,
        distance_m: 0.9,
        saturation_ratio: 0.0,
    }
}

pub(crate) fn report(mission: &Mission, phase: MissionPhase) -> RecordContent {
    RecordContent::Mission(MissionReport {
        mission: mission.id,
        revision: mission.revision,
        plan_hash: mission.plan_hash,
        at: time("2026-11-01T00:00:01Z"),
        phase,
        since: None,
        reason: None,
        progress: None,
        quality: None,
        driven: None,
    })
}

pub(crate) fn measured(seq: u64, segment: Segment) -> Record {
    Record {
        seq,
        content: RecordContent::Segment(segment),
    }
}

/// Sends a query and reads its reply; `Err(None)` is no reply.
pub(crate) async fn ask<T: DeserializeOwned + Send + 'static>(
    session: &zenoh::Session,
    key: String,
    payload: Vec<u8>,
) -> Result<T, Option<Refusal>> {
    let session = session.clone();
    let asking = tokio::task::spawn_blocking(move || {
        let replies = session
            .get(key)
            .payload(payload)
            .timeout(PATIENCE)
            .wait()
            .unwrap();
        let reply = replies.recv().map_err(|_closed| None)?;
        match reply.result() {
            Ok(sample) => Ok(wire::decode(&sample.payload().to_bytes()).unwrap()),
            Err(error) => Err(wire::decode(&error.payload().to_bytes()).ok()),
        }
    });
    asking.await.unwrap()
}
