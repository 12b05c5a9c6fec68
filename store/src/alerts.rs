//! Alerts: filters and places.

use tread_api::geometry::Point;
use tread_api::ids::{AlertCode, AlertId, MissionId, RobotId, SiteId};
use tread_api::rights::Scope;

/// Which alerts to list.
#[derive(Debug, Clone, Default)]
pub struct AlertFilter {
    /// Only those of this site.
    pub site: Option<SiteId>,
    /// Only those of robots of this name.
    pub robot: Option<RobotId>,
    /// Only those of this kind.
    pub kind: Option<AlertCode>,
    /// Only those that have not cleared.
    pub raised: bool,
    /// Only those older than this one (cursor).
    pub before: Option<AlertId>,
    /// Only those about sites and robots in this scope.
    pub within: Scope,
}

/// Mission and place of an alert, as far as they are known.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct AlertLocation {
    /// The mission.
    pub mission: Option<MissionId>,
    /// The robot's position in the site frame.
    pub place: Option<Point>,
}
