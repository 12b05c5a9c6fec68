//! State of a site, accumulated from its events.

use std::collections::BTreeMap;

use tread_api::event::Event;
use tread_api::ids::{AlertId, MissionId, RobotId};
use tread_api::mission::{Mission, MissionState};
use tread_api::robot::{Alert, LinkState, Robot};

/// Maximum number of missions kept; the oldest are dropped.
const MISSIONS_KEPT: usize = 1_000;

/// State of a site, accumulated from its events.
#[derive(Debug, Default)]
pub(super) struct SiteState {
    robots: BTreeMap<RobotId, Robot>,
    missions: BTreeMap<MissionId, Mission>,
    /// Alerts about the server itself that have not cleared.
    server_alerts: BTreeMap<AlertId, Alert>,
    is_whole: bool,
}

/// Number of robots, missions and alerts by state.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Counts {
    pub(super) online: usize,
    pub(super) stale: usize,
    pub(super) offline: usize,
    pub(super) stopped: usize,
    pub(super) in_progress: usize,
    pub(super) queued: usize,
    pub(super) alerts: usize,
}

impl SiteState {
    pub(super) fn take(&mut self, event: Event) {
        match event {
            Event::SnapshotBegin => *self = Self::default(),
            Event::SnapshotEnd => self.is_whole = true,
            Event::Robot(robot) => {
                self.robots.insert(robot.id.clone(), *robot);
            }
            Event::Mission(mission) => {
                self.missions.insert(mission.id, *mission);
                if self.missions.len() > MISSIONS_KEPT {
                    self.missions.pop_first();
                }
            }
            Event::Alert(alert) if alert.robot.is_none() => {
                if alert.cleared_at.is_some() {
                    self.server_alerts.remove(&alert.id);
                } else {
                    self.server_alerts.insert(alert.id, *alert);
                }
            }
            // Alerts of a robot are part of the robot, steps of a mission part of the mission.
            Event::Alert(_) | Event::Step(_) | Event::Map(_) | Event::End(_) => {}
        }
    }

    /// Whether the snapshot is complete.
    pub(super) fn is_whole(&self) -> bool {
        self.is_whole
    }

    /// Iterates over the robots that are not retired, by identifier.
    pub(super) fn robots(&self) -> impl Iterator<Item = &Robot> {
        self.robots
            .values()
            .filter(|robot| robot.retired_at.is_none())
    }

    /// Returns active missions, then queued ones, then ended ones, each the newest first.
    pub(super) fn missions(&self) -> Vec<Mission> {
        let mut missions: Vec<Mission> = self
            .missions
            .values()
            .rev()
            .map(|mission| self.fresh(mission))
            .collect();
        missions.sort_by_key(|mission| {
            let (state, is_ended) = (mission.state, mission.state.is_terminal());
            (is_ended, state == MissionState::Queued)
        });
        missions
    }

    /// Returns a mission with the newest progress of its robot; missions are only sent on a step.
    fn fresh(&self, mission: &Mission) -> Mission {
        let live = self.robots.get(&mission.robot);
        let driven = live.and_then(|robot| robot.live.as_ref()?.mission);
        let progress =
            driven.filter(|driven| driven.id == mission.id && !mission.state.is_terminal());
        Mission {
            progress: progress.or(mission.progress),
            ..mission.clone()
        }
    }

    /// Returns the alerts that have not cleared: unacknowledged ones first, then the newest.
    pub(super) fn alerts(&self) -> Vec<&Alert> {
        let of_robots = self.robots().flat_map(|robot| &robot.alerts);
        let mut alerts: Vec<&Alert> = self.server_alerts.values().chain(of_robots).collect();
        alerts.sort_by_key(|alert| {
            let newest = std::cmp::Reverse(alert.raised_at);
            (alert.acknowledged_at.is_some(), newest)
        });
        alerts
    }

    pub(super) fn counts(&self) -> Counts {
        let linked = |link: LinkState| self.robots().filter(|robot| robot.link == link).count();
        let is_stopped = |robot: &&Robot| {
            let live = robot.live.as_ref();
            live.is_some_and(|live| live.safety.stop.is_some())
        };
        let open = || {
            let all = self.missions.values();
            all.filter(|mission| !mission.state.is_terminal())
        };
        let queued = open().filter(|mission| mission.state == MissionState::Queued);
        let queued = queued.count();
        Counts {
            online: linked(LinkState::Online),
            stale: linked(LinkState::Stale),
            offline: linked(LinkState::Offline),
            stopped: self.robots().filter(is_stopped).count(),
            in_progress: open().count() - queued,
            queued,
            alerts: self.alerts().len(),
        }
    }
}
