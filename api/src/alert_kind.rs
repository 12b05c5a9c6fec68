//! Kinds of alerts: the codes that this version raises. Clients offer them, and a webhook that is
//! limited to a kind of no alert is refused.

use crate::ids::AlertCode;

/// Codes that servers and agents of this version raise, in alphabetical order. Those about the
/// messages of a robot's base are named by [`BASE_PREFIX`] alone, but for the ones listed here.
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
/// Begins the codes about dropped messages of a robot's base; the reason follows.
pub const BASE_PREFIX: &str = "base-";

/// Returns whether agents or servers of this version raise alerts of this kind.
pub fn is_known(code: &AlertCode) -> bool {
    let code = code.as_str();
    ALERT_KINDS.contains(&code) || code.starts_with(BASE_PREFIX)
}
