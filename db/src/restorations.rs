//! Restorations of backups, and the robots that await what follows from one.

pub use tread_store::restorations::{
    Changed, ENROLMENTS_SKIPPED, REVISIONS_SKIPPED, Restoration, RestrictedRobot,
};

use super::{DbError, Tx, forward};

forward! {
    restorations;
    fn begin(restoration: &Restoration) -> Changed;
    fn newest() -> Option<Restoration>;
    fn enrolment_floor() -> u32;
    fn restricted() -> Vec<RestrictedRobot>;
    fn awaiting_count() -> u64;
    fn release(robot_pk: i64) -> bool;
    fn record_outcomes(robot_pk: i64) -> ();
}
