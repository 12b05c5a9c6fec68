//! Epochs, the buckets of measuring time: hours, merged with age into days and then into calendar
//! months (UTC).
//!
//! The database may not be merged yet; reading through [`Horizons::epoch_of`] gives the same result
//! before, during and after the merge.

use jiff::civil::Date;
use jiff::tz::TimeZone;
use jiff::{Timestamp, ToSpan as _};

/// Seconds per hour.
pub const HOUR_S: i64 = 3_600;
/// Microseconds per hour.
const HOUR_US: i64 = 3_600_000_000;
/// Hours per day.
pub const DAY_H: i64 = 24;
/// Age at which the hours of a day become one epoch, hours.
const HOURS_KEPT_H: i64 = 7 * DAY_H;
/// Age at which the days of a month become one epoch, hours. It counts from the end of the month.
const DAYS_KEPT_H: i64 = 90 * DAY_H;

/// Returns the hour of a time: whole hours since 1970.
pub fn epoch_h(time: Timestamp) -> i64 {
    epoch_h_at(time.as_microsecond())
}

/// The same for a time in microseconds since 1970.
pub fn epoch_h_at(time_us: i64) -> i64 {
    time_us.div_euclid(HOUR_US)
}

/// An epoch of a site's map.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Epoch {
    /// First hour, since 1970.
    pub first_h: i64,
    /// Hour after the last one.
    pub end_h: i64,
}

impl Epoch {
    /// Returns the time at which the epoch begins.
    pub fn begin(self) -> Timestamp {
        Timestamp::from_second(self.first_h.saturating_mul(HOUR_S)).unwrap_or(Timestamp::MIN)
    }

    /// Returns whether an hour belongs to the epoch.
    pub fn includes_h(self, hour: i64) -> bool {
        (self.first_h..self.end_h).contains(&hour)
    }
}

/// Hours before which a site's epochs are days, and months.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct Horizons {
    /// Epochs before this hour are days or months; the first hour of a day.
    pub days_before_h: i64,
    /// Epochs before this hour are months; the first hour of a month, at most `days_before_h`.
    pub months_before_h: i64,
}

impl Horizons {
    /// Returns the horizons at a time.
    pub fn at(now: Timestamp) -> Self {
        let now_h = epoch_h(now);
        Self {
            days_before_h: day_of(now_h - HOURS_KEPT_H).first_h,
            months_before_h: month_of(now_h - DAYS_KEPT_H).first_h,
        }
    }

    /// Returns these horizons, neither of which is before that of `other`.
    #[must_use]
    pub fn advanced_to(self, other: Self) -> Self {
        Self {
            days_before_h: self.days_before_h.max(other.days_before_h),
            months_before_h: self.months_before_h.max(other.months_before_h),
        }
    }

    /// Returns the epoch that contains an hour.
    pub fn epoch_of(self, hour: i64) -> Epoch {
        if hour < self.months_before_h {
            month_of(hour)
        } else if hour < self.days_before_h {
            day_of(hour)
        } else {
            Epoch {
                first_h: hour,
                end_h: hour.saturating_add(1),
            }
        }
    }
}

fn day_of(hour: i64) -> Epoch {
    let first_h = hour.div_euclid(DAY_H) * DAY_H;
    Epoch {
        first_h,
        end_h: first_h + DAY_H,
    }
}

/// Returns the calendar month that contains an hour; the day, of an hour that no calendar has.
fn month_of(hour: i64) -> Epoch {
    let date = |hour: i64| -> Result<Date, jiff::Error> {
        let time = Timestamp::from_second(hour.saturating_mul(HOUR_S))?;
        Ok(time.to_zoned(TimeZone::UTC).date())
    };
    let hours = |date: Date| -> Result<i64, jiff::Error> {
        Ok(epoch_h(date.to_zoned(TimeZone::UTC)?.timestamp()))
    };
    let found = || -> Result<Epoch, jiff::Error> {
        let first = date(hour)?.first_of_month();
        Ok(Epoch {
            first_h: hours(first)?,
            end_h: hours(first.checked_add(1.month())?)?,
        })
    };
    found().unwrap_or_else(|_outside| day_of(hour))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn horizons() -> impl Strategy<Value = Horizons> {
        (0_i64..1_200_000)
            .prop_map(|now_h| Horizons::at(Timestamp::from_second(now_h * HOUR_S).unwrap()))
    }

    proptest! {
        #[test]
        fn an_epoch_holds_its_hours_and_each_of_them_gives_it(horizons in horizons(), hour in 0_i64..1_200_000) {
            let epoch = horizons.epoch_of(hour);
            prop_assert!(epoch.includes_h(hour));
            for of_it in [epoch.first_h, epoch.end_h - 1] {
                prop_assert_eq!(horizons.epoch_of(of_it), epoch);
            }
            let length_h = epoch.end_h - epoch.first_h;
            let is_as_long_as_it_may_be = if hour >= horizons.days_before_h {
                length_h == 1
            } else if hour >= horizons.months_before_h {
                length_h == DAY_H
            } else {
                (28 * DAY_H..=31 * DAY_H).contains(&length_h)
            };
            prop_assert!(is_as_long_as_it_may_be, "{} hours", length_h);
        }

        #[test]
        fn later_horizons_never_divide_an_epoch(horizons in horizons(), later in horizons(), hour in 0_i64..1_200_000) {
            let (before, after) = (horizons.epoch_of(hour), horizons.advanced_to(later).epoch_of(hour));
            prop_assert!(after.first_h <= before.first_h && before.end_h <= after.end_h);
        }

        #[test]
        fn horizons_keep_a_week_of_hours_and_ninety_days_of_days(now_h in 10_000_i64..1_200_000) {
            let horizons = Horizons::at(Timestamp::from_second(now_h * HOUR_S).unwrap());
            prop_assert!(horizons.months_before_h <= horizons.days_before_h);
            let (days_h, months_h) = (now_h - horizons.days_before_h, now_h - horizons.months_before_h);
            prop_assert!((7 * DAY_H..8 * DAY_H).contains(&days_h), "{}", days_h);
            prop_assert!((90 * DAY_H..121 * DAY_H).contains(&months_h), "{}", months_h);
        }
    }

    #[test]
    fn a_month_is_one_of_the_calendar() {
        let hour = |text: &str| epoch_h(text.parse().unwrap());
        let horizons = Horizons::at("2024-08-01T00:00:00Z".parse().unwrap());
        assert_eq!(horizons.months_before_h, hour("2024-05-01T00:00:00Z"));
        let february = Epoch {
            first_h: hour("2024-02-01T00:00:00Z"),
            end_h: hour("2024-03-01T00:00:00Z"),
        };
        assert_eq!(horizons.epoch_of(hour("2024-02-29T23:59:59Z")), february);
        assert_eq!(
            Horizons::default().epoch_of(-1).first_h,
            hour("1969-12-01T00:00:00Z")
        );
    }
}
