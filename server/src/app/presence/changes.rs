//! Changes of robots, for event clients and for stored alerts.

use std::time::Duration;

use tread_api::ids::{MissionId, StopId};
use tread_api::robot::{AlertReport, LinkCause, LinkState, RobotMode};

use super::{Presences, RobotKey, content, lease_of, stop_of};

/// State of a robot that was published last to event clients.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct PublishedState {
    at: Duration,
    link: LinkState,
    cause: Option<LinkCause>,
    mode: Option<RobotMode>,
    mission: Option<(MissionId, u32, bool)>,
    stop: Option<StopId>,
    lease: Option<u64>,
    seq: Option<u64>,
}

/// Minimum interval between two events about a robot of which only measured values changed.
const SHOW_PERIOD: Duration = Duration::from_secs(1);

/// Maximum number of robots per call.
const CHANGES_MAX: usize = 500;

impl Presences {
    /// Returns the alerts of each robot whose alerts changed since the last call.
    pub fn take_alert_changes(&self) -> Vec<(RobotKey, Vec<AlertReport>)> {
        let mut robots = self.lock();
        let changed = robots
            .iter_mut()
            .filter(|(_, presence)| presence.alerts_changed);
        let taken = changed.filter_map(|(key, presence)| {
            // Without a state of the present run, the robot's own alerts are not known.
            let own = presence.state()?.alerts.clone();
            let alerts = presence
                .duplicate_agent_alert()
                .into_iter()
                .chain(own)
                .collect();
            presence.alerts_changed = false;
            Some((key.clone(), alerts))
        });
        taken.collect()
    }

    /// Marks a robot's alerts as changed again, because they could not be stored.
    pub fn return_alert_change(&self, key: &RobotKey) {
        if let Some(presence) = self.lock().get_mut(key) {
            presence.alerts_changed = true;
        }
    }

    /// Returns the robots whose present state event clients have not seen: at once after a change
    /// of link, mode, mission, stop or lease, and once a second while only measured values change.
    ///
    /// At most [`CHANGES_MAX`] per call, so that clients are not overloaded; the others follow in
    /// later calls.
    pub fn take_changed(&self, now: Duration) -> Vec<RobotKey> {
        let mut robots = self.lock();
        let mut changed = Vec::new();
        for (key, presence) in robots.iter_mut() {
            if !presence.welcomed {
                continue;
            }
            let state = presence.state();
            let shown = PublishedState {
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
                let same = PublishedState {
                    at: before.at,
                    seq: before.seq,
                    ..shown
                };
                moved || before != same
            });
            if is_new {
                presence.shown = Some(shown);
                changed.push(key.clone());
            }
            if changed.len() >= CHANGES_MAX {
                break;
            }
        }
        changed
    }
}
