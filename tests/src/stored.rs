//! What a database holds of measurements, read beside its server.

use std::path::Path;
use std::time::Duration;

use anyhow::ensure;
use sqlx::sqlite::SqliteConnectOptions;
use sqlx::{ConnectOptions as _, Connection as _, Row as _};
use tokio::time::Instant;

/// Longest wait for the sums of what was uploaded: the server stores them every few seconds.
const SUMS_WAIT_MAX: Duration = Duration::from_secs(30);
const LOOK_EVERY: Duration = Duration::from_millis(200);

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

/// Counts what a database holds now.
///
/// # Errors
/// It cannot be read.
pub async fn count(database: &Path) -> anyhow::Result<Stored> {
    let options = SqliteConnectOptions::new().filename(database);
    let mut connection = options.read_only(true).connect().await?;
    let row = sqlx::query(
        "SELECT count(*), count(*) - count(DISTINCT boot_pk || ':' || seq), \
         (SELECT coalesce(sum(segments), 0) FROM cell_sums), \
         (SELECT count(*) FROM cell_sums) FROM segments",
    )
    .fetch_one(&mut connection)
    .await?;
    connection.close().await?;
    Ok(Stored {
        segments: row.try_get(0)?,
        doubles: row.try_get(1)?,
        in_sums: row.try_get(2)?,
        sums: row.try_get(3)?,
    })
}

/// Waits, after the last upload, until the stored sums contain as many segments as there are.
///
/// # Errors
/// The database cannot be read, or the numbers differ for too long.
pub async fn await_sums(database: &Path) -> anyhow::Result<()> {
    let begin = Instant::now();
    let options = SqliteConnectOptions::new().filename(database);
    let mut connection = options.read_only(true).connect().await?;
    loop {
        let row = sqlx::query(
            "SELECT (SELECT count(*) FROM segments), \
             (SELECT coalesce(sum(segments), 0) FROM cell_sums)",
        );
        let row = row.fetch_one(&mut connection).await?;
        let (segments, in_sums): (i64, i64) = (row.try_get(0)?, row.try_get(1)?);
        if segments == in_sums {
            connection.close().await?;
            return Ok(());
        }
        ensure!(
            begin.elapsed() < SUMS_WAIT_MAX,
            "{segments} segments are stored, and {in_sums} are in the sums"
        );
        tokio::time::sleep(LOOK_EVERY).await;
    }
}
