//! Computes the time of a measurement by the agent's monotonic clock from the stamp of its message.
//!
//! With [`StampClock::Host`] the stamp is of this machine's wall clock, and the age is the
//! difference to that clock at the arrival, regardless of steps of the clock. With
//! [`StampClock::Base`] the smallest recent delay is assumed to be zero, and forgotten slowly, so
//! that clock drift is followed; a jump of the stamps is accepted after [`AGREE_MIN`] consistent
//! messages, and until then all are refused. A jump is a change of more than a second, or any step
//! back, since no delay lowers a writer's stamps.

use std::time::Duration;

use super::refusal::Refusal;
use super::settings::StampClock;

/// Largest amount by which a stamp may be in the future, nanoseconds: two readings of clocks of one
/// machine.
pub const AHEAD_MAX_NS: i64 = 5_000_000;
/// Largest difference of two stamps that count as equal, nanoseconds.
const SAME_NS: i64 = 20_000;
/// Smallest age that counts as a jump of the clock instead of a delay, nanoseconds.
const LEAP_NS: i64 = 1_000_000_000;
/// Number of consistent messages after which a jump is accepted.
pub const AGREE_MIN: u32 = 10;
/// Largest difference of consistent messages, nanoseconds.
const AGREE_NS: i64 = 50_000_000;
/// Ratio of elapsed time by which the smallest delay is forgotten; above the drift of any clock.
const FORGET_SHARE: f64 = 5.0e-4;

/// Time of a message's arrival.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Arrival {
    /// By the agent's monotonic clock.
    pub monotonic: Duration,
    /// By this machine's wall clock at that time, nanoseconds since the Unix epoch.
    pub wall_ns: i64,
}

/// State of the stamps of one topic.
#[derive(Debug, Clone, Copy)]
pub struct Stamps {
    clock: StampClock,
    late_after_ns: i64,
    /// Monotonic time minus stamp, for the base's clock.
    offset_ns: Option<i64>,
    /// Offset of the last messages after a jump, and the number of consistent ones.
    leap: Option<(i64, u32)>,
    last_arrival: Duration,
    last_ns: Option<i64>,
    /// Stamp of the last message that was accepted.
    last_stamp_ns: Option<i64>,
    /// Number of jumps that were accepted.
    leaps: u32,
}

fn nanoseconds(span: Duration) -> i64 {
    i64::try_from(span.as_nanos()).unwrap_or(i64::MAX)
}

impl Stamps {
    /// Creates the state before the first message.
    pub fn new(clock: StampClock, late_after: Duration) -> Self {
        Self {
            clock,
            late_after_ns: nanoseconds(late_after),
            offset_ns: None,
            leap: None,
            last_arrival: Duration::ZERO,
            last_ns: None,
            last_stamp_ns: None,
            leaps: 0,
        }
    }

    /// Returns the number of jumps of the base's clock that were accepted.
    pub fn leaps(&self) -> u32 {
        self.leaps
    }

    /// Returns the time of measurement by the agent's monotonic clock.
    ///
    /// # Errors
    /// [`Refusal::Stamp`] for a stamp that jumped, [`Refusal::Late`] for an old one, and
    /// [`Refusal::OutOfOrder`] for one that is not newer than the last.
    pub fn place(&mut self, stamp_ns: i64, arrival: Arrival) -> Result<Duration, Refusal> {
        let now_ns = nanoseconds(arrival.monotonic);
        let age_ns = match self.clock {
            StampClock::Host => arrival.wall_ns.saturating_sub(stamp_ns),
            StampClock::Base => self.age_by_base_ns(stamp_ns, arrival.monotonic)?,
        };
        if !(-AHEAD_MAX_NS..=LEAP_NS).contains(&age_ns) {
            return Err(Refusal::Stamp);
        }
        if age_ns > self.late_after_ns {
            return Err(Refusal::Late);
        }
        let at_ns = (now_ns - age_ns.max(0)).max(0);
        if self
            .last_ns
            .is_some_and(|last_ns| at_ns <= last_ns + SAME_NS)
        {
            return Err(Refusal::OutOfOrder);
        }
        self.last_ns = Some(at_ns);
        self.last_stamp_ns = Some(stamp_ns);
        Ok(Duration::from_nanos(at_ns.unsigned_abs()))
    }

    fn age_by_base_ns(&mut self, stamp_ns: i64, now: Duration) -> Result<i64, Refusal> {
        let seen_ns = nanoseconds(now).saturating_sub(stamp_ns);
        let since = now.saturating_sub(self.last_arrival);
        self.last_arrival = now;
        let Some(offset_ns) = self.offset_ns else {
            self.offset_ns = Some(seen_ns);
            return Ok(0);
        };
        let offset_ns = offset_ns.saturating_add(nanoseconds(since.mul_f64(FORGET_SHARE)));
        let age_ns = seen_ns.saturating_sub(offset_ns);
        if age_ns.unsigned_abs() > LEAP_NS.unsigned_abs() {
            return self.leapt(seen_ns, Refusal::Stamp);
        }
        let is_back = |last_ns: i64| stamp_ns < last_ns.saturating_sub(SAME_NS);
        if self.last_stamp_ns.is_some_and(is_back) {
            // A single such message is out of order; many mean that the clock was set back.
            return self.leapt(seen_ns, Refusal::OutOfOrder);
        }
        self.leap = None;
        self.offset_ns = Some(offset_ns.min(seen_ns));
        Ok(age_ns.max(0))
    }

    fn leapt(&mut self, seen_ns: i64, refusal: Refusal) -> Result<i64, Refusal> {
        let agreed = match self.leap {
            Some((least_ns, count)) if seen_ns.abs_diff(least_ns) <= AGREE_NS.unsigned_abs() => {
                (least_ns.min(seen_ns), count + 1)
            }
            Some(_) | None => (seen_ns, 1),
        };
        if agreed.1 < AGREE_MIN {
            self.leap = Some(agreed);
            return Err(refusal);
        }
        self.leap = None;
        self.leaps = self.leaps.saturating_add(1);
        self.offset_ns = Some(agreed.0);
        Ok(seen_ns - agreed.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    fn at(milliseconds: i64, wall_ms: i64) -> Arrival {
        Arrival {
            monotonic: Duration::from_millis(milliseconds.unsigned_abs()),
            wall_ns: wall_ms * MS,
        }
    }

    fn stamps(clock: StampClock) -> Stamps {
        Stamps::new(clock, Duration::from_millis(100))
    }

    #[test]
    fn by_the_machines_clock_a_message_is_as_old_as_it_says_also_after_a_step() {
        let mut stamps = stamps(StampClock::Host);
        let mut place = |stamp_ms: i64, arrival| stamps.place(stamp_ms * MS, arrival);
        assert_eq!(
            place(70_000, at(1_000, 70_004)),
            Ok(Duration::from_millis(996))
        );
        // The clock is put back by a minute.
        assert_eq!(place(70_006, at(1_012, 10_016)), Err(Refusal::Stamp));
        assert_eq!(
            place(10_020, at(1_020, 10_024)),
            Ok(Duration::from_millis(1_016))
        );
        assert_eq!(place(10_020, at(1_021, 10_025)), Err(Refusal::OutOfOrder));
        assert_eq!(place(10_010, at(1_022, 10_026)), Err(Refusal::OutOfOrder));
        assert_eq!(place(10_030, at(1_150, 10_154)), Err(Refusal::Late));
        assert_eq!(place(10_200, at(1_160, 10_164)), Err(Refusal::Stamp));
        assert_eq!(
            place(10_176, at(1_176, 10_180)),
            Ok(Duration::from_millis(1_172))
        );
    }

    #[test]
    fn a_stamp_at_the_end_of_time_is_refused() {
        for clock in [StampClock::Host, StampClock::Base] {
            let mut stamps = stamps(clock);
            stamps.place(10_000 * MS, at(1_000, 10_000)).unwrap();
            for stamp_ns in [i64::MIN, i64::MAX] {
                let refused = stamps.place(stamp_ns, at(1_010, 10_010));
                assert_eq!(refused, Err(Refusal::Stamp));
            }
        }
    }

    #[test]
    fn by_the_bases_clock_the_least_delay_counts_as_none() {
        let mut stamps = stamps(StampClock::Base);
        let mut place = |stamp_ms: i64, now_ms: i64| stamps.place(stamp_ms * MS, at(now_ms, 0));
        assert_eq!(place(5, 1_020), Ok(Duration::from_millis(1_020)));
        let second = place(15, 1_025).unwrap();
        assert_eq!(second, Duration::from_millis(1_025));
        let third = place(25, 1_055).unwrap();
        assert!(
            third.abs_diff(Duration::from_millis(1_035)) < Duration::from_micros(100),
            "{third:?}"
        );
        assert_eq!(place(35, 1_200), Err(Refusal::Late));
    }

    #[test]
    fn a_leap_of_the_bases_clock_is_believed_when_it_lasts() {
        let mut stamps = stamps(StampClock::Base);
        let mut refused = 0;
        for index in 0..100 {
            let now_ms = 1_000 + 10 * index;
            // It is put on by an hour, after a third of the time.
            let leap_ms = if index < 33 { 0 } else { 3_600_000 };
            match stamps.place((now_ms + leap_ms) * MS, at(now_ms, 0)) {
                Ok(placed) => assert!(placed <= Duration::from_millis(now_ms.unsigned_abs())),
                Err(refusal) => {
                    assert_eq!(refusal, Refusal::Stamp);
                    refused += 1;
                }
            }
        }
        assert_eq!(refused, AGREE_MIN - 1);
    }

    #[test]
    fn a_base_whose_clock_is_put_back_by_any_step_is_heard_after_ten_messages() {
        for back_ms in [15, 150, 500, 999, 5_000] {
            let mut stamps = stamps(StampClock::Base);
            let mut refused = 0;
            for index in 0..200 {
                let now_ms = 10_000 + 10 * index;
                let stamp_ms = now_ms - if index < 100 { 0 } else { back_ms };
                match stamps.place(stamp_ms * MS, at(now_ms, 0)) {
                    Ok(placed) => assert!(
                        placed.abs_diff(Duration::from_millis(now_ms.unsigned_abs()))
                            < Duration::from_millis(20)
                    ),
                    Err(_) => refused += 1,
                }
            }
            assert!(refused < AGREE_MIN, "{back_ms} ms: {refused}");
        }
    }

    #[test]
    fn messages_that_are_repeated_are_not_taken_for_a_clock_that_was_put_back() {
        let mut stamps = stamps(StampClock::Base);
        for index in 0..300 {
            let now_ms = 10_000 + 10 * index;
            assert!(stamps.place(now_ms * MS, at(now_ms, 0)).is_ok());
            for old_ms in [now_ms, now_ms - 50] {
                let refused = stamps.place(old_ms * MS, at(now_ms + 1, 0));
                assert_eq!(refused, Err(Refusal::OutOfOrder));
            }
        }
        assert_eq!(stamps.leaps(), 0);
    }

    #[test]
    fn stamps_that_leap_to_and_fro_are_never_believed() {
        let mut stamps = stamps(StampClock::Base);
        stamps.place(0, at(1_000, 0)).unwrap();
        for index in 1..100_i64 {
            let stamp_ns = (index % 7 + 1) * 10_000_000_000;
            assert_eq!(
                stamps.place(stamp_ns, at(1_000 + 10 * index, 0)),
                Err(Refusal::Stamp)
            );
        }
    }

    #[test]
    fn a_clock_that_runs_slow_is_followed() {
        let mut stamps = stamps(StampClock::Base);
        for index in 0..100_000_i64 {
            let now_ns = (1_000 + 10 * index) * MS;
            let arrival = at(1_000 + 10 * index, 0);
            // By 200 in a million: a fifth of a second in the end.
            let stamp_ns = now_ns - now_ns / 5_000;
            assert!(stamps.place(stamp_ns, arrival).is_ok(), "at {index}");
        }
    }
}
