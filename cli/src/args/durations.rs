//! Durations of the command line, such as `500ms`, `90s`, `5m` or `2h`: their parsers, each with its
//! bounds, and their notation.

use std::ops::RangeInclusive;
use std::time::Duration;

use tread_api::mission::{LINK_SILENCE_MAX_S, LINK_SILENCE_MIN_S};

/// Bounds of a time that this program waits, and of the time within which a mission is to start.
const WAIT_BOUNDS: RangeInclusive<Duration> =
    Duration::from_millis(1)..=Duration::from_hours(366 * 24);
/// Bounds of the period of updates of `tread watch`, which limit the load.
const WATCH_PERIOD_BOUNDS: RangeInclusive<Duration> =
    Duration::from_millis(100)..=Duration::from_hours(1);
/// Bounds of the duration of an external limit, as the server has them.
const LIMIT_BOUNDS: RangeInclusive<Duration> = Duration::from_millis(1)..=Duration::from_hours(1);
/// Bounds of the time between two rows of a history, as the server has them.
const HISTORY_STEP_BOUNDS: RangeInclusive<Duration> =
    Duration::from_mins(1)..=Duration::from_hours(366 * 24);
/// Units of a duration, with their milliseconds.
const UNITS: [(&str, u128); 3] = [("h", 3_600_000), ("m", 60_000), ("s", 1_000)];

/// Parses a duration, which may be 0.
pub(super) fn duration(text: &str) -> Result<Duration, String> {
    let unit_at = text
        .find(|letter: char| letter.is_ascii_alphabetic())
        .unwrap_or(text.len());
    let (number, unit) = text.split_at(unit_at);
    let seconds_per_unit = match unit {
        "ms" => 1e-3,
        "s" => 1.0,
        "m" | "min" => 60.0,
        "h" => 3600.0,
        _ => return Err("give a number and a unit: 500ms, 90s, 5m or 2h".to_owned()),
    };
    let number: f64 = number
        .parse()
        .map_err(|_| format!("`{number}` is not a number"))?;
    // The library's text names a type of the program.
    Duration::try_from_secs_f64(number * seconds_per_unit)
        .map_err(|_| format!("`{text}` is negative or too long"))
}

/// Parses a duration with bounds.
pub(super) fn within(text: &str, bounds: &RangeInclusive<Duration>) -> Result<Duration, String> {
    let time = duration(text)?;
    if bounds.contains(&time) {
        return Ok(time);
    }
    let (min, max) = (
        format_duration(*bounds.start()),
        format_duration(*bounds.end()),
    );
    Err(format!("give a time from {min} to {max}"))
}

/// Parses a time that this program waits, or within which a mission is to start.
pub(super) fn wait_time(text: &str) -> Result<Duration, String> {
    within(text, &WAIT_BOUNDS)
}

/// Parses the update period of `tread watch`.
pub(super) fn watch_interval(text: &str) -> Result<Duration, String> {
    within(text, &WATCH_PERIOD_BOUNDS)
}

/// Parses the duration of an external limit.
pub(super) fn limit_time(text: &str) -> Result<Duration, String> {
    within(text, &LIMIT_BOUNDS)
}

/// Parses the time between two rows of a history.
pub(super) fn history_step(text: &str) -> Result<Duration, String> {
    within(text, &HISTORY_STEP_BOUNDS)
}

/// Parses the silence of a server or a robot after which a mission is stopped or fails.
pub(super) fn silence(text: &str) -> Result<Duration, String> {
    let [min, max] = [LINK_SILENCE_MIN_S, LINK_SILENCE_MAX_S].map(Duration::from_secs_f64);
    within(text, &(min..=max))
}

/// Returns a duration as the command line takes it, in its largest whole unit, rounded down to a
/// millisecond.
pub(crate) fn format_duration(time: Duration) -> String {
    let millis = time.as_millis();
    let is_whole = |of_unit: u128| millis >= of_unit && millis.is_multiple_of(of_unit);
    let unit = UNITS.into_iter().find(|&(_, of_unit)| is_whole(of_unit));
    match unit {
        Some((unit, of_unit)) => format!("{}{unit}", millis / of_unit),
        None => format!("{millis}ms"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_are_read_with_their_units() {
        assert_eq!(duration("500ms"), Ok(Duration::from_millis(500)));
        assert_eq!(duration("1.5m"), Ok(Duration::from_secs(90)));
        for wrong in ["", "5", "s", "-5s", "5 days", "nans", "infs"] {
            assert!(duration(wrong).is_err(), "`{wrong}` was taken");
        }
    }

    #[test]
    fn a_time_is_formatted_as_it_is_given() {
        for text in ["1ms", "1500ms", "1s", "90s", "5m", "61m", "2h", "8784h"] {
            assert_eq!(format_duration(duration(text).unwrap()), text);
        }
        assert_eq!(format_duration(Duration::ZERO), "0ms");
        assert_eq!(format_duration(duration("60m").unwrap()), "1h");
    }

    #[test]
    fn a_time_out_of_its_bounds_is_refused_with_them() {
        type Parser = fn(&str) -> Result<Duration, String>;
        let cases: [(Parser, &str, &[&str]); 5] = [
            (
                wait_time,
                "give a time from 1ms to 8784h",
                &["0s", "0.5ms", "9000h"],
            ),
            (
                watch_interval,
                "give a time from 100ms to 1h",
                &["0s", "61m"],
            ),
            (limit_time, "give a time from 1ms to 1h", &["0s", "61m"]),
            (history_step, "give a time from 1m to 8784h", &["0s", "59s"]),
            (
                silence,
                "give a time from 1s to 24h",
                &["0s", "900ms", "25h"],
            ),
        ];
        for (parse, said, wrong) in cases {
            for wrong in wrong {
                assert_eq!(parse(wrong), Err(said.to_owned()), "`{wrong}`");
            }
            assert_eq!(parse("1h"), Ok(Duration::from_hours(1)), "{said}");
        }
    }
}
