//! Robots without physics: they speak like an agent, as fast as they are configured to.
//!
//! They say hello, hold a liveliness token, publish states, and upload segments in batches with
//! acknowledgement. What they never do is drive.

use std::time::Duration;

use anyhow::{Context, bail};
use jiff::Timestamp;
use serde::Serialize;
use serde::de::DeserializeOwned;
use tokio::time::Instant;
use tread_agent::fleet::Tunnel;
use tread_agent::membership::Membership;
use tread_api::friction::{Information, Segment};
use tread_api::geometry::Pose;
use tread_api::ids::{BootId, RobotId, SiteId};
use tread_api::keys;
use tread_api::robot::{
    Aged, Capabilities, LoopStatus, OutboxStatus, RobotLimits, RobotMode, RobotModel,
};
use tread_api::site::Cell;
use tread_api::wire::encoding::Encoding;
use tread_api::wire::hello::{Hello, Welcome};
use tread_api::wire::ingest::{Batch, Receipt, Record, RecordContent};
use tread_api::wire::state::RobotState;
use tread_api::wire::{self, Refusal};
use zenoh::Session;
use zenoh::liveliness::LivelinessToken;
use zenoh::pubsub::Publisher;
use zenoh::qos::CongestionControl;
use zenoh::query::ConsolidationMode;

/// Longest wait for the server's answer to anything.
const ANSWER_WAIT_MAX: Duration = Duration::from_secs(5);

/// Maximum number of times that a robot says hello, which an agent does without end: while thousands join, the
/// server opens routers one after the other.
const HELLO_TRIES_MAX: u32 = 12;

/// A session as agents open it: a client of one router, nothing discovered.
///
/// # Errors
/// No router answers at `endpoint`.
pub async fn open_session(endpoint: &str) -> anyhow::Result<Session> {
    let mut config = zenoh::Config::default();
    let settings = [
        ("mode", r#""client""#.to_owned()),
        ("connect/endpoints", format!("[\"{endpoint}\"]")),
        ("connect/timeout_ms", "5000".to_owned()),
        ("scouting/multicast/enabled", "false".to_owned()),
        ("scouting/gossip/enabled", "false".to_owned()),
    ];
    for (path, value) in settings {
        let set = config.insert_json5(path, &value);
        set.map_err(|error| anyhow::anyhow!("zenoh refuses `{path}`: {error}"))?;
    }
    // Opening blocks its thread until the router answers.
    tokio::task::spawn_blocking(move || zenoh::Wait::wait(zenoh::open(config)))
        .await?
        .map_err(|error| anyhow::anyhow!("no router answers at {endpoint}: {error}"))
}

/// A session through a robot's TLS tunnel, which must outlive it.
///
/// # Errors
/// The robot is not let in.
pub async fn open_secure_session(
    endpoint: &str,
    membership: &Membership,
) -> anyhow::Result<(Session, Tunnel)> {
    let tunnel = Tunnel::open(endpoint, membership).await?;
    let config = tunnel.session_config()?;
    // Opening blocks its thread until the router answers.
    let session = tokio::task::spawn_blocking(move || zenoh::Wait::wait(zenoh::open(config)))
        .await?
        .map_err(|error| anyhow::anyhow!("the robot is not let in at {endpoint}: {error}"))?;
    Ok((session, tunnel))
}

/// Asks and waits for one answer.
///
/// # Errors
/// Nobody answered, or the answer was a refusal.
pub async fn ask<Q: Serialize, A: DeserializeOwned>(
    session: &Session,
    key: &str,
    question: &Q,
) -> anyhow::Result<A> {
    ask_raw(session, key, wire::encode(question)?).await
}

/// Asks with a payload as it is, and waits for one answer.
///
/// # Errors
/// Nobody answered, or the answer was a refusal.
pub async fn ask_raw<A: DeserializeOwned>(
    session: &Session,
    key: &str,
    payload: Vec<u8>,
) -> anyhow::Result<A> {
    ask_encoded(session, key, payload, Encoding::Json).await
}

async fn ask_encoded<A: DeserializeOwned>(
    session: &Session,
    key: &str,
    payload: Vec<u8>,
    encoding: Encoding,
) -> anyhow::Result<A> {
    let replies = session
        .get(key)
        .payload(payload)
        .encoding(encoding.media_type())
        .consolidation(ConsolidationMode::None)
        .timeout(ANSWER_WAIT_MAX)
        .await
        .map_err(|error| anyhow::anyhow!("cannot ask `{key}`: {error}"))?;
    let Ok(reply) = replies.recv_async().await else {
        bail!("nobody answers `{key}`")
    };
    match reply.result() {
        Ok(sample) => Ok(wire::decode(&sample.payload().to_bytes())?),
        Err(error) => {
            let refusal: Refusal = wire::decode(&error.payload().to_bytes())
                .context("an error that is no refusal, such as a timeout")?;
            bail!("refused as {:?}: {}", refusal.code, refusal.detail)
        }
    }
}

/// Says hello as a robot, and gives what the server answers.
///
/// # Errors
/// The server does not answer or does not welcome it.
pub async fn introduce(
    session: &Session,
    site: &SiteId,
    robot: &RobotId,
    boot: BootId,
) -> anyhow::Result<Welcome> {
    let hello = Hello {
        robot: robot.clone(),
        boot,
        agent_version: env!("CARGO_PKG_VERSION").to_owned(),
        model: paper_robot(),
        robot_time: now(),
        capabilities: Capabilities::default(),
    };
    ask(session, &keys::hello(site, robot), &hello).await
}

/// A robot that only talks.
#[derive(Debug)]
pub struct LightRobot {
    /// Its identifier.
    pub id: RobotId,
    /// Its site.
    pub site: SiteId,
    /// Its boot.
    pub boot: BootId,
    /// Its session.
    pub session: Session,
    /// What the server answered of the site.
    pub welcome: Welcome,
    /// Encoding of its uploads; at first the one that an agent would take.
    pub encoding: Encoding,
    model: RobotModel,
    ingest_key: String,
    state_publisher: Publisher<'static>,
    _token: LivelinessToken,
    /// What the session goes through; it must outlive the session.
    pub tunnel: Option<Tunnel>,
    next_record: u64,
    next_state: u64,
}

impl LightRobot {
    /// Connects, says hello and announces itself.
    ///
    /// # Errors
    /// The server does not answer or does not welcome it.
    pub async fn start(endpoint: &str, site: &SiteId, id: RobotId) -> anyhow::Result<Self> {
        Self::start_on(open_session(endpoint).await?, site, id).await
    }

    /// The same by TLS, with the robot's certificate.
    ///
    /// # Errors
    /// The robot is not let in, or the server does not answer or does not welcome it.
    pub async fn start_secure(endpoint: &str, membership: &Membership) -> anyhow::Result<Self> {
        let (session, tunnel) = open_secure_session(endpoint, membership).await?;
        let (site, robot) = (&membership.site, membership.robot.clone());
        let mut started = Self::start_on(session, site, robot).await?;
        started.tunnel = Some(tunnel);
        Ok(started)
    }

    /// Says hello and announces itself on an open session.
    ///
    /// # Errors
    /// The server does not answer or does not welcome it.
    async fn start_on(session: Session, site: &SiteId, id: RobotId) -> anyhow::Result<Self> {
        let boot = BootId::from_uuid(uuid::Uuid::new_v4());
        let mut tries = 1..=HELLO_TRIES_MAX;
        let welcome = loop {
            // As agents do: its router may close when another one takes its robots.
            match introduce(&session, site, &id, boot).await {
                Err(error) if tries.next().is_none() => return Err(error),
                Err(_again) => {}
                Ok(welcome) => break welcome,
            }
        };
        Self::announce(session, welcome, (site.clone(), id), boot).await
    }

    /// Connects to a router without a server, and announces itself as if it had been welcomed so.
    ///
    /// # Errors
    /// No router answers.
    pub async fn start_without_server(
        endpoint: &str,
        welcome: Welcome,
        named: (SiteId, RobotId),
    ) -> anyhow::Result<Self> {
        let boot = BootId::from_uuid(uuid::Uuid::new_v4());
        Self::announce(open_session(endpoint).await?, welcome, named, boot).await
    }

    async fn announce(
        session: Session,
        welcome: Welcome,
        (site, id): (SiteId, RobotId),
        boot: BootId,
    ) -> anyhow::Result<Self> {
        let model = paper_robot();
        let failed = |error: zenoh::Error| anyhow::anyhow!("zenoh: {error}");
        let state_publisher = session
            .declare_publisher(keys::state(&site, &id))
            .congestion_control(CongestionControl::Drop)
            .await
            .map_err(failed)?;
        let token = session
            .liveliness()
            .declare_token(keys::alive(&site, &id, boot));
        let token = token.await.map_err(failed)?;
        let ingest_key = keys::ingest(&site, &id);
        Ok(Self {
            id,
            site,
            boot,
            session,
            encoding: welcome.upload_encoding(),
            welcome,
            model,
            ingest_key,
            state_publisher,
            _token: token,
            tunnel: None,
            next_record: 0,
            next_state: 0,
        })
    }

    /// Goes on with the same boot at another server.
    ///
    /// # Errors
    /// The server does not answer or does not welcome it; then the robot stays as it is.
    pub async fn reconnect(&mut self, endpoint: &str) -> anyhow::Result<()> {
        let session = open_session(endpoint).await?;
        let (site, id, boot) = (self.site.clone(), self.id.clone(), self.boot);
        let welcome = introduce(&session, &site, &id, boot).await?;
        let announced = Self::announce(session, welcome, (site, id), boot).await?;
        *self = Self {
            next_record: self.next_record,
            next_state: self.next_state,
            ..announced
        };
        Ok(())
    }

    /// Says hello once more.
    ///
    /// # Errors
    /// The server does not answer or does not welcome it.
    pub async fn hello(&self) -> anyhow::Result<Welcome> {
        introduce(&self.session, &self.site, &self.id, self.boot).await
    }

    /// The next state of this boot.
    pub fn next_state(&mut self) -> RobotState {
        let state = RobotState {
            robot: self.id.clone(),
            boot: self.boot,
            seq: self.next_state,
            robot_time: now(),
            mode: RobotMode::Idle,
            fault: None,
            pose: Some(Aged {
                value: Pose {
                    x_m: 1.0,
                    y_m: 2.0,
                    heading_rad: 0.5,
                },
                age_ms: 3,
            }),
            twist: None,
            mission: None,
            terrain_revision: Some(self.welcome.site.terrain_revision),
            outbox: OutboxStatus::default(),
            control_loop: LoopStatus {
                rate_hz: 100.0,
                ticks: self.next_state,
                ..LoopStatus::default()
            },
            battery: None,
            alerts: Vec::new(),
            leaving: false,
            monotonic_us: None,
            safety: tread_api::safety::SafetyStatus::default(),
        };
        self.next_state += 1;
        state
    }

    /// Publishes one state.
    ///
    /// # Errors
    /// The session is closed.
    pub async fn publish_state(&mut self) -> anyhow::Result<()> {
        let state = self.next_state();
        let put = self.state_publisher.put(wire::encode(&state)?).await;
        put.map_err(|error| anyhow::anyhow!("cannot publish: {error}"))
    }

    /// The next `count` records of this boot, segments of one pass over neighbouring cells.
    pub fn next_batch(&mut self, count: usize) -> Batch {
        let records = (0..count).map(|_| self.next_segment()).collect();
        Batch {
            robot: self.id.clone(),
            boot: self.boot,
            robot_time: None,
            records,
        }
    }

    fn next_segment(&mut self) -> Record {
        let seq = self.next_record;
        self.next_record += 1;
        let at = now();
        // A path that visits 40 × 40 cells and revisits them, as a robot on its rounds does.
        let step = i32::try_from(seq % 1_600).unwrap_or(0);
        #[expect(clippy::cast_precision_loss, reason = "a small wobble of the value")]
        let theta = 0.2 + 0.001 * ((seq % 17) as f64);
        let information = 2.5e4;
        let segment = Segment {
            configuration: self.model.configuration(),
            mission: None,
            started_at: at,
            ended_at: at,
            grid_revision: self.welcome.site.grid.revision,
            cell: Cell {
                ix: step % 40,
                iy: step / 40,
            },
            terrain: self
                .welcome
                .site
                .terrains
                .first()
                .map(|shape| shape.terrain.clone()),
            theta: Information {
                information,
                weighted: information * theta,
            },
            theta_errors: None,
            effective_track_ratio: None,
            rolling_resistance: None,
            mu_peak_lower_bound: Some(0.3),
            samples: 160,
            distance_m: 1.0,
            saturation_ratio: 0.0,
        };
        Record {
            seq,
            content: RecordContent::Segment(segment),
        }
    }

    /// Uploads a batch and returns the server's receipt with the time it took.
    ///
    /// # Errors
    /// The server did not answer in time, or refused.
    pub async fn upload(&self, batch: &Batch) -> anyhow::Result<(Receipt, Duration)> {
        let begin = Instant::now();
        let payload = wire::encode_as(self.encoding, batch);
        let payload = payload.map_err(|error| anyhow::anyhow!("cannot encode: {error}"))?;
        let key = &self.ingest_key;
        let receipt = ask_encoded(&self.session, key, payload, self.encoding).await?;
        Ok((receipt, begin.elapsed()))
    }
}

/// The wall clock: these robots have no other.
#[expect(
    clippy::disallowed_methods,
    reason = "a load generator measures real time"
)]
pub fn now() -> Timestamp {
    Timestamp::now()
}

/// The robot of the 2007 experiment.
pub fn paper_robot() -> RobotModel {
    RobotModel {
        name: "yi2007".to_owned(),
        tyres: "standard".to_owned(),
        mass_kg: 5.0,
        track_width_m: 0.43,
        wheelbase_m: 0.28,
        wheel_radius_m: 0.08,
        yaw_inertia_kg_m2: 0.45,
        limits: RobotLimits {
            linear_max_m_s: 1.0,
            angular_max_rad_s: 2.0,
            linear_acceleration_max_m_s2: 1.0,
            lateral_acceleration_max_m_s2: 1.0,
            linear_jerk_max_m_s3: 5.0,
            wheel_speed_max_rad_s: 20.0,
            wheel_acceleration_max_rad_s2: 50.0,
        },
    }
}
