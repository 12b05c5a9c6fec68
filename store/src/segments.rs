//! Raw measurements.

use std::collections::BTreeSet;

use tread_api::friction::Segment;
use tread_api::ids::{RobotId, TerrainId};

/// A measurement to be stored.
#[derive(Debug, Clone, Copy)]
pub struct NewSegment<'segment> {
    /// Key of the run of the agent.
    pub boot_pk: i64,
    /// Its sequence number within that run.
    pub seq: i64,
    /// Key of the robot.
    pub robot_pk: i64,
    /// Key of the site.
    pub site_pk: i64,
    /// Key of the configuration.
    pub configuration_pk: i64,
    /// The measurement.
    pub segment: &'segment Segment,
    /// Its begin and end, by the server's clock, nanoseconds since 1970.
    pub times_ns: (i64, i64),
}

impl NewSegment<'_> {
    /// Returns whether the ledger may name this and the next measurement in one range.
    pub fn is_followed_by(&self, next: &Self) -> bool {
        let whole = |new: &Self| (new.boot_pk, new.robot_pk, new.site_pk, new.configuration_pk);
        let shared = |segment: &Segment| (segment.mission, segment.grid_revision);
        self.seq.checked_add(1) == Some(next.seq)
            && whole(self) == whole(next)
            && shared(self.segment) == shared(next.segment)
            && self.segment.terrain == next.segment.terrain
    }
}

/// Keys of measurements that were added together; empty if `last` is before `first`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Added {
    /// Key of the first one.
    pub first: i64,
    /// Key of the last one.
    pub last: i64,
}

/// Filter of a list of measurements.
#[derive(Debug, Clone, Default)]
pub struct SegmentFilter {
    /// Only those of this robot.
    pub robot: Option<RobotId>,
    /// Only those on this terrain.
    pub terrain: Option<TerrainId>,
    /// Only those of these robots.
    pub robots: Option<BTreeSet<RobotId>>,
    /// Only those with a larger key (cursor).
    pub after: i64,
}

/// Cursor in the measurements of a site.
#[derive(Debug, Clone, Copy)]
pub struct SiteCursor {
    /// Key of the site.
    pub site_pk: i64,
    /// Only those with a larger key.
    pub after: i64,
}

/// Cursor in the measurements of a robot.
#[derive(Debug, Clone, Copy)]
pub struct RobotCursor {
    /// Key of the robot.
    pub robot_pk: i64,
    /// Only those with a larger key.
    pub after: i64,
}

/// Range of stored measurements; it changes whenever one is added or removed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Extent {
    /// Key of the oldest one; measurements are removed from the oldest on.
    pub first: Option<i64>,
    /// Key of the newest one.
    pub last: Option<i64>,
    /// Time at which the newest one was received, microseconds since 1970: keys may restart after
    /// all were removed.
    pub last_at_us: Option<i64>,
}

/// A measurement with the keys of what it names.
#[derive(Debug)]
pub struct KeyedSegment {
    /// Its key.
    pub pk: i64,
    /// Key of the first measurement of its range: those of a range were committed together.
    pub range_pk: i64,
    /// Key of the robot.
    pub robot_pk: i64,
    /// The robot.
    pub robot: RobotId,
    /// Key of the site.
    pub site_pk: i64,
    /// Key of the configuration.
    pub configuration_pk: i64,
    /// The measurement.
    pub segment: Segment,
}
