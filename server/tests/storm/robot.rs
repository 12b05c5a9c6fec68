//! A robot of few lines: what any agent must do about missions, and nothing else.

use std::collections::{BTreeMap, HashSet, VecDeque};

use serde::Serialize;
use tread_api::ids::{BootId, MissionId, PlanHash, RobotId, StopId};
use tread_api::keys::Verb;
use tread_api::robot::{LoopStatus, MissionProgress, OutboxStatus, PauseCause, RobotMode};
use tread_api::safety::{Driver, Lease, SafetyStatus, StopLatch};
use tread_api::wire;
use tread_api::wire::command::{Cancel, Offer, Pause};
use tread_api::wire::ingest::{Batch, MissionPhase, MissionReport, Record, RecordContent};
use tread_api::wire::reply::{
    Acknowledgement, Answer, CommandRefusal, CommandRefusalCode, LeaseReply, OfferReply,
};
use tread_api::wire::safety::{AcquireLease, ClearStop, LeaseCommand, ReleaseLease, Stop};
use tread_api::wire::state::RobotState;
use uuid::Uuid;

/// A mission in the robot's hand.
#[derive(Debug, Clone, Copy)]
struct Held {
    mission: MissionId,
    revision: u32,
    plan_hash: PlanHash,
    /// Whether it is to be held; it stands after its next drive.
    to_stand: bool,
    paused: bool,
    paused_by: PauseCause,
    driven_m: f64,
}

/// The robot: what survives its restarts, and what does not.
#[derive(Debug)]
pub(crate) struct Robot {
    pub(crate) id: RobotId,
    pub(crate) boot: BootId,
    pub(crate) on: bool,
    pub(crate) linked: bool,
    held: Option<Held>,
    pub(crate) ended: BTreeMap<MissionId, MissionPhase>,
    /// Survives restarts, as do the stops that were seen.
    stop: Option<StopLatch>,
    stops_seen: HashSet<StopId>,
    lease: Option<Lease>,
    leases: u64,
    outbox: VecDeque<(BootId, Record)>,
    next_record: u64,
    states: u64,
}

const LENGTH_M: f64 = 10.0;

impl Robot {
    pub(crate) fn new(id: RobotId, boot: u64) -> Self {
        Self {
            id,
            boot: boot_id(boot),
            on: true,
            linked: true,
            held: None,
            ended: BTreeMap::new(),
            stop: None,
            stops_seen: HashSet::new(),
            lease: None,
            leases: 0,
            outbox: VecDeque::new(),
            next_record: 0,
            states: 0,
        }
    }

    /// Whether that run of the agent is the present one; none names whatever runs.
    pub(crate) fn is_run(&self, run: Option<BootId>) -> bool {
        run.is_none_or(|run| run == self.boot)
    }

    pub(crate) fn holds(&self) -> Option<MissionId> {
        self.held.map(|held| held.mission)
    }

    /// Whether a stop is in force, or a person drives.
    pub(crate) fn is_operator_controlled(&self) -> bool {
        self.stop.is_some() || self.lease.is_some()
    }

    /// The stop in force.
    pub(crate) fn stopped_by(&self) -> Option<StopId> {
        self.stop.as_ref().map(|latch| latch.id)
    }

    /// Whoever teleoperated is gone; what was paused for it stays paused.
    pub(crate) fn end_lease(&mut self) {
        self.lease = None;
    }

    /// A new run of the agent; what was held is over, and reported only if the robot still could.
    pub(crate) fn restart(&mut self, boot: u64, tells: bool) {
        self.boot = boot_id(boot);
        (self.lease, self.leases) = (None, 0);
        self.next_record = 0;
        self.states = 0;
        if let Some(held) = self.held.take() {
            self.ended.insert(held.mission, MissionPhase::Failed);
            if tells {
                self.record(held, MissionPhase::Failed);
            }
        }
    }

    fn record(&mut self, held: Held, phase: MissionPhase) {
        let report = MissionReport {
            mission: held.mission,
            revision: held.revision,
            plan_hash: held.plan_hash,
            at: "2026-11-01T00:00:00Z".parse().expect("it is a time"),
            phase,
            since: None,
            reason: None,
            progress: None,
            quality: None,
            driven: None,
        };
        let record = Record {
            seq: self.next_record,
            content: RecordContent::Mission(report),
        };
        self.next_record += 1;
        self.outbox.push_back((self.boot, record));
    }

    fn end(&mut self, held: Held, phase: MissionPhase) {
        self.held = None;
        self.ended.insert(held.mission, phase);
        self.record(held, phase);
    }

    /// Drives on; at the end of the way the mission has succeeded, or failed if it is `unlucky`.
    pub(crate) fn drive(&mut self, distance_m: f64, unlucky: bool) {
        let Some(mut held) = self.held.filter(|_| self.on) else {
            return;
        };
        if held.to_stand != held.paused {
            held.paused = held.to_stand;
            self.held = Some(held);
            let (paused, resumed) = (MissionPhase::Paused, MissionPhase::Resumed);
            self.record(held, if held.paused { paused } else { resumed });
        }
        if held.paused {
            return;
        }
        held.driven_m += distance_m;
        self.held = Some(held);
        if unlucky {
            self.end(held, MissionPhase::Failed);
        } else if held.driven_m >= LENGTH_M {
            self.end(held, MissionPhase::Succeeded);
        }
    }

    /// What the robot says of itself now.
    pub(crate) fn state(&mut self) -> RobotState {
        self.states += 1;
        let progress = |held: Held| MissionProgress {
            id: held.mission,
            revision: held.revision,
            plan_hash: held.plan_hash,
            driven_m: held.driven_m.min(LENGTH_M),
            length_m: LENGTH_M,
            cross_track_m: 0.0,
            paused: held.paused,
            paused_by: held.paused.then_some(held.paused_by),
        };
        RobotState {
            robot: self.id.clone(),
            boot: self.boot,
            seq: self.states,
            robot_time: "2026-11-01T00:00:00Z".parse().expect("it is a time"),
            mode: if self.stop.is_some() {
                RobotMode::Stopped
            } else {
                RobotMode::Idle
            },
            fault: None,
            pose: None,
            twist: None,
            mission: self.held.map(progress),
            terrain_revision: None,
            outbox: OutboxStatus {
                pending: self.outbox.len() as u64,
                ..OutboxStatus::default()
            },
            control_loop: LoopStatus {
                ticks: self.states,
                ..LoopStatus::default()
            },
            battery: None,
            alerts: Vec::new(),
            leaving: false,
            monotonic_us: None,
            safety: SafetyStatus {
                stop: self.stop.clone(),
                lease: self.lease.clone(),
                ..SafetyStatus::default()
            },
        }
    }

    /// The oldest records of one run.
    pub(crate) fn batch(&self, records_max: usize) -> Option<Batch> {
        let &(boot, _) = self.outbox.front()?;
        let of_run = self.outbox.iter().take_while(|(of, _)| *of == boot);
        Some(Batch {
            robot: self.id.clone(),
            boot,
            robot_time: None,
            records: of_run
                .take(records_max)
                .map(|(_, record)| record.clone())
                .collect(),
        })
    }

    /// The server has answered for a batch.
    pub(crate) fn answered(&mut self, batch: &Batch) {
        self.outbox.retain(|(boot, record)| {
            *boot != batch.boot || !batch.records.iter().any(|sent| sent.seq == record.seq)
        });
    }

    /// Answers a command: the payload.
    pub(crate) fn answer(&mut self, verb: Verb, payload: &[u8], impossible: bool) -> Vec<u8> {
        match verb {
            Verb::Offer => {
                let offer = wire::decode(payload).expect("an offer");
                let reply = self.offer(&offer, impossible);
                self.says(reply)
            }
            Verb::Cancel => {
                let cancelled = self.cancel(&wire::decode(payload).expect("a cancellation"));
                self.acknowledges(cancelled)
            }
            Verb::Pause | Verb::Resume => {
                let pause: Pause = wire::decode(payload).expect("a pause or a resumption");
                let held = self.hold(&pause, verb == Verb::Pause);
                self.acknowledges(held)
            }
            // No server of the storm was restored, so none asks for outcomes.
            Verb::Site | Verb::StateRate | Verb::Outcomes => self.acknowledges(Ok(())),
            Verb::Stop => {
                let latched = self.latch(wire::decode(payload).expect("a stop"));
                self.acknowledges(latched)
            }
            Verb::Clear => {
                let cleared = self.clear(&wire::decode(payload).expect("a clear"));
                self.acknowledges(cleared)
            }
            Verb::Lease => match wire::decode(payload).expect("a lease") {
                LeaseCommand::Acquire(acquire) => {
                    let reply = LeaseReply::from(self.lend(acquire));
                    self.says(reply)
                }
                LeaseCommand::Release(release) => {
                    self.undo_step(&release);
                    self.acknowledges(Ok(()))
                }
            },
            Verb::Limit => self.acknowledges(refused(CommandRefusalCode::Other)),
        }
    }

    fn acknowledges(&self, decided: Result<(), CommandRefusal>) -> Vec<u8> {
        self.says(Acknowledgement::from(decided))
    }

    fn says<R: Serialize>(&self, reply: R) -> Vec<u8> {
        let boot = self.boot;
        wire::encode(&Answer { boot, reply }).expect("it can be written")
    }

    fn offer(&mut self, offer: &Offer, impossible: bool) -> OfferReply {
        let refuses = |code| OfferReply::Refused(refusal(code));
        if self.ended.contains_key(&offer.mission) {
            return refuses(CommandRefusalCode::Ended);
        }
        let content = (offer.revision, offer.plan_hash);
        let new = Held {
            mission: offer.mission,
            revision: offer.revision,
            plan_hash: offer.plan_hash,
            to_stand: offer.on_hold,
            paused: false,
            paused_by: PauseCause::Request,
            driven_m: 0.0,
        };
        match self.held {
            None if self.is_operator_controlled() => refuses(CommandRefusalCode::NotReady),
            None if impossible => refuses(CommandRefusalCode::Impossible),
            None => {
                self.held = Some(new);
                self.record(new, MissionPhase::Started);
                OfferReply::Accepted { plan: None }
            }
            Some(held) if held.mission != offer.mission => refuses(CommandRefusalCode::Busy),
            Some(held) if (held.revision, held.plan_hash) == content => {
                OfferReply::Accepted { plan: None }
            }
            Some(held) if held.revision < offer.revision && !impossible => {
                let new = Held {
                    to_stand: held.to_stand,
                    paused: held.paused,
                    paused_by: held.paused_by,
                    ..new
                };
                self.held = Some(new);
                self.record(new, MissionPhase::Replaced);
                OfferReply::Accepted { plan: None }
            }
            Some(_) => refuses(CommandRefusalCode::Conflict),
        }
    }

    fn cancel(&mut self, cancel: &Cancel) -> Result<(), CommandRefusal> {
        match self.held.filter(|held| held.mission == cancel.mission) {
            Some(held) => {
                self.end(held, MissionPhase::Cancelled);
                Ok(())
            }
            None => match self.ended.get(&cancel.mission) {
                Some(MissionPhase::Cancelled) => Ok(()),
                Some(_) => refused(CommandRefusalCode::Ended),
                None => {
                    self.ended.insert(cancel.mission, MissionPhase::Cancelled);
                    refused(CommandRefusalCode::Unknown)
                }
            },
        }
    }

    fn hold(&mut self, pause: &Pause, paused: bool) -> Result<(), CommandRefusal> {
        let same = |held: &Held| (held.mission, held.revision) == (pause.mission, pause.revision);
        let Some(held) = self.held.filter(same) else {
            return refused(if self.ended.contains_key(&pause.mission) {
                CommandRefusalCode::Ended
            } else {
                CommandRefusalCode::Unknown
            });
        };
        if !paused && self.stop.is_some() {
            return refused(CommandRefusalCode::Stopped);
        }
        if !paused && self.lease.is_some() {
            return refused(CommandRefusalCode::Leased);
        }
        self.held = Some(Held {
            to_stand: paused,
            paused_by: PauseCause::Request,
            ..held
        });
        Ok(())
    }

    /// Whatever is active stands, and goes on only when it is commanded to.
    fn stand(&mut self, cause: PauseCause) {
        if let Some(held) = &mut self.held {
            (held.to_stand, held.paused_by) = (true, cause);
        }
    }

    fn latch(&mut self, stop: Stop) -> Result<(), CommandRefusal> {
        // The same twice is one stop, also after it was cleared.
        if self.stops_seen.insert(stop.stop) {
            self.stop = Some(StopLatch {
                id: stop.stop,
                by: stop.by,
                reason: stop.reason,
                since: stop.at,
            });
            self.stand(PauseCause::Stop);
        }
        if self.stop.is_none() {
            return refused(CommandRefusalCode::Ended);
        }
        Ok(())
    }

    fn clear(&mut self, clear: &ClearStop) -> Result<(), CommandRefusal> {
        match self.stopped_by() {
            Some(newest) if newest == clear.stop => {
                self.stop = None;
                Ok(())
            }
            Some(_) => refused(CommandRefusalCode::Conflict),
            None if self.stops_seen.contains(&clear.stop) => Ok(()),
            None => refused(CommandRefusalCode::Unknown),
        }
    }

    fn lend(&mut self, asked: AcquireLease) -> Result<u64, CommandRefusal> {
        if !asked.take && self.is_leased_by_other(&asked.holder) {
            return refused(CommandRefusalCode::Leased);
        }
        self.leases += 1;
        self.lease = Some(Lease {
            epoch: self.leases,
            driver: asked.holder,
        });
        self.stand(PauseCause::Teleoperation);
        Ok(self.leases)
    }

    fn undo_step(&mut self, release: &ReleaseLease) {
        if !self.is_leased_by_other(&release.holder) {
            self.lease = None;
        }
    }

    fn is_leased_by_other(&self, driver: &Driver) -> bool {
        let lease = self.lease.as_ref();
        lease.is_some_and(|lease| lease.driver.client != driver.client)
    }
}

fn refusal(code: CommandRefusalCode) -> CommandRefusal {
    CommandRefusal::new(code, "so it is")
}

fn refused<T>(code: CommandRefusalCode) -> Result<T, CommandRefusal> {
    Err(refusal(code))
}

fn boot_id(number: u64) -> BootId {
    BootId::from_uuid(Uuid::from_u128(u128::from(number) + 1))
}
