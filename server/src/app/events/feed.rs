//! The one task that looks for what is new, and publishes it.

use std::collections::{HashMap, HashSet};
use std::time::Duration;

use tokio_util::sync::CancellationToken;
use tracing::error;
use tread_api::event::{Event, Topic};
use tread_api::robot::{Alert, Robot};

use super::super::{App, AppError};
use super::ROBOTS_MAX;
use crate::db;
use crate::db::robots::RobotRow;
use crate::fleet::presence::RobotKey;

/// How often robots are looked at.
pub const FEED_PERIOD: Duration = Duration::from_millis(100);
/// Steps of missions in one look.
const STEPS_MAX: u32 = 500;
/// Robots whose rows are read afresh at most this often.
const ROWS_PERIOD: Duration = Duration::from_secs(1);

/// Publishes until the stop.
pub async fn run(app: App, stop: CancellationToken) {
    let mut feed = Feed {
        app: app.clone(),
        last_step: None,
        rows: HashMap::new(),
        rows_of: (0, None),
    };
    loop {
        if let Err(error) = feed.look().await {
            error!("cannot read what is new: {error:?}");
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

struct Feed {
    app: App,
    last_step: Option<i64>,
    rows: HashMap<RobotKey, (RobotRow, Vec<Alert>)>,
    /// The generation of the rows, and when they were read.
    rows_of: (u64, Option<Duration>),
}

impl Feed {
    async fn look(&mut self) -> Result<(), AppError> {
        let now = self.app.clock().elapsed();
        self.steps().await?;
        self.robots(now).await?;
        self.app.hub().sweep(now);
        Ok(())
    }

    async fn steps(&mut self) -> Result<(), AppError> {
        let mut tx = self.app.db().read().await?;
        let Some(mut last) = self.last_step else {
            // What was before the start is in every snapshot.
            self.last_step = Some(db::history::newest_step(&mut tx).await?);
            return Ok(());
        };
        let steps = db::history::steps_after(&mut tx, last, STEPS_MAX).await?;
        if u32::try_from(steps.len()).is_ok_and(|count| count == STEPS_MAX) {
            self.app.announce();
        }
        let mut moved = HashSet::new();
        let mut ended = HashSet::new();
        for (pk, step) in steps {
            last = pk;
            moved.insert(step.mission);
            if step.step.to.is_terminal() && step.step.from != Some(step.step.to) {
                ended.insert(step.mission);
            }
            let robot = (step.site.clone(), step.robot.clone());
            let event = Event::Step(Box::new(step));
            self.app.hub().publish(&event, Topic::Missions, robot);
        }
        for id in moved {
            if let Some(row) = db::missions::find(&mut tx, id).await? {
                if ended.contains(&id) {
                    self.app.mission_durations().note(&row.mission);
                }
                let mission = self.app.with_progress(row.mission);
                let robot = (mission.site.clone(), mission.robot.clone());
                let event = Event::Mission(Box::new(mission));
                self.app.hub().publish(&event, Topic::Missions, robot);
            }
        }
        self.last_step = Some(last);
        Ok(())
    }

    async fn robots(&mut self, now: Duration) -> Result<(), AppError> {
        let generation = self.app.robots_generation();
        let due = self
            .rows_of
            .1
            .is_none_or(|read_at| now.saturating_sub(read_at) >= ROWS_PERIOD);
        let mut news: HashSet<RobotKey> = HashSet::new();
        if due && self.rows_of.0 != generation {
            let mut tx = self.app.db().read().await?;
            let mut rows = HashMap::new();
            for row in db::robots::all(&mut tx, ROBOTS_MAX).await? {
                let key = (row.site.clone(), row.id.clone());
                rows.insert(key, (row, Vec::new()));
            }
            for alert in db::alerts::raised(&mut tx, ROBOTS_MAX).await? {
                let key = (alert.site.clone(), alert.robot.clone());
                if let Some((_row, alerts)) = rows.get_mut(&key) {
                    alerts.push(alert);
                }
            }
            for (key, (row, alerts)) in &rows {
                let is_same = |(before, raised): &(RobotRow, Vec<Alert>)| {
                    (&before.name, before.retired_at, raised) == (&row.name, row.retired_at, alerts)
                };
                if !self.rows.get(key).is_some_and(is_same) {
                    news.insert(key.clone());
                }
            }
            self.rows = rows;
            self.rows_of = (generation, Some(now));
        }
        news.extend(self.app.presences().take_news(now));
        if self.app.hub().client_count() == 0 {
            return Ok(());
        }
        for key in news {
            if let Some((row, alerts)) = self.rows.get(&key) {
                let robot: Robot = self.app.with_live(row.clone(), alerts.clone());
                let event = Event::Robot(Box::new(robot));
                self.app.hub().publish(&event, Topic::Robots, key);
            }
        }
        Ok(())
    }
}
