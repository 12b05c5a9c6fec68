//! Validation of a segment, and correction of its times, before it is stored.

use jiff::{SignedDuration, Timestamp};
use serde_json::value::{RawValue, to_raw_value};
use tread_api::friction::Segment;
use tread_api::site::Grid;

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
        let ahead = robot_time.map_or(SignedDuration::ZERO, |said| said.duration_since(now));
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
    pub(super) fn put_right(self, at: Timestamp) -> Timestamp {
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
pub(super) enum Prepared {
    /// A measurement with corrected times.
    Ready(Box<Ready>),
    /// A measurement with a time in the future: the clock of its run is not known.
    Ahead(Box<RawValue>),
}

/// A valid segment, ready to be stored.
#[derive(Debug)]
pub(super) struct Ready {
    pub(super) segment: Segment,
    pub(super) sums: Sums,
    pub(super) measurement: Box<RawValue>,
}

/// Checks a segment and corrects its times.
///
/// # Errors
/// The reason why it is invalid, for people.
pub(super) fn prepared(segment: &Segment, grid: &Grid, skew: Skew) -> Result<Prepared, String> {
    segment.validate().map_err(|invalid| invalid.to_string())?;
    if segment.grid_revision > grid.revision {
        return Err(format!("the site has no grid {}", segment.grid_revision));
    }
    if segment.grid_revision == grid.revision && !grid.center_of(segment.cell).is_on_the_map() {
        return Err("the cell lies outside the site".to_owned());
    }
    if segment.ended_at.as_microsecond() > skew.latest_us() {
        let measurement = to_raw_value(segment).map_err(|error| error.to_string())?;
        return Ok(Prepared::Ahead(measurement));
    }
    let mut segment = segment.clone();
    let span = segment.ended_at.duration_since(segment.started_at);
    segment.ended_at = skew.shifted(segment.ended_at);
    let started_at = segment.ended_at.checked_sub(span);
    segment.started_at = started_at.unwrap_or(segment.ended_at);
    let sums = Sums::of(&segment).ok_or_else(|| "theta is out of range".to_owned())?;
    let measurement = to_raw_value(&segment).map_err(|error| error.to_string())?;
    Ok(Prepared::Ready(Box::new(Ready {
        segment,
        sums,
        measurement,
    })))
}
