//! What a database holds of measurements, read beside its server.

use std::path::Path;
use std::time::Duration;

use anyhow::{Context as _, ensure};
use tokio::time::Instant;
use tread_agent::outbox::{Limits, Outbox};
use tread_api::ids::{BootId, RobotId};

use crate::database::FleetDatabase;

/// Longest wait for the sums of what was uploaded: the server stores them every few seconds.
const SUMS_WAIT_MAX: Duration = Duration::from_secs(30);
const POLL_INTERVAL: Duration = Duration::from_millis(200);

/// Numbers of stored segments.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Stored {
    /// Raw segments.
    pub segments: i64,
    /// Those among them that are stored more than once.
    pub doubles: i64,
    /// Segments in the stored sums of cells.
    pub in_sums: i64,
    /// Stored sums of cells.
    pub sums: i64,
}

/// Names of all records that a database has taken, as boot and number within it, sorted.
///
/// # Errors
/// It cannot be read.
pub async fn records(database: &FleetDatabase) -> Result<Vec<(String, i64)>, sqlx::Error> {
    let records = database.rows(
        "SELECT boots.id, seq FROM (SELECT boot_pk, seq FROM segments UNION ALL
             SELECT boot_pk, seq FROM reports_seen) AS taken
         JOIN boots ON boots.pk = taken.boot_pk ORDER BY boots.id, seq",
    );
    records.await
}

/// Compares the records that a robot wrote into its folder with those that were taken, of that robot alone,
/// and says what is wrong. A process that is killed loses nothing that it had written, so all that was ever
/// appended must have arrived.
pub fn lost_records(folder: &Path, robot: &RobotId, records: Vec<(String, i64)>) -> Option<String> {
    let boot = BootId::from_uuid(uuid::Uuid::nil());
    let folder = folder.join("outbox");
    let outbox = match Outbox::open(&folder, Limits::default(), robot.clone(), boot) {
        Ok(outbox) => outbox,
        Err(cause) => return Some(format!("the outbox cannot be read: {cause}")),
    };
    let (appended, status) = (outbox.appended(), outbox.status());
    let arrived = records.len() as u64;
    let mut distinct = records;
    distinct.dedup();
    let is_whole = appended == arrived
        && distinct.len() as u64 == arrived
        && (status.pending, status.dropped, status.refused) == (0, 0, 0);
    (!is_whole).then(|| {
        format!(
            "the robot wrote {appended} records, {arrived} are at the server, {} of them \
             distinct; {status:?}",
            distinct.len()
        )
    })
}

/// Counts what a database holds now.
///
/// # Errors
/// It cannot be read.
pub async fn count(database: &FleetDatabase) -> anyhow::Result<Stored> {
    let rows = database.rows(
        "SELECT count(*), count(*) - count(DISTINCT boot_pk || ':' || seq), \
         (SELECT CAST(coalesce(sum(segments), 0) AS BIGINT) FROM cell_sums), \
         (SELECT count(*) FROM cell_sums) FROM segments",
    );
    let counted: Option<(i64, i64, i64, i64)> = rows.await?.pop();
    let (segments, doubles, in_sums, sums) = counted.context("no row of counts")?;
    Ok(Stored {
        segments,
        doubles,
        in_sums,
        sums,
    })
}

/// Waits, after the last upload, until the stored sums contain as many segments as there are.
///
/// # Errors
/// The database cannot be read, or the numbers differ for too long.
pub async fn await_sums(database: &FleetDatabase) -> anyhow::Result<()> {
    let begin = Instant::now();
    loop {
        let rows = database.rows(
            "SELECT (SELECT count(*) FROM segments), \
             (SELECT CAST(coalesce(sum(segments), 0) AS BIGINT) FROM cell_sums)",
        );
        let counted: Option<(i64, i64)> = rows.await?.pop();
        let (segments, in_sums) = counted.context("no row of counts")?;
        if segments == in_sums {
            return Ok(());
        }
        ensure!(
            begin.elapsed() < SUMS_WAIT_MAX,
            "{segments} segments are stored, and {in_sums} are in the sums"
        );
        tokio::time::sleep(POLL_INTERVAL).await;
    }
}
