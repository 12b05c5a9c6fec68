//! Validation of a segment, and correction of its times, before it is stored.

use std::borrow::Cow;

use jiff::{SignedDuration, Timestamp};
use serde_json::value::{RawValue, to_raw_value};
use tread_api::friction::Segment;
use tread_api::site::{GRID_REVISION_FIRST, Grid};

use crate::friction::Sums;

/// Offset of a robot's wall clock from the server's, from the time stamp of its message.
///
/// Offsets up to [`SKEW_MIN`] are attributed to the network and ignored, so that a segment has the
/// same epoch whenever it arrives. Beyond that the segment's duration is kept and its date is
/// corrected by the offset.
#[derive(Debug, Clone, Copy)]
pub(super) struct Skew {
    ahead: SignedDuration,
    now: Timestamp,
}

/// Maximum offset that is ignored.
pub(in crate::app) const SKEW_MIN: SignedDuration = SignedDuration::from_secs(30);

impl Skew {
    pub(super) fn of(robot_time: Option<Timestamp>, now: Timestamp) -> Self {
        let ahead = robot_time.map_or(SignedDuration::ZERO, |robot_time| {
            robot_time.duration_since(now)
        });
        let ahead = if ahead.abs() > SKEW_MIN {
            ahead
        } else {
            SignedDuration::ZERO
        };
        Self { ahead, now }
    }

    fn shifted(self, at: Timestamp) -> Timestamp {
        at.checked_sub(self.ahead).unwrap_or(at)
    }

    /// Corrects the time of a mission report. A time that is still in the future is of an earlier
    /// run with a wrong clock; it is replaced by the present.
    pub(super) fn corrected(self, at: Timestamp) -> Timestamp {
        let at = self.shifted(at);
        if at.duration_since(self.now) > SKEW_MIN {
            self.now
        } else {
            at
        }
    }

    /// Returns the latest time of the robot's clock that is not in the future, microseconds since
    /// 1970.
    pub(super) fn latest_us(self) -> i64 {
        let latest = self.now.checked_add(SKEW_MIN + self.ahead);
        latest.unwrap_or(self.now).as_microsecond()
    }
}

/// Result of checking a segment.
#[derive(Debug)]
#[expect(
    clippy::large_enum_variant,
    reason = "a measurement with a time in the future is rare"
)]
pub(super) enum Prepared<'segment> {
    /// A measurement with corrected times.
    Ready(Ready<'segment>),
    /// A measurement with a time in the future: the clock of its run is not known.
    Ahead(Box<RawValue>),
}

/// A valid segment, ready to be stored.
#[derive(Debug)]
pub(super) struct Ready<'segment> {
    /// The measurement, with the times of the robot's clock.
    pub(super) segment: Cow<'segment, Segment>,
    /// Its corrected begin and end, nanoseconds since 1970.
    pub(super) times_ns: (i64, i64),
    pub(super) sums: Sums,
}

/// Checks a segment and corrects its times.
///
/// # Errors
/// The reason why it is invalid, for people.
pub(super) fn prepared<'segment>(
    segment: Cow<'segment, Segment>,
    grid: &Grid,
    skew: Skew,
) -> Result<Prepared<'segment>, String> {
    segment.validate().map_err(|invalid| invalid.to_string())?;
    if !(GRID_REVISION_FIRST..=grid.revision).contains(&segment.grid_revision) {
        return Err(format!("the site has no grid {}", segment.grid_revision));
    }
    if segment.grid_revision == grid.revision && !grid.center_of(segment.cell).is_on_the_map() {
        return Err("the cell lies outside the site".to_owned());
    }
    if segment.ended_at.as_microsecond() > skew.latest_us() {
        let measurement = to_raw_value(&*segment).map_err(|error| error.to_string())?;
        return Ok(Prepared::Ahead(measurement));
    }
    let span = segment.ended_at.duration_since(segment.started_at);
    let ended_at = skew.shifted(segment.ended_at);
    let started_at = ended_at.checked_sub(span).unwrap_or(ended_at);
    let (started_at_ns, ended_at_ns) = (stored_ns(started_at), stored_ns(ended_at));
    let sums = Sums::of_ended_at(&segment, us_of(ended_at_ns));
    Ok(Prepared::Ready(Ready {
        sums: sums.ok_or_else(|| "theta is out of range".to_owned())?,
        segment,
        times_ns: (started_at_ns, ended_at_ns),
    }))
}

/// Returns a time as it is stored, nanoseconds since 1970. Times before 1677 or after 2262, which wrong
/// clocks give, become the first or the last that can be stored.
fn stored_ns(at: Timestamp) -> i64 {
    let ns = at.as_nanosecond();
    i64::try_from(ns).unwrap_or(if ns < 0 { i64::MIN } else { i64::MAX })
}

/// Converts a time to microseconds since 1970, as [`Timestamp::as_microsecond`] does.
pub(super) fn us_of(at_ns: i64) -> i64 {
    at_ns / 1_000
}
