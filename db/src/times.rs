//! The newest times that the database holds.

use jiff::Timestamp;
use uuid::Uuid;

use super::{DbError, Tx, forward};

forward! {
    times;
    fn newest() -> Option<Timestamp>;
    fn newest_id() -> Option<Uuid>;
}
