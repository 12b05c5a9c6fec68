//! The task that collects changes and publishes them.

use std::collections::{HashMap, HashSet};
use std::time::Duration;

use tokio_util::sync::CancellationToken;
use tread_api::event::{Event, Topic};
use tread_api::ids::MissionId;
use tread_api::robot::{Alert, Robot};

use super::super::{App, AppError};
use super::ALERTS_MAX;
use crate::app::enrolment::FLEET_ROBOTS_MAX;
use crate::app::presence::RobotKey;
use crate::db::robots::RobotRow;
use crate::db::{self, DbError};

/// Polling interval for changes of robots.
pub const FEED_PERIOD: Duration = Duration::from_millis(100);
/// Maximum number of mission transitions per poll.
const STEPS_MAX: u32 = 500;
/// Minimum interval between two reads of the robots' rows.
const ROWS_PERIOD: Duration = Duration::from_secs(1);

/// Publishes until the stop.
pub async fn run(app: App, stop: CancellationToken) {
    let mut feed = Feed {
        last_step: app.hub().newest().step,
        app: app.clone(),
        moved: HashMap::new(),
        rows: HashMap::new(),
        rows_of: (0, None),
    };
    loop {
        if let Err(error) = db::limited(feed.poll()).await {
            app.log_failure("read what is new", &error);
        }
        tokio::select! {
            biased;
            () = stop.cancelled() => break,
            () = app.announced() => {}
            () = tokio::time::sleep(FEED_PERIOD) => {}
        }
    }
    app.hub().close();
}

/// Robots' rows, with the alerts that are raised about each.
type Rows = HashMap<RobotKey, (RobotRow, Vec<Alert>)>;

struct Feed {
    app: App,
    last_step: i64,
    /// Missions that changed state and are not published yet, and whether they have ended; at most
    /// [`STEPS_MAX`] more than after the poll before.
    moved: HashMap<MissionId, bool>,
    rows: Rows,
    /// Generation of the rows, and when they were read (time since the start).
    rows_of: (u64, Option<Duration>),
}

impl Feed {
    async fn poll(&mut self) -> Result<(), AppError> {
        let now = self.app.clock().elapsed();
        // Live states of robots are published also while the database fails.
        let steps = self.steps().await;
        let robots = self.robots(now).await;
        self.app.hub().sweep(now);
        steps.and(robots)
    }

    async fn steps(&mut self) -> Result<(), AppError> {
        let mut tx = self.app.db().read("events").await?;
        let mut last = self.last_step;
        // Transitions that could not be read before are published first.
        let room = if self.moved.is_empty() { STEPS_MAX } else { 0 };
        let steps = db::history::steps_after(&mut tx, last, room).await?;
        if u32::try_from(steps.len()).is_ok_and(|count| count >= STEPS_MAX) {
            self.app.announce();
        }
        for (pk, step) in steps {
            last = pk;
            let has_ended = step.step.to.is_terminal() && step.step.from != Some(step.step.to);
            *self.moved.entry(step.mission).or_default() |= has_ended;
            let robot = (step.site.clone(), step.robot.clone());
            let event = Event::Step(Box::new(step));
            self.app.hub().publish_step(&event, pk, robot);
        }
        // Each transition is published once, even if the rest fails.
        self.last_step = last;
        let moved: Vec<MissionId> = self.moved.keys().copied().collect();
        for id in moved {
            let row = match db::missions::find(&mut tx, id).await {
                Ok(row) => row,
                // A corrupt row stays unreadable; the mission's transitions are published all the
                // same.
                Err(cause @ DbError::Corrupt { .. }) => {
                    self.app
                        .log_failure("read a mission that has moved", &cause);
                    None
                }
                Err(cause) => return Err(cause.into()),
            };
            let has_ended = self.moved.remove(&id).unwrap_or_default();
            let Some(row) = row else { continue };
            if has_ended {
                self.app.record_duration(&row.mission);
            }
            let mission = self.app.with_progress(row.mission);
            let robot = (mission.site.clone(), mission.robot.clone());
            let event = Event::Mission(Box::new(mission));
            self.app.hub().publish(&event, Topic::Missions, robot);
        }
        Ok(())
    }

    async fn robots(&mut self, now: Duration) -> Result<(), AppError> {
        let generation = self.app.robots_generation();
        let due = self
            .rows_of
            .1
            .is_none_or(|read_at| now.saturating_sub(read_at) >= ROWS_PERIOD);
        let mut changed: HashSet<RobotKey> = HashSet::new();
        let mut failed = None;
        if due && self.rows_of.0 != generation {
            let rows = match self.read_rows().await {
                Ok(rows) => rows,
                Err(error) => {
                    failed = Some(error);
                    self.rows.clone()
                }
            };
            for (key, (row, alerts)) in &rows {
                let is_same = |(before, raised): &(RobotRow, Vec<Alert>)| {
                    (&before.name, before.retired_at, raised) == (&row.name, row.retired_at, alerts)
                };
                if !self.rows.get(key).is_some_and(is_same) {
                    changed.insert(key.clone());
                }
            }
            self.rows = rows;
            // After a failure the rows are read again when the interval has passed.
            let read = if failed.is_some() {
                self.rows_of.0
            } else {
                generation
            };
            self.rows_of = (read, Some(now));
        }
        changed.extend(self.app.presences().take_changed(now));
        if self.app.hub().client_count() == 0 {
            return failed.map_or(Ok(()), Err);
        }
        for key in changed {
            if let Some((row, alerts)) = self.rows.get(&key) {
                let robot: Robot = self.app.with_live(row.clone(), alerts.clone());
                let event = Event::Robot(Box::new(robot));
                self.app.hub().publish(&event, Topic::Robots, key);
            }
        }
        failed.map_or(Ok(()), Err)
    }

    async fn read_rows(&self) -> Result<Rows, AppError> {
        let mut tx = self.app.db().read("events").await?;
        let mut rows = Rows::new();
        for row in db::robots::all(&mut tx, FLEET_ROBOTS_MAX).await? {
            let key = (row.site.clone(), row.id.clone());
            rows.insert(key, (row, Vec::new()));
        }
        for alert in db::alerts::raised(&mut tx, ALERTS_MAX).await? {
            let row = alert.robot_key().and_then(|key| rows.get_mut(&key));
            if let Some((_row, alerts)) = row {
                alerts.push(alert);
            }
        }
        Ok(rows)
    }
}
