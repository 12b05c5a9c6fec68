//! Who is on the network now, and what each robot said last. In memory; ages by our own clock.

mod duplicate_agent;
mod looks;
mod news;

use std::collections::{BTreeSet, HashMap, VecDeque};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use jiff::Timestamp;
use tread_api::friction::LiveFriction;
use tread_api::ids::{BootId, MissionId, RobotId, SiteId, StopId};
use tread_api::robot::{Aged, LinkCause, LinkState, MissionProgress, RobotLive};
use tread_api::safety::StandingState;
use tread_api::wire::state::{FrictionReport, RobotState};

pub use self::duplicate_agent::DuplicateAgent;
use self::duplicate_agent::OtherRun;
pub use self::looks::{Attending, Held};
use self::news::Shown;

/// How long after its last heartbeat a robot counts as online: three of them at 5 Hz.
pub const ONLINE_TIMEOUT: Duration = Duration::from_millis(700);
/// How long after its last heartbeat a robot counts as offline, whatever its token says.
pub const OFFLINE_TIMEOUT: Duration = Duration::from_millis(1_400);
/// A token that goes within this time of a heartbeat was taken away by its robot or by the end of
/// its process; a network that is down makes the heartbeats stop long before.
const SUDDEN: Duration = Duration::from_secs(1);

/// Most robots that are kept track of before they have said hello.
const STRANGERS_MAX: usize = 20_000;

/// What became of a robot's message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Heard {
    /// It tells nothing that lets a mission go on.
    Nothing,
    /// It may let a mission go on: another mode or mission, another revision of the terrains, a
    /// store that became empty, or a robot heard again.
    News,
    /// The robot has not said hello; nothing of it is kept.
    Stranger,
    /// It is of another run of the agent than the present one; nothing of it is shown.
    Other,
}

/// A robot's name with its site.
pub type RobotKey = (SiteId, RobotId);

/// What is known of one robot now.
#[derive(Debug, Clone, Default)]
pub struct Presence {
    welcomed: bool,
    tokens: BTreeSet<BootId>,
    boot: Option<(BootId, Duration)>,
    /// When the last heartbeat came: a state in which the control loop's ticks had gone on.
    heard_at: Option<Duration>,
    /// When the last word of any kind came.
    spoken_at: Option<Duration>,
    /// Whether the last token went away while the robot was heard.
    went_suddenly: bool,
    /// How far the robot's wall clock is ahead, milliseconds: the largest of the last states,
    /// which had the shortest way.
    clock_offsets_ms: VecDeque<i64>,
    /// How far the robot's monotonic clock is ahead of ours, microseconds, likewise.
    monotonic_offsets_us: VecDeque<i64>,
    alerts_changed: bool,
    other: Option<OtherRun>,
    shown: Option<Shown>,
    state: Option<(RobotState, Duration)>,
    /// The last mission that it showed, whatever run of the agent drove it.
    progress: Option<MissionProgress>,
    friction: Option<(LiveFriction, Duration)>,
}

impl Presence {
    /// Whether the server hears the robot. Its token is a hint: one that is gone shows the end of
    /// a process at once. Without it, or without heartbeats, a robot is offline.
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

    /// Why the robot is not heard; `None` while it is online.
    pub fn link_cause(&self, now: Duration) -> Option<LinkCause> {
        if self.link(now) == LinkState::Online {
            return None;
        }
        let speaks = self
            .spoken_at
            .is_some_and(|at| now.saturating_sub(at) <= ONLINE_TIMEOUT);
        Some(if self.spoken_at.is_none() && self.tokens.is_empty() {
            LinkCause::ServerRestarted
        } else if self.tokens.is_empty() && self.went_suddenly {
            LinkCause::RobotOff
        } else if self.heard_at.is_none() && !self.tokens.is_empty() {
            LinkCause::Joining
        } else if speaks && !self.tokens.is_empty() {
            LinkCause::LoopStopped
        } else {
            LinkCause::LinkDown
        })
    }

    /// Whether the agent said that it leaves, and has not come back.
    pub fn has_left(&self) -> bool {
        self.state().is_some_and(|state| state.leaving)
    }

    /// How far the robot had come with a mission when it showed it last, also before it was off
    /// the network or its agent began another run.
    pub fn progress_of(&self, mission: MissionId) -> Option<MissionProgress> {
        self.progress.filter(|progress| progress.id == mission)
    }

    /// Time since the last heartbeat; `None` if there was none.
    pub fn silent_for(&self, now: Duration) -> Option<Duration> {
        self.heard_at.map(|at| now.saturating_sub(at))
    }

    /// How far the robot's wall clock is ahead of the server's, milliseconds.
    pub fn clock_offset_ms(&self) -> i64 {
        self.clock_offsets_ms.iter().copied().max().unwrap_or(0)
    }

    /// The robot's monotonic clock now, microseconds, by the state that had the shortest
    /// way: it lags by that way, so an end that is written with it comes too early, never too
    /// late. With the run that it belongs to; `None` for a robot that does not say.
    pub fn robot_clock_us(&self, now: Duration) -> Option<(BootId, u64)> {
        let (boot, _since) = self.boot?;
        let ahead_us = self.monotonic_offsets_us.iter().copied().max()?;
        let now_us = i64::try_from(now.as_micros()).ok()?;
        let clock_us = u64::try_from(now_us.saturating_add(ahead_us)).ok()?;
        Some((boot, clock_us))
    }

    /// Whether a stop is in force on the robot, or a person drives it.
    pub fn is_operator_controlled(&self) -> bool {
        let safety = self.state().map(|state| &state.safety);
        safety.is_some_and(|safety| safety.stop.is_some() || safety.lease.is_some())
    }

    /// Whether anything was heard of the robot of late, or its token is there.
    pub fn is_there(&self, now: Duration) -> bool {
        let spoke = self
            .spoken_at
            .is_some_and(|at| now.saturating_sub(at) <= OFFLINE_TIMEOUT);
        spoke || !self.tokens.is_empty()
    }

    /// Time since the last state came.
    pub fn state_age(&self, now: Duration) -> Option<Duration> {
        self.state.as_ref().map(|(_, at)| now.saturating_sub(*at))
    }

    /// The present run of the agent, and since when it is known.
    pub fn boot(&self) -> Option<(BootId, Duration)> {
        self.boot
    }

    /// The last state of the present run.
    pub fn state(&self) -> Option<&RobotState> {
        self.state.as_ref().map(|(state, _at)| state)
    }

    /// Both friction estimates that the robot sent last.
    pub fn friction(&self) -> Option<LiveFriction> {
        self.friction.map(|(friction, _at)| friction)
    }

    /// What the robot said last, every age grown by the time since.
    pub fn live(&self, now: Duration) -> Option<RobotLive> {
        let (state, at) = self.state.as_ref()?;
        let since_ms =
            |at: Duration| u64::try_from(now.saturating_sub(at).as_millis()).unwrap_or(u64::MAX);
        let elapsed_ms = since_ms(*at);
        let friction = self.friction.as_ref();
        Some(RobotLive {
            boot: state.boot,
            heard_age_ms: elapsed_ms,
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

    /// A robot that starts again forgets what its earlier run said.
    fn enter_boot(&mut self, boot: BootId, now: Duration) {
        if self.boot.is_none_or(|(present, _since)| present != boot) {
            self.boot = Some((boot, now));
            self.state = None;
            self.friction = None;
            self.clock_offsets_ms.clear();
            if self.other.is_some_and(|other| other.boot == boot) {
                self.forget_other();
            }
            self.monotonic_offsets_us.clear();
        }
    }

    /// Whether a message of that run is of the present one, or shows that a new one began.
    fn takes(&mut self, boot: BootId, now: Duration) -> bool {
        match self.boot {
            Some((present, _since)) if present == boot => true,
            // A straggler of an earlier run, while the present one is known to be alive.
            Some((present, _since)) if self.tokens.contains(&present) => false,
            Some(_) | None => {
                self.enter_boot(boot, now);
                true
            }
        }
    }
}

/// States of which the clock's offset is kept.
const OFFSETS_MAX: usize = 16;

/// All robots.
#[derive(Debug, Default)]
pub struct Presences {
    robots: Mutex<HashMap<RobotKey, Presence>>,
}

impl Presences {
    fn lock(&self) -> MutexGuard<'_, HashMap<RobotKey, Presence>> {
        self.robots.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// What is known of a robot.
    pub fn get(&self, key: &RobotKey) -> Presence {
        self.lock().get(key).cloned().unwrap_or_default()
    }

    /// Whether a robot has ever said hello.
    pub fn is_known(&self, key: &RobotKey) -> bool {
        self.lock()
            .get(key)
            .is_some_and(|presence| presence.welcomed)
    }

    /// A robot has answered that it cleared a stop; its next state will say so too.
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

    /// A robot's token appeared.
    pub fn token_appeared(&self, key: RobotKey, boot: BootId, now: Duration) {
        let mut robots = self.lock();
        // A token may come before its robot's hello; only so many of them are remembered.
        if !robots.contains_key(&key) && robots.len() >= STRANGERS_MAX {
            return;
        }
        let presence = robots.entry(key).or_default();
        presence.tokens.insert(boot);
        presence.enter_boot(boot, now);
    }

    /// A robot's token is gone.
    pub fn token_gone(&self, key: &RobotKey, boot: BootId, now: Duration) {
        let mut robots = self.lock();
        if let Some(presence) = robots.get_mut(key) {
            presence.tokens.remove(&boot);
            let silent = presence.silent_for(now);
            presence.went_suddenly = silent.is_none_or(|silent| silent <= SUDDEN);
            if !presence.welcomed && presence.tokens.is_empty() {
                robots.remove(key);
            }
        }
    }

    /// A robot that said hello to an earlier run of this server.
    pub fn know(&self, key: RobotKey) {
        self.lock().entry(key).or_default().welcomed = true;
    }

    /// A robot introduced itself.
    pub fn hello(&self, key: RobotKey, boot: BootId, now: Duration) {
        let mut robots = self.lock();
        let presence = robots.entry(key).or_default();
        presence.welcomed = true;
        presence.enter_boot(boot, now);
        presence.spoken_at = Some(now);
    }

    /// A robot sent its state.
    pub fn state(
        &self,
        key: &RobotKey,
        state: RobotState,
        now: Duration,
        wall: Timestamp,
    ) -> Heard {
        let mut robots = self.lock();
        let Some(presence) = robots.get_mut(key).filter(|presence| presence.welcomed) else {
            return Heard::Stranger;
        };
        let was_online = presence.link(now) == LinkState::Online;
        if !presence.takes(state.boot, now) {
            presence.note_other(&state, now);
            return Heard::Other;
        }
        let news = presence.state().is_none_or(|before| {
            before.mode != state.mode
                || content(before) != content(&state)
                || stop_of(before) != stop_of(&state)
                || standing_of(before) != standing_of(&state)
                || lease_of(before) != lease_of(&state)
                || before.safety.fence_revision != state.safety.fence_revision
                || before.terrain_revision != state.terrain_revision
                || (before.outbox.pending == 0) != (state.outbox.pending == 0)
        });
        // States come late and in another order too; a tick that was seen is no heartbeat.
        let beats = presence
            .state()
            .is_none_or(|before| state.control_loop.ticks > before.control_loop.ticks);
        if beats {
            presence.heard_at = Some(now);
        }
        presence.spoken_at = Some(now);
        if presence
            .state()
            .is_some_and(|before| before.seq >= state.seq)
        {
            return if news { Heard::News } else { Heard::Nothing };
        }
        let ahead_ms = state.robot_time.duration_since(wall).as_millis();
        if presence.clock_offsets_ms.len() >= OFFSETS_MAX {
            presence.clock_offsets_ms.pop_front();
        }
        let ahead_ms = i64::try_from(ahead_ms).unwrap_or(i64::MAX);
        presence.clock_offsets_ms.push_back(ahead_ms);
        if let Some(ahead_us) = monotonic_offset_us(&state, now) {
            if presence.monotonic_offsets_us.len() >= OFFSETS_MAX {
                presence.monotonic_offsets_us.pop_front();
            }
            presence.monotonic_offsets_us.push_back(ahead_us);
        }
        let said = presence.state().map(|before| &before.alerts);
        presence.alerts_changed |= said != Some(&state.alerts);
        presence.progress = state.mission.or(presence.progress);
        presence.state = Some((state, now));
        if news || !was_online {
            Heard::News
        } else {
            Heard::Nothing
        }
    }

    /// A robot sent both of its friction estimates.
    pub fn friction(&self, key: &RobotKey, report: &FrictionReport, now: Duration) -> Heard {
        let mut robots = self.lock();
        let Some(presence) = robots.get_mut(key).filter(|presence| presence.welcomed) else {
            return Heard::Stranger;
        };
        if !presence.takes(report.boot, now) {
            return Heard::Other;
        }
        presence.friction = Some((report.friction, now));
        Heard::Nothing
    }
}

/// How far a robot's monotonic clock is ahead of ours, less the way of this state.
fn monotonic_offset_us(state: &RobotState, now: Duration) -> Option<i64> {
    let robot_us = i64::try_from(state.monotonic_us?).ok()?;
    let now_us = i64::try_from(now.as_micros()).ok()?;
    Some(robot_us - now_us)
}

fn standing_of(state: &RobotState) -> Option<StandingState> {
    state.safety.standing.map(|standing| standing.state)
}

fn stop_of(state: &RobotState) -> Option<StopId> {
    state.safety.stop.as_ref().map(|latch| latch.id)
}

fn lease_of(state: &RobotState) -> Option<u64> {
    state.safety.lease.as_ref().map(|lease| lease.epoch)
}

/// What of a robot's mission decides what it needs.
fn content(state: &RobotState) -> Option<(MissionId, u32, bool)> {
    let mission = state.mission?;
    Some((mission.id, mission.revision, mission.paused))
}

#[cfg(test)]
mod tests;
