//! Withdrawals: hours of robots whose measurements are not on the map.

pub use tread_store::withdrawals::{Hours, WithdrawalRow};

use super::{DbError, Tx, forward};

forward! {
    withdrawals;
    fn all() -> Vec<WithdrawalRow>;
    fn count() -> usize;
    fn insert(row: &WithdrawalRow) -> i64;
}
