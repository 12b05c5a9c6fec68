//! Detects two agents that run under one robot's name.
//!
//! The run with the newest hello counts as the robot; messages of other runs are refused. If
//! another run keeps sending, it is a second agent: an alert names both runs, and the second one
//! gets a cancel for the mission that it drives.

use std::time::Duration;

use tread_api::ids::{BootId, MissionId};
use tread_api::robot::{AlertReport, Severity};
use tread_api::wire::state::RobotState;

use super::{Presence, Presences, RobotKey};

/// Minimum time for which another run must keep sending before it counts as a second agent: longer
/// than messages of a replaced agent can be under way.
const DUPLICATE_AFTER: Duration = Duration::from_secs(1);
/// Time without a heartbeat after which a second agent counts as gone.
const DUPLICATE_TIMEOUT: Duration = Duration::from_secs(3);
/// Code of the alert about two agents under one name.
const DUPLICATE_ALERT: &str = "two-agents";

/// A second agent that runs under a robot's name.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DuplicateAgent {
    /// The robot's name.
    pub key: RobotKey,
    /// The second agent's run.
    pub boot: BootId,
    /// The mission that it reports.
    pub mission: Option<MissionId>,
}

/// A run that sends beside the present one.
#[derive(Debug, Clone, Copy)]
pub(super) struct OtherRun {
    pub(super) boot: BootId,
    since: Duration,
    /// Time of its last heartbeat, since the start of the server.
    last_message_at: Duration,
    ticks: u64,
    mission: Option<MissionId>,
    /// Whether it has been sending for at least [`DUPLICATE_AFTER`].
    is_duplicate: bool,
}

impl Presence {
    pub(super) fn remove_other(&mut self) {
        let other = self.other.take();
        self.alerts_changed |= other.is_some_and(|other| other.is_duplicate);
    }

    /// Records a state of another run, while the present one is on the network.
    pub(super) fn record_other(&mut self, state: &RobotState, now: Duration) {
        let ticks = state.control_loop.ticks;
        let fresh = OtherRun {
            boot: state.boot,
            since: now,
            last_message_at: now,
            ticks,
            mission: state.mission.map(|mission| mission.id),
            is_duplicate: false,
        };
        match &mut self.other {
            Some(other) if other.boot == state.boot => {
                if ticks <= other.ticks {
                    return;
                }
                let is_sure = now.saturating_sub(other.since) >= DUPLICATE_AFTER;
                self.alerts_changed |= is_sure && !other.is_duplicate;
                *other = OtherRun {
                    since: other.since,
                    is_duplicate: is_sure || other.is_duplicate,
                    ..fresh
                };
            }
            // Only one other run is tracked; the next one after this has gone.
            Some(_) => {}
            None => self.other = Some(fresh),
        }
    }

    /// Returns the server's own alert about a second agent, if there is one.
    pub(super) fn duplicate_agent_alert(&self) -> Option<AlertReport> {
        let other = self.other.filter(|other| other.is_duplicate)?;
        let (present, _since) = self.boot?;
        Some(AlertReport {
            code: DUPLICATE_ALERT.parse().ok()?,
            severity: Severity::Critical,
            text: format!(
                "two agents run under this name: boot {present} counts as the robot, boot {} is \
                 refused",
                other.boot
            ),
        })
    }
}

impl Presences {
    /// Returns the second agents, after forgetting those that have gone.
    pub fn take_duplicate_agents(&self, now: Duration) -> Vec<DuplicateAgent> {
        let mut robots = self.lock();
        let mut duplicates = Vec::new();
        for (key, presence) in robots.iter_mut() {
            let Some(other) = presence.other else {
                continue;
            };
            if now.saturating_sub(other.last_message_at) > DUPLICATE_TIMEOUT {
                presence.remove_other();
            } else if other.is_duplicate {
                duplicates.push(DuplicateAgent {
                    key: key.clone(),
                    boot: other.boot,
                    mission: other.mission,
                });
            }
        }
        duplicates
    }
}

#[cfg(test)]
mod tests {
    use super::super::MessageEffect;
    use super::super::tests::{SECOND, boot, key, state, wall};
    use super::*;

    #[test]
    fn a_second_agent_under_one_name_is_named_until_it_is_silent() {
        let presences = Presences::default();
        let says = |number, seq, at| presences.state(&key(), state(boot(number), seq), at, wall());
        for number in [1, 2] {
            presences.token_appeared(key(), boot(number), SECOND);
            presences.hello(key(), boot(number), SECOND);
        }
        says(2, 1, SECOND);
        presences.take_alert_changes();
        assert_eq!(says(1, 8, SECOND), MessageEffect::OtherRun);
        // A repeated late message is no second agent.
        assert_eq!(says(1, 8, 3 * SECOND), MessageEffect::OtherRun);
        assert!(presences.take_duplicate_agents(3 * SECOND).is_empty());
        assert_eq!(says(1, 9, 3 * SECOND), MessageEffect::OtherRun);
        let duplicates = presences.take_duplicate_agents(3 * SECOND);
        assert_eq!(duplicates.len(), 1);
        assert_eq!(duplicates[0].boot, boot(1));
        let (_, alerts) = presences.take_alert_changes().remove(0);
        for number in [1, 2] {
            assert!(alerts[0].text.contains(&boot(number).to_string()));
        }
        assert!(presences.take_alert_changes().is_empty());
        assert!(presences.take_duplicate_agents(7 * SECOND).is_empty());
        let (_, alerts) = presences.take_alert_changes().remove(0);
        assert!(alerts.is_empty(), "{alerts:?}");
    }
}
