//! Stops of robots: requested, confirmed, cleared or replaced.

use jiff::Timestamp;
use tread_api::ids::{RobotId, SiteId, StopId};
use tread_api::stop::Stop;
pub use tread_store::stops::StopFilter;

use super::{DbError, Tx, forward};

forward! {
    stops;
    fn list(filter: &StopFilter, limit: u32) -> Vec<Stop>;
    fn in_force() -> Vec<Stop>;
    fn in_force_of(robot_pk: i64) -> Option<Stop>;
    fn is_stopped(site: &SiteId, robot: &RobotId) -> bool;
    fn find(id: StopId) -> Option<Stop>;
    fn insert(stops: &[Stop], kept: u32) -> ();
    fn adopt(robot_pk: i64, stop: &Stop, kept: u32) -> ();
    fn confirm(ids: &[StopId], at: Timestamp) -> ();
    fn record_standstill(id: StopId, at: Timestamp) -> ();
    fn unconfirm(id: StopId) -> ();
    fn request_clear(id: StopId, by: &str, at: Timestamp) -> ();
    fn refuse_clear(id: StopId) -> ();
    fn clear(id: StopId, at: Timestamp) -> ();
    fn end(id: StopId, at: Timestamp) -> ();
}
