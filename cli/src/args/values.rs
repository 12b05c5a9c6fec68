//! Parsers of single values of the command line.

use std::ffi::OsString;
use std::str::FromStr;

use clap::builder::{PossibleValuesParser, TypedValueParser};
use jiff::{SignedDuration, Timestamp};
use tread_api::geometry::Point;
use tread_api::ids::TerrainId;
use tread_api::mission::MissionState;
use tread_api::site::GeoOrigin;
use tread_api::terrain::TerrainClass;
use tread_api::trajectory::Waypoint;

use super::durations::duration;
use crate::client::Area;

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
pub(crate) fn protect_negative_points(argument: OsString) -> OsString {
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
    let wrong = || format!("`{text}` is not a time: give 2026-11-21T08:00:00Z, or 2h for 2 h ago");
    let ago = duration(text).map_err(|_| wrong())?;
    let ago = SignedDuration::try_from(ago).map_err(|_| wrong())?;
    Timestamp::now().checked_sub(ago).map_err(|_| wrong())
}

/// Objects to which a server gives identifiers, and the command that lists them.
#[derive(Clone, Copy)]
pub(super) struct ObjectKind {
    object: &'static str,
    listing: &'static str,
}

pub(super) const TOKENS: ObjectKind = ObjectKind {
    object: "a token",
    listing: "tread tokens",
};
pub(super) const JOIN_TOKENS: ObjectKind = ObjectKind {
    object: "a join token",
    listing: "tread robots join-token list",
};
pub(super) const SESSIONS: ObjectKind = ObjectKind {
    object: "a session",
    listing: "tread sessions",
};
pub(super) const ALERTS: ObjectKind = ObjectKind {
    object: "an alert",
    listing: "tread alerts",
};
pub(super) const STOPS: ObjectKind = ObjectKind {
    object: "a stop",
    listing: "tread stops",
};

/// Returns the parser of the identifiers of such objects.
pub(super) fn identifier<T: FromStr>(
    of: ObjectKind,
) -> impl Fn(&str) -> Result<T, String> + Clone + Send + Sync + 'static {
    let ObjectKind { object, listing } = of;
    move |text| {
        let wrong = |_| format!("this is not the identifier of {object}: `{listing}` lists them");
        text.parse().map_err(wrong)
    }
}

/// Parses the name of a mission state.
pub(super) fn mission_state() -> impl TypedValueParser<Value = MissionState> {
    let names = MissionState::ALL.map(MissionState::as_str);
    PossibleValuesParser::new(names)
        .try_map(|name| MissionState::from_name(&name).ok_or("is not a mission state"))
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
    use tread_api::ids::{AlertId, JoinTokenId, SessionId, StopId, TokenId};

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
    fn a_text_that_is_no_identifier_is_refused_with_the_command_that_lists_them() {
        let refused = [
            identifier::<TokenId>(TOKENS)("nope").unwrap_err(),
            identifier::<JoinTokenId>(JOIN_TOKENS)("nope").unwrap_err(),
            identifier::<SessionId>(SESSIONS)("nope").unwrap_err(),
            identifier::<AlertId>(ALERTS)("nope").unwrap_err(),
            identifier::<StopId>(STOPS)("nope").unwrap_err(),
        ];
        let listings = [
            "tokens`",
            "join-token list`",
            "sessions`",
            "alerts",
            "stops`",
        ];
        for (refused, listing) in refused.iter().zip(listings) {
            assert!(
                refused.starts_with("this is not the identifier of "),
                "{refused}"
            );
            assert!(refused.contains(listing), "{refused}");
        }
        let whole = "0192f0c1-2b3c-7d4e-8f50-617283940a1b";
        assert_eq!(
            identifier::<TokenId>(TOKENS)(whole).unwrap().to_string(),
            whole
        );
    }
}
