//! Ledger of stored measurements: ranges with consecutive keys and sequence numbers that agree in
//! everything but their values. A measurement that is sent again lies in one of them.

use std::collections::HashMap;
use std::ops::RangeInclusive;

use super::{DbError, Tx, forward};

forward! {
    segment_ranges;
    fn last() -> Option<(i64, i64)>;
    fn ends() -> Option<(i64, i64)>;
    fn received_at_us(pk: i64) -> Option<i64>;
    fn within(boot_pk: i64, seqs: RangeInclusive<i64>) -> Vec<(i64, i64)>;
    fn newest_seq(boot_pk: i64) -> Option<i64>;
    fn last_keys() -> HashMap<i64, i64>;
}
