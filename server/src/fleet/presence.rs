//! Who is on the network now, and what each robot said last. In memory; ages by our own clock.

mod rivals;

use std::collections::{BTreeMap, BTreeSet, HashMap, VecDeque};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use jiff::Timestamp;
use tread_api::friction::LiveFriction;
use tread_api::ids::{BootId, MissionId, RobotId, SiteId, StopId};
use tread_api::robot::{Aged, AlertReport, LinkCause, LinkState, RobotLive, RobotMode};
use tread_api::wire::state::{FrictionReport, RobotState};

use self::rivals::OtherRun;
pub use self::rivals::Rival;

/// How long after its last heartbeat a robot counts as online: three of them at 5 Hz.
pub const ONLINE_TIMEOUT: Duration = Duration::from_millis(700);
/// How long after its last heartbeat a robot counts as offline, whatever its token says.
pub const OFFLINE_TIMEOUT: Duration = Duration::from_millis(1_400);
/// A token that goes within this time of a heartbeat was taken away by its robot or by the end of
/// its process; a network that is down makes the heartbeats stop long before.
const SUDDEN: Duration = Duration::from_secs(1);
/// Least time between two events on a robot whose state only moved on.
const SHOW_PERIOD: Duration = Duration::from_secs(1);

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

/// What a robot holds of its site.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Held {
    /// The revision of its terrains.
    pub terrains: Option<u64>,
    /// The revision of its geofence; `None` also of a robot that knows no geofences.
    pub fence: Option<u64>,
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

    /// Time since the last heartbeat; `None` if there was none.
    pub fn silent_for(&self, now: Duration) -> Option<Duration> {
        self.heard_at.map(|at| now.saturating_sub(at))
    }

    /// How far the robot's wall clock is ahead of the server's, milliseconds.
    pub fn clock_offset_ms(&self) -> i64 {
        self.clock_offsets_ms.iter().copied().max().unwrap_or(0)
    }

    /// The robot's monotonic clock now, microseconds, as told by the state that had the shortest
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
    pub fn is_in_hands(&self) -> bool {
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

/// What of a robot was shown to event clients last.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Shown {
    at: Duration,
    link: LinkState,
    cause: Option<LinkCause>,
    mode: Option<RobotMode>,
    mission: Option<(MissionId, u32, bool)>,
    stop: Option<StopId>,
    lease: Option<u64>,
    seq: Option<u64>,
}

/// Robots that are shown afresh at a time.
const NEWS_MAX: usize = 500;
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

    /// Every robot that has ever said hello.
    pub fn known(&self) -> Vec<RobotKey> {
        let robots = self.lock();
        let known = robots.iter().filter(|(_, presence)| presence.welcomed);
        known.map(|(key, _)| key.clone()).collect()
    }

    /// The stops that robots show to be in force.
    pub fn shown_stops(&self) -> Vec<(RobotKey, StopId)> {
        let robots = self.lock();
        let shown = |(key, presence): (&RobotKey, &Presence)| {
            Some((key.clone(), presence.state().and_then(stop_of)?))
        };
        robots.iter().filter_map(shown).collect()
    }

    /// The robots that are heard now, with the revisions of terrains and geofence that each holds.
    pub fn online(&self, now: Duration) -> Vec<(RobotKey, Held)> {
        let robots = self.lock();
        let online = robots
            .iter()
            .filter(|(_, presence)| presence.link(now) == LinkState::Online);
        let held = |presence: &Presence| {
            let state = presence.state();
            Held {
                terrains: state.and_then(|state| state.terrain_revision),
                fence: state.and_then(|state| state.safety.fence_revision),
            }
        };
        online
            .map(|(key, presence)| (key.clone(), held(presence)))
            .collect()
    }

    /// The missions that robots which are heard now say they drive.
    pub fn shown_missions(&self, now: Duration) -> Vec<(RobotKey, MissionId)> {
        let robots = self.lock();
        let heard = robots
            .iter()
            .filter(|(_, presence)| presence.link(now) != LinkState::Offline);
        let shown = |presence: &Presence| presence.state()?.mission.map(|mission| mission.id);
        heard
            .filter_map(|(key, presence)| Some((key.clone(), shown(presence)?)))
            .collect()
    }

    /// What robots say needs attention, of those that said something else before; each is given
    /// once.
    pub fn take_alert_changes(&self) -> Vec<(RobotKey, Vec<AlertReport>)> {
        let mut robots = self.lock();
        let changed = robots
            .iter_mut()
            .filter(|(_, presence)| presence.alerts_changed);
        let taken = changed.filter_map(|(key, presence)| {
            // Without a state of the present run nobody knows what the robot itself says.
            let own = presence.state()?.alerts.clone();
            let alerts = presence.rival_alert().into_iter().chain(own).collect();
            presence.alerts_changed = false;
            Some((key.clone(), alerts))
        });
        taken.collect()
    }

    /// Gives what could not be written down again.
    pub fn return_alert_change(&self, key: &RobotKey) {
        if let Some(presence) = self.lock().get_mut(key) {
            presence.alerts_changed = true;
        }
    }

    /// The robots of which event clients have not seen the present state: at once when link, mode
    /// or mission changed, and once a second while only figures move on.
    ///
    /// At most [`NEWS_MAX`] at a time, so that no client is swamped; the rest comes next.
    pub fn take_news(&self, now: Duration) -> Vec<RobotKey> {
        let mut robots = self.lock();
        let mut news = Vec::new();
        for (key, presence) in robots.iter_mut() {
            if !presence.welcomed {
                continue;
            }
            let state = presence.state();
            let shown = Shown {
                at: now,
                link: presence.link(now),
                cause: presence.link_cause(now),
                mode: state.map(|state| state.mode),
                mission: state.and_then(content),
                stop: state.and_then(stop_of),
                lease: state.and_then(lease_of),
                seq: state.map(|state| state.seq),
            };
            let is_new = presence.shown.is_none_or(|before| {
                let elapsed = now.saturating_sub(before.at) >= SHOW_PERIOD;
                let moved = before.seq != shown.seq && elapsed;
                let same = Shown {
                    at: before.at,
                    seq: before.seq,
                    ..shown
                };
                moved || before != same
            });
            if is_new {
                presence.shown = Some(shown);
                news.push(key.clone());
            }
            if news.len() >= NEWS_MAX {
                break;
            }
        }
        news
    }

    /// How many robots that are heard are slowed down, by the name of the strictest cause.
    pub fn gate_causes(&self, now: Duration) -> BTreeMap<String, usize> {
        let robots = self.lock();
        let mut causes = BTreeMap::new();
        for presence in robots.values() {
            let state = presence
                .state()
                .filter(|_| presence.link(now) != LinkState::Offline);
            let cause = state.and_then(|state| state.safety.gate.cause);
            // A cause's name is that on the wire.
            if let Some(serde_json::Value::String(name)) =
                cause.and_then(|cause| serde_json::to_value(cause).ok())
            {
                *causes.entry(name).or_insert(0) += 1;
            }
        }
        causes
    }

    /// How many robots have each link state.
    pub fn link_counts(&self, now: Duration) -> [(LinkState, usize); 3] {
        let robots = self.lock();
        LinkState::ALL.map(|link| {
            let has = |presence: &&Presence| presence.welcomed && presence.link(now) == link;
            (link, robots.values().filter(has).count())
        })
    }

    /// How many robots are on the network.
    pub fn present_count(&self) -> usize {
        self.lock()
            .values()
            .filter(|presence| presence.welcomed && !presence.tokens.is_empty())
            .count()
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
mod tests {
    use tread_api::robot::{LoopStatus, OutboxStatus, RobotMode};
    use tread_api::safety::SafetyStatus;
    use uuid::Uuid;

    use super::*;

    pub(super) fn key() -> RobotKey {
        ("yard".parse().unwrap(), "rover-1".parse().unwrap())
    }

    pub(super) fn boot(number: u128) -> BootId {
        BootId::from_uuid(Uuid::from_u128(number))
    }

    pub(super) fn state(boot: BootId, seq: u64) -> RobotState {
        RobotState {
            robot: key().1,
            boot,
            seq,
            robot_time: "2026-11-01T00:00:00Z".parse().unwrap(),
            mode: RobotMode::Idle,
            fault: None,
            pose: None,
            twist: None,
            mission: None,
            terrain_revision: None,
            outbox: OutboxStatus::default(),
            control_loop: LoopStatus {
                ticks: seq,
                ..LoopStatus::default()
            },
            battery: None,
            alerts: Vec::new(),
            monotonic_us: None,
            safety: SafetyStatus::default(),
        }
    }

    pub(super) fn wall() -> Timestamp {
        "2026-11-01T00:00:00Z".parse().unwrap()
    }

    pub(super) const SECOND: Duration = Duration::from_secs(1);

    #[test]
    fn silence_is_stale_and_a_lost_token_is_offline() {
        let presences = Presences::default();
        let link = |now| presences.get(&key()).link(now);
        assert_eq!(link(SECOND), LinkState::Offline);
        presences.hello(key(), boot(1), SECOND);
        assert_eq!(link(SECOND), LinkState::Offline);
        presences.token_appeared(key(), boot(1), SECOND);
        assert_eq!(
            link(SECOND),
            LinkState::Offline,
            "present, but not heard yet"
        );
        let cause = |now| presences.get(&key()).link_cause(now);
        assert_eq!(cause(SECOND), Some(LinkCause::Joining));
        presences.state(&key(), state(boot(1), 0), SECOND, wall());
        assert_eq!(link(SECOND + ONLINE_TIMEOUT), LinkState::Online);
        assert_eq!(link(SECOND + OFFLINE_TIMEOUT), LinkState::Stale);
        assert_eq!(
            link(3 * SECOND),
            LinkState::Offline,
            "whatever its token says"
        );
        presences.token_gone(&key(), boot(1), 2 * SECOND);
        assert_eq!(link(SECOND), LinkState::Offline);
    }

    #[test]
    fn a_blip_of_the_token_is_no_restart_and_a_straggler_of_the_old_run_changes_nothing() {
        let presences = Presences::default();
        presences.token_appeared(key(), boot(1), SECOND);
        presences.hello(key(), boot(1), SECOND);
        presences.state(&key(), state(boot(1), 7), SECOND, wall());
        presences.token_gone(&key(), boot(1), 2 * SECOND);
        presences.token_appeared(key(), boot(1), 2 * SECOND);
        assert_eq!(presences.get(&key()).state().unwrap().seq, 7);
        presences.token_appeared(key(), boot(2), 3 * SECOND);
        assert!(presences.get(&key()).state().is_none());
        assert_eq!(
            presences.state(&key(), state(boot(1), 8), 3 * SECOND, wall()),
            Heard::Other
        );
        assert_eq!(presences.get(&key()).boot(), Some((boot(2), 3 * SECOND)));
        assert!(presences.take_rivals(4 * SECOND).is_empty());
    }

    #[test]
    fn ages_grow_until_the_robot_speaks_again() {
        let presences = Presences::default();
        presences.hello(key(), boot(1), SECOND);
        presences.state(&key(), state(boot(1), 0), SECOND, wall());
        let live = presences.get(&key()).live(4 * SECOND).unwrap();
        assert_eq!(live.heard_age_ms, 3_000);
    }

    #[test]
    fn of_a_robot_that_said_no_hello_nothing_is_kept() {
        let presences = Presences::default();
        let heard = presences.state(&key(), state(boot(1), 0), SECOND, wall());
        assert_eq!(heard, Heard::Stranger);
        presences.token_appeared(key(), boot(1), SECOND);
        assert_eq!(presences.present_count(), 0);
        assert_eq!(
            presences.state(&key(), state(boot(1), 0), SECOND, wall()),
            Heard::Stranger
        );
        presences.token_gone(&key(), boot(1), SECOND);
        assert!(presences.lock().is_empty());
    }

    #[test]
    fn robot_off_link_down_and_a_loop_that_stands_still_are_told_apart() {
        let presences = Presences::default();
        let cause = |now| presences.get(&key()).link_cause(now);
        assert_eq!(cause(SECOND), Some(LinkCause::ServerRestarted));
        presences.know(key());
        presences.token_appeared(key(), boot(1), SECOND);
        presences.state(&key(), state(boot(1), 1), SECOND, wall());
        assert_eq!(cause(SECOND), None);
        assert_eq!(cause(3 * SECOND), Some(LinkCause::LinkDown));
        // The agent speaks on, and its loop's ticks do not.
        let mut stuck = state(boot(1), 2);
        stuck.control_loop.ticks = 1;
        presences.state(&key(), stuck, 3 * SECOND, wall());
        assert_eq!(presences.get(&key()).link(3 * SECOND), LinkState::Offline);
        assert_eq!(cause(3 * SECOND), Some(LinkCause::LoopStopped));
        presences.state(&key(), state(boot(1), 3), 4 * SECOND, wall());
        presences.token_gone(&key(), boot(1), 4 * SECOND);
        assert_eq!(cause(4 * SECOND), Some(LinkCause::RobotOff));
        presences.token_appeared(key(), boot(1), 5 * SECOND);
        presences.token_gone(&key(), boot(1), 9 * SECOND);
        assert_eq!(cause(9 * SECOND), Some(LinkCause::LinkDown));
    }

    #[test]
    fn the_clock_offset_is_that_of_the_state_with_the_shortest_way() {
        let presences = Presences::default();
        presences.know(key());
        let said = |seq, late_ms: i64| {
            let heard_at = wall() + jiff::SignedDuration::from_millis(late_ms - 3_000);
            presences.state(&key(), state(boot(1), seq), SECOND, heard_at);
        };
        said(1, 40);
        said(2, 2);
        said(3, 900);
        assert_eq!(presences.get(&key()).clock_offset_ms(), 2_998);
    }

    #[test]
    fn an_older_state_that_comes_late_is_not_shown() {
        let presences = Presences::default();
        presences.know(key());
        presences.state(&key(), state(boot(1), 5), SECOND, wall());
        presences.state(&key(), state(boot(1), 4), SECOND, wall());
        assert_eq!(presences.get(&key()).state().unwrap().seq, 5);
    }
}
