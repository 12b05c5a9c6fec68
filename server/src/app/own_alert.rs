//! An alert about a robot that the server itself raises.

use tread_api::ids::MissionId;
use tread_api::robot::Severity;

/// One of the server's own alerts about a robot, to be raised.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct OwnAlert {
    /// Its code.
    pub(super) code: &'static str,
    /// Severity.
    pub(super) severity: Severity,
    /// Description, for people.
    pub(super) text: String,
    /// Mission that it is about; if `None`, the one that the robot drives.
    pub(super) mission: Option<MissionId>,
}
