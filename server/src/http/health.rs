//! Liveness, readiness, status and counters of the server.

use std::time::Duration;

use axum::extract::State;
use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use tread_api::problem::{ProblemBody, ProblemType};
use utoipa::ToSchema;

use super::extract::Json;
use super::problem::Problem;
use super::subject::Subject;
use crate::app::App;
use crate::app::backups::BackupState;
use crate::app::storage::StorageCondition;
use crate::build;
use crate::counters::CounterValues;
use crate::metrics::SLOW_AFTER;

/// Result of a health check.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Health {
    /// Always `ok`.
    pub status: String,
}

/// State of the storage at its last check, a few seconds ago at most.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct StorageStatus {
    /// Whether the storage is writable and undamaged.
    pub ok: bool,
    /// Reason why nothing can be stored; `null` if the storage is writable.
    pub unwritable: Option<String>,
    /// Description of the damage; `null` if there is none.
    pub damaged: Option<String>,
    /// Free bytes on the disk of the database; `null` if the operating system does not report them.
    pub disk_free_bytes: Option<u64>,
    /// Whether `disk_free_bytes` is below the configured `storage.disk_free_min_mib`; then true until
    /// it exceeds that by 10 %.
    pub disk_low: bool,
    /// Size of the database file, bytes; `null` if the operating system does not report it.
    pub database_bytes: Option<u64>,
    /// Size of the write-ahead log, bytes; `null` if the operating system does not report it.
    pub log_bytes: Option<u64>,
    /// Growth of the database file over the last hour, bytes per hour; `null` in the first ten
    /// minutes of a run of the server.
    pub growth_bytes_per_hour: Option<i64>,
}

/// Number of waiting entries of a queue.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct QueueDepth {
    /// Name of the queue.
    pub name: String,
    /// Number of waiting entries.
    pub depth: u64,
}

/// Slow transactions of the database since the start of the server.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct SlowTransactions {
    /// Duration from which a transaction counts as slow, milliseconds.
    pub threshold_ms: u64,
    /// Number of slow transactions.
    pub count: u64,
    /// Use cases with the slowest transactions, the slowest first, at most 10.
    pub slowest: Vec<SlowUseCase>,
}

/// Slow transactions of one use case.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct SlowUseCase {
    /// Name of the use case, as the label `kind` in the metrics.
    pub kind: String,
    /// Whether its transactions write.
    pub writes: bool,
    /// Number of slow transactions.
    pub count: u64,
    /// Duration of the longest transaction, milliseconds.
    pub longest_ms: u64,
}

/// Maximum number of use cases with slow transactions that are listed.
const SLOWEST_MAX: usize = 10;

fn whole_ms(span: Duration) -> u64 {
    u64::try_from(span.as_millis()).unwrap_or(u64::MAX)
}

fn slow_transactions(app: &App) -> SlowTransactions {
    let slow = app.slow_use_cases();
    let count = slow.iter().map(|of| of.count).sum();
    let slowest = slow.into_iter().take(SLOWEST_MAX).map(|of| SlowUseCase {
        kind: of.kind.to_owned(),
        writes: of.writes,
        count: of.count,
        longest_ms: whole_ms(of.longest),
    });
    SlowTransactions {
        threshold_ms: whole_ms(SLOW_AFTER),
        count,
        slowest: slowest.collect(),
    }
}

impl From<StorageCondition> for StorageStatus {
    fn from(condition: StorageCondition) -> Self {
        Self {
            ok: condition.problem().is_none(),
            unwritable: condition.unwritable,
            damaged: condition.damaged,
            disk_free_bytes: condition.disk_free_bytes,
            disk_low: condition.is_disk_low,
            database_bytes: condition.database_bytes,
            log_bytes: condition.log_bytes,
            growth_bytes_per_hour: condition.growth_bytes_per_hour,
        }
    }
}

/// Last backup in the folder of backups, usually made by the server itself.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct BackupStatus {
    /// Time of the last complete backup; `null` without one.
    pub last_at: Option<Timestamp>,
    /// Size of that backup, bytes; `null` without one.
    pub last_bytes: Option<u64>,
    /// Reason why the last attempt failed; `null` if it did not.
    pub failure: Option<String>,
}

impl From<BackupState> for BackupStatus {
    fn from(state: BackupState) -> Self {
        Self {
            last_at: state.last.map(|(at, _)| at),
            last_bytes: state.last.map(|(_, bytes)| bytes),
            failure: state.failure,
        }
    }
}

/// Last restoration of the database from a backup.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct RestorationStatus {
    /// Time of the restoration.
    pub restored_at: Timestamp,
    /// Time of the backup; what happened between the two is unknown.
    pub backup_taken_at: Timestamp,
    /// Version of the server that made the backup.
    pub backup_version: String,
    /// Number of robots that await their release.
    pub robots_awaiting_release: u64,
}

/// Status of the server.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct ServerStatus {
    /// Version of the server.
    pub version: String,
    /// Commit from which it was built; `null` if the build did not record it.
    pub commit: Option<String>,
    /// Schema of the database: the number of its newest migration.
    pub schema: i64,
    /// Time since the start, milliseconds.
    pub uptime_ms: u64,
    /// State of the database.
    pub database: DatabaseStatus,
    /// State of the storage at its last check.
    pub storage: StorageStatus,
    /// Number of waiting entries of each queue: messages of robots (`hellos`, `presence`, `states`,
    /// `uploads`), uploads to be stored (`ingest`), commands of the reconciler (`reconciler`),
    /// deliveries to webhooks (`webhooks`), events for the slowest client (`events`).
    pub queues: Vec<QueueDepth>,
    /// Slow transactions of the database.
    pub slow_transactions: SlowTransactions,
    /// State of the backups; `null` if the server makes none by itself.
    pub backup: Option<BackupStatus>,
    /// Last restoration from a backup; `null` if there was none.
    pub restoration: Option<RestorationStatus>,
    /// Number of connected robots within the scope of the token.
    pub robots_present: usize,
    /// Whether robots can join with a join token, which requires `[robots]` in the configuration.
    pub robots_can_join: bool,
    /// Counters since the start of the server.
    pub counters: CounterValues,
}

/// Engine of the database and its standbys.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct DatabaseStatus {
    /// Name of the engine: `SQLite` or `PostgreSQL`.
    pub engine: String,
    /// Version of the engine.
    pub version: String,
    /// Number of standbys that follow the database; `null` for a database file, and while it does
    /// not answer.
    pub standbys: Option<u64>,
}

pub(super) fn ok() -> Json<Health> {
    Json(Health {
        status: "ok".to_owned(),
    })
}

/// Check that the process answers.
#[utoipa::path(get, path = "/healthz", tag = "server", responses((status = 200, body = Health)))]
pub(super) async fn healthz() -> Json<Health> {
    ok()
}

/// Check that the server is ready.
///
/// It is ready if the database accepts a write and has no known damage. The result may be one
/// second old.
#[utoipa::path(get, path = "/readyz", tag = "server",
    responses((status = 200, body = Health), (status = 503, body = ProblemBody)))]
pub(super) async fn readyz(State(app): State<App>) -> Result<Json<Health>, Problem> {
    let condition = app.ready().await;
    match condition.problem() {
        Some(problem) => Err(Problem::new(ProblemType::Unavailable).detail(problem)),
        None => Ok(ok()),
    }
}

/// Get the server's version, uptime and counters.
#[utoipa::path(get, path = "/v1/server", tag = "server", operation_id = "get_server",
    security(("token" = ["read"])),
    responses((status = 200, body = ServerStatus)))]
pub(super) async fn status(
    State(app): State<App>,
    Subject(subject): Subject,
) -> Json<ServerStatus> {
    let queues = app.queue_depths().await;
    let standbys = app.standbys().await.ok().flatten();
    Json(ServerStatus {
        version: build::VERSION.to_owned(),
        commit: build::commit().map(str::to_owned),
        schema: app.database_schema(),
        uptime_ms: whole_ms(app.uptime()),
        database: {
            let (engine, version) = app.database_engine();
            DatabaseStatus {
                engine: engine.to_owned(),
                version: version.to_owned(),
                standbys,
            }
        },
        storage: app.storage_condition().into(),
        queues: queues
            .into_iter()
            .map(|(name, depth)| QueueDepth {
                name: name.to_owned(),
                depth,
            })
            .collect(),
        slow_transactions: slow_transactions(&app),
        backup: app.backup_state().map(BackupStatus::from),
        restoration: app
            .restoration()
            .map(|(restored, awaiting)| RestorationStatus {
                restored_at: restored.restored_at,
                backup_taken_at: restored.taken_at,
                backup_version: restored.version,
                robots_awaiting_release: awaiting,
            }),
        robots_present: app.presences().present_count(&subject.scope),
        robots_can_join: app.trust_id().is_some(),
        counters: app.counters().values(),
    })
}
