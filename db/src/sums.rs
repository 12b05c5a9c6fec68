//! Sums of measurements per cell, ground, robot, configuration and hour of measuring, up to the
//! watermark of each robot ([`super::watermarks`]).

use tread_api::site::Cell;
use tread_store::friction::Sums;
pub use tread_store::sums::{StoredHour, SumKey, SumRow};
use tread_store::withdrawals::Hours;

use super::{DbError, Tx, forward};

forward! {
    sums;
    fn each(take: impl FnMut(SumRow)) -> ();
    fn of_block(site_pk: i64, cell: Cell, take: impl FnMut(SumRow)) -> ();
    fn unmerged(limit: u32) -> Vec<StoredHour>;
    fn of_hour(hour: StoredHour, limit: usize) -> Vec<SumRow>;
    fn remove(key: &SumKey) -> bool;
    fn remove_hours(robot_pk: i64, hours: Hours) -> u64;
}

/// Adds sums to those that are stored, bit for bit as [`Sums::add`] does.
///
/// # Errors
/// The engine failed.
pub async fn add<'sums>(
    tx: &mut Tx,
    sums: impl Iterator<Item = (&'sums SumKey, &'sums Sums)>,
) -> Result<(), DbError> {
    match tx {
        Tx::Sqlite(tx) => tread_store_sqlite::sums::add(tx, sums).await?,
        Tx::Postgres(tx) => Box::pin(tread_store_postgres::sums::add(tx, sums)).await?,
    }
    Ok(())
}
