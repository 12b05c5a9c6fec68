//! Makes what is wanted so: offers missions, sends cancellations, brings terrains to robots.
//!
//! Woken by every change and by a timer, it reads the database afresh and compares it with who is
//! on the network. It takes no other input, so it is right after any restart. What it decides for
//! one mission is pure (`needs`); commands to different robots are under way at the same time,
//! at most one of a kind per robot.

mod jobs;
mod needs;

use std::collections::{HashMap, HashSet};
use std::time::Duration;

use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;
use tracing::{debug, error};
use tread_api::ids::{MissionId, SiteId};

use self::jobs::{Finished, cancel, offer, push_site, settle};
use self::needs::{Memory, Need, decide};
use super::missions::transitions::Change;
use super::{App, AppError};
use crate::db;
use crate::db::missions::Standing;
use crate::fleet::commands::Commands;
use crate::fleet::presence::RobotKey;
use crate::supervisor::Supervisor;

/// How often it looks although nothing woke it.
pub const PERIOD: Duration = Duration::from_millis(500);
/// Commands that may be under way at once.
const COMMANDS_MAX: usize = 64;
/// First wait before a command is repeated; it doubles each time.
const RETRY_MIN: Duration = Duration::from_millis(100);
/// Longest wait before a command is repeated.
const RETRY_MAX: Duration = Duration::from_secs(2);
/// Missions that expire in one pass.
const EXPIRE_MAX: u32 = 1_000;
/// Most sites that are read in one pass.
const SITES_MAX: u32 = 1_000;

/// A command that is under way or waits to be repeated.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
enum Job {
    Offer(MissionId),
    Cancel(MissionId),
    Site(RobotKey),
}

#[derive(Debug, Clone, Copy)]
struct Retry {
    due: Duration,
    wait: Duration,
}

/// Runs until the stop.
pub async fn run(app: App, commands: Commands, supervisor: Supervisor, stop: CancellationToken) {
    let (finished, mut finishing) = mpsc::channel(COMMANDS_MAX);
    let mut reconciler = Reconciler {
        app: app.clone(),
        commands,
        supervisor,
        finished,
        under_way: HashSet::new(),
        retries: HashMap::new(),
        memories: HashMap::new(),
    };
    loop {
        if let Err(error) = reconciler.pass().await {
            error!("cannot reconcile missions: {error:?}");
        }
        let pause = reconciler.pause();
        tokio::select! {
            biased;
            () = stop.cancelled() => break,
            Some((job, how)) = finishing.recv() => reconciler.note(job, how),
            () = app.changed() => {}
            () = tokio::time::sleep(pause) => {}
        }
        while let Ok((job, how)) = finishing.try_recv() {
            reconciler.note(job, how);
        }
    }
}

struct Reconciler {
    app: App,
    commands: Commands,
    supervisor: Supervisor,
    finished: mpsc::Sender<(Job, Finished)>,
    under_way: HashSet<Job>,
    retries: HashMap<Job, Retry>,
    memories: HashMap<MissionId, Memory>,
}

impl Reconciler {
    /// How long until something is due.
    fn pause(&self) -> Duration {
        let now = self.app.clock().elapsed();
        let until = |retry: &Retry| retry.due.saturating_sub(now);
        let soonest = self
            .retries
            .values()
            .map(until)
            .filter(|wait| !wait.is_zero())
            .min();
        soonest.unwrap_or(PERIOD).min(PERIOD)
    }

    fn note(&mut self, job: Job, how: Finished) {
        self.under_way.remove(&job);
        let now = self.app.clock().elapsed();
        if let (Finished::EndedThere, Job::Offer(id) | Job::Cancel(id)) = (how, &job) {
            self.memories
                .entry(*id)
                .or_default()
                .ended_since
                .get_or_insert(now);
        }
        if how == Finished::Settled {
            self.retries.remove(&job);
        } else {
            let before = self.retries.get(&job);
            let wait = before.map_or(RETRY_MIN, |retry| (retry.wait * 2).min(RETRY_MAX));
            self.retries.insert(
                job,
                Retry {
                    due: now + wait,
                    wait,
                },
            );
        }
    }

    async fn pass(&mut self) -> Result<(), AppError> {
        self.expire().await?;
        let mut tx = self.app.db().read().await?;
        let mut open = db::missions::in_hand(&mut tx).await?;
        open.extend(db::missions::next_in_queues(&mut tx).await?);
        let sites = db::sites::list(&mut tx, "", SITES_MAX).await?;
        drop(tx);
        self.forget_all_but(&open);
        for mission in open {
            self.serve(mission).await?;
        }
        let wanted: HashMap<SiteId, u64> = sites
            .into_iter()
            .map(|row| (row.site.id, row.site.terrain_revision))
            .collect();
        for (key, held) in self.app.presences().online(self.app.clock().elapsed()) {
            // Without any definition the robot will say hello, and gets one.
            let lags = held.is_some_and(|held| wanted.get(&key.0).is_some_and(|&now| now != held));
            let job = Job::Site(key.clone());
            if lags && self.is_due(&job) {
                let (app, commands) = (self.app.clone(), self.commands.clone());
                self.start(job, push_site(app, commands, key));
            } else if !lags {
                self.retries.remove(&job);
            }
        }
        Ok(())
    }

    async fn expire(&self) -> Result<(), AppError> {
        let now = self.app.clock().now();
        let mut tx = self.app.db().read().await?;
        let overdue = db::missions::overdue(&mut tx, now, EXPIRE_MAX).await?;
        drop(tx);
        for mission in overdue {
            let step = (Change::Expire, "its latest start passed while it waited");
            settle(&self.app, &mission, step.0, step.1).await?;
        }
        Ok(())
    }

    /// Drops what is remembered of missions that need nothing any more.
    fn forget_all_but(&mut self, missions: &[Standing]) {
        let open: HashSet<MissionId> = missions.iter().map(|mission| mission.id).collect();
        self.memories.retain(|id, _| open.contains(id));
        self.retries.retain(|job, _| match job {
            Job::Offer(id) | Job::Cancel(id) => open.contains(id),
            Job::Site(_) => true,
        });
    }

    async fn serve(&mut self, mission: Standing) -> Result<(), AppError> {
        let key = (mission.site.clone(), mission.robot.clone());
        let presence = self.app.presences().get(&key);
        let memory = self.memories.get(&mission.id).copied().unwrap_or_default();
        let (app, commands) = (self.app.clone(), self.commands.clone());
        match decide(&mission, &presence, memory, self.app.clock().elapsed()) {
            Need::Wait => {}
            Need::Settle(change, reason) => settle(&self.app, &mission, change, reason).await?,
            Need::Offer => {
                let job = Job::Offer(mission.id);
                if self.is_due(&job) {
                    self.start(job, offer(app, commands, mission));
                }
            }
            Need::Cancel => {
                let job = Job::Cancel(mission.id);
                // An offer that is under way is answered first, so that the order is kept.
                if self.is_due(&job) && !self.under_way.contains(&Job::Offer(mission.id)) {
                    self.start(job, cancel(app, commands, mission));
                }
            }
        }
        Ok(())
    }

    fn is_due(&self, job: &Job) -> bool {
        let now = self.app.clock().elapsed();
        self.under_way.len() < COMMANDS_MAX
            && !self.under_way.contains(job)
            && self.retries.get(job).is_none_or(|retry| retry.due <= now)
    }

    fn start(
        &mut self,
        job: Job,
        work: impl Future<Output = Result<Finished, AppError>> + Send + 'static,
    ) {
        self.under_way.insert(job.clone());
        // Sent when the task ends in any way, also by a panic.
        let report = Report {
            job,
            how: Finished::Again,
            finished: self.finished.clone(),
        };
        self.supervisor.spawn_passing("command", async move {
            let mut report = report;
            match work.await {
                Ok(how) => report.how = how,
                Err(error) => error!("cannot write down a command's answer: {error:?}"),
            }
        });
    }
}

/// Tells the reconciler how a command went, when it is dropped.
struct Report {
    job: Job,
    how: Finished,
    finished: mpsc::Sender<(Job, Finished)>,
}

impl Drop for Report {
    fn drop(&mut self) {
        // There are never more commands under way than the channel has places.
        if self
            .finished
            .try_send((self.job.clone(), self.how))
            .is_err()
        {
            debug!("the reconciler has stopped");
        }
    }
}
