//! Raw measurements, in the order of their commits.

use std::ops::RangeInclusive;

use jiff::Timestamp;
use tread_api::friction::StoredSegment;
pub use tread_store::segments::{
    Added, Extent, KeyedSegment, NewSegment, RobotCursor, SegmentFilter, SiteCursor,
};

use futures_util::future::Either;
use futures_util::{Stream, StreamExt as _};

use super::{DbError, Tx, forward};

forward! {
    segments;
    fn insert(segments: &[NewSegment<'_>], received_at: Timestamp) -> Added;
    fn extent(site_pk: i64, filter: &SegmentFilter) -> Extent;
    fn list(site_pk: i64, filter: &SegmentFilter, limit: u32) -> Vec<StoredSegment>;
    fn first_since(at: Timestamp) -> Option<i64>;
    fn of_site(cursor: SiteCursor, limit: u32) -> Vec<KeyedSegment>;
    fn after(after: i64, limit: u32) -> Vec<KeyedSegment>;
    fn of_all_sites(keys: RangeInclusive<i64>, limit: u32) -> Vec<(i64, StoredSegment)>;
}

/// Returns all measurements of a robot after a cursor, in the order of their commits.
pub fn of_robot(
    tx: &mut Tx,
    cursor: RobotCursor,
) -> impl Stream<Item = Result<KeyedSegment, DbError>> {
    match tx {
        Tx::Sqlite(tx) => {
            let rows = tread_store_sqlite::segments::of_robot(tx, cursor);
            Either::Left(rows.map(|row| row.map_err(DbError::from)))
        }
        Tx::Postgres(tx) => {
            let rows = tread_store_postgres::segments::of_robot(tx, cursor);
            Either::Right(rows.map(|row| row.map_err(DbError::from)))
        }
    }
}
