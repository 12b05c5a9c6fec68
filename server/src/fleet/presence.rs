//! Who is on the network now, and what each robot said last. In memory; ages by our own clock.

use std::collections::{BTreeSet, HashMap};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tread_api::friction::LiveFriction;
use tread_api::ids::{BootId, RobotId, SiteId};
use tread_api::robot::{Aged, LinkState, RobotLive};
use tread_api::wire::state::{FrictionReport, RobotState};

/// How long after its last word a robot counts as heard.
pub const ONLINE_TIMEOUT: Duration = Duration::from_millis(1_500);

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
}

/// A robot's name with its site.
pub type RobotKey = (SiteId, RobotId);

/// What is known of one robot now.
#[derive(Debug, Clone, Default)]
pub struct Presence {
    welcomed: bool,
    tokens: BTreeSet<BootId>,
    boot: Option<(BootId, Duration)>,
    heard_at: Option<Duration>,
    state: Option<(RobotState, Duration)>,
    friction: Option<(LiveFriction, Duration)>,
}

impl Presence {
    /// Whether the server hears the robot.
    pub fn link(&self, now: Duration) -> LinkState {
        let heard = |at: Duration| now.saturating_sub(at) <= ONLINE_TIMEOUT;
        if self.tokens.is_empty() {
            LinkState::Offline
        } else if self.heard_at.is_some_and(heard) {
            LinkState::Online
        } else {
            LinkState::Stale
        }
    }

    /// The present run of the agent, and since when it is known.
    pub fn boot(&self) -> Option<(BootId, Duration)> {
        self.boot
    }

    /// The last state of the present run.
    pub fn state(&self) -> Option<&RobotState> {
        self.state.as_ref().map(|(state, _at)| state)
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
        })
    }

    /// A robot that starts again forgets what its earlier run said.
    fn enter_boot(&mut self, boot: BootId, now: Duration) {
        if self.boot.is_none_or(|(present, _since)| present != boot) {
            self.boot = Some((boot, now));
            self.state = None;
            self.friction = None;
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

    /// The robots that are heard now, with the revision of the terrains that each holds.
    pub fn online(&self, now: Duration) -> Vec<(RobotKey, Option<u64>)> {
        let robots = self.lock();
        let online = robots
            .iter()
            .filter(|(_, presence)| presence.link(now) == LinkState::Online);
        let held = |presence: &Presence| presence.state().and_then(|state| state.terrain_revision);
        online
            .map(|(key, presence)| (key.clone(), held(presence)))
            .collect()
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
    pub fn token_gone(&self, key: &RobotKey, boot: BootId) {
        let mut robots = self.lock();
        if let Some(presence) = robots.get_mut(key) {
            presence.tokens.remove(&boot);
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
        presence.heard_at = Some(now);
    }

    /// A robot sent its state.
    pub fn state(&self, key: &RobotKey, state: RobotState, now: Duration) -> Heard {
        let mut robots = self.lock();
        let Some(presence) = robots.get_mut(key).filter(|presence| presence.welcomed) else {
            return Heard::Stranger;
        };
        let was_online = presence.link(now) == LinkState::Online;
        if !presence.takes(state.boot, now) {
            return Heard::Nothing;
        }
        let news = presence.state().is_none_or(|before| {
            before.mode != state.mode
                || before.mission.map(|mission| mission.id) != state.mission.map(|m| m.id)
                || before.terrain_revision != state.terrain_revision
                || (before.outbox.pending == 0) != (state.outbox.pending == 0)
        });
        presence.heard_at = Some(now);
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
        if presence.takes(report.boot, now) {
            presence.friction = Some((report.friction, now));
        }
        Heard::Nothing
    }
}

#[cfg(test)]
mod tests {
    use tread_api::robot::{LoopStatus, OutboxStatus, RobotMode};
    use uuid::Uuid;

    use super::*;

    fn key() -> RobotKey {
        ("yard".parse().unwrap(), "rover-1".parse().unwrap())
    }

    fn boot(number: u128) -> BootId {
        BootId::from_uuid(Uuid::from_u128(number))
    }

    fn state(boot: BootId, seq: u64) -> RobotState {
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
            control_loop: LoopStatus::default(),
        }
    }

    const SECOND: Duration = Duration::from_secs(1);

    #[test]
    fn silence_is_stale_and_a_lost_token_is_offline() {
        let presences = Presences::default();
        let link = |now| presences.get(&key()).link(now);
        assert_eq!(link(SECOND), LinkState::Offline);
        presences.hello(key(), boot(1), SECOND);
        assert_eq!(link(SECOND), LinkState::Offline);
        presences.token_appeared(key(), boot(1), SECOND);
        presences.state(&key(), state(boot(1), 0), SECOND);
        assert_eq!(link(2 * SECOND), LinkState::Online);
        assert_eq!(link(3 * SECOND), LinkState::Stale);
        presences.token_gone(&key(), boot(1));
        assert_eq!(link(SECOND), LinkState::Offline);
    }

    #[test]
    fn a_blip_of_the_token_is_no_restart_and_a_straggler_of_the_old_run_changes_nothing() {
        let presences = Presences::default();
        presences.token_appeared(key(), boot(1), SECOND);
        presences.hello(key(), boot(1), SECOND);
        presences.state(&key(), state(boot(1), 7), SECOND);
        presences.token_gone(&key(), boot(1));
        presences.token_appeared(key(), boot(1), 2 * SECOND);
        assert_eq!(presences.get(&key()).state().unwrap().seq, 7);
        presences.token_appeared(key(), boot(2), 3 * SECOND);
        assert!(presences.get(&key()).state().is_none());
        assert_eq!(
            presences.state(&key(), state(boot(1), 8), 3 * SECOND),
            Heard::Nothing
        );
        assert_eq!(presences.get(&key()).boot(), Some((boot(2), 3 * SECOND)));
    }

    #[test]
    fn ages_grow_until_the_robot_speaks_again() {
        let presences = Presences::default();
        presences.hello(key(), boot(1), SECOND);
        presences.state(&key(), state(boot(1), 0), SECOND);
        let live = presences.get(&key()).live(4 * SECOND).unwrap();
        assert_eq!(live.heard_age_ms, 3_000);
    }

    #[test]
    fn of_a_robot_that_said_no_hello_nothing_is_kept() {
        let presences = Presences::default();
        let heard = presences.state(&key(), state(boot(1), 0), SECOND);
        assert_eq!(heard, Heard::Stranger);
        presences.token_appeared(key(), boot(1), SECOND);
        assert_eq!(presences.present_count(), 0);
        assert_eq!(
            presences.state(&key(), state(boot(1), 0), SECOND),
            Heard::Stranger
        );
        presences.token_gone(&key(), boot(1));
        assert!(presences.lock().is_empty());
    }
}
