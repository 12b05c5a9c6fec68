//! Segments that wait for the time of their robot.

use jiff::Timestamp;
use tread_api::friction::Segment;

use crate::RecordKey;

/// A deferred segment.
#[derive(Debug, Clone)]
pub struct DeferredSegment {
    /// Its sequence number within its run.
    pub seq: i64,
    /// The segment, with the times of the robot's clock.
    pub segment: Segment,
}

/// Filter of the deferred segments that are taken.
#[derive(Debug, Clone, Copy)]
pub struct DeferredFilter {
    /// Only those of this run of the agent.
    pub boot_pk: i64,
    /// Only those that ended at this time of its robot's clock, or before, microseconds since 1970.
    pub ended_until_us: i64,
}

/// Times of a segment that is deferred.
#[derive(Debug, Clone, Copy)]
pub struct DeferredTimes {
    /// Its end, by its robot's clock.
    pub ended_at: Timestamp,
    /// Its receipt, by the server's clock.
    pub received_at: Timestamp,
}

/// Origin of a segment.
#[derive(Debug, Clone, Copy)]
pub struct Origin {
    /// Key of its record.
    pub key: RecordKey,
    /// Key of the site.
    pub site_pk: i64,
    /// Key of the robot.
    pub robot_pk: i64,
}
