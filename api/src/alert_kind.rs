//! Kinds of alerts: the codes that this version raises. Clients offer them for selection. The
//! server refuses a webhook that is limited to an unknown kind.

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
    "does-not-stand",
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

/// Returns whether agents or servers of this version raise alerts of this kind.
pub fn is_known(code: &AlertCode) -> bool {
    let code = code.as_str();
    ALERT_KINDS.contains(&code) || code.starts_with(BASE_PREFIX)
}
