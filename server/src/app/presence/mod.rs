//! Presence of robots on the network, with each robot's last messages. In memory; ages are by the
//! server's monotonic clock.

mod changes;
mod duplicate_agent;
mod link_quality;
mod offsets;
mod queries;

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use jiff::Timestamp;
use tread_api::friction::LiveFriction;
use tread_api::ids::{BootId, MissionId, RobotId, SiteId, StopId};
use tread_api::link::LinkQuality;
use tread_api::robot::{Aged, LinkCause, LinkState, MissionProgress, RobotLive};
use tread_api::safety::StandstillState;
use tread_api::wire::state::{FrictionReport, RobotState};
use uuid::Uuid;

use self::changes::PublishedState;
pub use self::duplicate_agent::DuplicateAgent;
use self::duplicate_agent::OtherRun;
use self::link_quality::LinkCounts;
use self::offsets::Offsets;
pub use self::queries::{LinkStatus, ReportedCondition, ReportedRevisions};

/// Maximum age of the last heartbeat of an online robot: three periods at 5 Hz, the rate at which a
/// robot publishes that nobody watches.
pub const ONLINE_TIMEOUT: Duration = Duration::from_millis(700);
/// Age of the last heartbeat beyond which a robot is offline, whether or not its liveliness token
/// is there.
pub const OFFLINE_TIMEOUT: Duration = Duration::from_millis(1_400);
/// Maximum age of the last heartbeat at which a vanished liveliness token means that its process
/// ended. If the network is down, heartbeats stop long before the token vanishes.
const SUDDEN: Duration = Duration::from_secs(1);

/// Maximum number of robots in memory; beyond it no further robot is added for its token alone.
const ROBOTS_BY_TOKEN_MAX: usize = 20_000;

/// Effect of a robot's message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MessageEffect {
    /// No change that may let a mission proceed.
    Unchanged,
    /// A change that may let a mission proceed: of mode, mission, stop, lease or revisions, an
    /// outbox that became empty, or a robot that is online again.
    Changed,
    /// The robot has sent no hello; the message is dropped.
    NotWelcomed,
    /// The message is of another run of the agent than the present one; it is not shown.
    OtherRun,
}

/// A robot's name with its site.
pub type RobotKey = (SiteId, RobotId);

/// Presence of one robot.
#[derive(Debug, Clone, Default)]
pub struct Presence {
    welcomed: bool,
    tokens: BTreeSet<BootId>,
    boot: Option<(BootId, Duration)>,
    /// Time of the last heartbeat: a state in which the tick count of the control loop had
    /// increased.
    last_heartbeat_at: Option<Duration>,
    /// Time of the last message of any kind.
    last_message_at: Option<Duration>,
    /// Whether the last token vanished shortly after a heartbeat.
    vanished_suddenly: bool,
    /// Offsets of the robot's wall clock, robot minus server, milliseconds, of the last states. The
    /// largest is of the state with the shortest delay.
    clock_offsets_ms: Offsets,
    /// Offsets of the robot's monotonic clock, robot minus server, microseconds, of the last
    /// states.
    monotonic_offsets_us: Offsets,
    alerts_changed: bool,
    other: Option<OtherRun>,
    shown: Option<PublishedState>,
    state: Option<(RobotState, Duration)>,
    /// Progress of the mission that it showed last, of any run of the agent.
    progress: Option<MissionProgress>,
    friction: Option<(LiveFriction, Duration)>,
    link_counts: LinkCounts,
    /// Names of the drivers to whom the robot has granted its lease, until it is over. The robot's
    /// states show the lease later.
    drivers: BTreeMap<Uuid, String>,
}

impl Presence {
    /// Returns the state of the link, by the age of the last heartbeat. A robot without a
    /// liveliness token is offline: a token vanishes at once when its process ends.
    pub fn link(&self, now: Duration) -> LinkState {
        let within = |limit: Duration| self.silent_for(now).is_some_and(|silent| silent <= limit);
        if self.tokens.is_empty() || !within(OFFLINE_TIMEOUT) {
            LinkState::Offline
        } else if within(ONLINE_TIMEOUT) {
            LinkState::Online
        } else {
            LinkState::Stale
        }
    }

    /// Returns why the robot is not online; `None` while it is.
    pub fn link_cause(&self, now: Duration) -> Option<LinkCause> {
        if self.link(now) == LinkState::Online {
            return None;
        }
        let is_recent = self
            .last_message_at
            .is_some_and(|at| now.saturating_sub(at) <= ONLINE_TIMEOUT);
        Some(
            if self.last_message_at.is_none() && self.tokens.is_empty() {
                LinkCause::ServerRestarted
            } else if self.tokens.is_empty() && self.vanished_suddenly {
                LinkCause::RobotOff
            } else if self.last_heartbeat_at.is_none() && !self.tokens.is_empty() {
                LinkCause::Joining
            } else if is_recent && !self.tokens.is_empty() {
                LinkCause::LoopStopped
            } else {
                LinkCause::LinkDown
            },
        )
    }

    /// Returns whether the agent announced in its last state that it stops.
    pub fn has_left(&self) -> bool {
        self.state().is_some_and(|state| state.leaving)
    }

    /// Returns the progress of a mission as the robot showed it last, also before it went offline
    /// or its agent was restarted.
    pub fn progress_of(&self, mission: MissionId) -> Option<MissionProgress> {
        self.progress.filter(|progress| progress.id == mission)
    }

    /// Time since the last heartbeat; `None` if there was none.
    pub fn silent_for(&self, now: Duration) -> Option<Duration> {
        self.last_heartbeat_at.map(|at| now.saturating_sub(at))
    }

    /// Returns the offset of the robot's wall clock, robot minus server, milliseconds; 0 if it is
    /// not known.
    pub fn clock_offset_ms(&self) -> i64 {
        self.clock_offsets_ms.largest().unwrap_or(0)
    }

    /// Returns the robot's monotonic clock at `now`, microseconds, with the run that it belongs to.
    /// The estimate is late by the shortest network delay seen, so a deadline derived from it is
    /// never too late. `None` for a robot that does not send its clock.
    pub fn robot_clock_us(&self, now: Duration) -> Option<(BootId, u64)> {
        let (boot, _since) = self.boot?;
        let ahead_us = self.monotonic_offsets_us.largest()?;
        let now_us = i64::try_from(now.as_micros()).ok()?;
        let clock_us = u64::try_from(now_us.saturating_add(ahead_us)).ok()?;
        Some((boot, clock_us))
    }

    /// Returns whether a stop is in force on the robot, or a person teleoperates it.
    pub fn is_operator_controlled(&self) -> bool {
        let safety = self.state().map(|state| &state.safety);
        safety.is_some_and(|safety| safety.stop.is_some()) || self.driver().is_some()
    }

    /// Returns the name of the driver who teleoperates the robot, according to its state or to the
    /// lease that it granted.
    pub fn driver(&self) -> Option<&str> {
        let shown = self.state().and_then(|state| state.safety.lease.as_ref());
        let shown = shown.map(|lease| lease.driver.name.as_str());
        shown.or_else(|| self.drivers.values().next().map(String::as_str))
    }

    /// Returns whether a message came within [`OFFLINE_TIMEOUT`], or a liveliness token exists.
    pub fn is_connected(&self, now: Duration) -> bool {
        let is_recent = self
            .last_message_at
            .is_some_and(|at| now.saturating_sub(at) <= OFFLINE_TIMEOUT);
        is_recent || !self.tokens.is_empty()
    }

    /// Returns the time since the last state arrived.
    pub fn state_age(&self, now: Duration) -> Option<Duration> {
        self.state.as_ref().map(|(_, at)| now.saturating_sub(*at))
    }

    /// Returns the present run of the agent, and the time at which it was first seen.
    pub fn boot(&self) -> Option<(BootId, Duration)> {
        self.boot
    }

    /// Returns the last state of the present run.
    pub fn state(&self) -> Option<&RobotState> {
        self.state.as_ref().map(|(state, _at)| state)
    }

    /// Returns the adapted and the measured θ that the robot sent last.
    pub fn friction(&self) -> Option<LiveFriction> {
        self.friction.map(|(friction, _at)| friction)
    }

    /// Returns the robot's last state, with each age increased by the time since its arrival.
    pub fn live(&self, now: Duration) -> Option<RobotLive> {
        let (state, at) = self.state.as_ref()?;
        let since_ms =
            |at: Duration| u64::try_from(now.saturating_sub(at).as_millis()).unwrap_or(u64::MAX);
        let elapsed_ms = since_ms(*at);
        let friction = self.friction.as_ref();
        Some(RobotLive {
            boot: state.boot,
            state_age_ms: elapsed_ms,
            robot_time: state.robot_time,
            clock_offset_ms: self.clock_offset_ms(),
            mode: state.mode,
            fault: state.fault.clone(),
            pose: state.pose.map(|pose| pose.older_by(elapsed_ms)),
            twist: state.twist.map(|twist| twist.older_by(elapsed_ms)),
            mission: state.mission,
            friction: friction.map(|&(value, at)| Aged {
                value,
                age_ms: since_ms(at),
            }),
            outbox: state.outbox,
            control_loop: state.control_loop,
            battery: state.battery,
            safety: state.safety.clone(),
        })
    }

    /// Returns the quality of the robot's link; `None` if it has sent nothing.
    pub fn link_quality(&self, now: Duration) -> Option<LinkQuality> {
        self.last_message_at?;
        let offsets = &self.clock_offsets_ms;
        let variation_ms = offsets.largest().zip(offsets.newest());
        let variation_ms = variation_ms.map(|(fastest, newest)| fastest.abs_diff(newest));
        Some(self.link_counts.quality(now, variation_ms))
    }

    /// Makes a run the present one, and drops the data of the run before.
    fn enter_boot(&mut self, boot: BootId, now: Duration) {
        if self.boot.is_none_or(|(present, _since)| present != boot) {
            self.boot = Some((boot, now));
            self.state = None;
            self.friction = None;
            self.clock_offsets_ms.clear();
            if self.other.is_some_and(|other| other.boot == boot) {
                self.remove_other();
            }
            self.monotonic_offsets_us.clear();
        }
    }

    /// Returns whether a message's run is the present one, after making a newly seen run the
    /// present one.
    fn takes(&mut self, boot: BootId, now: Duration) -> bool {
        match self.boot {
            Some((present, _since)) if present == boot => true,
            // A late message of an earlier run, while the present one is on the network.
            Some((present, _since)) if self.tokens.contains(&present) => false,
            Some(_) | None => {
                self.enter_boot(boot, now);
                true
            }
        }
    }
}

/// Presence of all robots.
#[derive(Debug, Default)]
pub struct Presences {
    robots: Mutex<HashMap<RobotKey, Presence>>,
}

impl Presences {
    fn lock(&self) -> MutexGuard<'_, HashMap<RobotKey, Presence>> {
        self.robots.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns a copy of a robot's presence; an empty one if it is not known.
    pub fn get(&self, key: &RobotKey) -> Presence {
        self.lock().get(key).cloned().unwrap_or_default()
    }

    /// Returns whether a robot has ever sent a hello.
    pub fn is_known(&self, key: &RobotKey) -> bool {
        self.lock()
            .get(key)
            .is_some_and(|presence| presence.welcomed)
    }

    /// Removes a stop from a robot's last state, after the robot has answered that it cleared it.
    pub fn stop_cleared(&self, key: &RobotKey, id: StopId) {
        if let Some((state, _at)) = self
            .lock()
            .get_mut(key)
            .and_then(|presence| presence.state.as_mut())
        {
            let stop = &mut state.safety.stop;
            if stop.as_ref().is_some_and(|latch| latch.id == id) {
                *stop = None;
            }
        }
    }

    /// Records that a robot's liveliness token appeared.
    pub fn token_appeared(&self, key: RobotKey, boot: BootId, now: Duration) {
        let mut robots = self.lock();
        // A token may come before its robot's hello; the number of such robots is limited.
        if !robots.contains_key(&key) && robots.len() >= ROBOTS_BY_TOKEN_MAX {
            return;
        }
        let presence = robots.entry(key).or_default();
        presence.tokens.insert(boot);
        presence.enter_boot(boot, now);
    }

    /// Records that a robot's liveliness token vanished.
    pub fn token_gone(&self, key: &RobotKey, boot: BootId, now: Duration) {
        let mut robots = self.lock();
        if let Some(presence) = robots.get_mut(key) {
            presence.tokens.remove(&boot);
            let silent = presence.silent_for(now);
            presence.vanished_suddenly = silent.is_none_or(|silent| silent <= SUDDEN);
            if !presence.welcomed && presence.tokens.is_empty() {
                robots.remove(key);
            }
        }
    }

    /// Records a robot that sent a hello to an earlier run of this server.
    pub fn register(&self, key: RobotKey) {
        self.lock().entry(key).or_default().welcomed = true;
    }

    /// Records that a robot granted its lease to a driver; returns what identifies this lease.
    pub fn lease_granted(&self, key: &RobotKey, driver: &str) -> Uuid {
        let id = Uuid::new_v4();
        if let Some(presence) = self.lock().get_mut(key) {
            presence.drivers.insert(id, driver.to_owned());
        }
        id
    }

    /// Records that a lease is over.
    pub fn lease_over(&self, key: &RobotKey, id: Uuid) {
        if let Some(presence) = self.lock().get_mut(key) {
            presence.drivers.remove(&id);
        }
    }

    /// Records the time from a command to a robot's answer.
    pub fn round_trip(&self, key: &RobotKey, took: Duration) {
        if let Some(presence) = self.lock().get_mut(key) {
            presence.link_counts.round_trip(took);
        }
    }

    /// Records a robot's hello.
    pub fn hello(&self, key: RobotKey, boot: BootId, now: Duration) {
        let mut robots = self.lock();
        let presence = robots.entry(key).or_default();
        // A hello is the first message of each connection.
        if presence.last_message_at.is_some() {
            presence.link_counts.reconnect(now);
        }
        presence.welcomed = true;
        presence.enter_boot(boot, now);
        presence.last_message_at = Some(now);
    }

    /// Records a robot's state, received at `now`.
    pub fn state(
        &self,
        key: &RobotKey,
        state: RobotState,
        now: Duration,
        wall: Timestamp,
    ) -> MessageEffect {
        let mut robots = self.lock();
        let Some(presence) = robots.get_mut(key).filter(|presence| presence.welcomed) else {
            return MessageEffect::NotWelcomed;
        };
        let was_online = presence.link(now) == LinkState::Online;
        if !presence.takes(state.boot, now) {
            presence.record_other(&state, now);
            return MessageEffect::OtherRun;
        }
        let has_changed = presence.state().is_none_or(|before| {
            before.mode != state.mode
                || content(before) != content(&state)
                || stop_of(before) != stop_of(&state)
                || standstill_of(before) != standstill_of(&state)
                || lease_of(before) != lease_of(&state)
                || before.safety.fence_revision != state.safety.fence_revision
                || before.terrain_revision != state.terrain_revision
                || (before.outbox.pending == 0) != (state.outbox.pending == 0)
        });
        // States may arrive late or out of order; only an increased tick count is a heartbeat.
        let beats = presence
            .state()
            .is_none_or(|before| state.control_loop.ticks > before.control_loop.ticks);
        if beats {
            presence.last_heartbeat_at = Some(now);
        }
        presence.last_message_at = Some(now);
        if presence
            .state()
            .is_some_and(|before| before.seq >= state.seq)
        {
            if presence
                .state()
                .is_some_and(|before| before.seq > state.seq)
            {
                presence.link_counts.late_state(now);
            }
            return if has_changed {
                MessageEffect::Changed
            } else {
                MessageEffect::Unchanged
            };
        }
        let before = presence.state().map(|before| before.seq);
        presence.link_counts.state(now, before, state.seq);
        let ahead_ms = state.robot_time.duration_since(wall).as_millis();
        let ahead_ms = i64::try_from(ahead_ms).unwrap_or(i64::MAX);
        presence.clock_offsets_ms.push(now, ahead_ms);
        if let Some(ahead_us) = monotonic_offset_us(&state, now) {
            presence.monotonic_offsets_us.push(now, ahead_us);
        }
        let reported = presence.state().map(|before| &before.alerts);
        presence.alerts_changed |= reported != Some(&state.alerts);
        presence.progress = state.mission.or(presence.progress);
        presence.state = Some((state, now));
        if has_changed || !was_online {
            MessageEffect::Changed
        } else {
            MessageEffect::Unchanged
        }
    }

    /// Records a robot's adapted and measured θ.
    pub fn friction(
        &self,
        key: &RobotKey,
        report: &FrictionReport,
        now: Duration,
    ) -> MessageEffect {
        let mut robots = self.lock();
        let Some(presence) = robots.get_mut(key).filter(|presence| presence.welcomed) else {
            return MessageEffect::NotWelcomed;
        };
        if !presence.takes(report.boot, now) {
            return MessageEffect::OtherRun;
        }
        presence.friction = Some((report.friction, now));
        MessageEffect::Unchanged
    }
}

/// Returns the offset of a robot's monotonic clock, robot minus server, in microseconds. It is too
/// small by the delay of this state.
fn monotonic_offset_us(state: &RobotState, now: Duration) -> Option<i64> {
    let robot_us = i64::try_from(state.monotonic_us?).ok()?;
    let now_us = i64::try_from(now.as_micros()).ok()?;
    Some(robot_us - now_us)
}

fn standstill_of(state: &RobotState) -> Option<StandstillState> {
    state.safety.standstill.map(|standstill| standstill.state)
}

fn stop_of(state: &RobotState) -> Option<StopId> {
    state.safety.stop.as_ref().map(|latch| latch.id)
}

fn lease_of(state: &RobotState) -> Option<u64> {
    state.safety.lease.as_ref().map(|lease| lease.epoch)
}

/// Returns the part of a robot's mission that determines what the mission needs.
fn content(state: &RobotState) -> Option<(MissionId, u32, bool)> {
    let mission = state.mission?;
    Some((mission.id, mission.revision, mission.paused))
}

#[cfg(test)]
mod tests;
