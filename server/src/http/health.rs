//! Whether the server lives, is ready, and what it counts.

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

/// The server is there.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Health {
    /// Always `ok`.
    pub status: String,
}

/// The storage as it was checked last, at most a few seconds ago.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct StorageStatus {
    /// Whether everything works.
    pub ok: bool,
    /// Why nothing can be stored, if that is so.
    pub unwritable: Option<String>,
    /// What is damaged, if anything is.
    pub damaged: Option<String>,
    /// Free bytes on the disk of the database; `null` if the operating system does not report them.
    pub disk_free_bytes: Option<u64>,
    /// Whether that is below `storage.disk_free_min_mib`.
    pub disk_low: bool,
}

impl From<StorageCondition> for StorageStatus {
    fn from(condition: StorageCondition) -> Self {
        Self {
            ok: condition.problem().is_none(),
            unwritable: condition.unwritable,
            damaged: condition.damaged,
            disk_free_bytes: condition.disk_free_bytes,
            disk_low: condition.is_disk_low,
        }
    }
}

/// The last backup that the server made by itself, or that was put into the folder of backups.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct BackupStatus {
    /// Time of the last complete backup; `null` without one.
    pub last_at: Option<Timestamp>,
    /// Its size, bytes.
    pub last_bytes: Option<u64>,
    /// Why the last attempt failed, if it did.
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

/// The last restoration of the database from a backup.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct RestorationStatus {
    /// Time of the restoration.
    pub restored_at: Timestamp,
    /// Time of the backup; what happened between the two is unknown.
    pub backup_taken_at: Timestamp,
    /// Version of the server that made the backup.
    pub backup_version: String,
    /// Robots that await their release.
    pub robots_awaiting_release: u64,
}

/// The server about itself.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct ServerStatus {
    /// Version of the server.
    pub version: String,
    /// Commit that it was built from; `null` if the build did not say.
    pub commit: Option<String>,
    /// Schema of its database: the newest migration.
    pub schema: i64,
    /// Time since the start, milliseconds.
    pub uptime_ms: u64,
    /// Version of the SQLite library.
    pub sqlite_version: String,
    /// The storage as it was checked last.
    pub storage: StorageStatus,
    /// Its backups; `null` if it makes none by itself.
    pub backup: Option<BackupStatus>,
    /// The last restoration from a backup; `null` if there was none.
    pub restoration: Option<RestorationStatus>,
    /// Robots that are on the network now, of those that the token is for.
    pub robots_present: usize,
    /// What it has counted since the start.
    pub counters: CounterValues,
}

fn ok() -> Json<Health> {
    Json(Health {
        status: "ok".to_owned(),
    })
}

/// Check that the process answers.
#[utoipa::path(get, path = "/healthz", tag = "server", responses((status = 200, body = Health)))]
pub(super) async fn healthz() -> Json<Health> {
    ok()
}

/// Check that the server can work.
///
/// The database takes a write, and no damage of it is known. The answer may be a second old.
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
    Json(ServerStatus {
        version: build::VERSION.to_owned(),
        commit: build::commit().map(str::to_owned),
        schema: build::schema(),
        uptime_ms: u64::try_from(app.uptime().as_millis()).unwrap_or(u64::MAX),
        sqlite_version: app.db().sqlite_version().to_owned(),
        storage: app.storage_condition().into(),
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
        counters: app.counters().values(),
    })
}
