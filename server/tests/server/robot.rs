//! A robot whose every word the test chooses.

mod answers;

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use serde::de::DeserializeOwned;
use tokio::time::Instant;
use tread_api::ids::{BootId, MissionId, RobotId};
use tread_api::keys::{self, Verb};
use tread_api::mission::Mission;
use tread_api::robot::{Capabilities, LoopStatus, MissionProgress, OutboxStatus, RobotMode};
use tread_api::safety::SafetyStatus;
use tread_api::wire::command::{Cancel, Offer, Outcomes};
use tread_api::wire::hello::{Hello, SiteDefinition, Welcome};
use tread_api::wire::ingest::{Batch, MissionPhase, Receipt, Record};
use tread_api::wire::reply::{CommandRefusalCode, EndedMission, MissionOutcomes};
use tread_api::wire::safety::{ClearStop, DriveCommand, ExternalLimit, LeaseCommand, Stop};
use tread_api::wire::state::{RobotState, StateRate};
use tread_api::wire::{self, Refusal};
use tread_server::supervisor::Supervisor;
use uuid::Uuid;
use zenoh::Wait as _;

use self::answers::answer;
use crate::harness::{PATIENCE, Yard, ask, eventually, model, report, site, time};

/// What a played robot answers to an offer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Mood {
    Willing,
    Refusing(CommandRefusalCode),
    Silent,
    /// Takes a pause and goes on braking for it.
    Braking,
}

#[derive(Debug)]
struct Heard {
    mood: Mood,
    offers: Vec<Offer>,
    cancels: Vec<Cancel>,
    holds: Vec<Verb>,
    sites: Vec<SiteDefinition>,
    stops: Vec<Stop>,
    clears: Vec<ClearStop>,
    leases: Vec<LeaseCommand>,
    limits: Vec<ExternalLimit>,
    drives: Vec<DriveCommand>,
    state_rates: Vec<(Instant, StateRate)>,
    deaf_to_stops: bool,
    deaf_to_state_rates: bool,
    stops_are_over: bool,
    epoch: u64,
    outcomes_asked: Vec<Outcomes>,
    /// What it says of missions that ended; `None` is silence.
    remembered: Option<MissionOutcomes>,
}

/// A robot on the network that says what the test tells it to.
pub(crate) struct Robot {
    pub(crate) id: RobotId,
    pub(crate) boot: BootId,
    session: zenoh::Session,
    state: Arc<Mutex<RobotState>>,
    heard: Arc<Mutex<Heard>>,
    beating: Arc<AtomicBool>,
    shows_lease: Arc<AtomicBool>,
    _token: zenoh::liveliness::LivelinessToken,
    supervisor: Supervisor,
}

impl Drop for Robot {
    fn drop(&mut self) {
        self.supervisor.stop_token().cancel();
        let _ = self.session.close().wait();
    }
}

/// A session of a client of the server's router.
pub(crate) async fn session(yard: &Yard) -> zenoh::Session {
    let mut config = zenoh::Config::default();
    let endpoint = format!("[\"{}\"]", yard.server.zenoh_endpoint());
    for (key, value) in [
        ("mode", "\"client\""),
        ("connect/endpoints", endpoint.as_str()),
        (
            "connect/retry",
            "{ period_init_ms: 50, period_max_ms: 200, period_increase_factor: 1.5 }",
        ),
        ("scouting/multicast/enabled", "false"),
        ("scouting/gossip/enabled", "false"),
    ] {
        config.insert_json5(key, value).unwrap();
    }
    let opening = tokio::task::spawn_blocking(move || zenoh::open(config).wait());
    tokio::time::timeout(PATIENCE, opening)
        .await
        .unwrap()
        .unwrap()
        .unwrap()
}

/// What a robot says first, with that many records in its store.
pub(crate) fn first_state(id: &RobotId, boot: BootId, pending: u64) -> RobotState {
    RobotState {
        robot: id.clone(),
        boot,
        seq: 0,
        robot_time: time("2026-11-01T00:00:00Z"),
        mode: RobotMode::Idle,
        fault: None,
        pose: None,
        twist: None,
        mission: None,
        terrain_revision: None,
        outbox: OutboxStatus {
            pending,
            ..OutboxStatus::default()
        },
        control_loop: LoopStatus::default(),
        battery: None,
        alerts: Vec::new(),
        leaving: false,
        monotonic_us: None,
        safety: SafetyStatus::default(),
    }
}

impl Robot {
    pub(crate) async fn join(yard: &Yard, id: &str) -> Self {
        Self::join_with_pending(yard, id, 0).await
    }

    /// Joins with that many records in its store.
    pub(crate) async fn join_with_pending(yard: &Yard, id: &str, pending: u64) -> Self {
        let id: RobotId = id.parse().unwrap();
        let boot = BootId::from_uuid(Uuid::new_v4());
        let session = session(yard).await;
        let heard = Arc::new(Mutex::new(Heard {
            mood: Mood::Willing,
            offers: Vec::new(),
            cancels: Vec::new(),
            holds: Vec::new(),
            sites: Vec::new(),
            stops: Vec::new(),
            clears: Vec::new(),
            leases: Vec::new(),
            limits: Vec::new(),
            drives: Vec::new(),
            state_rates: Vec::new(),
            deaf_to_stops: false,
            deaf_to_state_rates: false,
            stops_are_over: false,
            epoch: 0,
            outcomes_asked: Vec::new(),
            remembered: Some(MissionOutcomes {
                ended: Vec::new(),
                active: None,
                forgotten: None,
            }),
        }));
        let state = Arc::new(Mutex::new(first_state(&id, boot, pending)));
        let (listener, holding) = (Arc::clone(&heard), Arc::clone(&state));
        session
            .declare_queryable(keys::commands(&site(), &id))
            .complete(true)
            .callback(move |query| answer(&query, boot, &listener, &holding))
            .background()
            .wait()
            .unwrap();
        let driven = Arc::clone(&heard);
        session
            .declare_subscriber(keys::teleop(&site(), &id))
            .callback(move |sample| {
                let command = wire::decode(&sample.payload().to_bytes()).unwrap();
                driven.lock().unwrap().drives.push(command);
            })
            .background()
            .wait()
            .unwrap();
        let token = session
            .liveliness()
            .declare_token(keys::alive(&site(), &id, boot))
            .wait()
            .unwrap();
        let publisher = session
            .declare_publisher(keys::state(&site(), &id))
            .wait()
            .unwrap();
        let said = Arc::clone(&state);
        let beating = Arc::new(AtomicBool::new(true));
        let beats = Arc::clone(&beating);
        let shows_lease = Arc::new(AtomicBool::new(true));
        let is_lease_shown = Arc::clone(&shows_lease);
        let supervisor = Supervisor::new();
        let stop = supervisor.stop_token();
        let clock = Instant::now();
        supervisor.spawn_vital("speaking", async move {
            while !stop.is_cancelled() {
                let payload = {
                    let mut state = said.lock().unwrap();
                    state.seq += 1;
                    // Its clock goes, and is weeks behind.
                    state.robot_time = time("2026-11-01T00:00:00Z") + clock.elapsed();
                    state.monotonic_us = Some(u64::try_from(clock.elapsed().as_micros()).unwrap());
                    state.control_loop.ticks += u64::from(beats.load(Ordering::Relaxed));
                    let mut sent = state.clone();
                    let is_hidden = !is_lease_shown.load(Ordering::Relaxed);
                    sent.safety.lease.take_if(|_| is_hidden);
                    wire::encode(&sent).unwrap()
                };
                let _ = publisher.put(payload).wait();
                tokio::time::sleep(Duration::from_millis(50)).await;
            }
        });
        let robot = Self {
            id,
            boot,
            session,
            state,
            heard,
            beating,
            shows_lease,
            _token: token,
            supervisor,
        };
        robot.hello().await;
        robot.is_seen(yard).await;
        robot
    }

    /// Waits until the server has a state of this run: its clock alone dates limits and leases.
    async fn is_seen(&self, yard: &Yard) {
        let path = format!("/v1/sites/{}/robots/{}", site(), self.id);
        eventually("the server has the robot's state", async || {
            let (_, found) = yard.get_value(&path).await;
            let boot = found["live"]["boot"].as_str();
            let is_seen = boot == Some(self.boot.to_string().as_str());
            if is_seen { Ok(()) } else { Err(found) }
        })
        .await;
    }

    /// Ends this run of the agent and begins another, which remembers nothing.
    pub(crate) async fn reboot(self, yard: &Yard) -> Self {
        let id = self.id.clone();
        drop(self);
        Self::join(yard, id.as_str()).await
    }

    /// Introduces itself until it is answered.
    pub(crate) async fn hello(&self) -> Welcome {
        let hello = Hello {
            robot: self.id.clone(),
            boot: self.boot,
            agent_version: "0.0.1".to_owned(),
            model: model(),
            robot_time: time("2026-11-01T00:00:00Z"),
            capabilities: Capabilities {
                pause: true,
                replace: true,
                stop: true,
                teleop: true,
                ..Capabilities::default()
            },
        };
        let welcome: Welcome = eventually("the server answers a hello", async || {
            self.ask(
                keys::hello(&site(), &self.id),
                wire::encode(&hello).unwrap(),
            )
            .await
        })
        .await;
        self.say(|state| {
            state.terrain_revision = Some(welcome.site.terrain_revision);
            state.safety.fence_revision = Some(welcome.site.geofence.revision);
        });
        welcome
    }

    /// Sends a query and reads its reply; `Err(None)` is no reply.
    pub(crate) async fn ask<T: DeserializeOwned + Send + 'static>(
        &self,
        key: String,
        payload: Vec<u8>,
    ) -> Result<T, Option<Refusal>> {
        ask(&self.session, key, payload).await
    }

    pub(crate) fn say(&self, change: impl FnOnce(&mut RobotState)) {
        change(&mut self.state.lock().unwrap());
    }

    pub(crate) fn set_mood(&self, mood: Mood) {
        self.heard.lock().unwrap().mood = mood;
    }

    pub(crate) fn offers(&self) -> Vec<Offer> {
        self.heard.lock().unwrap().offers.clone()
    }

    pub(crate) fn sites(&self) -> Vec<SiteDefinition> {
        self.heard.lock().unwrap().sites.clone()
    }

    /// Lets it hear no stop, or hear them again.
    pub(crate) fn be_deaf_to_stops(&self, deaf: bool) {
        self.heard.lock().unwrap().deaf_to_stops = deaf;
    }

    /// Lets it say of every stop that it was in force and has been cleared.
    pub(crate) fn call_stops_over(&self) {
        self.heard.lock().unwrap().stops_are_over = true;
    }

    pub(crate) fn stops(&self) -> Vec<Stop> {
        self.heard.lock().unwrap().stops.clone()
    }

    pub(crate) fn leases(&self) -> Vec<LeaseCommand> {
        self.heard.lock().unwrap().leases.clone()
    }

    pub(crate) fn limits(&self) -> Vec<ExternalLimit> {
        self.heard.lock().unwrap().limits.clone()
    }

    pub(crate) fn drives(&self) -> Vec<DriveCommand> {
        self.heard.lock().unwrap().drives.clone()
    }

    /// The requested state rates, with the time of each.
    pub(crate) fn state_rates(&self) -> Vec<(Instant, StateRate)> {
        self.heard.lock().unwrap().state_rates.clone()
    }

    /// Lets it know no state rates, as an agent of an older release.
    pub(crate) fn be_deaf_to_state_rates(&self) {
        self.heard.lock().unwrap().deaf_to_state_rates = true;
    }

    pub(crate) fn state(&self) -> RobotState {
        self.state.lock().unwrap().clone()
    }

    /// Lets its states arrive as if a lease had been granted after each of them.
    pub(crate) fn show_no_lease(&self) {
        self.shows_lease.store(false, Ordering::Relaxed);
    }

    /// Lets the control loop stand still while the agent speaks on.
    pub(crate) fn stop_loop(&self) {
        self.beating.store(false, Ordering::Relaxed);
    }

    /// Lets it go on.
    pub(crate) fn start_loop(&self) {
        self.beating.store(true, Ordering::Relaxed);
    }

    pub(crate) fn holds(&self) -> Vec<Verb> {
        self.heard.lock().unwrap().holds.clone()
    }

    pub(crate) fn cancels(&self) -> Vec<Cancel> {
        self.heard.lock().unwrap().cancels.clone()
    }

    pub(crate) async fn upload_as(
        &self,
        boot: BootId,
        records: Vec<Record>,
    ) -> Result<Receipt, Option<Refusal>> {
        let batch = Batch {
            robot: self.id.clone(),
            boot,
            robot_time: None,
            records,
        };
        let key = keys::ingest(&site(), &self.id);
        self.ask(key, wire::encode(&batch).unwrap()).await
    }

    pub(crate) async fn upload(&self, records: Vec<Record>) -> Result<Receipt, Option<Refusal>> {
        self.upload_as(self.boot, records).await
    }

    /// Reports on a mission by the acknowledged way.
    pub(crate) async fn report(&self, seq: u64, mission: &Mission, phase: MissionPhase) -> Receipt {
        let ends = !matches!(
            phase,
            MissionPhase::Started
                | MissionPhase::Paused
                | MissionPhase::Resumed
                | MissionPhase::Replaced
        );
        if ends {
            self.say(|state| {
                state.mode = RobotMode::Idle;
                state.mission = None;
            });
        }
        self.upload(vec![Record {
            seq,
            content: report(mission, phase),
        }])
        .await
        .unwrap()
    }

    /// Lets it remember that missions ended, and that it has forgotten those up to one.
    pub(crate) fn remember(
        &self,
        ended: &[(MissionId, MissionPhase)],
        forgotten: Option<MissionId>,
    ) {
        let ended = ended.iter();
        let ended = ended.map(|&(mission, phase)| EndedMission { mission, phase });
        self.heard.lock().unwrap().remembered = Some(MissionOutcomes {
            ended: ended.collect(),
            active: None,
            forgotten,
        });
    }

    /// Lets it not know the question how missions ended, as an older agent.
    pub(crate) fn be_deaf_to_outcomes(&self) {
        self.heard.lock().unwrap().remembered = None;
    }

    /// How often it was asked how missions ended.
    pub(crate) fn outcomes_asked(&self) -> usize {
        self.heard.lock().unwrap().outcomes_asked.len()
    }

    /// Shows in its state that it drives a mission.
    pub(crate) fn drive(&self, mission: &Mission, driven_m: f64) {
        let progress = MissionProgress {
            id: mission.id,
            revision: mission.revision,
            plan_hash: mission.plan_hash,
            driven_m,
            length_m: 18.85,
            cross_track_m: 0.0,
            paused: false,
            paused_by: None,
        };
        self.say(|state| {
            state.mode = RobotMode::Tracking;
            state.mission = Some(progress);
        });
    }
}
