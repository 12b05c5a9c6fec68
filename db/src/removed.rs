//! Raw measurements that were removed after their retention; their names (`boot`, `seq`) are kept
//! as ranges.

use jiff::Timestamp;
use std::collections::HashSet;
use std::ops::RangeInclusive;

use super::{DbError, Tx, forward};

forward! {
    removed;
    fn last_before(before: Timestamp, begins_until_pk: i64) -> Option<i64>;
    fn remove(until_pk: i64) -> (u64, HashSet<i64>);
    fn release_removed() -> Option<u64>;
    fn boots() -> HashSet<i64>;
    fn within(boot_pk: i64, seqs: RangeInclusive<i64>) -> Vec<(i64, i64)>;
    fn newest_seq(boot_pk: i64) -> Option<i64>;
}
