//! Names of missions on the command line: a whole identifier, or its beginning or end.

use std::fmt;
use std::str::FromStr;

use tread_api::ids::MissionId;

/// Minimum number of hexadecimal digits of an abbreviated identifier.
const PART_DIGITS_MIN: usize = 4;
/// Number of hexadecimal digits of a whole identifier.
const WHOLE_DIGITS: usize = 32;

/// Mission as a user names it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum MissionName {
    /// The whole identifier.
    Whole(MissionId),
    /// The beginning or the end of the identifier: hexadecimal digits in lower case, without
    /// hyphens. Identifiers begin with their time, so the end is what differs.
    Part(String),
}

impl MissionName {
    /// Returns whether the name stands for a mission.
    pub(crate) fn fits(&self, mission_id: MissionId) -> bool {
        match self {
            Self::Whole(whole) => *whole == mission_id,
            Self::Part(part) => {
                let digits = digits_of(&mission_id.to_string());
                digits.starts_with(part) || digits.ends_with(part)
            }
        }
    }
}

impl fmt::Display for MissionName {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Whole(whole) => whole.fmt(formatter),
            Self::Part(part) => part.fmt(formatter),
        }
    }
}

impl FromStr for MissionName {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        if let Ok(whole) = text.parse() {
            return Ok(Self::Whole(whole));
        }
        let part = digits_of(text);
        let is_hexadecimal = part.bytes().all(|digit| digit.is_ascii_hexdigit());
        if is_hexadecimal && (PART_DIGITS_MIN..WHOLE_DIGITS).contains(&part.len()) {
            return Ok(Self::Part(part));
        }
        Err(format!(
            "give the identifier as `tread missions` prints it, or at least {PART_DIGITS_MIN} \
             hexadecimal digits of its end or beginning: 0192f0c1-2b3c-7d4e-8f50-617283940a1b or 0a1b"
        ))
    }
}

fn digits_of(text: &str) -> String {
    text.replace('-', "").to_ascii_lowercase()
}

#[cfg(test)]
mod tests {
    use super::*;

    const WHOLE: &str = "0192f0c1-2b3c-7d4e-8f50-617283940a1b";

    #[test]
    fn a_mission_is_named_by_its_whole_identifier_its_end_or_its_beginning() {
        let mission_id: MissionId = WHOLE.parse().unwrap();
        for name in [
            WHOLE,
            "0a1b",
            "83940A1B",
            "0192",
            "0192f0c1-2b",
            "8f50-617283940a1b",
        ] {
            let read: MissionName = name.parse().unwrap();
            assert!(read.fits(mission_id), "{name}");
        }
        for name in ["2b3c", "0a1c", "0193"] {
            let read: MissionName = name.parse().unwrap();
            assert!(!read.fits(mission_id), "{name}");
        }
    }

    #[test]
    fn what_is_no_name_of_a_mission_is_refused_with_where_to_find_one() {
        for wrong in [
            "",
            "123",
            "rover-1",
            "0a1g",
            "0192f0c1-2b3c-7d4e-8f50-617283940a1b0",
        ] {
            let error = wrong.parse::<MissionName>().unwrap_err();
            assert!(error.contains("tread missions"), "{wrong}: {error}");
        }
    }
}
