//! Attendance of robots.

use tread_api::ids::{RobotId, SiteId};

/// Attendance of one robot.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Expected {
    /// The robot's site.
    pub site: SiteId,
    /// The robot.
    pub robot: RobotId,
    /// Whether it was on the network and has not left by itself.
    pub is_present: bool,
    /// Whether the requested alert is raised about it.
    pub is_alerted: bool,
}
