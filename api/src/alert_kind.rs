//! Kinds of alerts: the codes that this version raises. Clients offer them for selection. The
//! server refuses a webhook that is limited to an unknown kind.

use serde::{Deserialize as _, Deserializer};

use crate::ids::AlertCode;

/// Codes that servers and agents of this version raise, in alphabetical order. Codes about dropped
/// messages of a robot's base begin with [`BASE_PREFIX`] and are not listed, except those below.
pub const ALERT_KINDS: [&str; 42] = [
    "archive-failed",
    "backup-failed",
    "backup-old",
    "base-clock",
    "base-restarted",
    "base-silent",
    "battery-critical",
    "battery-low",
    "certificate-expiring",
    "clock-wrong",
    "command-second-writer",
    "database-damaged",
    "disk-low",
    "dug-in",
    "loop-overrun",
    "mission-expired",
    "mission-failed",
    "mission-rejected",
    "mission-waiting",
    "moves-while-stopped",
    "outbox-damaged",
    "outbox-dropped",
    "outbox-long",
    "payload-changed",
    "position-lost",
    "retired-authority",
    "revoked-robot",
    "robot-lost",
    "robot-waiting",
    "robots-await-release",
    "sensor-frozen",
    "sensor-inconsistent",
    "server-restarted",
    "standstill-not-reached",
    "stop-unconfirmed",
    "stopped",
    "storage-unwritable",
    "surface-change",
    "two-agents",
    "unknown-certificate",
    "wheel-locked",
    "wheels-and-motion-disagree",
];
/// Prefix of the codes about dropped messages of a robot's base; the reason follows it.
pub const BASE_PREFIX: &str = "base-";
/// Former codes of earlier versions, each with the present one.
const RENAMED: [(&str, &str); 1] = [("does-not-stand", "standstill-not-reached")];

/// Returns whether agents or servers of this version raise alerts of this kind, also by its former
/// code, because webhooks that were stored by an earlier version have it.
pub fn is_known(code: &AlertCode) -> bool {
    let code = code.as_str();
    ALERT_KINDS.contains(&code)
        || code.starts_with(BASE_PREFIX)
        || RENAMED.iter().any(|(former, _)| *former == code)
}

/// Returns the other code of a renamed kind: the former one for the present one, and the reverse;
/// `None` if the kind was not renamed.
pub fn other_code(code: &AlertCode) -> Option<AlertCode> {
    let other = RENAMED.iter().find_map(|(former, present)| {
        if code.as_str() == *present {
            Some(former)
        } else {
            (code.as_str() == *former).then_some(present)
        }
    });
    other.and_then(|other| other.parse().ok())
}

/// Deserialises the code of a report; a former code of an earlier version becomes the present one.
pub(crate) fn deserialize_present<'de, D>(deserializer: D) -> Result<AlertCode, D::Error>
where
    D: Deserializer<'de>,
{
    let code = AlertCode::deserialize(deserializer)?;
    let renamed = RENAMED.iter().find(|(former, _)| *former == code.as_str());
    Ok(renamed
        .and_then(|(_, present)| present.parse().ok())
        .unwrap_or(code))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_renamed_kind_has_two_codes_and_the_former_one_is_still_known() {
        for (former, present) in RENAMED {
            let [former, present]: [AlertCode; 2] =
                [former, present].map(|code| code.parse().unwrap());
            assert!(is_known(&former) && is_known(&present));
            assert_eq!(other_code(&former).as_ref(), Some(&present));
            assert_eq!(other_code(&present), Some(former));
        }
        assert_eq!(other_code(&"battery-low".parse().unwrap()), None);
    }
}
