//! What a database holds of measurements, read beside its server.

use std::time::Duration;

use anyhow::{Context as _, ensure};
use tokio::time::Instant;

use crate::database::FleetDatabase;

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
pub async fn count(database: &FleetDatabase) -> anyhow::Result<Stored> {
    let rows = database.rows(
        "SELECT (SELECT count(*) FROM segment_values), \
         (SELECT CAST(coalesce(sum(segments), 0) AS BIGINT) FROM cell_sums), \
         (SELECT count(*) FROM cell_sums)",
    );
    let counted: Option<(i64, i64, i64)> = rows.await?.pop();
    let (segments, in_sums, sums) = counted.context("no row of counts")?;
    let ranges: Vec<(i64, i64, i64)> = database
        .rows("SELECT boot_pk, first_seq, last_seq FROM segment_ranges ORDER BY boot_pk, first_seq")
        .await?;
    let named: i64 = ranges.iter().map(|(_, first, last)| last - first + 1).sum();
    ensure!(
        named == segments,
        "the ledger names {named} segments, and {segments} have values"
    );
    Ok(Stored {
        segments,
        doubles: doubles(&ranges),
        in_sums,
        sums,
    })
}

/// Returns how many sequence numbers are in more than one range of their run; the ranges are in the order
/// of runs and first numbers.
fn doubles(ranges: &[(i64, i64, i64)]) -> i64 {
    let (mut doubles, mut run, mut end) = (0, None, i64::MIN);
    for &(boot_pk, first, last) in ranges {
        if run != Some(boot_pk) {
            (run, end) = (Some(boot_pk), i64::MIN);
        }
        doubles += (end.min(last).saturating_sub(first).saturating_add(1)).max(0);
        end = end.max(last);
    }
    doubles
}

/// Waits, after the last upload, until the stored sums contain as many segments as there are.
///
/// # Errors
/// The database cannot be read, or the numbers differ for too long.
pub async fn await_sums(database: &FleetDatabase) -> anyhow::Result<()> {
    let begin = Instant::now();
    loop {
        let rows = database.rows(
            "SELECT (SELECT count(*) FROM segment_values), \
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
        tokio::time::sleep(LOOK_EVERY).await;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_in_several_ranges_of_a_run_are_doubles() {
        assert_eq!(doubles(&[]), 0);
        assert_eq!(doubles(&[(1, 0, 9), (1, 10, 12), (2, 0, 9)]), 0);
        assert_eq!(doubles(&[(1, 0, 9), (1, 8, 12), (2, 9, 9)]), 2);
        assert_eq!(doubles(&[(1, 0, 9), (1, 2, 3), (1, 9, 9)]), 3);
    }
}
