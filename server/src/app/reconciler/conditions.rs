//! Conditions of robots that last: a robot that does not come on with its mission, and a robot whose
//! clock is wrong. Each raises an alert after a time, and clears it when it is over.
//!
//! What a robot shows is judged only while it is heard; a robot that is not heard has an alert of
//! its own ([`super::attendance`]). After a restart of the server an alert that is raised stays so
//! until the robot shows that its cause is over.

use std::collections::{HashMap, HashSet};
use std::time::Duration;

use tread_api::ids::MissionId;
use tread_api::mission::MissionState;
use tread_api::robot::{Alert, LinkState, Severity};

use crate::app::own_alert::OwnAlert;
use crate::app::presence::{ReportedCondition, RobotKey};
use crate::app::{App, AppError};
use crate::db;
use crate::db::missions::OpenMission;

/// Code of the alert about a robot that has waited too long on its mission.
pub(in crate::app) const ROBOT_WAITING_ALERT: &str = "robot-waiting";
/// Code of the alert about a robot whose clock is wrong.
pub(in crate::app) const CLOCK_WRONG_ALERT: &str = "clock-wrong";
/// Time without progress on its mission after which a robot has waited too long, for whatever
/// reason: a pause, a stop, a limit of another program.
pub(in crate::app) const WAITING_ALERT_AFTER: Duration = Duration::from_mins(5);
/// Minimum progress that ends waiting, metres.
const PROGRESS_MIN_M: f64 = 0.1;
/// Offset between a robot's clock and the server's from which the robot's counts as wrong,
/// milliseconds.
const CLOCK_WRONG_MS: u64 = 10_000;
/// Offset below which a wrong clock counts as right again, milliseconds.
const CLOCK_RIGHT_MS: u64 = 5_000;
/// Time for which a clock must be wrong before the alert is raised: states that wait on a slow link
/// look like a clock that is behind.
const CLOCK_WRONG_FOR: Duration = Duration::from_secs(30);
/// Minimum interval between two checks.
const CHECK_EVERY: Duration = Duration::from_secs(1);

/// What is remembered of a robot.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct Memory {
    /// Mission with the progress from which it has not come on, and the time since which.
    standing: Option<(MissionId, f64, Duration)>,
    /// Time since which its clock has been wrong.
    wrong_since: Option<Duration>,
    is_waiting: bool,
    is_clock_wrong: bool,
}

/// Change of what is remembered of a robot.
#[derive(Debug, Clone, Copy)]
struct MemoryChange {
    before: Memory,
    after: Memory,
}

impl Memory {
    /// Takes in what the robot shows; `is_waiting` and `is_clock_wrong` are right afterwards.
    fn judge(&mut self, shown: ReportedCondition, now: Duration) {
        match (shown.mission, self.standing) {
            (None, _) => {
                self.standing = None;
                self.is_waiting = false;
            }
            (Some(progress), Some((mission, driven_m, since)))
                if progress.id == mission && progress.driven_m < driven_m + PROGRESS_MIN_M =>
            {
                let waited = now.saturating_sub(since);
                self.is_waiting |= waited >= WAITING_ALERT_AFTER;
            }
            (Some(progress), before) => {
                // The first look after a restart of the server ends nothing.
                self.is_waiting &= before.is_none();
                self.standing = Some((progress.id, progress.driven_m, now));
            }
        }
        let offset_ms = shown.clock_offset_ms.unsigned_abs();
        if offset_ms < CLOCK_RIGHT_MS {
            self.wrong_since = None;
            self.is_clock_wrong = false;
        } else if offset_ms >= CLOCK_WRONG_MS {
            let since = *self.wrong_since.get_or_insert(now);
            self.is_clock_wrong |= now.saturating_sub(since) >= CLOCK_WRONG_FOR;
        } else {
            self.wrong_since = None;
        }
    }
}

/// Lasting conditions of all robots.
#[derive(Debug, Default)]
pub(super) struct Conditions {
    robots: Option<HashMap<RobotKey, Memory>>,
    looked_at: Option<Duration>,
}

impl Conditions {
    /// Checks all robots that are heard, and raises and clears their alerts.
    ///
    /// # Errors
    /// The database failed; the next check repeats this one.
    pub(super) async fn check(&mut self, app: &App) -> Result<(), AppError> {
        let now = app.clock().elapsed();
        let is_early = |looked_at: Duration| now.saturating_sub(looked_at) < CHECK_EVERY;
        if self.looked_at.is_some_and(is_early) {
            return Ok(());
        }
        let robots = match &mut self.robots {
            Some(robots) => robots,
            none => none.insert(raised(app).await?),
        };
        for (key, shown) in app.presences().conditions(now) {
            let memory = robots.entry(key.clone()).or_default();
            let mut judged = *memory;
            judged.judge(shown, now);
            if (judged.is_waiting, judged.is_clock_wrong)
                != (memory.is_waiting, memory.is_clock_wrong)
            {
                let change = MemoryChange {
                    before: *memory,
                    after: judged,
                };
                store_transition(app, &key, change, shown).await?;
            }
            *memory = judged;
        }
        self.looked_at = Some(now);
        Ok(())
    }

    /// Clears the alert about a robot that is not heard and waited on a mission that has ended
    /// meanwhile: the robot cannot show that it no longer drives it.
    ///
    /// # Errors
    /// The database failed; the next check repeats this one.
    pub(super) async fn end_of_absent(
        &mut self,
        app: &App,
        open: &[OpenMission],
    ) -> Result<(), AppError> {
        let now = app.clock().elapsed();
        let robots = self.robots.iter_mut().flatten();
        for (key, memory) in robots.filter(|(_, memory)| memory.is_waiting) {
            let is_of_robot =
                |mission: &&OpenMission| (&mission.site, &mission.robot) == (&key.0, &key.1);
            let has_mission = open.iter().filter(is_of_robot).any(is_in_progress);
            if has_mission || app.presences().get(key).link(now) != LinkState::Offline {
                continue;
            }
            let judged = Memory {
                is_waiting: false,
                standing: None,
                ..*memory
            };
            let shown = ReportedCondition {
                mission: None,
                clock_offset_ms: 0,
            };
            let change = MemoryChange {
                before: *memory,
                after: judged,
            };
            store_transition(app, key, change, shown).await?;
            *memory = judged;
        }
        Ok(())
    }
}

/// Returns whether a robot has accepted a mission that has not ended.
fn is_in_progress(mission: &OpenMission) -> bool {
    matches!(
        mission.state,
        MissionState::Active | MissionState::Paused | MissionState::Cancelling
    )
}

async fn raised(app: &App) -> Result<HashMap<RobotKey, Memory>, AppError> {
    let mut tx = app.db().read("reconciler").await?;
    let mut of_code = async |code| {
        let found = db::alerts::raised_about(&mut tx, code).await?;
        Ok::<HashSet<RobotKey>, AppError>(found.into_iter().collect())
    };
    let waiting = of_code(ROBOT_WAITING_ALERT).await?;
    let wrong = of_code(CLOCK_WRONG_ALERT).await?;
    let memory = |key: &RobotKey| Memory {
        is_waiting: waiting.contains(key),
        is_clock_wrong: wrong.contains(key),
        ..Memory::default()
    };
    let keys = waiting.union(&wrong);
    Ok(keys.map(|key| (key.clone(), memory(key))).collect())
}

async fn store_transition(
    app: &App,
    (site, robot): &RobotKey,
    MemoryChange { before, after }: MemoryChange,
    shown: ReportedCondition,
) -> Result<(), AppError> {
    let mut tx = app.db().write("reconciler").await?;
    let Some(robot_pk) = db::robots::pk_of(&mut tx, site, robot).await? else {
        return Ok(());
    };
    let mut alerts: Vec<Alert> = Vec::new();
    let turns = [
        (
            (before.is_waiting, after.is_waiting),
            ROBOT_WAITING_ALERT,
            waiting_text(shown),
        ),
        (
            (before.is_clock_wrong, after.is_clock_wrong),
            CLOCK_WRONG_ALERT,
            clock_text(shown.clock_offset_ms),
        ),
    ];
    for (turn, code, text) in turns {
        let changed = match turn {
            (false, true) => {
                let alert = OwnAlert {
                    code,
                    severity: Severity::Warning,
                    text,
                    mission: None,
                };
                app.begin_alert(&mut tx, robot_pk, alert).await?
            }
            (true, false) => app.end_alert(&mut tx, robot_pk, code).await?,
            (true, true) | (false, false) => None,
        };
        alerts.extend(changed);
    }
    Ok(app.commit_alerts(tx, alerts).await?)
}

fn waiting_text(shown: ReportedCondition) -> String {
    let minutes = WAITING_ALERT_AFTER.as_secs() / 60;
    let how = match shown.mission {
        Some(progress) if progress.paused => "it is paused",
        Some(_) | None => "it is not paused: look what holds the robot",
    };
    let id = shown.mission.map(|progress| progress.id.to_string());
    let id = id.unwrap_or_default();
    format!("the robot has not come on with mission `{id}` for {minutes} min; {how}")
}

fn clock_text(offset_ms: i64) -> String {
    let seconds = Duration::from_millis(offset_ms.unsigned_abs()).as_secs_f64();
    let direction = if offset_ms > 0 { "ahead of" } else { "behind" };
    format!(
        "the robot's clock is {seconds:.1} s {direction} the server's: look which of the two is \
         wrong, and synchronise it"
    )
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn shown(mission: u8, driven_m: f64) -> ReportedCondition {
        let progress = json!({
            "id": format!("0192f0c1-2b3c-7d4e-8f50-6172839400{mission:02x}"), "revision": 1,
            "plan_hash": "0192f0c1-2b3c-5d4e-8f50-617283940a1b", "driven_m": driven_m,
            "length_m": 100.0, "cross_track_m": 0.0,
        });
        ReportedCondition {
            mission: Some(serde_json::from_value(progress).unwrap()),
            clock_offset_ms: 0,
        }
    }

    fn off_by(clock_offset_ms: i64) -> ReportedCondition {
        ReportedCondition {
            mission: None,
            clock_offset_ms,
        }
    }

    const fn at(seconds: u64) -> Duration {
        Duration::from_secs(seconds)
    }

    #[test]
    fn a_robot_waits_too_long_when_it_does_not_come_on_until_it_does_or_the_mission_ends() {
        let mut memory = Memory::default();
        memory.judge(shown(1, 5.0), at(0));
        memory.judge(shown(1, 5.05), at(299));
        assert!(!memory.is_waiting);
        memory.judge(shown(1, 5.05), at(300));
        assert!(memory.is_waiting);
        memory.judge(shown(1, 5.2), at(301));
        assert!(!memory.is_waiting, "it drives again");
        memory.judge(shown(1, 5.2), at(601));
        assert!(memory.is_waiting);
        memory.judge(shown(2, 5.2), at(602));
        assert!(!memory.is_waiting, "it is another mission");
        memory.judge(shown(2, 5.2), at(1_000));
        memory.judge(off_by(0), at(1_001));
        assert!(!memory.is_waiting, "it has none");
    }

    #[test]
    fn a_robot_that_waits_still_waits_after_a_restart_of_the_server() {
        let mut memory = Memory {
            is_waiting: true,
            ..Memory::default()
        };
        memory.judge(shown(1, 5.0), at(1));
        memory.judge(shown(1, 5.0), at(2));
        assert!(memory.is_waiting);
        memory.judge(shown(1, 6.0), at(3));
        assert!(!memory.is_waiting);
    }

    #[test]
    fn a_clock_is_wrong_when_it_stays_so_and_right_when_it_is_clearly_near() {
        let mut memory = Memory::default();
        memory.judge(off_by(-11_000), at(0));
        memory.judge(off_by(-9_000), at(20));
        memory.judge(off_by(11_000), at(31));
        assert!(!memory.is_clock_wrong, "it was not wrong all the time");
        memory.judge(off_by(i64::MIN), at(61));
        assert!(memory.is_clock_wrong);
        memory.judge(off_by(7_000), at(62));
        assert!(memory.is_clock_wrong);
        memory.judge(off_by(4_999), at(63));
        assert!(!memory.is_clock_wrong);
    }
}
