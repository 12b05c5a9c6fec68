//! The reconciler: brings robots to the state that the database wants. It offers missions, sends
//! cancellations, and sends terrains.
//!
//! Woken by every change and by a timer, it reads the database anew and compares it with the
//! presence of robots, so it is correct after any restart. Missions that were offered with their
//! creation are also handed to it in memory, to save the time of reading them. The decision for
//! one mission is pure (`needs`). Commands to different robots run concurrently, at most one of a
//! kind per robot.

pub(super) mod attendance;
pub(super) mod conditions;
pub(super) mod delays;
mod jobs;
pub mod needs;
mod outcomes;
mod periodic_checks;
mod unknown_missions;

use std::collections::{HashMap, HashSet};
use std::sync::atomic::Ordering;
use std::time::Duration;

use jiff::SignedDuration;
use tokio::sync::mpsc;
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;
use tracing::debug;
use tread_api::ids::{MissionId, SiteId, StopId};
use tread_api::mission::MissionState;
use tread_api::stop::Stop;

use self::attendance::Attendance;
use self::conditions::Conditions;
use self::delays::Delays;
use self::jobs::{
    Finished, adopt_reported_revision, apply_change, cancel, hold, offer, replace, send_offer,
    stop_again,
};
use self::needs::{Memory, Need, Now, Silence, decide, is_absent, is_heard, is_held_otherwise};
use self::unknown_missions::cancel_foreign_mission;
use super::missions::transitions::Change;
use super::{App, AppError};
use crate::app::presence::RobotKey;
use crate::db;
use crate::db::missions::OpenMission;
use crate::db::restorations::RestrictedRobot;

/// Interval between passes when nothing wakes it.
pub const PERIOD: Duration = Duration::from_millis(500);
/// Minimum interval of the periodic checks, which are no steps of missions: definitions of sites,
/// attendance, expiry. If each pass ran them, they would delay the offer of a new mission.
const UPKEEP_EVERY: Duration = Duration::from_millis(100);
/// If reading all open missions takes longer than this, a delay of the robots' reports is attributed to the
/// database.
const ANSWER_DELAY: Duration = Duration::from_millis(500);
/// Maximum total time for which consecutive delays of the database excuse robots. It is bounded so that
/// every mission ends.
const EXCUSED_MAX: Duration = Duration::from_mins(1);
/// Value of [`Reconciler::answering_since`] while no read of the database has succeeded.
const NEVER: Duration = Duration::MAX;
/// Maximum number of commands under way at once.
const COMMANDS_MAX: usize = 64;
/// Maximum number of stops under way at once, in addition to other commands.
const STOPS_UNDER_WAY_MAX: usize = 256;
/// Maximum wait before a stop is repeated.
const STOP_RETRY_MAX: Duration = Duration::from_millis(400);
/// First wait before a command is repeated; it doubles each time up to [`RETRY_MAX`].
const RETRY_MIN: Duration = Duration::from_millis(100);
/// Maximum wait before a command is repeated.
const RETRY_MAX: Duration = Duration::from_secs(2);
/// Time for which a robot may show a mission that is not among its open ones before it gets a
/// cancel: its report of the end may be under way.
const FOREIGN_GRACE: Duration = Duration::from_millis(1_500);

/// A command that is under way or waits to be repeated.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
enum Job {
    Stop(StopId),
    Offer(MissionId),
    Replace(MissionId),
    /// Pauses it (true) or resumes it.
    Hold(MissionId, bool),
    Cancel(MissionId),
    Disown(RobotKey),
    EndDuplicateAgent(RobotKey),
    Site(RobotKey),
    Outcomes(RobotKey),
}

#[derive(Debug, Clone, Copy)]
struct Retry {
    due: Duration,
    wait: Duration,
}

/// Runs until the stop.
pub async fn run(app: App, stop: CancellationToken) {
    let depth = app.metrics().queues().show_count("reconciler");
    let mut reconciler = Reconciler::new(app.clone());
    loop {
        if let Err(error) = db::limited(reconciler.pass()).await {
            app.log_failure("reconcile missions", &error);
        }
        depth.store(reconciler.depth(), Ordering::Relaxed);
        let pause = reconciler.pause();
        tokio::select! {
            biased;
            () = stop.cancelled() => break,
            Some((job, how)) = reconciler.finishing.recv() => reconciler.record(job, how),
            () = app.changed() => {}
            () = tokio::time::sleep(pause) => {}
        }
        reconciler.record_all();
    }
}

fn key_of(robot: &RestrictedRobot) -> RobotKey {
    (robot.site.clone(), robot.robot.clone())
}

/// Compares the wanted state with the robots' state, one pass at a time.
#[derive(Debug)]
pub struct Reconciler {
    app: App,
    finished: mpsc::Sender<(Job, Finished)>,
    finishing: mpsc::Receiver<(Job, Finished)>,
    under_way: HashSet<Job>,
    retries: HashMap<Job, Retry>,
    /// [`App::recalls`] before the missions were read last.
    recalls: u64,
    memories: HashMap<MissionId, Memory>,
    /// Stops to be sent again, as read last.
    stops: Vec<Stop>,
    /// Missions that robots show and that are not among their open ones, with the time since which.
    foreign: HashMap<RobotKey, (MissionId, Duration)>,
    attendance: Attendance,
    conditions: Conditions,
    delays: Delays,
    /// Robots that are restricted since a restoration, as read last.
    restricted: HashMap<RobotKey, RestrictedRobot>,
    /// Of each robot that gets outcome queries: since when it is online, and the number of queries
    /// that it was sent.
    outcome_queries: HashMap<RobotKey, (Duration, u32)>,
    /// Time since which the database answers without delay.
    answering_since: Duration,
    /// Time of the first delay of those that have followed each other.
    delayed_since: Option<Duration>,
    /// Time from which the periodic checks may run again, and whether a pass has left it out.
    checks_due: Duration,
    are_checks_owed: bool,
}

impl Reconciler {
    /// Creates a reconciler.
    pub fn new(app: App) -> Self {
        let (finished, finishing) = mpsc::channel(COMMANDS_MAX + STOPS_UNDER_WAY_MAX);
        Self {
            app,
            finished,
            finishing,
            under_way: HashSet::new(),
            retries: HashMap::new(),
            recalls: 0,
            memories: HashMap::new(),
            stops: Vec::new(),
            foreign: HashMap::new(),
            attendance: Attendance::default(),
            conditions: Conditions::default(),
            delays: Delays::default(),
            restricted: HashMap::new(),
            outcome_queries: HashMap::new(),
            answering_since: Duration::ZERO,
            delayed_since: None,
            checks_due: Duration::ZERO,
            are_checks_owed: false,
        }
    }

    /// Waits until no command is under way.
    pub async fn rest(&mut self) {
        while !self.under_way.is_empty() {
            match self.finishing.recv().await {
                Some((job, how)) => self.record(job, how),
                None => break,
            }
        }
    }

    fn record_all(&mut self) {
        while let Ok((job, how)) = self.finishing.try_recv() {
            self.record(job, how);
        }
    }

    /// Returns the number of commands that are under way or to be repeated.
    fn depth(&self) -> usize {
        let repeated = self.retries.keys();
        let waiting = repeated.filter(|job| !self.under_way.contains(*job));
        self.under_way.len() + waiting.count()
    }

    /// Returns the time until something is due.
    fn pause(&self) -> Duration {
        let now = self.app.clock().elapsed();
        let until = |retry: &Retry| retry.due.saturating_sub(now);
        let soonest = self
            .retries
            .values()
            .map(until)
            .filter(|wait| !wait.is_zero())
            .min();
        let checks = self.checks_due.saturating_sub(now);
        let most = if self.are_checks_owed { checks } else { PERIOD };
        soonest.unwrap_or(PERIOD).min(most)
    }

    fn record(&mut self, job: Job, how: Finished) {
        self.under_way.remove(&job);
        let now = self.app.clock().elapsed();
        if let (
            Finished::EndedThere,
            Job::Offer(id) | Job::Replace(id) | Job::Hold(id, _) | Job::Cancel(id),
        ) = (how, &job)
        {
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
            let most = match job {
                Job::Stop(_) => STOP_RETRY_MAX,
                Job::Offer(_)
                | Job::Replace(_)
                | Job::Hold(..)
                | Job::Cancel(_)
                | Job::Disown(_)
                | Job::EndDuplicateAgent(_)
                | Job::Site(_)
                | Job::Outcomes(_) => RETRY_MAX,
            };
            let wait = match (how, before) {
                (Finished::Delivered, _) => most,
                (_, None) => RETRY_MIN,
                (_, Some(retry)) => (retry.wait * 2).min(most),
            };
            self.retries.insert(
                job,
                Retry {
                    due: now + wait,
                    wait,
                },
            );
        }
    }

    /// Runs one pass: reads the database and the presence of robots, and starts the missing
    /// commands. Missions come first, since people wait for them; what can wait is looked at every
    /// [`UPKEEP_EVERY`] at most.
    ///
    /// # Errors
    /// The database failed; the next pass repeats this one.
    pub async fn pass(&mut self) -> Result<(), AppError> {
        self.send_new_offers();
        let served = self.serve_missions().await;
        self.stop_again().await;
        let alerts = self.app.sync_alerts().await;
        let now = self.app.clock().elapsed();
        if self.checks_due > now {
            self.are_checks_owed = true;
            return served.map(|_open| ()).and(alerts);
        }
        self.checks_due = now + UPKEEP_EVERY;
        self.are_checks_owed = false;
        let (open, served) = match served {
            Ok(open) => (Some(open), Ok(())),
            Err(error) => (None, Err(error)),
        };
        let checks = self.run_periodic_checks(open.as_deref()).await;
        served.and(alerts).and(checks)
    }

    /// Sends the offers of missions that were created just now, without reading them again.
    fn send_new_offers(&mut self) {
        for mission in self.app.new_offers().take() {
            let job = Job::Offer(mission.row.mission.id);
            if self.is_due(&job) {
                self.start(job, send_offer(self.app.clone(), mission));
            }
        }
    }

    /// Starts what open missions need, and returns them.
    async fn serve_missions(&mut self) -> Result<Vec<OpenMission>, AppError> {
        self.recalls = self.app.recalls();
        let begun = Instant::now();
        // Remains if this is given up.
        let before = std::mem::replace(&mut self.answering_since, NEVER);
        let read = self.read_missions().await;
        let is_prompt = read.is_ok() && begun.elapsed() <= ANSWER_DELAY && before != NEVER;
        self.record_answer(is_prompt, before);
        let (restricted, open) = read?;
        // Before a mission of a robot that was released is offered, so that nobody sees it driven while
        // its robot counts as one that awaits its release.
        self.app.show_awaiting(&restricted);
        let by_key = restricted.into_iter().map(|it| (key_of(&it), it));
        self.restricted = by_key.collect();
        self.retain_open(&open);
        self.cancel_foreign_missions(&open);
        for mission in &open {
            self.serve(mission.clone()).await?;
        }
        Ok(open)
    }

    /// Notes whether the database answered without delay; `before` is [`Reconciler::answering_since`].
    fn record_answer(&mut self, is_prompt: bool, before: Duration) {
        let now = self.app.clock().elapsed();
        if is_prompt {
            self.answering_since = before;
            if now.saturating_sub(before) > EXCUSED_MAX {
                self.delayed_since = None;
            }
            return;
        }
        let since = *self.delayed_since.get_or_insert(now);
        let is_excused = now.saturating_sub(since) < EXCUSED_MAX;
        self.answering_since = if is_excused { now } else { before.min(now) };
    }

    /// Reads the robots that are restricted, and the missions that may need something.
    async fn read_missions(&self) -> Result<(Vec<RestrictedRobot>, Vec<OpenMission>), AppError> {
        let mut tx = self.app.db().read("reconciler").await?;
        let restricted = db::restorations::restricted(&mut tx).await?;
        let mut open = db::missions::in_progress(&mut tx).await?;
        open.extend(db::missions::next_in_queues(&mut tx).await?);
        Ok((restricted, open))
    }

    /// Sends unconfirmed stops again. Continues even if everything else fails.
    async fn stop_again(&mut self) {
        match self.app.reconcile_stops().await {
            Ok(again) => self.stops = again,
            // The stops read before are still sent.
            Err(error) => self.app.log_failure("look after stops", &error),
        }
        let again = self.stops.clone();
        let wanted: HashSet<StopId> = again.iter().map(|stop| stop.id).collect();
        self.retries
            .retain(|job, _| !matches!(job, Job::Stop(id) if !wanted.contains(id)));
        for stop in again {
            let key = (stop.site.clone(), stop.robot.clone());
            let presence = self.app.presences().get(&key);
            let job = Job::Stop(stop.id);
            // Any sign of the agent suffices, even if its control loop has stopped.
            let is_connected = presence.is_connected(self.app.clock().elapsed());
            if is_connected && self.is_due(&job) {
                let app = self.app.clone();
                self.start(job, stop_again(app, stop));
            }
        }
    }

    /// Returns the action for a mission; [`Need::Wait`] in place of one that a restoration forbids.
    fn defer_if_restricted(&self, key: &RobotKey, heard: bool, need: Need) -> Need {
        let Some(restricted) = self.restricted.get(key) else {
            return need;
        };
        // A robot that was released, and does not come back, is lost as any other.
        let is_unknown = restricted.outcomes_wanted && (restricted.awaits_release || heard);
        let is_dispatch = matches!(need, Need::Offer | Need::Replace | Need::Resume);
        let is_seen = |change| matches!(change, Change::Accept | Change::Pause | Change::Resume);
        let is_guess = matches!(need, Need::Apply(change) if !is_seen(change));
        if is_dispatch && (is_unknown || restricted.awaits_release) || is_guess && is_unknown {
            Need::Wait
        } else {
            need
        }
    }

    /// Forgets everything about missions that are no longer open.
    fn retain_open(&mut self, missions: &[OpenMission]) {
        let open: HashSet<MissionId> = missions.iter().map(|mission| mission.id).collect();
        self.memories.retain(|id, _| open.contains(id));
        self.retries.retain(|job, _| match job {
            Job::Offer(id) | Job::Replace(id) | Job::Hold(id, _) | Job::Cancel(id) => {
                open.contains(id)
            }
            Job::Disown(_)
            | Job::EndDuplicateAgent(_)
            | Job::Site(_)
            | Job::Outcomes(_)
            | Job::Stop(_) => true,
        });
    }

    /// Finds robots that drive a mission that is not among their open ones, and commands them to
    /// end it.
    fn cancel_foreign_missions(&mut self, open: &[OpenMission]) {
        let now = self.app.clock().elapsed();
        let shown = self.app.presences().shown_missions(now);
        let mut own: HashMap<MissionId, (&SiteId, &tread_api::ids::RobotId)> = HashMap::new();
        for mission in open {
            own.insert(mission.id, (&mission.site, &mission.robot));
        }
        let mut foreign = HashMap::new();
        for (key, id) in shown {
            if own.get(&id) == Some(&(&key.0, &key.1)) {
                continue;
            }
            let before = self.foreign.get(&key).filter(|(before, _)| *before == id);
            let since = before.map_or(now, |&(_, since)| since);
            foreign.insert(key, (id, since));
        }
        self.foreign = foreign;
        let due: Vec<(RobotKey, MissionId)> = self
            .foreign
            .iter()
            .filter(|(_, (_, since))| now.saturating_sub(*since) > FOREIGN_GRACE)
            .map(|(key, (id, _))| (key.clone(), *id))
            .collect();
        for (key, id) in due {
            let job = Job::Disown(key.clone());
            if self.is_due(&job) {
                let app = self.app.clone();
                self.start(job, cancel_foreign_mission(app, key, id));
            }
        }
        let foreign = &self.foreign;
        self.retries.retain(|job, _| match job {
            Job::Disown(key) => foreign.contains_key(key),
            Job::Offer(_)
            | Job::Replace(_)
            | Job::Hold(..)
            | Job::Cancel(_)
            | Job::EndDuplicateAgent(_)
            | Job::Site(_)
            | Job::Outcomes(_)
            | Job::Stop(_) => true,
        });
    }

    /// Stores since when a mission's robot has not been heard.
    async fn record_silence(&self, mission: &mut OpenMission, heard: bool) -> Result<(), AppError> {
        if heard == mission.silent_since.is_none() || mission.state == MissionState::Queued {
            return Ok(());
        }
        let clock = self.app.clock();
        let key = (mission.site.clone(), mission.robot.clone());
        let silent = self.app.presences().get(&key).silent_for(clock.elapsed());
        let silent = SignedDuration::try_from(silent.unwrap_or_default()).unwrap_or_default();
        let since = (!heard).then(|| clock.now().checked_sub(silent).unwrap_or(clock.now()));
        let mut tx = self.app.db().write("reconciler").await?;
        db::missions::set_silence(&mut tx, mission.id, since).await?;
        tx.commit().await?;
        mission.silent_since = since;
        Ok(())
    }

    async fn serve(&mut self, mut mission: OpenMission) -> Result<(), AppError> {
        let key = (mission.site.clone(), mission.robot.clone());
        let presence = self.app.presences().get(&key);
        let now = Now {
            elapsed: self.app.clock().elapsed(),
            wall: self.app.clock().now(),
            answering_since: self.answering_since,
        };
        let heard = is_heard(&presence, now.elapsed);
        self.record_silence(&mut mission, heard).await?;
        let memory = self.memories.entry(mission.id).or_default();
        memory.absent_since = is_absent(&mission, &presence, now.elapsed)
            .then(|| memory.absent_since.unwrap_or(now.elapsed));
        memory.differs_from = is_held_otherwise(&mission, &presence)
            .then(|| memory.differs_from.unwrap_or(now.elapsed));
        memory.silence = Silence::of(&mission, memory.silence, now);
        let memory = *memory;
        let app = self.app.clone();
        let need = decide(&mission, &presence, memory, now);
        let need = self.defer_if_restricted(&key, heard, need);
        // A command that is wanted again later does not inherit the back-off of the earlier one.
        for (held, wanted) in [(true, Need::Pause), (false, Need::Resume)] {
            if need != wanted {
                self.retries.remove(&Job::Hold(mission.id, held));
            }
        }
        match need {
            Need::Wait => {}
            Need::Apply(change) => {
                let shown_since = memory.differs_from.unwrap_or(now.elapsed);
                let shown_for = now.elapsed.saturating_sub(shown_since);
                apply_change(&self.app, &mission, change, shown_for).await?;
            }
            Need::Adopt => adopt_reported_revision(&self.app, &mission).await?,
            Need::Replace => {
                let job = Job::Replace(mission.id);
                if self.is_due(&job) {
                    self.start(job, replace(app, mission));
                }
            }
            Need::Pause | Need::Resume => {
                let held = mission.pause_requested;
                let job = Job::Hold(mission.id, held);
                if self.is_due(&job) {
                    self.start(job, hold(app, mission, held, self.recalls));
                }
            }
            Need::Offer => {
                let job = Job::Offer(mission.id);
                if self.is_due(&job) {
                    self.start(job, offer(app, mission));
                }
            }
            Need::Cancel => {
                let job = Job::Cancel(mission.id);
                // The command under way is answered first, which keeps the order.
                let id = mission.id;
                let before = [
                    Job::Offer(id),
                    Job::Replace(id),
                    Job::Hold(id, true),
                    Job::Hold(id, false),
                ];
                let is_clear = !before.iter().any(|job| self.under_way.contains(job));
                if is_clear && self.is_due(&job) {
                    self.start(job, cancel(app, mission));
                }
            }
        }
        Ok(())
    }

    fn is_due(&self, job: &Job) -> bool {
        let now = self.app.clock().elapsed();
        let is_stop = |job: &&Job| matches!(job, Job::Stop(_));
        let stops = self.under_way.iter().filter(is_stop).count();
        let has_room = if is_stop(&job) {
            stops < STOPS_UNDER_WAY_MAX
        } else {
            self.under_way.len() - stops < COMMANDS_MAX
        };
        has_room
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
        let app = self.app.clone();
        self.app.supervisor().spawn_passing("command", async move {
            let mut report = report;
            match db::limited(work).await {
                Ok(how) => report.how = how,
                Err(error) => app.log_failure("write down a command's answer", &error),
            }
        });
    }
}

/// Reports the result of a command to the reconciler when it is dropped.
struct Report {
    job: Job,
    how: Finished,
    finished: mpsc::Sender<(Job, Finished)>,
}

impl Drop for Report {
    fn drop(&mut self) {
        // The channel has room for every command that can be under way.
        if self
            .finished
            .try_send((self.job.clone(), self.how))
            .is_err()
        {
            debug!("the reconciler has stopped");
        }
    }
}
