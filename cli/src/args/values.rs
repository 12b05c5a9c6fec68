//! How single values of the command line are read.

use std::ffi::OsString;
use std::time::Duration;

use tread_api::geometry::Point;
use tread_api::trajectory::Waypoint;

/// Least and most time between two looks of `tread watch`.
const LOOK_EVERY_MIN: Duration = Duration::from_millis(100);
const LOOK_EVERY_MAX: Duration = Duration::from_hours(1);

/// Reads a time such as `500ms`, `90s`, `5m` or `2h`.
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
    Duration::try_from_secs_f64(number * seconds_per_unit).map_err(|error| error.to_string())
}

/// Reads the time between two looks: often enough to be of use, not so often that it is a load.
pub(super) fn look_interval(text: &str) -> Result<Duration, String> {
    let every = duration(text)?;
    if (LOOK_EVERY_MIN..=LOOK_EVERY_MAX).contains(&every) {
        Ok(every)
    } else {
        Err(format!(
            "give a time from {LOOK_EVERY_MIN:?} to {LOOK_EVERY_MAX:?}"
        ))
    }
}

/// Reads a number; what is no finite one could not be said in JSON.
pub(super) fn finite(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(number) if number.is_finite() => Ok(number),
        _ => Err("give a number".to_owned()),
    }
}

/// Reads a number above zero.
pub(super) fn positive(text: &str) -> Result<f64, String> {
    match finite(text) {
        Ok(number) if number > 0.0 => Ok(number),
        _ => Err("give a number above 0".to_owned()),
    }
}

/// Marks arguments like `-4,2.5` as values: with a space in front they are no options.
pub(crate) fn shield_negative_points(argument: OsString) -> OsString {
    let is_point = |text: &&str| text.starts_with('-') && coordinates(text).is_ok();
    match argument.to_str().filter(is_point) {
        Some(point) => format!(" {point}").into(),
        None => argument,
    }
}

fn coordinates(text: &str) -> Result<(f64, f64), String> {
    let (x, y) = text
        .split_once(',')
        .ok_or("give two numbers with a comma: 1.5,-2")?;
    let number = |part: &str| {
        let part = part.trim();
        part.parse::<f64>()
            .map_err(|_| format!("`{part}` is not a number"))
    };
    Ok((number(x)?, number(y)?))
}

pub(super) fn point(text: &str) -> Result<Point, String> {
    coordinates(text).map(|(x_m, y_m)| Point { x_m, y_m })
}

/// Reads one waypoint, `x,y` in metres.
pub(crate) fn waypoint(text: &str) -> Result<Waypoint, String> {
    let (x_m, y_m) = coordinates(text)?;
    Ok(Waypoint {
        x_m,
        y_m,
        speed_m_s: None,
        heading_rad: None,
    })
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
}
