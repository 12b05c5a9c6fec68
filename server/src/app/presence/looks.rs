//! What is asked of all robots at once.

use std::collections::BTreeMap;
use std::time::Duration;

use tread_api::ids::{MissionId, StopId};
use tread_api::rights::Scope;
use tread_api::robot::{LinkCause, LinkState};

use super::{Presence, Presences, RobotKey, stop_of};

/// What a robot holds of its site.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Held {
    /// The revision of its terrains.
    pub terrains: Option<u64>,
    /// The revision of its geofence; `None` also of a robot that knows no geofences.
    pub fence: Option<u64>,
}

/// Whether a robot is there.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Attending {
    /// Whether it is heard now.
    pub is_heard: bool,
    /// Whether its agent said that it leaves.
    pub has_left: bool,
    /// Time since its last heartbeat; `None` if there was none.
    pub silent_for: Option<Duration>,
    /// Why it is not heard; `None` while it is online.
    pub cause: Option<LinkCause>,
}

impl Presences {
    /// Every robot that has ever said hello.
    pub fn known(&self) -> Vec<RobotKey> {
        let robots = self.lock();
        let known = robots.iter().filter(|(_, presence)| presence.welcomed);
        known.map(|(key, _)| key.clone()).collect()
    }

    /// Every robot that has ever said hello, and whether it is there now.
    pub fn attending(&self, now: Duration) -> Vec<(RobotKey, Attending)> {
        let robots = self.lock();
        let known = robots.iter().filter(|(_, presence)| presence.welcomed);
        let attending = |presence: &Presence| Attending {
            is_heard: presence.link(now) != LinkState::Offline,
            has_left: presence.has_left(),
            silent_for: presence.silent_for(now),
            cause: presence.link_cause(now),
        };
        known
            .map(|(key, presence)| (key.clone(), attending(presence)))
            .collect()
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

    /// How many robots of a scope are on the network.
    pub fn present_count(&self, within: &Scope) -> usize {
        self.lock()
            .iter()
            .filter(|((site, robot), presence)| {
                let is_present = presence.welcomed && !presence.tokens.is_empty();
                is_present && within.includes_robot(site, robot)
            })
            .count()
    }
}
