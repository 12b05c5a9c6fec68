//! A segment before it is stored: possible or not, and when it was measured.

use jiff::{SignedDuration, Timestamp};
use serde_json::value::{RawValue, to_raw_value};
use tread_api::friction::Segment;
use tread_api::site::Grid;

use crate::friction::Sums;

/// How wrong a robot's clock is, from the time that it wrote on what it sent.
///
/// Small differences are the network's and are left alone, so that a segment has the same epoch
/// whenever it arrives. With a clock that is wrong by more, the spans are right and the date is
/// not; the server's date counts then.
#[derive(Debug, Clone, Copy)]
pub(super) struct Skew {
    ahead: SignedDuration,
    now: Timestamp,
}

/// Differences that count as the network's.
const SKEW_MIN: SignedDuration = SignedDuration::from_secs(30);

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

    /// The time of a mission report. One from the future all the same is of an earlier run, whose
    /// clock was wrong and can no longer be asked; what has arrived cannot be later than now.
    pub(super) fn put_right(self, at: Timestamp) -> Timestamp {
        let at = self.shifted(at);
        if at.duration_since(self.now) > SKEW_MIN {
            self.now
        } else {
            at
        }
    }

    /// The latest time of the robot's clock that is no future, microseconds since 1970.
    pub(super) fn latest_us(self) -> i64 {
        let latest = self.now.checked_add(SKEW_MIN + self.ahead);
        latest.unwrap_or(self.now).as_microsecond()
    }
}

/// What a segment is to the server.
#[derive(Debug)]
pub(super) enum Prepared {
    /// A measurement with its times put right.
    Ready(Box<Ready>),
    /// One from a time that has not come: its run's clock is not known.
    Ahead(Box<RawValue>),
}

/// A segment that is possible, ready to be stored.
#[derive(Debug)]
pub(super) struct Ready {
    pub(super) segment: Segment,
    pub(super) sums: Sums,
    pub(super) measurement: Box<RawValue>,
}

/// Checks a segment and puts its times right.
///
/// # Errors
/// Why it is not possible, for people.
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
