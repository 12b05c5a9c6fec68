//! Topics on which the agent publishes its state to the rest of the robot, and the trait of their
//! publisher.

use std::time::Duration;

use tread_ros2::messages::{DiagnosticArray, Float64MultiArray, Message as _, MessageType, Path};
use tread_ros2::names::Name;

use super::settings::OutwardSettings;

/// Interval of the checks.
pub(crate) const CHECK_EVERY: Duration = Duration::from_millis(100);

/// A published topic.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum PublishedTopic {
    /// Plan of the active mission; empty without one.
    Plan,
    /// Driven path since the last mission began, the newest some hundred points.
    Driven,
    /// Measured θ, its standard deviation, and θ̂ of the tracking law.
    Theta,
    /// State of the agent.
    Diagnostics,
}

impl PublishedTopic {
    /// All topics.
    pub(crate) const ALL: [Self; 4] = [Self::Plan, Self::Driven, Self::Theta, Self::Diagnostics];

    /// Returns the topic's name.
    pub(crate) fn topic(self, settings: &OutwardSettings) -> &Name {
        match self {
            Self::Plan => &settings.plan,
            Self::Driven => &settings.driven,
            Self::Theta => &settings.theta,
            Self::Diagnostics => &settings.diagnostics,
        }
    }

    /// Returns the type of the topic's messages.
    pub(crate) fn message_type(self) -> MessageType {
        match self {
            Self::Plan | Self::Driven => Path::TYPE,
            Self::Theta => Float64MultiArray::TYPE,
            Self::Diagnostics => DiagnosticArray::TYPE,
        }
    }
}

/// Publishes the agent's state. Runs on a thread of its own.
pub(crate) trait StatePublisher: std::fmt::Debug + Send + Sync {
    /// Calls `publish` with each message that is due, encoded.
    fn step(&mut self, now: Duration, wall_ns: i64, publish: &mut dyn FnMut(PublishedTopic, &[u8]));
}
