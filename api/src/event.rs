//! Server-sent events of `GET /v1/events`: every change of missions, robots, alerts and the
//! friction map.
//!
//! Each event's `event:` line is [`Event::name`], its `data:` line an [`Event`] as JSON, its `id:`
//! line the value that a client sends as `Last-Event-ID` to resume. A stream begins with a
//! snapshot: `snapshot_begin`, the present state of everything that matches the filters,
//! `snapshot_end`. If the server still keeps the events since the given `Last-Event-ID`, the stream
//! begins with those events instead. If that event is from another server, or from before a restart
//! of the server, the stream begins with the mission steps that followed it, and the snapshot comes
//! after them. Before the server ends a stream it sends [`Event::End`].

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::friction::MapChange;
use crate::ids::{MissionId, RobotId, SiteId};
use crate::mission::{Mission, MissionEvent};
use crate::robot::{Alert, Robot};

/// Subject of an event, by which a stream is filtered.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Topic {
    /// Missions and the steps of their histories.
    Missions,
    /// Robots and their live state.
    Robots,
    /// Alerts.
    Alerts,
    /// Changes of the friction map.
    Map,
}

impl Topic {
    /// Every topic.
    pub const ALL: [Self; 4] = [Self::Missions, Self::Robots, Self::Alerts, Self::Map];

    /// Returns the topic's name on the wire.
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Missions => "missions",
            Self::Robots => "robots",
            Self::Alerts => "alerts",
            Self::Map => "map",
        }
    }

    /// Returns the topic with this name; `None` if there is none.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|topic| topic.as_str() == name)
    }
}

/// Event of a stream.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Event {
    /// Start of the snapshot; the client discards all earlier state.
    SnapshotBegin,
    /// End of the snapshot.
    SnapshotEnd,
    /// Present state of a mission.
    Mission(Box<Mission>),
    /// New step in a mission's history.
    Step(Box<MissionStep>),
    /// Present state of a robot.
    Robot(Box<Robot>),
    /// Present state of an alert.
    Alert(Box<Alert>),
    /// Region in which the friction map has changed.
    Map(Box<MapChange>),
    /// The server ends the stream.
    End(StreamEnd),
}

impl Event {
    /// Returns the event's name on its `event:` line.
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

/// Step in a mission's history.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct MissionStep {
    /// Identifier of the mission.
    pub mission: MissionId,
    /// Site of the robot.
    pub site: SiteId,
    /// Robot of the mission.
    pub robot: RobotId,
    /// The step.
    pub step: MissionEvent,
}

/// Reason why the server ends a stream.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum StreamEnd {
    /// The client reads too slowly. It misses events unless it resumes while the server still keeps
    /// them.
    TooSlow,
    /// The server is shutting down.
    Stopping,
}
