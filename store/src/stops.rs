//! Stops: filters.

use tread_api::ids::{RobotId, SiteId, StopId};
use tread_api::rights::Scope;

/// Filter of a list of stops.
#[derive(Debug, Clone, Default)]
pub struct StopFilter {
    /// Only those of this site.
    pub site: Option<SiteId>,
    /// Only those of robots of this name.
    pub robot: Option<RobotId>,
    /// Only open ones, at most one of each robot.
    pub in_force: bool,
    /// Only those older than this one (cursor).
    pub before: Option<StopId>,
    /// Only those of sites and robots in this scope.
    pub within: Scope,
}
