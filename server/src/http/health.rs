//! Whether the server lives, is ready, and what it counts.

use axum::extract::State;
use serde::{Deserialize, Serialize};
use tread_api::problem::{ProblemBody, ProblemType};
use utoipa::ToSchema;

use super::extract::Json;
use super::problem::Problem;
use super::subject::Subject;
use crate::app::App;
use crate::app::storage::StorageCondition;
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

/// The server about itself.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct ServerStatus {
    /// Version of the server.
    pub version: String,
    /// Time since the start, milliseconds.
    pub uptime_ms: u64,
    /// Version of the SQLite library.
    pub sqlite_version: String,
    /// The storage as it was checked last.
    pub storage: StorageStatus,
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
        version: env!("CARGO_PKG_VERSION").to_owned(),
        uptime_ms: u64::try_from(app.uptime().as_millis()).unwrap_or(u64::MAX),
        sqlite_version: app.db().sqlite_version().to_owned(),
        storage: app.storage_condition().into(),
        robots_present: app.presences().present_count(&subject.scope),
        counters: app.counters().values(),
    })
}
