//! Attendance: raises an alert for each robot that was on the network and is no longer heard for a
//! time.
//!
//! ```text
//!              heard                 not heard for LOST_AFTER
//!   absent ─────────────► present ────────────────────────────► lost
//!      ▲                     │  ▲      heard for BACK_AFTER       │
//!      └─────────────────────┘  └─────────────────────────────────┘
//!        leaves by itself
//! ```
//!
//! The state of each robot is in the database, so a restart of the server changes nothing, except
//! that it waits for [`START_GRACE`] until robots have connected again.

use std::collections::HashMap;
use std::time::Duration;

use tread_api::robot::{LinkCause, Severity};

use crate::app::own_alert::OwnAlert;
use crate::app::presence::RobotKey;
use crate::app::{App, AppError};
use crate::db;

/// Code of the alert about a robot that was present and is no longer heard.
pub(in crate::app) const ROBOT_LOST_ALERT: &str = "robot-lost";
/// Time for which a present robot may be unheard before its alert is raised: longer than links take
/// to recover.
pub(in crate::app) const LOST_AFTER: Duration = Duration::from_secs(15);
/// Time for which a robot must be heard again before its alert is cleared.
pub(in crate::app) const BACK_AFTER: Duration = Duration::from_secs(3);
/// Minimum interval between two checks: in a large fleet the reconciler is woken far more often.
const CHECK_EVERY: Duration = Duration::from_millis(500);
/// Time after the start of the server in which no robot counts as lost, since all of them must
/// reconnect.
pub(in crate::app) const START_GRACE: Duration = Duration::from_secs(30);

/// Attendance of one robot.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
struct RobotAttendance {
    is_present: bool,
    is_lost: bool,
    /// Time since which it has been heard without interruption.
    heard_since: Option<Duration>,
}

/// Transition of a robot's attendance, to be stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Turn {
    Came,
    Left,
    Lost,
    Back,
}

/// Link of a robot at a check.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct ObservedLink {
    is_heard: bool,
    has_left: bool,
    silent: Duration,
}

/// Times of a check.
#[derive(Debug, Clone, Copy)]
struct Now {
    elapsed: Duration,
    uptime: Duration,
}

impl RobotAttendance {
    /// Returns the transition that follows from a check; the caller applies it once it is stored.
    fn judge(&mut self, observed: ObservedLink, now: Now) -> Option<Turn> {
        if !observed.is_heard {
            self.heard_since = None;
            if observed.has_left {
                return self.is_present.then_some(Turn::Left);
            }
            let is_over = observed.silent >= LOST_AFTER && now.uptime >= START_GRACE;
            return (self.is_present && is_over).then_some(Turn::Lost);
        }
        let since = *self.heard_since.get_or_insert(now.elapsed);
        if self.is_lost {
            let is_back = now.elapsed.saturating_sub(since) >= BACK_AFTER;
            return is_back.then_some(Turn::Back);
        }
        (!self.is_present).then_some(Turn::Came)
    }

    fn apply(&mut self, turn: Turn) {
        (self.is_present, self.is_lost) = match turn {
            Turn::Came | Turn::Back => (true, false),
            Turn::Left => (false, self.is_lost),
            Turn::Lost => (false, true),
        };
    }
}

/// Attendance of all robots, as stored in the database.
#[derive(Debug, Default)]
pub(super) struct Attendance {
    robots: Option<HashMap<RobotKey, RobotAttendance>>,
    looked_at: Option<Duration>,
}

impl Attendance {
    /// Checks all robots, and raises and clears the alerts of those that are lost or back.
    ///
    /// # Errors
    /// The database failed; the next check repeats this one.
    pub(super) async fn check(&mut self, app: &App) -> Result<(), AppError> {
        let elapsed = app.clock().elapsed();
        let is_early = |looked_at: Duration| elapsed.saturating_sub(looked_at) < CHECK_EVERY;
        if self.looked_at.is_some_and(is_early) {
            return Ok(());
        }
        let robots = match &mut self.robots {
            Some(robots) => robots,
            none => none.insert(expected(app).await?),
        };
        let now = Now {
            elapsed,
            uptime: app.uptime(),
        };
        for (key, attending) in app.presences().attending(elapsed) {
            let seen = robots.entry(key.clone()).or_default();
            let observed = ObservedLink {
                is_heard: attending.is_heard,
                has_left: attending.has_left,
                // A robot that was never heard has been silent at least since the start.
                silent: attending.silent_for.unwrap_or(now.uptime),
            };
            if let Some(turn) = seen.judge(observed, now) {
                store_transition(app, &key, turn, attending.cause).await?;
                seen.apply(turn);
            }
        }
        self.looked_at = Some(elapsed);
        Ok(())
    }
}

async fn expected(app: &App) -> Result<HashMap<RobotKey, RobotAttendance>, AppError> {
    let mut tx = app.db().read("reconciler").await?;
    let expected = db::attendance::all(&mut tx, ROBOT_LOST_ALERT).await?;
    let seen = |robot: db::attendance::Expected| {
        let seen = RobotAttendance {
            is_present: robot.is_present,
            is_lost: robot.is_alerted,
            heard_since: None,
        };
        ((robot.site, robot.robot), seen)
    };
    Ok(expected.into_iter().map(seen).collect())
}

async fn store_transition(
    app: &App,
    key: &RobotKey,
    turn: Turn,
    cause: Option<LinkCause>,
) -> Result<(), AppError> {
    let (site, robot) = key;
    let mut tx = app.db().write("reconciler").await?;
    let Some(site_row) = db::sites::find(&mut tx, site).await? else {
        return Ok(());
    };
    let Some(row) = db::robots::find(&mut tx, site_row.pk, robot).await? else {
        return Ok(());
    };
    let is_there = matches!(turn, Turn::Came | Turn::Back);
    db::attendance::set_present(&mut tx, row.pk, is_there).await?;
    // No alert for a robot that was retired or revoked.
    let is_missed = row.retired_at.is_none() && app.enrolment_registry().may_send(key);
    let alert = match turn {
        Turn::Lost if is_missed => {
            let alert = OwnAlert {
                code: ROBOT_LOST_ALERT,
                severity: Severity::Critical,
                text: lost_text(cause),
                mission: None,
            };
            app.begin_alert(&mut tx, row.pk, alert).await?
        }
        Turn::Back => app.end_alert(&mut tx, row.pk, ROBOT_LOST_ALERT).await?,
        Turn::Came | Turn::Left | Turn::Lost => None,
    };
    Ok(app.commit_alerts(tx, alert.into_iter().collect()).await?)
}

fn lost_text(cause: Option<LinkCause>) -> String {
    let why = match cause {
        Some(LinkCause::RobotOff) => "its agent ended without leaving: it crashed, or lost power",
        Some(LinkCause::LinkDown) => "it went silent: the network to it is down, or it is off",
        Some(LinkCause::LoopStopped) => "its agent speaks, and its control loop stands still",
        Some(LinkCause::Joining) => "it is on the network, and sends no heartbeat",
        Some(LinkCause::ServerRestarted) => "it has not come back since the server started",
        None => "it sends no heartbeat",
    };
    let after_s = LOST_AFTER.as_secs();
    format!("the robot was present and has not been heard for more than {after_s} s: {why}")
}

#[cfg(test)]
mod tests {
    use super::*;

    const HEARD: ObservedLink = ObservedLink {
        is_heard: true,
        has_left: false,
        silent: Duration::ZERO,
    };

    fn silent(seconds: u64) -> ObservedLink {
        ObservedLink {
            is_heard: false,
            has_left: false,
            silent: Duration::from_secs(seconds),
        }
    }

    fn at(seconds: u64) -> Now {
        let elapsed = Duration::from_secs(seconds);
        Now {
            elapsed,
            uptime: elapsed,
        }
    }

    fn step(seen: &mut RobotAttendance, look: ObservedLink, now: Now) -> Option<Turn> {
        let turn = seen.judge(look, now);
        if let Some(turn) = turn {
            seen.apply(turn);
        }
        turn
    }

    #[test]
    fn a_robot_that_goes_away_is_lost_after_the_bound_once_and_back_when_it_is_heard_on() {
        let mut seen = RobotAttendance::default();
        assert_eq!(step(&mut seen, HEARD, at(100)), Some(Turn::Came));
        assert_eq!(step(&mut seen, silent(14), at(114)), None);
        assert_eq!(step(&mut seen, silent(15), at(115)), Some(Turn::Lost));
        assert_eq!(step(&mut seen, silent(500), at(600)), None);
        // A link that goes up and down neither clears nor raises the alert.
        for cycle in 0..20 {
            assert_eq!(step(&mut seen, HEARD, at(700 + 4 * cycle)), None);
            assert_eq!(step(&mut seen, HEARD, at(702 + 4 * cycle)), None);
            assert_eq!(step(&mut seen, silent(2), at(703 + 4 * cycle)), None);
        }
        assert_eq!(step(&mut seen, HEARD, at(800)), None);
        assert_eq!(step(&mut seen, HEARD, at(803)), Some(Turn::Back));
        assert_eq!(step(&mut seen, HEARD, at(804)), None);
    }

    #[test]
    fn nobody_is_lost_who_left_by_itself_or_while_the_server_has_just_started() {
        let mut seen = RobotAttendance::default();
        step(&mut seen, HEARD, at(100));
        let left = ObservedLink {
            has_left: true,
            ..silent(1)
        };
        assert_eq!(step(&mut seen, left, at(101)), Some(Turn::Left));
        assert_eq!(step(&mut seen, silent(60), at(160)), None);
        // After a restart of the server: the robot was present before.
        let mut seen = RobotAttendance {
            is_present: true,
            ..RobotAttendance::default()
        };
        assert_eq!(step(&mut seen, silent(29), at(29)), None);
        assert_eq!(step(&mut seen, silent(30), at(30)), Some(Turn::Lost));
    }
}
