//! State of the storage: checked periodically, and shown by `/readyz`, metrics and alerts.
//!
//! ```text
//! every 5 s, and when somebody asks ─► a real write, the root page of every table, the free disk
//!   a failure ──► not ready, and an alert, until nothing has failed for 10 s
//!   damage ─────► not ready, and an alert, until `PRAGMA quick_check` finds nothing
//! ```
//!
//! These alerts are about the server and no robot. They are kept in memory and in the log, because
//! they report that nothing can be stored.

mod growth;
mod repeats;

use std::collections::VecDeque;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use jiff::Timestamp;
use tokio_util::sync::CancellationToken;
use tracing::{error, info, warn};
use tread_api::ids::{AlertId, RobotId};
use tread_api::robot::{Alert, Severity};
use tread_api::webhook::NoticeEvent;

use self::growth::Growth;
use self::repeats::{Failure, Repeats};
use super::App;
use crate::config::StorageConfig;
use crate::db::alerts::AlertFilter;
use crate::db::failure::{self, StorageFailure};
use crate::db::{DbError, Engine};
use crate::error_text::chain;
use crate::metrics::SlowUseCase;

/// Interval between checks of the storage.
const CHECK_EVERY: Duration = Duration::from_secs(5);
/// Maximum age of a check that answers a request for readiness: anybody may send one, and each
/// check costs a synced write.
const CHECK_VALIDITY: Duration = Duration::from_secs(1);
/// Maximum time for one part of a check before it counts as failed.
const CHECK_TIMEOUT: Duration = Duration::from_secs(5);
/// Time without a failure after which the storage counts as working again.
const RECOVERED_AFTER: Duration = Duration::from_secs(10);
/// Interval between examinations of a damaged database.
const EXAMINE_EVERY: Duration = Duration::from_mins(10);
/// Minimum time between an examination without findings and one caused by the next report of
/// damage.
const EXAMINE_REST: Duration = Duration::from_mins(1);
/// Maximum time for an examination.
const EXAMINE_MAX: Duration = Duration::from_mins(10);
/// Free space above the limit, as a fraction of the limit, at which the alert is cleared.
const DISK_LOW_HYSTERESIS: f64 = 0.1;
/// Maximum number of cleared alerts about the server that are kept.
const CLEARED_KEPT_MAX: usize = 100;
/// Maximum length of SQLite's finding in an alert, characters.
const FINDING_MAX: usize = 200;

/// Code of the alert about a database that cannot be written.
pub const UNWRITABLE_ALERT: &str = "storage-unwritable";
/// Code of the alert about a damaged database.
pub const DAMAGED_ALERT: &str = "database-damaged";
/// Code of the alert about a disk that is nearly full.
pub const DISK_LOW_ALERT: &str = "disk-low";

/// Code of the note that the server was restarted.
pub const SERVER_RESTARTED_ALERT: &str = "server-restarted";
/// Time after which the note of a restart clears by itself.
pub const RESTART_NOTED_FOR: Duration = Duration::from_mins(10);

/// Result of the last check.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct StorageCondition {
    /// Reason why nothing can be written, if so.
    pub unwritable: Option<String>,
    /// What is damaged, if anything is.
    pub damaged: Option<String>,
    /// Free bytes on the database's disk; `None` if the operating system does not report them.
    pub disk_free_bytes: Option<u64>,
    /// Size of the database file, bytes.
    pub database_bytes: Option<u64>,
    /// Size of its write-ahead log, bytes.
    pub log_bytes: Option<u64>,
    /// Growth of the database file, bytes per hour; `None` until it was
    /// measured for ten minutes.
    pub growth_bytes_per_hour: Option<i64>,
    /// Whether the free space is below the configured limit.
    pub is_disk_low: bool,
}

impl StorageCondition {
    /// Returns the reason why the server cannot work, if there is one.
    pub fn problem(&self) -> Option<&str> {
        let damaged = self.damaged.as_deref();
        damaged.or(self.unwritable.as_deref())
    }
}

/// Result of the last check, and the alerts about the server.
#[derive(Debug)]
pub(super) struct Storage {
    config: StorageConfig,
    /// Locked during a check.
    checking: tokio::sync::Mutex<()>,
    inner: Mutex<Inner>,
}

#[derive(Debug, Default)]
struct Inner {
    condition: StorageCondition,
    checked_at: Option<Duration>,
    /// Time of the last examination, and the number of damage reports at that time.
    examined: Option<(Duration, u64)>,
    repeats: Repeats,
    growth: Growth,
    /// End of the validity of the REST API's certificate.
    certificate_ends: Option<Timestamp>,
    raised: Vec<Alert>,
    /// Cleared alerts, newest last.
    cleared: VecDeque<Alert>,
}

impl Storage {
    pub(super) fn new(config: StorageConfig) -> Self {
        Self {
            config,
            checking: tokio::sync::Mutex::default(),
            inner: Mutex::default(),
        }
    }

    fn lock(&self) -> MutexGuard<'_, Inner> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Stores the end of the validity of the REST API's certificate.
    pub(super) fn record_certificate_expiry(&self, ends: Option<Timestamp>) {
        self.lock().certificate_ends = ends;
    }

    /// Returns the end of the validity of the REST API's certificate; `None` without one.
    pub(super) fn certificate_ends(&self) -> Option<Timestamp> {
        self.lock().certificate_ends
    }

    /// Returns the alerts about the server that a filter lets through, newest first.
    pub(super) fn alerts(&self, filter: &AlertFilter) -> Vec<Alert> {
        // They concern every site, and no robot.
        if filter.robot.is_some() {
            return Vec::new();
        }
        let inner = self.lock();
        let cleared = inner.cleared.iter().filter(|_| !filter.raised);
        let is_of_kind =
            |alert: &&Alert| filter.kind.as_ref().is_none_or(|kind| alert.code == *kind);
        let all = inner.raised.iter().chain(cleared).filter(is_of_kind);
        let before = |alert: &&Alert| filter.before.is_none_or(|before| alert.id < before);
        let mut alerts: Vec<Alert> = all.filter(before).cloned().collect();
        alerts.sort_by_key(|alert| std::cmp::Reverse(alert.id));
        alerts
    }

    /// Returns an alert about the server; `None` if there is none with this identifier.
    pub(super) fn alert(&self, id: AlertId) -> Option<Alert> {
        let inner = self.lock();
        let mut all = inner.raised.iter().chain(&inner.cleared);
        all.find(|alert| alert.id == id).cloned()
    }

    /// Acknowledges an alert about the server; `None` if there is none with this identifier.
    pub(super) fn acknowledge(&self, id: AlertId, now: Timestamp) -> Option<Alert> {
        let mut inner = self.lock();
        let Inner {
            raised, cleared, ..
        } = &mut *inner;
        let mut all = raised.iter_mut().chain(cleared.iter_mut());
        let alert = all.find(|alert| alert.id == id)?;
        alert.acknowledged_at.get_or_insert(now);
        Some(alert.clone())
    }
}

impl App {
    /// Returns the name of the database's engine, and its version.
    pub fn database_engine(&self) -> (&'static str, &str) {
        let (engine, version) = self.db().engine();
        (engine.name(), version)
    }

    /// Returns the schema of the database.
    pub fn database_schema(&self) -> i64 {
        self.db().schema()
    }

    /// Returns the use cases with slow transactions, the slowest first.
    pub fn slow_use_cases(&self) -> Vec<SlowUseCase> {
        self.db().metrics().slow()
    }

    /// Logs that a background task failed and will be repeated; repeats are counted.
    pub(crate) fn log_failure(&self, what: &'static str, cause: &dyn std::error::Error) {
        let (now, reason) = (self.clock().elapsed(), chain(cause));
        let failure = Failure {
            what,
            reason: &reason,
        };
        let logged = self.storage().lock().repeats.record(now, failure);
        let Some(repeats) = logged else { return };
        error!(repeats, "cannot {what}: {reason}");
    }

    /// Returns the result of the last check.
    pub fn storage_condition(&self) -> StorageCondition {
        self.storage().lock().condition.clone()
    }

    /// Returns whether the server can work now; checks unless the last check is recent.
    pub async fn ready(&self) -> StorageCondition {
        self.check_storage(CHECK_VALIDITY).await
    }

    /// Checks unless the last check is younger than `shared_for`.
    async fn check_storage(&self, shared_for: Duration) -> StorageCondition {
        let _checking = self.storage().checking.lock().await;
        let checked_at = self.storage().lock().checked_at;
        let now = self.clock().elapsed();
        if checked_at.is_some_and(|at| now.saturating_sub(at) < shared_for) {
            return self.storage_condition();
        }
        let (engine, _version) = self.db().engine();
        let written = limited(engine, self.db().probe_write()).await;
        let read = limited(engine, self.db().probe_tables()).await;
        let disk = self.db().disk().await.unwrap_or_default();
        let disk_free_bytes = disk.free_bytes;
        let condition = {
            let mut inner = self.storage().lock();
            inner.checked_at = Some(self.clock().elapsed());
            let growth = disk
                .database_bytes
                .map(|bytes| inner.growth.record(now, bytes));
            let is_damaged = inner.has_new_damage();
            let condition = &mut inner.condition;
            condition.unwritable = unwritable(engine, written.and(read).err());
            if is_damaged && condition.damaged.is_none() {
                let text = format!(
                    "{} met a damaged page; the whole database is being checked",
                    engine.name()
                );
                condition.damaged = Some(text);
            }
            condition.disk_free_bytes = disk_free_bytes;
            condition.database_bytes = disk.database_bytes;
            condition.log_bytes = disk.log_bytes;
            condition.growth_bytes_per_hour = growth.flatten();
            let limit = self.storage().config.disk_free_min_bytes();
            condition.is_disk_low = is_low(disk_free_bytes, limit, condition.is_disk_low);
            condition.clone()
        };
        self.show_condition(&condition);
        condition
    }

    /// Examines the whole database if damage is suspected or known and the last examination is old enough.
    async fn examine_database(&self) {
        let reports = failure::count(StorageFailure::Damaged);
        let now = self.clock().elapsed();
        {
            let inner = self.storage().lock();
            // Repeated access to the damage must not cause the whole file to be read all the time.
            let every = match inner.condition.damaged {
                Some(_) => EXAMINE_EVERY,
                None => EXAMINE_REST,
            };
            let is_due = inner
                .examined
                .is_none_or(|(at, _)| now.saturating_sub(at) >= every);
            let has_reason = inner.has_new_damage() || inner.condition.damaged.is_some();
            if !(has_reason && is_due) {
                return;
            }
        }
        let found = tokio::time::timeout(EXAMINE_MAX, self.db().quick_check()).await;
        let found = found.unwrap_or_else(|_elapsed| Err(DbError::unanswered()));
        let condition = {
            let mut inner = self.storage().lock();
            // Damage found by this examination itself is not new.
            let reports = failure::count(StorageFailure::Damaged).max(reports);
            inner.examined = Some((self.clock().elapsed(), reports));
            inner.condition.damaged = match found {
                Ok(None) => None,
                Ok(Some(finding)) => Some(finding.chars().take(FINDING_MAX).collect()),
                Err(cause) if cause.failure() == Some(StorageFailure::Damaged) => {
                    Some(StorageFailure::Damaged.explanation().to_owned())
                }
                Err(cause) => {
                    error!("cannot examine the database: {cause:?}");
                    inner.condition.damaged.take()
                }
            };
            inner.condition.clone()
        };
        self.show_condition(&condition);
    }

    /// Raises and clears the alerts about the storage.
    fn show_condition(&self, condition: &StorageCondition) {
        let path = self.db().name();
        let unwritable = condition.unwritable.as_ref().map(|why| {
            format!(
                "nothing can be stored in `{path}`: {why}; missions and measurements wait, Stop and \
                 teleoperation work"
            )
        });
        let damaged = condition.damaged.as_ref().map(|finding| {
            format!("the database `{path}` is damaged, restore a backup of it: {finding}")
        });
        let disk = condition.is_disk_low.then(|| {
            let limit = self.storage().config.disk_free_min_mib;
            format!(
                "less than {limit} MiB are free on the disk of the database `{path}`: make room"
            )
        });
        for (code, severity, text) in [
            (UNWRITABLE_ALERT, Severity::Critical, unwritable),
            (DAMAGED_ALERT, Severity::Critical, damaged),
            (DISK_LOW_ALERT, Severity::Warning, disk),
        ] {
            self.set_server_alert(code, severity, text);
        }
    }

    /// Raises the note for people that the server was restarted.
    pub(crate) fn raise_restart_notice(&self) {
        let text = "the server was restarted; robots connect again by themselves, and streams and \
                    teleoperation must be opened again";
        let severity = Severity::Warning;
        self.set_server_alert(SERVER_RESTARTED_ALERT, severity, Some(text.to_owned()));
    }

    /// Ends the note of a restart after its time.
    fn end_restart_notice(&self) {
        if self.uptime() >= RESTART_NOTED_FOR {
            self.set_server_alert(SERVER_RESTARTED_ALERT, Severity::Warning, None);
        }
    }

    /// Raises, changes or clears an alert about the server.
    pub(super) fn set_server_alert(
        &self,
        code: &'static str,
        severity: Severity,
        text: Option<String>,
    ) {
        let now = self.clock().now();
        let mut inner = self.storage().lock();
        let found = inner
            .raised
            .iter()
            .position(|alert| alert.code.as_str() == code);
        let (alert, event) = match (found, text) {
            (None, Some(text)) => {
                let Ok(code) = code.parse() else { return };
                match severity {
                    Severity::Critical => error!("{text}"),
                    Severity::Warning => warn!("{text}"),
                }
                let alert = Alert {
                    id: self.clock().new_id::<AlertId>(),
                    site: None,
                    robot: None::<RobotId>,
                    code,
                    severity,
                    text,
                    mission: None,
                    place: None,
                    raised_at: now,
                    acknowledged_at: None,
                    cleared_at: None,
                };
                inner.raised.push(alert.clone());
                (alert, Some(NoticeEvent::Opened))
            }
            (Some(index), None) => {
                info!("the alert `{code}` is over");
                let mut alert = inner.raised.remove(index);
                alert.cleared_at = Some(now.max(alert.raised_at));
                inner.cleared.push_back(alert.clone());
                if inner.cleared.len() > CLEARED_KEPT_MAX {
                    inner.cleared.pop_front();
                }
                (alert, Some(NoticeEvent::Ended))
            }
            (Some(index), Some(text)) if inner.raised[index].text != text => {
                let alert = &mut inner.raised[index];
                alert.text = text;
                (alert.clone(), None)
            }
            (Some(_), Some(_)) | (None, None) => return,
        };
        drop(inner);
        self.hub().alert(&alert);
        if let Some(event) = event {
            self.queue_server_alert(event, &alert);
        }
    }
}

impl Inner {
    /// Returns whether SQLite has reported damage since the last examination.
    fn has_new_damage(&self) -> bool {
        let examined = self.examined.map_or(0, |(_, reports)| reports);
        failure::count(StorageFailure::Damaged) > examined
    }
}

/// Returns what failed, and what to do about it.
fn cause_and_remedy(engine: Engine, failure: StorageFailure) -> String {
    format!("{}: {}", failure.explanation(), engine.advice(failure))
}

/// Runs a check with a time limit; on failure returns the reason, for people.
async fn limited(
    engine: Engine,
    probe: impl Future<Output = Result<(), DbError>>,
) -> Result<(), String> {
    match tokio::time::timeout(CHECK_TIMEOUT, probe).await {
        Ok(Ok(())) => Ok(()),
        Ok(Err(cause)) => {
            tracing::debug!("a check of the storage failed: {cause:?}");
            let unknown = || "the database answers with an error, see the log".to_owned();
            let failure = cause.failure();
            Err(failure.map_or_else(unknown, |failure| cause_and_remedy(engine, failure)))
        }
        Err(_elapsed) => Err(cause_and_remedy(engine, StorageFailure::Busy)),
    }
}

/// Returns why nothing can be stored, from the checks and from recent failures.
fn unwritable(engine: Engine, found: Option<String>) -> Option<String> {
    let recent = || {
        let (failure, since) = failure::last()?;
        // Damage has an alert of its own: writes elsewhere succeed.
        let counts = failure != StorageFailure::Damaged && since < RECOVERED_AFTER;
        counts.then(|| cause_and_remedy(engine, failure))
    };
    found.or_else(recent)
}

#[expect(
    clippy::cast_precision_loss,
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "bytes of a disk, to a few per cent"
)]
fn is_low(free_bytes: Option<u64>, limit_bytes: u64, was_low: bool) -> bool {
    let hysteresis = (limit_bytes as f64 * DISK_LOW_HYSTERESIS) as u64;
    let bound = limit_bytes.saturating_add(if was_low { hysteresis } else { 0 });
    free_bytes.is_some_and(|free| free < bound)
}

/// Checks periodically until the stop.
pub async fn run(app: App, stop: CancellationToken) {
    while !stop.is_cancelled() {
        app.check_storage(CHECK_VALIDITY).await;
        app.end_restart_notice();
        tokio::select! {
            () = stop.cancelled() => return,
            () = app.examine_database() => {}
        }
        tokio::select! {
            () = stop.cancelled() => {}
            () = tokio::time::sleep(CHECK_EVERY) => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_disk_is_low_until_there_is_clearly_more_than_the_limit() {
        assert!(!is_low(Some(1_000), 1_000, false));
        assert!(is_low(Some(999), 1_000, false));
        assert!(is_low(Some(1_099), 1_000, true));
        assert!(!is_low(Some(1_100), 1_000, true));
        assert!(!is_low(None, 1_000, true));
    }
}
