//! Missions that do not begin: the next mission of a robot that drives none, and that has not begun
//! for a time. It raises an alert, and clears it when the mission begins or is no longer the next.
//!
//! A mission that waits for another mission of its robot is not late, and neither is one that a
//! person holds. After a restart of the server the time begins anew; an alert that is raised stays
//! so while a mission of its robot waits.

use std::collections::{HashMap, HashSet};
use std::time::Duration;

use tread_api::ids::MissionId;
use tread_api::mission::MissionState;
use tread_api::robot::{LinkState, RobotMode, Severity};

use super::conditions::WAITING_ALERT_AFTER;
use crate::app::own_alert::OwnAlert;
use crate::app::presence::{Presence, RobotKey};
use crate::app::{App, AppError};
use crate::db;
use crate::db::missions::OpenMission;

/// Code of the alert about a mission that is next and does not begin.
pub(in crate::app) const MISSION_WAITING_ALERT: &str = "mission-waiting";

/// State of a robot whose next mission has not begun.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct DelayedRobot {
    /// The mission with the time since which it is the next; `None` until the first check after a
    /// start of the server.
    next: Option<(MissionId, Duration)>,
    is_raised: bool,
}

impl DelayedRobot {
    const fn raised() -> Self {
        Self {
            next: None,
            is_raised: true,
        }
    }

    /// Returns what is remembered once a mission is seen as the next.
    fn seen(self, mission: MissionId, now: Duration) -> Self {
        match self.next {
            Some((known, _)) if known == mission => self,
            // The first check after a restart ends nothing.
            None => Self {
                next: Some((mission, now)),
                ..self
            },
            Some(_) => Self {
                next: Some((mission, now)),
                is_raised: false,
            },
        }
    }

    fn is_late(self, now: Duration) -> bool {
        let waited = |(_, since): (MissionId, Duration)| now.saturating_sub(since);
        self.next.map(waited) >= Some(WAITING_ALERT_AFTER)
    }
}

/// Next missions of all robots that drive none.
#[derive(Debug, Default)]
pub(super) struct Delays {
    robots: Option<HashMap<RobotKey, DelayedRobot>>,
}

impl Delays {
    /// Checks the open missions, and raises and clears alerts.
    ///
    /// # Errors
    /// The database failed; the next check repeats this one.
    pub(super) async fn check(&mut self, app: &App, open: &[OpenMission]) -> Result<(), AppError> {
        let now = app.clock().elapsed();
        let robots = match &mut self.robots {
            Some(robots) => robots,
            none => none.insert(raised(app).await?),
        };
        let mut waiting = HashSet::new();
        for mission in open.iter().filter(|mission| is_next(mission)) {
            let key = (mission.site.clone(), mission.robot.clone());
            // A robot that was revoked gets no mission, and nobody waits for it.
            if !app.enrolment_registry().may_send(&key) {
                continue;
            }
            let before = robots.get(&key).copied();
            let fresh = DelayedRobot {
                next: None,
                is_raised: false,
            };
            let mut seen = before.unwrap_or(fresh).seen(mission.id, now);
            let was_raised = before.is_some_and(|before| before.is_raised);
            if was_raised && !seen.is_raised {
                store_transition(app, &key, None).await?;
            }
            if !seen.is_raised && seen.is_late(now) {
                store_transition(app, &key, Some(mission)).await?;
                seen.is_raised = true;
            }
            robots.insert(key.clone(), seen);
            waiting.insert(key);
        }
        let over: Vec<RobotKey> = robots
            .keys()
            .filter(|key| !waiting.contains(*key))
            .cloned()
            .collect();
        for key in over {
            if robots.get(&key).is_some_and(|known| known.is_raised) {
                store_transition(app, &key, None).await?;
            }
            robots.remove(&key);
        }
        Ok(())
    }
}

/// Returns whether a mission is the next of a robot that drives none.
fn is_next(mission: &OpenMission) -> bool {
    matches!(mission.state, MissionState::Queued | MissionState::Offered)
}

async fn raised(app: &App) -> Result<HashMap<RobotKey, DelayedRobot>, AppError> {
    let mut tx = app.db().read("reconciler").await?;
    let found = db::alerts::raised_about(&mut tx, MISSION_WAITING_ALERT).await?;
    Ok(found
        .into_iter()
        .map(|key| (key, DelayedRobot::raised()))
        .collect())
}

/// Raises the alert about a mission, or clears that of a robot.
async fn store_transition(
    app: &App,
    key: &RobotKey,
    mission: Option<&OpenMission>,
) -> Result<(), AppError> {
    let mut tx = app.db().write("reconciler").await?;
    let Some(robot_pk) = db::robots::pk_of(&mut tx, &key.0, &key.1).await? else {
        return Ok(());
    };
    let changed = match mission {
        Some(mission) => {
            let alert = OwnAlert {
                code: MISSION_WAITING_ALERT,
                severity: Severity::Warning,
                text: waiting_text(app, key, mission),
                mission: Some(mission.id),
            };
            app.begin_alert(&mut tx, robot_pk, alert).await?
        }
        None => {
            app.end_alert(&mut tx, robot_pk, MISSION_WAITING_ALERT)
                .await?
        }
    };
    Ok(app.commit_alerts(tx, changed.into_iter().collect()).await?)
}

fn waiting_text(app: &App, key: &RobotKey, mission: &OpenMission) -> String {
    let minutes = WAITING_ALERT_AFTER.as_secs() / 60;
    let presence = app.presences().get(key);
    let delay_cause = delay_cause(&presence, presence.link(app.clock().elapsed()));
    format!(
        "mission `{}` has not begun for {minutes} min: {delay_cause}",
        mission.id
    )
}

fn delay_cause(presence: &Presence, link: LinkState) -> &'static str {
    let Some(state) = presence.state().filter(|_| link != LinkState::Offline) else {
        return "the robot is not heard";
    };
    if state.safety.stop.is_some() {
        return "the robot is stopped; clear the stop";
    }
    match state.mode {
        RobotMode::Fault => "the robot has a fault",
        RobotMode::Teleoperated => "the robot is teleoperated",
        RobotMode::Idle | RobotMode::Tracking | RobotMode::Stopped => {
            "the robot does not take it; the history of the mission says why"
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn mission(number: u8) -> MissionId {
        format!("0192f0c1-2b3c-7d4e-8f50-6172839400{number:02x}")
            .parse()
            .unwrap()
    }

    const fn at(seconds: u64) -> Duration {
        Duration::from_secs(seconds)
    }

    #[test]
    fn a_mission_is_late_once_it_was_the_next_for_five_minutes() {
        let fresh = DelayedRobot {
            next: None,
            is_raised: false,
        };
        let first = fresh.seen(mission(1), at(10));
        assert!(!first.seen(mission(1), at(309)).is_late(at(309)));
        assert!(first.seen(mission(1), at(310)).is_late(at(310)));
        let second = first.seen(mission(2), at(310));
        assert!(!second.is_late(at(310)), "another mission is the next");
        assert!(!fresh.is_late(at(1_000)));
    }

    #[test]
    fn an_alert_stays_raised_over_a_restart_and_ends_with_another_mission() {
        let known = DelayedRobot::raised().seen(mission(1), at(1));
        assert!(known.is_raised);
        assert!(!known.seen(mission(2), at(2)).is_raised);
    }
}
