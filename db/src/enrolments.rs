//! Enrolments of robots, and the certificates that count for a renewal.

use jiff::Timestamp;
use std::collections::BTreeSet;
use tread_api::enrolment::Enrolment;
use tread_api::ids::{RobotId, SiteId};
use tread_store::Issued;
pub use tread_store::enrolments::{AcceptedCertificates, Renewal};

use super::{DbError, Tx, forward};

forward! {
    enrolments;
    fn all_newest() -> Vec<Enrolment>;
    fn list(robots: (&SiteId, Option<&BTreeSet<RobotId>>), after: &str, limit: u32) -> Vec<Enrolment>;
    fn newest(site: &SiteId, robot: &RobotId) -> Option<Enrolment>;
    fn robot_count() -> i64;
    fn insert(enrolment: &Enrolment, issued: &Issued) -> ();
    fn accepted_certificates(enrolment: (&SiteId, &RobotId, u32)) -> AcceptedCertificates;
    fn delete_issued_certificates() -> u64;
    fn renew(enrolment: (&SiteId, &RobotId, u32), renewal: Renewal<'_>) -> bool;
    fn record_authority(enrolment: (&SiteId, &RobotId, u32), authority: &str) -> ();
    fn revoke(robot: (&SiteId, &RobotId), by: &str, at: Timestamp) -> ();
}
