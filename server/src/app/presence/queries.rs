//! Queries over all robots. A robot is heard while its link is online or stale.

use std::collections::BTreeMap;
use std::time::Duration;

use tread_api::ids::{BootId, MissionId, StopId};
use tread_api::link::LinkQuality;
use tread_api::rights::Scope;
use tread_api::robot::{LinkCause, LinkState, MissionProgress};

use super::{Presence, Presences, RobotKey, stop_of};

/// Revisions of a site's data that a robot reports.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ReportedRevisions {
    /// Revision of the terrains.
    pub terrains: Option<u64>,
    /// Revision of the geofence; `None` also for a robot without support for geofences.
    pub fence: Option<u64>,
}

/// Link of one robot.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LinkStatus {
    /// Whether its link is online or stale.
    pub is_heard: bool,
    /// Whether its agent reported that it leaves.
    pub has_left: bool,
    /// Time since its last heartbeat; `None` if there was none.
    pub silent_for: Option<Duration>,
    /// Cause of a link that is not online; `None` while it is.
    pub cause: Option<LinkCause>,
}

/// Mission and clock of a robot that is heard.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ReportedCondition {
    /// Progress of its mission.
    pub mission: Option<MissionProgress>,
    /// Offset of its clock, milliseconds, positive if it is ahead of the server's.
    pub clock_offset_ms: i64,
}

impl Presences {
    /// Returns every robot that has ever sent a hello.
    pub fn known(&self) -> Vec<RobotKey> {
        let robots = self.lock();
        let known = robots.iter().filter(|(_, presence)| presence.welcomed);
        known.map(|(key, _)| key.clone()).collect()
    }

    /// Returns the link of every robot that has ever sent a hello.
    pub fn attending(&self, now: Duration) -> Vec<(RobotKey, LinkStatus)> {
        let robots = self.lock();
        let known = robots.iter().filter(|(_, presence)| presence.welcomed);
        let attending = |presence: &Presence| LinkStatus {
            is_heard: presence.link(now) != LinkState::Offline,
            has_left: presence.has_left(),
            silent_for: presence.silent_for(now),
            cause: presence.link_cause(now),
        };
        known
            .map(|(key, presence)| (key.clone(), attending(presence)))
            .collect()
    }

    /// Returns mission and clock of every robot that is heard at `now`. The clock of a robot without
    /// enough states counts as right.
    pub fn conditions(&self, now: Duration) -> Vec<(RobotKey, ReportedCondition)> {
        let robots = self.lock();
        let heard = robots
            .iter()
            .filter(|(_, presence)| presence.link(now) != LinkState::Offline);
        let shown = |presence: &Presence| {
            let offset_ms = presence.clock_offsets_ms.has_enough();
            let offset_ms = offset_ms.then(|| presence.clock_offset_ms());
            Some(ReportedCondition {
                mission: presence.state()?.mission,
                clock_offset_ms: offset_ms.unwrap_or(0),
            })
        };
        heard
            .filter_map(|(key, presence)| Some((key.clone(), shown(presence)?)))
            .collect()
    }

    /// Returns the stop that each robot reports as in force.
    pub fn shown_stops(&self) -> Vec<(RobotKey, StopId)> {
        let robots = self.lock();
        let shown = |(key, presence): (&RobotKey, &Presence)| {
            Some((key.clone(), presence.state().and_then(stop_of)?))
        };
        robots.iter().filter_map(shown).collect()
    }

    /// Returns the robots online at `now`, with the revisions of terrains and geofence that each
    /// reports.
    pub fn online(&self, now: Duration) -> Vec<(RobotKey, ReportedRevisions)> {
        let robots = self.lock();
        let online = robots
            .iter()
            .filter(|(_, presence)| presence.link(now) == LinkState::Online);
        let held = |presence: &Presence| {
            let state = presence.state();
            ReportedRevisions {
                terrains: state.and_then(|state| state.terrain_revision),
                fence: state.and_then(|state| state.safety.fence_revision),
            }
        };
        online
            .map(|(key, presence)| (key.clone(), held(presence)))
            .collect()
    }

    /// Returns the present run of a robot that is online at `now`; `None` if it is not.
    pub fn online_run(&self, key: &RobotKey, now: Duration) -> Option<BootId> {
        let robots = self.lock();
        let presence = robots.get(key)?;
        let (boot, _since) = presence.boot()?;
        (presence.link(now) == LinkState::Online).then_some(boot)
    }

    /// Returns, for each robot heard at `now` that reports a mission, the robot and that mission.
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

    /// Returns the number of robots, by the name of the cause that limits their speed most, of
    /// those heard at `now`.
    pub fn gate_causes(&self, now: Duration) -> BTreeMap<String, usize> {
        let robots = self.lock();
        let mut causes = BTreeMap::new();
        for presence in robots.values() {
            let state = presence
                .state()
                .filter(|_| presence.link(now) != LinkState::Offline);
            let cause = state.and_then(|state| state.safety.gate.cause);
            // The name of a cause in JSON.
            if let Some(serde_json::Value::String(name)) =
                cause.and_then(|cause| serde_json::to_value(cause).ok())
            {
                *causes.entry(name).or_insert(0) += 1;
            }
        }
        causes
    }

    /// Returns the quality of the links of at most `robots_max` robots, in the order of their
    /// names, and the number of robots beyond those.
    pub fn link_qualities(
        &self,
        now: Duration,
        robots_max: usize,
    ) -> (Vec<(RobotKey, LinkQuality)>, usize) {
        let robots = self.lock();
        let welcomed = robots.iter().filter(|(_, presence)| presence.welcomed);
        let mut found: Vec<(RobotKey, LinkQuality)> = welcomed
            .filter_map(|(key, presence)| Some((key.clone(), presence.link_quality(now)?)))
            .collect();
        drop(robots);
        found.sort_by(|(one, _), (other, _)| one.cmp(other));
        let left_out = found.len().saturating_sub(robots_max);
        found.truncate(robots_max);
        (found, left_out)
    }

    /// Returns the number of robots in each link state.
    pub fn link_counts(&self, now: Duration) -> [(LinkState, usize); 3] {
        let robots = self.lock();
        LinkState::ALL.map(|link| {
            let has = |presence: &&Presence| presence.welcomed && presence.link(now) == link;
            (link, robots.values().filter(has).count())
        })
    }

    /// Returns the number of robots of a scope with a liveliness token on the network.
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
