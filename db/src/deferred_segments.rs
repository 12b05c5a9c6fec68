//! Deferred segments: measurements with times in the future, kept until the clock of their run is
//! known.

use serde_json::value::RawValue;
pub use tread_store::deferred_segments::{DeferredFilter, DeferredSegment, DeferredTimes, Origin};

use super::{DbError, Tx, forward};

forward! {
    deferred_segments;
    fn put(origin: Origin, times: DeferredTimes, measurement: &RawValue) -> bool;
    fn count(robot_pk: i64) -> u64;
    fn is_any() -> bool;
    fn take(filter: DeferredFilter, limit: u32) -> Vec<DeferredSegment>;
}
