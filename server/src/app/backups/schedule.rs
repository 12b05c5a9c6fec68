//! Scheduled backups: when they are due, how many are kept, and their reported state.

use std::fs::DirBuilder;
use std::os::unix::fs::DirBuilderExt as _;
use std::path::PathBuf;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use jiff::{SignedDuration, Timestamp};
use tokio_util::sync::CancellationToken;
use tracing::{error, info};
use tread_api::robot::Severity;

use super::{BackupError, Order, make};
use crate::app::App;
use crate::backup::{Filter, folder};
use crate::config::backup::BackupConfig;
use crate::file_error::FileError;

/// Code of the alert about a backup that could not be made.
pub const BACKUP_FAILED_ALERT: &str = "backup-failed";
/// Code of the alert about a last backup that is too old.
pub const BACKUP_OLD_ALERT: &str = "backup-old";
/// Interval at which the server checks whether a backup is due.
const CHECK_EVERY: Duration = Duration::from_secs(1);
/// Interval at which the folder is read again: people may remove or add backups.
const LIST_EVERY: Duration = Duration::from_mins(1);
/// Time after a failure before the next attempt.
const RETRY_AFTER: Duration = Duration::from_mins(10);
/// Number of intervals after which the last backup is too old.
const OLD_AFTER_INTERVALS: u32 = 2;

/// State of the backups that the server makes by itself.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct BackupState {
    /// Time and size of the last complete backup in the folder.
    pub last: Option<(Timestamp, u64)>,
    /// Why the last attempt failed, if it did.
    pub failure: Option<String>,
    /// Duration of the last successful attempt of this process.
    pub took: Option<Duration>,
}

/// State of scheduled backups; `None` until they are configured.
#[derive(Debug, Default)]
pub(in crate::app) struct Backups {
    state: Mutex<Option<BackupState>>,
}

impl Backups {
    fn lock(&self) -> MutexGuard<'_, Option<BackupState>> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl App {
    fn backups(&self) -> &Backups {
        &self.inner.backups
    }

    /// Returns the state of scheduled backups; `None` if none are configured.
    pub fn backup_state(&self) -> Option<BackupState> {
        self.backups().lock().clone()
    }
}

/// Makes backups at the configured interval until the stop.
pub async fn run(app: App, schedule: Option<Schedule>, stop: CancellationToken) {
    let Some(schedule) = schedule else {
        return stop.cancelled().await;
    };
    let mut scheduler = Scheduler {
        app,
        schedule,
        listed_at: None,
        made_at: None,
        failed_at: None,
    };
    while !stop.is_cancelled() {
        tokio::select! {
            () = stop.cancelled() => return,
            () = scheduler.poll() => {}
        }
        tokio::select! {
            () = stop.cancelled() => {}
            () = tokio::time::sleep(CHECK_EVERY) => {}
        }
    }
}

/// What scheduled backups are made of.
#[derive(Debug, Clone)]
pub struct Schedule {
    /// The settings.
    pub config: BackupConfig,
    /// The database.
    pub database: PathBuf,
    /// Folder of the fleet's authority, if the server has one.
    pub authority: Option<PathBuf>,
    /// Free space that the server itself needs on the disk of the database, bytes.
    pub reserve_bytes: u64,
}

struct Scheduler {
    app: App,
    schedule: Schedule,
    listed_at: Option<Duration>,
    /// Time of the last success of this process.
    made_at: Option<Duration>,
    /// Time of the last failure since then.
    failed_at: Option<Duration>,
}

impl Scheduler {
    async fn poll(&mut self) {
        let now = self.app.clock().elapsed();
        let since = |at: Duration| now.saturating_sub(at);
        if self.listed_at.is_none_or(|at| since(at) >= LIST_EVERY) {
            self.list().await;
        }
        let waits = self.failed_at.is_some_and(|at| since(at) < RETRY_AFTER);
        if !waits && self.is_due(now) {
            match self.make().await {
                Ok(()) => {
                    self.made_at = Some(now);
                    self.failed_at = None;
                }
                Err(cause) => {
                    // Counted from the end of the attempt, which may have taken long.
                    self.failed_at = Some(self.app.clock().elapsed());
                    self.record_failure(&cause);
                }
            }
            self.list().await;
        }
        self.show_alerts();
    }

    /// Steps of the wall clock move neither the interval within this process nor a backup of before
    /// by more than one.
    fn is_due(&self, now: Duration) -> bool {
        let every = self.schedule.config.every();
        if let Some(made_at) = self.made_at {
            return now.saturating_sub(made_at) >= every;
        }
        let state = self.app.backup_state().unwrap_or_default();
        let age = state
            .last
            .map(|(at, _)| self.app.clock().now().duration_since(at));
        let every = SignedDuration::try_from(every).unwrap_or(SignedDuration::MAX);
        age.is_none_or(|age| age >= every || age.is_negative())
    }

    async fn list(&mut self) {
        let path = self.schedule.config.folder.clone();
        let listed = tokio::task::spawn_blocking(move || folder::list(&path)).await;
        let last = match listed {
            Ok(Ok(found)) => found.last().map(|last| (last.taken_at, last.bytes)),
            // The folder may not exist before the first backup; a failure of that one is reported.
            Ok(Err(_)) | Err(_) => None,
        };
        self.listed_at = Some(self.app.clock().elapsed());
        let mut state = self.app.backups().lock();
        state.get_or_insert_default().last = last;
    }

    async fn make(&mut self) -> Result<(), BackupError> {
        let Schedule {
            config,
            database,
            authority,
            reserve_bytes,
        } = self.schedule.clone();
        let path = config.folder.clone();
        let mut builder = DirBuilder::new();
        let made = builder.recursive(true).mode(0o700).create(&path);
        made.map_err(FileError::of("create", &path))?;
        let order = Order {
            database,
            authority,
            target: path.clone(),
            encryption: config.encrypt.clone().map(Filter),
            reserve_bytes,
            now: self.app.clock().now(),
        };
        let began_at = self.app.clock().elapsed();
        // A server that starts from the archive then has little to add to its sums.
        self.app.try_to_write_sums().await;
        let made = make(order, |_progress| {}).await?;
        let took = self.app.clock().elapsed().saturating_sub(began_at);
        info!(
            backup.bytes = made.bytes,
            "backed the database up to `{}` in {:.1} s",
            made.path.display(),
            took.as_secs_f64(),
        );
        {
            let mut state = self.app.backups().lock();
            let state = state.get_or_insert_default();
            state.failure = None;
            state.took = Some(took);
        }
        let keep = usize::try_from(config.keep).unwrap_or(usize::MAX);
        let failed = path.clone();
        let removed = tokio::task::spawn_blocking(move || folder::remove_old(&path, keep)).await;
        if let Ok(Err(cause)) = removed {
            error!(
                "cannot remove old backups from `{}`: {cause}",
                failed.display()
            );
        }
        Ok(())
    }

    fn record_failure(&self, cause: &BackupError) {
        let mut text = cause.to_string();
        let mut source = std::error::Error::source(cause);
        while let Some(error) = source {
            text.push_str(": ");
            text.push_str(&error.to_string());
            source = error.source();
        }
        let mut state = self.app.backups().lock();
        state.get_or_insert_default().failure = Some(text);
    }

    fn show_alerts(&self) {
        let state = self.app.backup_state().unwrap_or_default();
        let failed = state.failure.map(|why| {
            let minutes = RETRY_AFTER.as_secs() / 60;
            format!("no backup could be made: {why}; it is tried again every {minutes} min")
        });
        let (now, app) = (self.app.clock().now(), &self.app);
        let every = self.schedule.config.every();
        let limit = every.saturating_mul(OLD_AFTER_INTERVALS);
        let folder = self.schedule.config.folder.display();
        let old = match state.last {
            Some((at, _)) => {
                let age = Duration::try_from(now.duration_since(at)).unwrap_or_default();
                let text = || format!("the last backup in `{folder}` is of {at}");
                (age > limit).then(text)
            }
            None => (app.uptime() > limit).then(|| format!("`{folder}` has no backup")),
        };
        for (code, text) in [(BACKUP_FAILED_ALERT, failed), (BACKUP_OLD_ALERT, old)] {
            app.set_server_alert(code, Severity::Warning, text);
        }
    }
}
