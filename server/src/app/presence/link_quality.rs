//! Quality of a robot's link: what arrived, what did not, and how long answers took.
//!
//! Counts are kept by minute for an hour, so an hour's sum is accurate to a minute.

use std::collections::VecDeque;
use std::time::Duration;

use tokio::time::Instant;
use tread_api::link::LinkQuality;

/// Time over which events are counted.
const SPAN: Duration = Duration::from_hours(1);
const MINUTE_S: u64 = 60;
/// Maximum number of states that one gap of sequence numbers counts as missed: those of an hour at
/// the highest rate.
const GAP_MAX: u64 = 72_000;

/// Counts of one minute.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
struct Minute {
    /// Number of the minute since the start of the clock.
    number: u64,
    received: u32,
    missed: u32,
    reconnects: u32,
}

impl Minute {
    /// Returns whether this minute is no longer within the hour that ends in minute `now`.
    fn is_over(&self, now: u64) -> bool {
        now.saturating_sub(self.number) >= SPAN.as_secs() / MINUTE_S
    }
}

/// Counts of a robot's link, by minute, and its last round trip.
#[derive(Debug, Clone, Default)]
pub(super) struct LinkCounts {
    minutes: VecDeque<Minute>,
    round_trip: Option<(Duration, Instant)>,
}

impl LinkCounts {
    fn minute(&mut self, now: Duration) -> &mut Minute {
        let number = now.as_secs() / MINUTE_S;
        self.drop_expired(number);
        if self.minutes.back().is_none_or(|last| last.number < number) {
            self.minutes.push_back(Minute {
                number,
                ..Minute::default()
            });
        }
        let last = self.minutes.len() - 1;
        &mut self.minutes[last]
    }

    /// Drops the minutes that ended an hour ago.
    fn drop_expired(&mut self, number: u64) {
        while self
            .minutes
            .front()
            .is_some_and(|first| first.is_over(number))
        {
            self.minutes.pop_front();
        }
    }

    /// Counts a state that arrived, and those between it and the newest before of the same run.
    pub(super) fn state(&mut self, now: Duration, before: Option<u64>, seq: u64) {
        let gap = before.map_or(0, |before| seq.saturating_sub(before).saturating_sub(1));
        let minute = self.minute(now);
        minute.received = minute.received.saturating_add(1);
        let gap = u32::try_from(gap.min(GAP_MAX)).unwrap_or_default();
        minute.missed = minute.missed.saturating_add(gap);
    }

    /// Counts a state that arrived after a newer one, and that was counted as missed.
    pub(super) fn late_state(&mut self, now: Duration) {
        let minute = self.minute(now);
        minute.received = minute.received.saturating_add(1);
        let counted = self.minutes.iter_mut().rev();
        if let Some(minute) = counted.into_iter().find(|minute| minute.missed > 0) {
            minute.missed -= 1;
        }
    }

    /// Counts a connection of a robot that was connected before.
    pub(super) fn reconnect(&mut self, now: Duration) {
        let minute = self.minute(now);
        minute.reconnects = minute.reconnects.saturating_add(1);
    }

    /// Records the time from a command to its answer, which has just arrived.
    pub(super) fn round_trip(&mut self, took: Duration) {
        self.round_trip = Some((took, Instant::now()));
    }

    /// Returns the quality of the last hour.
    pub(super) fn quality(&self, now: Duration, delay_variation_ms: Option<u64>) -> LinkQuality {
        let number = now.as_secs() / MINUTE_S;
        let minutes = || self.minutes.iter().filter(|minute| !minute.is_over(number));
        let sum =
            |of: fn(&Minute) -> u32| -> u64 { minutes().map(|minute| u64::from(of(minute))).sum() };
        LinkQuality {
            round_trip_ms: self.round_trip.map(|(took, _)| took.as_secs_f64() * 1e3),
            round_trip_age_ms: self
                .round_trip
                .map(|(_, at)| u64::try_from(at.elapsed().as_millis()).unwrap_or(u64::MAX)),
            delay_variation_ms,
            states_received: sum(|minute| minute.received),
            states_missed: sum(|minute| minute.missed),
            reconnects: sum(|minute| minute.reconnects),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(minute: u64) -> Duration {
        Duration::from_secs(minute * MINUTE_S)
    }

    fn counts(link: &LinkCounts, now: Duration) -> [u64; 3] {
        let quality = link.quality(now, None);
        [
            quality.states_received,
            quality.states_missed,
            quality.reconnects,
        ]
    }

    #[test]
    fn states_that_do_not_arrive_are_counted_for_an_hour() {
        let mut link = LinkCounts::default();
        link.state(at(0), None, 7);
        link.state(at(0), Some(7), 8);
        link.state(at(1), Some(8), 12);
        link.reconnect(at(2));
        assert_eq!(counts(&link, at(2)), [3, 3, 1]);
        link.late_state(at(2));
        assert_eq!(counts(&link, at(2)), [4, 2, 1]);
        assert_eq!(counts(&link, at(59)), [4, 2, 1]);
        assert_eq!(counts(&link, at(61)), [1, 0, 1]);
        assert_eq!(counts(&link, at(62)), [0, 0, 0]);
        link.state(at(200), Some(12), 13);
        assert_eq!((link.minutes.len(), counts(&link, at(200))), (1, [1, 0, 0]));
    }

    #[test]
    fn neither_memory_nor_numbers_grow_without_bound() {
        let mut link = LinkCounts::default();
        for minute in 0..1_000 {
            link.state(at(minute), Some(0), u64::MAX);
        }
        assert!(link.minutes.len() <= 61, "{}", link.minutes.len());
        assert!(counts(&link, at(999))[1] <= 61 * GAP_MAX);
    }
}
