//! Floods by robots that have a valid certificate, each with a session of its own.

use jiff::Timestamp;
use tokio::task::JoinSet;
use tokio::time::Instant;
use tread_api::ids::{BootId, ConfigurationId, StopId};
use tread_api::keys;
use tread_api::robot::{AlertReport, Severity};
use tread_api::safety::StopLatch;
use tread_api::wire::ingest::{Batch, RecordContent};
use tread_api::wire::{self};
use tread_tests::light_robot::{LightRobot, now};
use uuid::Uuid;
use zenoh::Wait as _;
use zenoh::handlers::FifoChannel;
use zenoh::liveliness::LivelinessToken;
use zenoh::qos::CongestionControl;

use super::attackers::{Outcome, Plan};
use crate::pace::Pace;

/// How long questions of a flood stay open, of which nobody reads the answers.
const QUESTION_TIMEOUT: std::time::Duration = std::time::Duration::from_secs(2);
/// Liveliness tokens of one robot.
const TOKENS: u64 = 23_000;
/// As fast as the machine can.
const ALL_IT_CAN_HZ: f64 = 1e9;

/// What a robot floods with.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Flood {
    /// States with a stop of its own, each another one.
    ForgedStops,
    /// Introductions, the answers of which nobody waits for.
    Hellos,
    /// States that do not read.
    MalformedStates,
    /// What is worth a line of the log: what is damaged, or names another robot.
    Provocations,
    /// Uploads of a run of the agent that nobody knew, each another one.
    Boots,
    /// Uploads of a configuration that nobody knew, each another one.
    Configurations,
    /// Alerts, each another one.
    Alerts,
    /// Liveliness tokens of new runs.
    Tokens,
    /// Measurements of μ = 10.
    ImpossibleFriction,
}

impl Flood {
    /// All of them.
    pub(super) const ALL: [Self; 9] = [
        Self::ForgedStops,
        Self::Hellos,
        Self::MalformedStates,
        Self::Provocations,
        Self::Boots,
        Self::Configurations,
        Self::Alerts,
        Self::Tokens,
        Self::ImpossibleFriction,
    ];

    const fn words(self) -> (&'static str, &'static str) {
        match self {
            Self::ForgedStops => ("stops that a robot makes up", "states"),
            Self::Hellos => ("introductions", "asked"),
            Self::MalformedStates => ("malformed states", "put"),
            Self::Provocations => ("what provokes the log", "sent"),
            Self::Boots => ("new boots", "uploads"),
            Self::Configurations => ("new configurations", "uploads"),
            Self::Alerts => ("new alerts", "states"),
            Self::Tokens => ("liveliness tokens", "declared"),
            Self::ImpossibleFriction => ("measurements of mu = 10", "uploads"),
        }
    }

    const fn hz(self) -> f64 {
        match self {
            Self::ForgedStops => 700.0 / 15.0,
            Self::Hellos => 384.0,
            Self::MalformedStates | Self::Tokens => ALL_IT_CAN_HZ,
            Self::Provocations => 1_000.0,
            Self::Boots => 19_592.0 / 15.0,
            Self::Configurations => 2_996.0 / 15.0,
            Self::Alerts => 3_076.0 / 15.0,
            Self::ImpossibleFriction => 5.0,
        }
    }
}

/// Connects one robot for each flood.
pub(super) async fn connect(plan: &Plan) -> anyhow::Result<Vec<(Flood, LightRobot)>> {
    let mut connected = Vec::new();
    for (flood, membership) in Flood::ALL.into_iter().zip(&plan.robots) {
        if !plan.has(flood.words().0) {
            continue;
        }
        let robot = LightRobot::start_secure(&plan.endpoint, membership).await?;
        connected.push((flood, robot));
    }
    Ok(connected)
}

/// Starts all of them.
pub(super) fn spawn(
    floods: &mut JoinSet<Outcome>,
    robots: Vec<(Flood, LightRobot)>,
    until: Instant,
) {
    for (flood, robot) in robots {
        // zenoh's calls block their thread.
        floods.spawn_blocking(move || Flooder::new(flood, robot).run(until));
    }
}

struct Flooder {
    flood: Flood,
    robot: LightRobot,
    tokens: Vec<LivelinessToken>,
    number: u64,
}

impl Flooder {
    fn new(flood: Flood, robot: LightRobot) -> Self {
        Self {
            flood,
            robot,
            tokens: Vec::new(),
            number: 0,
        }
    }

    fn run(mut self, until: Instant) -> Outcome {
        let (flood, of) = self.flood.words();
        let mut pace = Pace::new(self.flood.hz(), until);
        let (mut count, mut failed) = (0, 0_u64);
        'flooding: while let Some(due) = pace.due_blocking() {
            for _ in 0..due {
                if Instant::now() >= until || (self.flood == Flood::Tokens && count >= TOKENS) {
                    break 'flooding;
                }
                self.number += 1;
                match self.send() {
                    Ok(()) => count += 1,
                    Err(_) => failed += 1,
                }
            }
        }
        // Tokens stay for as long as the others flood.
        std::thread::sleep(until.saturating_duration_since(Instant::now()));
        let is_unbounded = self.flood.hz() >= ALL_IT_CAN_HZ;
        Outcome {
            flood,
            of,
            count,
            wanted_per_s: (!is_unbounded).then(|| self.flood.hz()),
            notes: if failed > 0 {
                format!("{failed} not sent")
            } else {
                String::new()
            },
        }
    }

    fn put(&self, key: String, payload: Vec<u8>) -> zenoh::Result<()> {
        let put = self.robot.session.put(key, payload);
        put.congestion_control(CongestionControl::Drop).wait()
    }

    fn ask(&self, key: String, payload: Vec<u8>) -> zenoh::Result<()> {
        let asked = self.robot.session.get(key).payload(payload);
        let asked = asked.timeout(QUESTION_TIMEOUT).with(FifoChannel::new(1));
        asked.wait().map(drop)
    }

    fn upload(&mut self, change: impl FnOnce(&mut Batch)) -> zenoh::Result<()> {
        let mut batch = self.robot.next_batch(1);
        change(&mut batch);
        let key = keys::ingest(&self.robot.site, &self.robot.id);
        self.ask(key, wire::encode(&batch)?)
    }

    fn send(&mut self) -> zenoh::Result<()> {
        let (site, id) = (self.robot.site.clone(), self.robot.id.clone());
        match self.flood {
            Flood::ForgedStops => {
                let mut state = self.robot.next_state();
                state.safety.stop = Some(forged_stop(now()));
                self.put(keys::state(&site, &id), wire::encode(&state)?)
            }
            Flood::Alerts => {
                let mut state = self.robot.next_state();
                state.alerts = vec![AlertReport {
                    code: format!("made-up-{}", self.number).parse()?,
                    severity: Severity::Critical,
                    text: "x".repeat(300),
                }];
                self.put(keys::state(&site, &id), wire::encode(&state)?)
            }
            Flood::Hellos => self.ask(keys::hello(&site, &id), b"no introduction".to_vec()),
            Flood::MalformedStates => self.put(
                keys::state(&site, &id),
                b"{\"v\":2,\"body\":{\"robot\"".to_vec(),
            ),
            Flood::Provocations => {
                let number = self.number;
                let words = format!("{{\"v\":2,\"body\":\"line\\n{number} \u{1b}[31m of a log\"}}");
                match number % 4 {
                    0 => self.put(keys::friction(&site, &id), words.into_bytes()),
                    1 => self.ask(keys::ingest(&site, &id), words.into_bytes()),
                    2 => {
                        let other = format!("other-{number}").parse()?;
                        self.upload(|batch| batch.robot = other)
                    }
                    _ => {
                        let version = format!("{{\"v\":{number},\"body\":{{}}}}");
                        self.put(keys::state(&site, &id), version.into_bytes())
                    }
                }
            }
            Flood::Boots => self.upload(|batch| batch.boot = BootId::from_uuid(Uuid::new_v4())),
            Flood::Configurations => self.upload(|batch| {
                for record in &mut batch.records {
                    if let RecordContent::Segment(segment) = &mut record.content {
                        segment.configuration = ConfigurationId::from_uuid(Uuid::new_v4());
                    }
                }
            }),
            Flood::Tokens => {
                let boot = BootId::from_uuid(Uuid::new_v4());
                let token = self.robot.session.liveliness();
                let token = token.declare_token(keys::alive(&site, &id, boot)).wait()?;
                self.tokens.push(token);
                Ok(())
            }
            Flood::ImpossibleFriction => self.upload(|batch| {
                for record in &mut batch.records {
                    if let RecordContent::Segment(segment) = &mut record.content {
                        segment.mu_peak_lower_bound = Some(10.0);
                    }
                }
            }),
        }
    }
}

fn forged_stop(since: Timestamp) -> StopLatch {
    StopLatch {
        id: StopId::from_uuid(Uuid::new_v4()),
        by: "nobody".to_owned(),
        reason: "made up".to_owned(),
        since,
    }
}
