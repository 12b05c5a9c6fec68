//! Robots, their configurations, and the runs of their agents.

use jiff::Timestamp;
use std::collections::{BTreeSet, HashMap};
use tread_api::ids::{BootId, ConfigurationId, RobotId, SiteId, Tag};
pub use tread_store::robots::{Introduction, RobotRow};

use super::{DbError, Tx, forward};

forward! {
    robots;
    fn find(site_pk: i64, id: &RobotId) -> Option<RobotRow>;
    fn is_known(site: Option<&SiteId>, id: &RobotId) -> bool;
    fn pk_of(site: &SiteId, robot: &RobotId) -> Option<i64>;
    fn list(robots: (i64, Option<&BTreeSet<RobotId>>), after: &str, retired: bool, limit: u32) -> Vec<RobotRow>;
    fn introduce(site_pk: i64, introduction: Introduction<'_>, runs_kept: u32) -> ();
    fn find_boot(robot_pk: i64, boot: BootId) -> Option<i64>;
    fn boot_key(robot_pk: i64, boot: BootId, kept: u32) -> i64;
    fn configuration_key(id: &str) -> i64;
    fn measured_configuration(robot_pk: i64, id: ConfigurationId) -> Option<i64>;
    fn measured_count(robot_pk: i64) -> i64;
    fn record_measured(robot_pk: i64, id: ConfigurationId) -> i64;
    fn names() -> Vec<(SiteId, RobotId)>;
    fn rename(robot_pk: i64, name: &str) -> ();
    fn set_tags(robot_pk: i64, tags: &BTreeSet<Tag>) -> ();
    fn set_retired(robot_pk: i64, at: Option<Timestamp>) -> ();
    fn all(limit: u32) -> Vec<RobotRow>;
    fn ids_by_key() -> HashMap<i64, RobotId>;
    fn of_site_by_key(site_pk: i64) -> HashMap<i64, RobotId>;
    fn configurations_by_key() -> HashMap<i64, ConfigurationId>;
    fn model_names() -> HashMap<ConfigurationId, String>;
    fn count_refused(pk: i64, count: u64, why: &str) -> ();
}
