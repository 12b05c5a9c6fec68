//! A tiny server for agents under test: a real zenoh router with the two queryables, and a memory.

#[path = "../../../tests/src/ports.rs"]
#[expect(
    unreachable_pub,
    reason = "it is a public module of the crate of all tests"
)]
mod ports;

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use tread_agent::sim::scenario::Scenario;
use tread_api::ids::{BootId, MissionId, RobotId, SiteId};
use tread_api::keys::{self, Key, Verb};
use tread_api::mission::LinkPolicy;
use tread_api::safety::Geofence;
use tread_api::site::Grid;
use tread_api::terrain::{TerrainRef, TerrainShape};
use tread_api::trajectory::Trajectory;
use tread_api::wire::command::Offer;
use tread_api::wire::encoding::Encoding;
use tread_api::wire::hello::{Hello, SiteDefinition, Welcome};
use tread_api::wire::ingest::{Batch, MissionPhase, Receipt, Record, RecordContent};
use tread_api::wire::reply::{Answer, Command, OfferReply};
use tread_api::wire::state::{FrictionReport, PULSE_PERIOD_MS, RobotState, ServerPulse};
use tread_api::wire::{self, Refusal, RefusalCode};
use uuid::Uuid;
use zenoh::Wait;
use zenoh::query::{ConsolidationMode, Query};
use zenoh::sample::SampleKind;

pub(crate) use self::ports::free_address;

/// Longest wait for anything in these tests.
pub(crate) const WAIT_MAX: Duration = Duration::from_secs(30);

/// Waits until a condition holds, and says what was seen last if it does not.
pub(crate) async fn eventually<T: std::fmt::Debug>(
    what: &str,
    mut look: impl FnMut() -> Result<T, String>,
) -> T {
    let mut seen = String::new();
    let waiting = async {
        loop {
            match look() {
                Ok(found) => return found,
                Err(now) => seen = now,
            }
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    };
    let found = tokio::time::timeout(WAIT_MAX, waiting).await;
    found.unwrap_or_else(|_| panic!("waited in vain until {what}; last seen: {seen}"))
}

/// What the fake server remembers; it outlives the router.
#[derive(Debug, Default)]
pub(crate) struct Memory {
    pub(crate) hellos: Vec<Hello>,
    /// Every record by its name, and how often it came.
    pub(crate) records: BTreeMap<(BootId, u64), (RecordContent, usize)>,
    /// The encoding of each upload that was read.
    pub(crate) encodings: Vec<Encoding>,
    pub(crate) states: Vec<RobotState>,
    pub(crate) frictions: Vec<FrictionReport>,
    /// The robot's clock in each batch.
    pub(crate) batch_times: Vec<Option<jiff::Timestamp>>,
    pub(crate) alive: Vec<BootId>,
    pub(crate) gone: Vec<BootId>,
}

impl Memory {
    pub(crate) fn phases(&self, mission: MissionId) -> Vec<MissionPhase> {
        let reports = self
            .records
            .values()
            .filter_map(|(content, _)| match content {
                RecordContent::Mission(report) if report.mission == mission => Some(report),
                RecordContent::Mission(_) | RecordContent::Segment(_) => None,
            });
        let mut reports: Vec<_> = reports.collect();
        reports.sort_by_key(|report| report.at);
        reports.into_iter().map(|report| report.phase).collect()
    }

    pub(crate) fn segments(&self) -> usize {
        let is_segment = |content: &RecordContent| matches!(content, RecordContent::Segment(_));
        self.records
            .values()
            .filter(|(content, _)| is_segment(content))
            .count()
    }
}

pub(crate) type SharedMemory = Arc<Mutex<Memory>>;

/// The router, with the server's queryables.
pub(crate) struct FakeServer {
    session: zenoh::Session,
    site: SiteId,
    /// Receipts that are not sent although the records were kept.
    pub(crate) receipts_to_lose: Arc<AtomicUsize>,
    /// Batches with the start of a mission in them are refused as a whole.
    pub(crate) refuses_starts: Arc<AtomicBool>,
    /// Uploads in CBOR are refused, as by an older server, which takes them for broken JSON.
    pub(crate) reads_json_alone: Arc<AtomicBool>,
}

pub(crate) fn site_of(scenario: &Scenario) -> SiteDefinition {
    let shapes = scenario.terrains.iter().map(|terrain| TerrainShape {
        terrain: TerrainRef {
            id: terrain.id.clone(),
            revision: 1,
        },
        polygon: terrain.outline().unwrap(),
        layer: terrain.layer,
    });
    SiteDefinition {
        grid: Grid {
            revision: 1,
            cell_m: scenario.cell_m,
        },
        terrain_revision: 5,
        terrains: shapes.collect(),
        geofence: Geofence::default(),
    }
}

impl FakeServer {
    pub(crate) fn start(port: u16, scenario: &Scenario, memory: &SharedMemory) -> Self {
        Self::start_with_site(port, scenario, memory, site_of(scenario))
    }

    /// A server that welcomes robots with this definition of their site.
    pub(crate) fn start_with_site(
        port: u16,
        scenario: &Scenario,
        memory: &SharedMemory,
        definition: SiteDefinition,
    ) -> Self {
        let mut config = zenoh::Config::default();
        for (key, value) in [
            ("mode", "\"router\"".to_owned()),
            ("listen/endpoints", format!("[\"tcp/127.0.0.1:{port}\"]")),
            ("scouting/multicast/enabled", "false".to_owned()),
            ("scouting/gossip/enabled", "false".to_owned()),
        ] {
            config.insert_json5(key, &value).unwrap();
        }
        let session = zenoh::open(config).wait().unwrap();
        let receipts_to_lose = Arc::new(AtomicUsize::new(0));
        let refuses_starts = Arc::new(AtomicBool::new(false));
        let server = Self {
            session,
            site: scenario.site.clone(),
            receipts_to_lose,
            refuses_starts,
            reads_json_alone: Arc::new(AtomicBool::new(false)),
        };
        server.declare(definition, memory);
        server
    }

    fn declare(&self, definition: SiteDefinition, memory: &SharedMemory) {
        let session = &self.session;
        let welcome = Welcome {
            site: definition,
            server_time: jiff::Timestamp::UNIX_EPOCH,
            upload_encodings: vec![Encoding::Other, Encoding::Cbor],
        };
        let welcome = wire::encode(&welcome).unwrap();
        let (kept, answer) = (Arc::clone(memory), welcome);
        session
            .declare_queryable(keys::ALL_HELLOS)
            .complete(true)
            .callback(move |query| {
                kept.lock().unwrap().hellos.push(read(&query));
                query
                    .reply(query.key_expr().clone(), answer.clone())
                    .wait()
                    .unwrap();
            })
            .background()
            .wait()
            .unwrap();
        self.declare_ingest(memory);
        let kept = Arc::clone(memory);
        session
            .declare_subscriber("tread/*/robots/*/*")
            .callback(move |sample| {
                let bytes = sample.payload().to_bytes();
                let mut memory = kept.lock().unwrap();
                match Key::parse(sample.key_expr().as_str()) {
                    Some(Key::State(..)) => memory.states.push(wire::decode(&bytes).unwrap()),
                    Some(Key::Friction(..)) => memory.frictions.push(wire::decode(&bytes).unwrap()),
                    Some(Key::Teleop(..)) => {}
                    other => panic!("published on {other:?}"),
                }
            })
            .background()
            .wait()
            .unwrap();
        let kept = Arc::clone(memory);
        session
            .liveliness()
            .declare_subscriber(keys::ALL_ALIVE)
            .history(true)
            .callback(move |sample| {
                let Some(Key::Alive(_, _, boot)) = Key::parse(sample.key_expr().as_str()) else {
                    panic!("no token: {}", sample.key_expr());
                };
                let mut memory = kept.lock().unwrap();
                match sample.kind() {
                    SampleKind::Put => memory.alive.push(boot),
                    SampleKind::Delete => memory.gone.push(boot),
                }
            })
            .background()
            .wait()
            .unwrap();
    }

    /// Answers uploads.
    fn declare_ingest(&self, memory: &SharedMemory) {
        let (kept, to_lose) = (Arc::clone(memory), Arc::clone(&self.receipts_to_lose));
        let refuses_starts = Arc::clone(&self.refuses_starts);
        let reads_json_alone = Arc::clone(&self.reads_json_alone);
        self.session
            .declare_queryable(keys::ALL_INGEST)
            .complete(true)
            .callback(move |query| {
                let media_type = query.encoding().unwrap().to_string();
                let encoding = if reads_json_alone.load(Ordering::SeqCst) {
                    Encoding::Json
                } else {
                    Encoding::of_media_type(&media_type)
                };
                let payload = query.payload().unwrap().to_bytes();
                let batch: Batch = match wire::decode_as(encoding, &payload) {
                    Ok(batch) => batch,
                    Err(error) => {
                        let payload = wire::encode(&Refusal::from(&error)).unwrap();
                        query.reply_err(payload).wait().unwrap();
                        return;
                    }
                };
                kept.lock().unwrap().encodings.push(encoding);
                if refuses_starts.load(Ordering::SeqCst) && batch.records.iter().any(is_start) {
                    let refusal = Refusal {
                        code: RefusalCode::Malformed,
                        detail: "on purpose".to_owned(),
                    };
                    let payload = wire::encode(&refusal).unwrap();
                    query.reply_err(payload).wait().unwrap();
                    return;
                }
                let receipt = keep(&mut kept.lock().unwrap(), batch);
                let lose = |left: usize| left.checked_sub(1);
                if to_lose
                    .fetch_update(Ordering::SeqCst, Ordering::SeqCst, lose)
                    .is_err()
                {
                    let payload = wire::encode(&receipt).unwrap();
                    query
                        .reply(query.key_expr().clone(), payload)
                        .wait()
                        .unwrap();
                }
            })
            .background()
            .wait()
            .unwrap();
    }

    /// Sends the payload of a command as it stands, and gives that of the reply; `None` when
    /// nobody answers.
    pub(crate) async fn ask(
        &self,
        robot: &RobotId,
        verb: Verb,
        payload: Vec<u8>,
    ) -> Option<Result<Vec<u8>, Refusal>> {
        let replies = self
            .session
            .get(keys::command(&self.site, robot, verb))
            .payload(payload)
            .consolidation(ConsolidationMode::None)
            .timeout(Duration::from_secs(5))
            .await
            .unwrap();
        let reply = replies.recv_async().await.ok()?;
        Some(match reply.into_result() {
            Ok(sample) => Ok(sample.payload().to_bytes().into_owned()),
            Err(error) => Err(wire::decode(&error.payload().to_bytes()).unwrap()),
        })
    }

    /// Sends a command, which must be answered.
    pub(crate) async fn send<C: Command>(&self, robot: &RobotId, command: &C) -> C::Reply {
        let payload = wire::encode(command).unwrap();
        let answer = self.ask(robot, C::VERB, payload).await;
        let answer = answer.expect("no answer").expect("refused");
        wire::decode::<Answer<C::Reply>>(&answer).unwrap().reply
    }

    /// Publishes, as the server or another program would.
    pub(crate) async fn publish(&self, key: &str, payload: Vec<u8>) {
        self.session.put(key, payload).await.unwrap();
    }

    /// Lets the robots hear the server until the task is dropped.
    pub(crate) fn pulse(&self) -> tokio::task::JoinHandle<()> {
        let pulse = ServerPulse {
            trust: None,
            server_time: jiff::Timestamp::UNIX_EPOCH,
        };
        self.repeat(wire::encode(&pulse).unwrap())
    }

    /// Publishes the pulse of a server of the next wire version until the task is dropped.
    pub(crate) fn pulse_of_another_version(&self) -> tokio::task::JoinHandle<()> {
        let version = wire::VERSION + 1;
        self.repeat(format!(r#"{{"v":{version},"body":{{}}}}"#).into_bytes())
    }

    /// Publishes a payload as the server's pulse until the task is dropped.
    fn repeat(&self, pulse: Vec<u8>) -> tokio::task::JoinHandle<()> {
        let (session, key) = (self.session.clone(), keys::pulse(&self.site));
        #[expect(clippy::disallowed_methods, reason = "a test has no supervisor")]
        tokio::spawn(async move {
            loop {
                session.put(&key, pulse.clone()).await.unwrap();
                tokio::time::sleep(Duration::from_millis(PULSE_PERIOD_MS)).await;
            }
        })
    }

    pub(crate) async fn offer(&self, robot: &RobotId, offer: &Offer) -> OfferReply {
        self.send(robot, offer).await
    }

    pub(crate) async fn stop(self) {
        self.session.close().await.unwrap();
    }
}

fn is_start(record: &Record) -> bool {
    match &record.content {
        RecordContent::Mission(report) => report.phase == MissionPhase::Started,
        RecordContent::Segment(_) => false,
    }
}

fn read<T: serde::de::DeserializeOwned>(query: &Query) -> T {
    wire::decode(&query.payload().unwrap().to_bytes()).unwrap()
}

fn keep(memory: &mut Memory, batch: Batch) -> Receipt {
    let mut receipt = Receipt {
        committed: 0,
        duplicates: 0,
        refused: Vec::new(),
    };
    assert!(
        batch
            .records
            .windows(2)
            .all(|pair| pair[0].seq < pair[1].seq)
    );
    memory.batch_times.push(batch.robot_time);
    for record in batch.records {
        let name = (batch.boot, record.seq);
        let kept = memory
            .records
            .entry(name)
            .or_insert((record.content.clone(), 0));
        assert_eq!(kept.0, record.content, "one name, two contents");
        kept.1 += 1;
        if kept.1 == 1 {
            receipt.committed += 1;
        } else {
            receipt.duplicates += 1;
        }
    }
    receipt
}

pub(crate) fn offer(number: u128, asked: &str) -> Offer {
    let mission = MissionId::from_uuid(Uuid::from_u128(number));
    let trajectory: Trajectory = serde_json::from_str(asked).unwrap();
    let plan_hash = Offer::plan_hash_of(mission, 1, &trajectory);
    Offer {
        mission,
        revision: 1,
        plan_hash,
        trajectory,
        start_within_ms: Some(10_000),
        link_policy: LinkPolicy::default(),
        prior: None,
        on_hold: false,
    }
}
