//! How old drive commands are at a robot behind a narrow link that bulk fills: messages to the
//! robot in the clear, and by TLS the robot's own full outbox.
//!
//! The commands go the whole path: WebSocket, server, zenoh, link, agent. What the robot says of
//! their age is by the server's estimate of the robot's clock, which only makes them look older.

use std::path::Path;
use std::time::Duration;

use anyhow::Context;
use futures_util::{SinkExt as _, StreamExt as _};
use tokio::net::TcpStream;
use tokio::time::{Instant, MissedTickBehavior};
use tokio_tungstenite::tungstenite::{ClientRequestBuilder, Message};
use tokio_tungstenite::{MaybeTlsStream, WebSocketStream, connect_async};
use tread_agent::RunningAgent;
use tread_agent::outbox::{Limits, Outbox};
use tread_api::drive::{Drive, DriveRequest, DriveUpdate, DriverName};
use tread_api::ids::{BootId, RobotId};
use tread_api::keys;
use tread_tests::fleet::{Fleet, SITE};
use tread_tests::light_robot::{LightRobot, open_session};
use tread_tests::relay::Relay;
use tread_tests::report::{Check, figure, quantile};
use zenoh::qos::CongestionControl;

use crate::Arguments;
use crate::robots::{name, start};

/// The robot's number, apart from all others.
const NUMBER: u32 = 901;
/// What the link carries, bytes a second.
const LINK_BYTES_PER_S: f64 = 1e6;
/// What the slow link carries, bytes a second: 1 Mbit/s.
const SLOW_LINK_BYTES_PER_S: f64 = 125e3;
/// Records in the outbox at the begin.
const OUTBOX_RECORDS: usize = 60_000;
/// Bulk that is offered to it, bytes a second and in each message.
const BULK_BYTES_PER_S: f64 = 2e6;
const BULK_MESSAGE_BYTES: usize = 4_096;
/// Time between two drive commands.
const DRIVE_PERIOD: Duration = Duration::from_millis(50);
/// Age of drive commands, 99 % of them, at the most.
const AGE_MAX_MS: f64 = 120.0;
/// Share of the commands that must arrive.
const ARRIVED_MIN: f64 = 0.9;
/// Time for the bulk to fill the link before it counts.
const FILL: Duration = Duration::from_secs(2);

type Socket = WebSocketStream<MaybeTlsStream<TcpStream>>;

pub(crate) async fn measure(arguments: &Arguments, fleet: &Fleet) -> anyhow::Result<Vec<Check>> {
    let folder = tempfile::tempdir()?;
    let target = fleet.zenoh_endpoint().trim_start_matches("tcp/").parse()?;
    let relay = Relay::start_narrow(target, LINK_BYTES_PER_S).await?;
    let endpoint = format!("tcp/{}", relay.address());
    let robot = name(NUMBER)?;
    let agent = start(NUMBER, &endpoint, folder.path())?;
    fleet.robot_is_online(&robot).await;
    let mut socket = acquire(fleet).await?;

    // The robot listens to this key, so that the router sends all of it down the link.
    let session = open_session(&fleet.zenoh_endpoint()).await?;
    let bulk = session
        .declare_publisher(keys::limit(&fleet.site(), &robot, &"bulk".parse()?))
        .congestion_control(CongestionControl::Drop)
        .await
        .map_err(|error| anyhow::anyhow!("zenoh: {error}"))?;
    #[expect(clippy::cast_precision_loss, reason = "a message's length")]
    let gap = Duration::from_secs_f64(BULK_MESSAGE_BYTES as f64 / BULK_BYTES_PER_S);
    let mut bulk_ticks = tokio::time::interval(gap);
    bulk_ticks.set_missed_tick_behavior(MissedTickBehavior::Burst);
    let mut filling = tokio::task::JoinSet::new();
    filling.spawn(async move {
        let payload = vec![b' '; BULK_MESSAGE_BYTES];
        loop {
            bulk_ticks.tick().await;
            if bulk.put(payload.clone()).await.is_err() {
                return;
            }
        }
    });

    let driven = drive(&mut socket, &agent, arguments.seconds).await?;
    filling.shutdown().await;
    agent.stop().await;
    // Each bulk message that arrives is one limit that the robot refuses.
    #[expect(clippy::cast_precision_loss, reason = "a message's length")]
    let carried =
        figure(driven.limits_refused) * BULK_MESSAGE_BYTES as f64 / figure(arguments.seconds);
    let mut checks = vec![
        Check::of(
            "link: bulk carried, share of the link",
            carried / LINK_BYTES_PER_S,
        )
        .at_least(0.7),
    ];
    checks.extend(driven.checks("link"));
    Ok(checks)
}

/// The same by TLS, while the robot uploads its full outbox.
pub(crate) async fn measure_tls(
    arguments: &Arguments,
    fleet: &Fleet,
) -> anyhow::Result<Vec<Check>> {
    let folder = tempfile::tempdir()?;
    let relay = Relay::start_narrow(fleet.zenoh_address(), SLOW_LINK_BYTES_PER_S).await?;
    let robot = name(NUMBER)?;
    let filled = fill_outbox(fleet, &robot, folder.path()).await?;
    let mut membership = fleet.membership(&robot).await;
    membership.endpoint = format!("tls/{}", relay.address());
    membership.save(&folder.path().join(robot.as_str()))?;
    let agent = start(NUMBER, &membership.endpoint, folder.path())?;
    fleet.robot_is_online(&robot).await;
    let mut socket = acquire(fleet).await?;
    let before = agent.state().outbox.pending;
    let driven = drive(&mut socket, &agent, arguments.seconds).await?;
    let after = agent.state().outbox.pending;
    agent.stop().await;
    let uploaded = figure(before) - figure(after);
    let mut checks = vec![
        Check::of("slow link by TLS: records in the outbox", figure(filled)).at_least(1.0),
        Check::of("slow link by TLS: records uploaded meanwhile", uploaded).at_least(1.0),
        Check::of("slow link by TLS: records left at the end", figure(after)).at_least(1.0),
    ];
    checks.extend(driven.checks("slow link by TLS"));
    Ok(checks)
}

/// Fills a robot's outbox with more than the link carries meanwhile; how many records that are.
async fn fill_outbox(fleet: &Fleet, robot: &RobotId, folder: &Path) -> anyhow::Result<u64> {
    let like: RobotId = "light".parse()?;
    let membership = fleet.membership(&like).await;
    let mut source = LightRobot::start_secure(&fleet.zenoh_endpoint(), &membership).await?;
    let folder = folder.join(robot.as_str()).join("outbox");
    let boot = BootId::from_uuid(uuid::Uuid::new_v4());
    let outbox = Outbox::open(&folder, Limits::default(), robot.clone(), boot)?;
    let mut records = 0;
    for record in source.next_batch(OUTBOX_RECORDS).records {
        outbox.append(&record.content)?;
        records += 1;
    }
    outbox.sync()?;
    Ok(records)
}

/// What came of driving for a while.
struct Driven {
    ages_ms: Vec<f64>,
    sent: u64,
    accepted: u64,
    limits_refused: u64,
}

impl Driven {
    fn checks(mut self, link: &str) -> [Check; 3] {
        [
            Check::of(
                format!("{link}: command age at the robot, p50, ms"),
                quantile(&mut self.ages_ms, 0.5),
            )
            .at_most(AGE_MAX_MS),
            Check::of(
                format!("{link}: command age at the robot, p99, ms"),
                quantile(&mut self.ages_ms, 0.99),
            )
            .at_most(AGE_MAX_MS),
            Check::of(
                format!("{link}: drive commands that arrived, share"),
                figure(self.accepted) / figure(self.sent),
            )
            .at_least(ARRIVED_MIN),
        ]
    }
}

/// Drives the robot for so long, after a while in which the bulk fills the link.
async fn drive(socket: &mut Socket, agent: &RunningAgent, seconds: u64) -> anyhow::Result<Driven> {
    let counted = || {
        let state = agent.state();
        let refused = state.safety.limits_refused;
        let drive = state.safety.drive;
        let drive = drive.map(|drive| (drive.counts.accepted, drive.command_age_ms));
        (drive.unwrap_or_default(), refused)
    };
    let mut ages_ms = Vec::new();
    let mut sent = 0_u64;
    let mut before = None;
    let mut ticks = tokio::time::interval(DRIVE_PERIOD);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let began = Instant::now();
    let drive = DriveRequest::Drive(Drive {
        linear_m_s: 0.2,
        angular_rad_s: 0.2,
        for_ms: Some(400),
    });
    while began.elapsed() < FILL + Duration::from_secs(seconds) {
        tokio::select! {
            _ = ticks.tick() => {
                send(socket, &drive).await?;
                if began.elapsed() > FILL {
                    let ((accepted, oldest_ms), refused) = counted();
                    before.get_or_insert((accepted, refused));
                    ages_ms.extend(oldest_ms);
                    sent += 1;
                }
            }
            frame = socket.next() => {
                frame.context("the server closed the socket")??;
            }
        }
    }
    let ((accepted, _), refused) = counted();
    let before = before.unwrap_or_default();
    Ok(Driven {
        ages_ms,
        sent,
        accepted: accepted - before.0,
        limits_refused: refused - before.1,
    })
}

async fn acquire(fleet: &Fleet) -> anyhow::Result<Socket> {
    let robot = name(NUMBER)?;
    let address = fleet.http_address();
    let url = format!("ws://{address}/v1/sites/{SITE}/robots/{robot}/drive");
    let request = ClientRequestBuilder::new(url.parse()?)
        .with_header("authorization", format!("Bearer {}", fleet.token()));
    let (mut socket, _) = connect_async(request).await?;
    let driver = DriverName {
        name: "safety".to_owned(),
    };
    send(&mut socket, &DriveRequest::Acquire(driver)).await?;
    loop {
        let frame = socket
            .next()
            .await
            .context("the server closed the socket")??;
        let Message::Text(text) = frame else {
            continue;
        };
        let update = serde_json::from_str(&text)?;
        if let DriveUpdate::Leased(_) = update {
            return Ok(socket);
        }
        if let DriveUpdate::Refused { detail, .. } = update {
            anyhow::bail!("no lease: {detail}");
        }
    }
}

async fn send(socket: &mut Socket, request: &DriveRequest) -> anyhow::Result<()> {
    let text = serde_json::to_string(request)?;
    Ok(socket.send(Message::text(text)).await?)
}
