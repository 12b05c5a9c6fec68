//! Robots.

use jiff::Timestamp;
use tread_api::ids::{BootId, ConfigurationId, RobotId, SiteId, Tag};
use tread_api::robot::{Capabilities, RobotModel, UnmappedMeasurements};

/// A robot as stored.
#[derive(Debug, Clone, PartialEq)]
pub struct RobotRow {
    /// Its database key.
    pub pk: i64,
    /// Its site.
    pub site: SiteId,
    /// The robot.
    pub id: RobotId,
    /// Model and tyres as last declared.
    pub model: RobotModel,
    /// Identifier of this model with these tyres.
    pub configuration: ConfigurationId,
    /// Display name; the identifier until it is renamed.
    pub name: String,
    /// Tags, sorted.
    pub tags: Vec<Tag>,
    /// Time at which it was retired; `None` if it is not.
    pub retired_at: Option<Timestamp>,
    /// Since when it awaits its release after a restoration; `None` if it does not.
    pub awaits_release_since: Option<Timestamp>,
    /// What the base and its agent can do.
    pub capabilities: Capabilities,
    /// Version of the agent.
    pub agent_version: String,
    /// The run of the agent that said hello last.
    pub boot: BootId,
    /// First hello.
    pub first_seen_at: Timestamp,
    /// Last hello.
    pub last_hello_at: Timestamp,
    /// Counts of its refused and deferred measurements.
    pub measurements: UnmappedMeasurements,
}

/// Content of a robot's hello.
#[derive(Debug, Clone, Copy)]
pub struct Introduction<'hello> {
    /// The robot.
    pub id: &'hello RobotId,
    /// This run of the agent.
    pub boot: BootId,
    /// Version of the agent.
    pub agent_version: &'hello str,
    /// Model and tyres.
    pub model: &'hello RobotModel,
    /// What the base and its agent can do.
    pub capabilities: &'hello Capabilities,
    /// Time of the hello.
    pub at: Timestamp,
}
