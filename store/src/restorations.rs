//! Restorations of the database from a backup.

use jiff::Timestamp;
use tread_api::ids::{RobotId, SiteId};

/// Number of revisions of terrains and geofences that are skipped at a restoration: more than
/// anybody draws between a backup and its restoration.
pub const REVISIONS_SKIPPED: i64 = 1_000_000;

/// Number of enrolments of a robot that are skipped at a restoration.
pub const ENROLMENTS_SKIPPED: i64 = 1_000;

/// A restoration.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Restoration {
    /// Time of the restoration.
    pub restored_at: Timestamp,
    /// Time of the backup.
    pub taken_at: Timestamp,
    /// Version of the server that made the backup.
    pub version: String,
}

/// Numbers of what a restoration changed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Changed {
    /// Robots that await their release.
    pub robots: u64,
    /// Sessions that were ended.
    pub sessions: u64,
    /// Join tokens that were revoked.
    pub join_tokens: u64,
    /// Deliveries to webhooks that are not sent any more.
    pub deliveries: u64,
    /// Robots of which the next certificate counts.
    pub certificates: u64,
}

/// A robot that is restricted since a restoration.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RestrictedRobot {
    /// Its key.
    pub pk: i64,
    /// Its site.
    pub site: SiteId,
    /// The robot.
    pub robot: RobotId,
    /// Whether it awaits its release by an operator, and is not retired.
    pub awaits_release: bool,
    /// Whether it is to say how its open missions ended.
    pub outcomes_wanted: bool,
}
