//! Parsers of single values of the command line.

use std::ffi::OsString;
use std::time::Duration;

use clap::builder::{PossibleValuesParser, TypedValueParser};
use jiff::{SignedDuration, Timestamp};
use tread_api::geometry::Point;
use tread_api::ids::TerrainId;
use tread_api::mission::MissionState;
use tread_api::site::GeoOrigin;
use tread_api::terrain::TerrainClass;
use tread_api::trajectory::Waypoint;

use crate::client::Area;

/// Minimum and maximum period of updates of `tread watch`.
const LOOK_EVERY_MIN: Duration = Duration::from_millis(100);
const LOOK_EVERY_MAX: Duration = Duration::from_hours(1);

/// Parses a time span such as `500ms`, `90s`, `5m` or `2h`.
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

/// Parses the update period of `tread watch`, bounded in both directions to limit the load.
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

/// Parses a finite number; JSON cannot represent any other.
pub(super) fn finite(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(number) if number.is_finite() => Ok(number),
        _ => Err("give a number".to_owned()),
    }
}

/// Parses a number above 0.
pub(super) fn positive(text: &str) -> Result<f64, String> {
    match finite(text) {
        Ok(number) if number > 0.0 => Ok(number),
        _ => Err("give a number above 0".to_owned()),
    }
}

/// Protects arguments such as `-4,2.5` from being parsed as options, by a space in front.
pub(crate) fn shield_negative_points(argument: OsString) -> OsString {
    let is_number = |part: &str| part.trim().parse::<f64>().is_ok();
    let are_numbers =
        |text: &&str| text.starts_with('-') && text.contains(',') && text.split(',').all(is_number);
    match argument.to_str().filter(are_numbers) {
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
        finite(part).map_err(|_| format!("`{part}` is not a number"))
    };
    Ok((number(x)?, number(y)?))
}

/// Parses a box, `x0,y0,x1,y1` in metres; any two opposite corners may be given.
pub(super) fn area(text: &str) -> Result<Area, String> {
    let numbers: Vec<f64> = text
        .split(',')
        .map(|part| finite(part.trim()))
        .collect::<Result<_, _>>()?;
    let [x0, y0, x1, y1] = numbers[..] else {
        return Err("give four numbers with commas: -5,-5,10,10".to_owned());
    };
    let corner = |x_m, y_m| Point { x_m, y_m };
    Ok(Area {
        lowest: corner(x0.min(x1), y0.min(y1)),
        highest: corner(x0.max(x1), y0.max(y1)),
    })
}

/// Parses a time: RFC 3339, or a time span before the present.
#[expect(
    clippy::disallowed_methods,
    reason = "a person's `2h` counts back from now"
)]
pub(super) fn moment(text: &str) -> Result<Timestamp, String> {
    if let Ok(at) = text.parse::<Timestamp>() {
        return Ok(at);
    }
    let wrong = || format!("`{text}` is no time: give 2026-11-21T08:00:00Z, or 2h for 2 hours ago");
    let ago = duration(text).map_err(|_| wrong())?;
    let ago = SignedDuration::try_from(ago).map_err(|_| wrong())?;
    Timestamp::now().checked_sub(ago).map_err(|_| wrong())
}

/// Parses the name of a mission state.
pub(super) fn mission_state() -> impl TypedValueParser<Value = MissionState> {
    let names = MissionState::ALL.map(MissionState::as_str);
    PossibleValuesParser::new(names)
        .try_map(|name| MissionState::from_name(&name).ok_or("is no state"))
}

/// Terrain classes as the API names them.
const TERRAIN_CLASSES: [&str; 13] = [
    "asphalt", "concrete", "paving", "gravel", "soil", "grass", "sand", "mud", "snow", "ice",
    "wood", "metal", "other",
];

/// Parses a terrain class.
pub(super) fn terrain_class() -> impl TypedValueParser<Value = TerrainClass> {
    PossibleValuesParser::new(TERRAIN_CLASSES)
        .try_map(|name| serde_json::from_value::<TerrainClass>(name.into()))
}

/// Parses a position in WGS 84, degrees north and east, with an x axis to the east.
pub(super) fn earth(text: &str) -> Result<GeoOrigin, String> {
    let (latitude_deg, longitude_deg) = coordinates(text)
        .map_err(|error| format!("{error}; degrees north and east: 48.14,11.57"))?;
    let place = serde_json::json!({
        "latitude_deg": latitude_deg, "longitude_deg": longitude_deg,
    });
    // Parsed like a body of the API, so that invalid positions are detected before a request.
    serde_json::from_value(place).map_err(|error| error.to_string())
}

pub(super) fn point(text: &str) -> Result<Point, String> {
    coordinates(text).map(|(x_m, y_m)| Point { x_m, y_m })
}

/// Where a history of friction is asked for.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum HistoryPlace {
    /// On a terrain.
    Terrain(TerrainId),
    /// At a point in the site frame.
    Point(Point),
}

/// Parses a terrain, or a point `x,y` in metres; no identifier has a comma.
pub(super) fn history_place(text: &str) -> Result<HistoryPlace, String> {
    if text.contains(',') {
        return point(text).map(HistoryPlace::Point);
    }
    let terrain = text.parse().map(HistoryPlace::Terrain);
    terrain.map_err(|invalid| format!("{invalid}; a point is X,Y"))
}

/// Parses one waypoint, `x,y` in metres.
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
    fn every_kind_of_ground_that_is_offered_is_one() {
        for name in TERRAIN_CLASSES {
            let class = serde_json::from_value::<TerrainClass>(name.into());
            assert!(class.is_ok(), "{name}");
        }
    }

    #[test]
    fn a_box_is_read_whichever_corner_comes_first() {
        let read = area("4,-1, -2.5,3").unwrap();
        let wanted = (
            Point {
                x_m: -2.5,
                y_m: -1.0,
            },
            Point { x_m: 4.0, y_m: 3.0 },
        );
        assert_eq!((read.lowest, read.highest), wanted);
        for wrong in ["", "1,2,3", "1,2,3,x", "1,2,3,nan"] {
            assert!(area(wrong).is_err(), "`{wrong}` was taken");
        }
    }

    #[test]
    fn a_place_on_the_earth_is_read_and_what_is_none_is_said() {
        let read = earth("-33.86, 151.21").unwrap();
        assert_eq!((read.latitude_deg, read.longitude_deg), (-33.86, 151.21));
        for (wrong, said) in [
            ("91,0", "latitude_deg must be -90 to 90"),
            ("0,181", "longitude_deg must be -180 to 180"),
            ("48.14", "48.14,11.57"),
            ("nan,0", "`nan` is not a number"),
        ] {
            let error = earth(wrong).unwrap_err();
            assert!(error.contains(said), "`{wrong}`: {error}");
        }
    }

    #[test]
    fn a_moment_is_a_time_or_lies_so_far_back() {
        let exact = moment("2026-11-21T08:00:00Z").unwrap();
        assert_eq!(exact.to_string(), "2026-11-21T08:00:00Z");
        let (day, hour) = (moment("24h").unwrap(), moment("1h").unwrap());
        let apart = hour.duration_since(day).as_secs();
        assert!((82_799..=82_801).contains(&apart), "{apart}");
        assert!(moment("yesterday").is_err());
    }

    #[test]
    fn times_are_read_with_their_units() {
        assert_eq!(duration("500ms"), Ok(Duration::from_millis(500)));
        assert_eq!(duration("1.5m"), Ok(Duration::from_secs(90)));
        for wrong in ["", "5", "s", "-5s", "5 days", "nans", "infs"] {
            assert!(duration(wrong).is_err(), "`{wrong}` was taken");
        }
    }
}
