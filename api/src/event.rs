//! What `GET /v1/events` sends: everything that changes, as server-sent events.
//!
//! Each event's `event:` line is [`Event::name`], its `data:` line an [`Event`] as JSON, its `id:`
//! line what to give back as `Last-Event-ID`. A stream begins with a snapshot: `snapshot_begin`,
//! the present state of everything that the filters let through, `snapshot_end`; or, when the
//! given `Last-Event-ID` is still in reach, with everything since. A stream that the server ends
//! says so in an [`Event::End`].

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::friction::MapChange;
use crate::ids::{MissionId, RobotId, SiteId};
use crate::mission::{Mission, MissionEvent};
use crate::robot::{Alert, Robot};

/// What an event is about.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Topic {
    /// Missions and their histories.
    Missions,
    /// Robots and their live state.
    Robots,
    /// Alerts.
    Alerts,
    /// Where the friction map changes.
    Map,
}

impl Topic {
    /// Every topic.
    pub const ALL: [Self; 4] = [Self::Missions, Self::Robots, Self::Alerts, Self::Map];

    /// The topic's name on the wire.
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Missions => "missions",
            Self::Robots => "robots",
            Self::Alerts => "alerts",
            Self::Map => "map",
        }
    }

    /// The topic of that name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|topic| topic.as_str() == name)
    }
}

/// One event of the stream.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Event {
    /// The snapshot begins: forget what was known.
    SnapshotBegin,
    /// The snapshot is whole.
    SnapshotEnd,
    /// A mission as it is now.
    Mission(Box<Mission>),
    /// A step of a mission's history.
    Step(Box<MissionStep>),
    /// A robot as it is now.
    Robot(Box<Robot>),
    /// An alert as it is now.
    Alert(Box<Alert>),
    /// Where the friction map has changed.
    Map(Box<MapChange>),
    /// The server ends the stream.
    End(StreamEnd),
}

impl Event {
    /// The event's name, on its `event:` line.
    pub const fn name(&self) -> &'static str {
        match self {
            Self::SnapshotBegin => "snapshot_begin",
            Self::SnapshotEnd => "snapshot_end",
            Self::Mission(_) => "mission",
            Self::Step(_) => "step",
            Self::Robot(_) => "robot",
            Self::Alert(_) => "alert",
            Self::Map(_) => "map",
            Self::End(_) => "end",
        }
    }
}

/// A step of a mission's history.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct MissionStep {
    /// The mission.
    pub mission: MissionId,
    /// The robot's site.
    pub site: SiteId,
    /// The robot.
    pub robot: RobotId,
    /// The step.
    pub step: MissionEvent,
}

/// Why the server ends a stream.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum StreamEnd {
    /// The client reads too slowly; what it missed is lost unless it resumes soon.
    TooSlow,
    /// The server stops.
    Stopping,
}
