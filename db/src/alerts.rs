//! Alerts of robots: raised, acknowledged, cleared.

use jiff::Timestamp;
use tread_api::ids::{AlertCode, AlertId, RobotId, SiteId};
use tread_api::robot::{Alert, AlertReport};
pub use tread_store::alerts::{AlertFilter, AlertLocation};

use super::{DbError, Tx, forward};

forward! {
    alerts;
    fn list(filter: &AlertFilter, limit: u32) -> Vec<Alert>;
    fn raised(limit: u32) -> Vec<Alert>;
    fn raised_about(code: &str) -> Vec<(SiteId, RobotId)>;
    fn raised_of(robot_pk: i64) -> Vec<Alert>;
    fn find(id: AlertId) -> Option<Alert>;
    fn raise(robot_pk: i64, id: AlertId, report: &AlertReport, at: Timestamp) -> ();
    fn locate(id: AlertId, location: AlertLocation) -> ();
    fn prune(robot_pk: i64, kept: u32) -> ();
    fn clear(robot_pk: i64, code: &AlertCode, at: Timestamp) -> ();
    fn acknowledge(id: AlertId, at: Timestamp) -> ();
}
