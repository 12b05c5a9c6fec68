//! What of robots is new: for event clients, and for the alerts that are written down.

use std::time::Duration;

use tread_api::ids::{MissionId, StopId};
use tread_api::robot::{AlertReport, LinkCause, LinkState, RobotMode};

use super::{Presences, RobotKey, content, lease_of, stop_of};

/// What of a robot was shown to event clients last.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Shown {
    at: Duration,
    link: LinkState,
    cause: Option<LinkCause>,
    mode: Option<RobotMode>,
    mission: Option<(MissionId, u32, bool)>,
    stop: Option<StopId>,
    lease: Option<u64>,
    seq: Option<u64>,
}

/// Least time between two events on a robot whose state only moved on.
const SHOW_PERIOD: Duration = Duration::from_secs(1);

/// Robots that are shown afresh at a time.
const NEWS_MAX: usize = 500;

impl Presences {
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
}
