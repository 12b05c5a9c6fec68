//! Publishes the agent's plan, driven path, friction and diagnostics to the rest of the robot.
//!
//! It reads the shared snapshot and plan, and publishes once a second and when a mission begins or
//! ends. It runs on a thread of its own and delays nobody: the loop skips a snapshot that is being
//! read, and commands are written by another thread.

use std::sync::Arc;
use std::time::Duration;

use tread_api::friction::NoEstimate;
use tread_api::ids::MissionId;
use tread_control::geometry::Pose;
use tread_ros2::cdr::{Sequence, encode};
use tread_ros2::messages::{
    DiagnosticArray, DiagnosticStatus, Float64MultiArray, KeyValue, Level, MultiArrayDimension,
    MultiArrayLayout,
};

use crate::control_loop::channels::{GivenPlan, Shared, Snapshot};
use crate::drive::ros2::published_topics::{PublishedTopic, StatePublisher};
use crate::drive::ros2::refusal::Counts;
use crate::drive::ros2::settings::OutwardSettings;
use crate::recording::views::{PATH_POINTS_MAX, header, path, poses_of, state};

/// Interval of the messages.
const PUBLISH_PERIOD: Duration = Duration::from_secs(1);
/// Silence of the server from which the diagnostics have the level of a warning.
const SILENT_SERVER: Duration = Duration::from_secs(5);
/// Distance between two points of the driven path, metres.
const SPACING_M: f64 = 0.1;
/// Values of the friction message, in this order; unknown ones are NaN.
const THETA_LABEL: &str = "theta,theta_std_dev,theta_loop";

/// Diagnostic status of one part of the agent.
#[derive(Debug)]
struct Part {
    name: &'static str,
    level: Level,
    message: String,
    values: Vec<(String, String)>,
}

/// Publisher of the agent's state on the robot's bus.
#[derive(Debug)]
pub(crate) struct AgentStatePublisher {
    settings: OutwardSettings,
    shared: Arc<Shared>,
    counts: Arc<Counts>,
    robot: String,
    /// Time of the last messages, by the agent's monotonic clock.
    published_at: Option<Duration>,
    /// Mission and revision of the published plan.
    mission: Option<(MissionId, u32)>,
    /// Poses of the plan, in the frame of the settings, as those of `driven`.
    plan: Vec<Pose>,
    driven: Vec<Pose>,
    /// Number of dropped messages at the last diagnostics.
    dropped: u64,
    /// Number of other nodes' commands at the last diagnostics.
    foreign_commands: u64,
}

impl StatePublisher for AgentStatePublisher {
    fn step(
        &mut self,
        now: Duration,
        wall_ns: i64,
        publish: &mut dyn FnMut(PublishedTopic, &[u8]),
    ) {
        let snapshot = self.shared.snapshot();
        let is_new = self.update_mission(&snapshot);
        self.update_place(&snapshot);
        let is_due = |published_at: Duration| now.saturating_sub(published_at) >= PUBLISH_PERIOD;
        if !is_new && !self.published_at.is_none_or(is_due) {
            return;
        }
        self.published_at = Some(now);
        let (frame, mut bytes) = (self.settings.frame.as_str(), Vec::new());
        path(&self.plan, frame, wall_ns, &mut bytes);
        publish(PublishedTopic::Plan, &bytes);
        path(&self.driven, frame, wall_ns, &mut bytes);
        publish(PublishedTopic::Driven, &bytes);
        theta(&snapshot, &mut bytes);
        publish(PublishedTopic::Theta, &bytes);
        let parts = self.parts(now, &snapshot);
        diagnostics(&parts, &self.robot, wall_ns, &mut bytes);
        publish(PublishedTopic::Diagnostics, &bytes);
    }
}

impl AgentStatePublisher {
    pub(crate) fn new(
        settings: OutwardSettings,
        shared: Arc<Shared>,
        counts: Arc<Counts>,
        robot: String,
    ) -> Self {
        Self {
            settings,
            shared,
            counts,
            robot,
            published_at: None,
            mission: None,
            plan: Vec::new(),
            driven: Vec::with_capacity(PATH_POINTS_MAX as usize),
            dropped: 0,
            foreign_commands: 0,
        }
    }

    /// Updates the plan; returns whether it has changed.
    fn update_mission(&mut self, snapshot: &Snapshot) -> bool {
        let driven = snapshot.mission.map(|now| (now.id, now.revision));
        if driven == self.mission {
            return false;
        }
        let Some((mission, revision)) = driven else {
            self.mission = None;
            self.plan.clear();
            return true;
        };
        // The loop may begin a mission before the dispatcher has published its plan.
        let given = self.shared.given_plan();
        let is_it = |given: &GivenPlan| (given.mission, given.revision) == (mission, revision);
        let Some(given) = given.filter(is_it) else {
            return false;
        };
        if self.mission.is_none_or(|(before, _)| before != mission) {
            self.driven.clear();
        }
        self.plan = poses_of(&given.plan);
        for pose in &mut self.plan {
            *pose = self.settings.frame_pose(*pose);
        }
        self.mission = driven;
        true
    }

    fn update_place(&mut self, snapshot: &Snapshot) {
        let Some((pose, _)) = snapshot.pose else {
            return;
        };
        let pose = self.settings.frame_pose(pose);
        let is_near = |last: &Pose| last.point().distance_m(pose.point()) < SPACING_M;
        if self.driven.last().is_some_and(is_near) {
            return;
        }
        if self.driven.len() >= PATH_POINTS_MAX as usize {
            self.driven.remove(0);
        }
        self.driven.push(pose);
    }

    fn parts(&mut self, now: Duration, snapshot: &Snapshot) -> [Part; 4] {
        [
            control(snapshot),
            link(self.shared.server_silence(now)),
            estimator(snapshot),
            self.base(),
        ]
    }

    fn base(&mut self) -> Part {
        let drops: Vec<_> = self.counts.drops().collect();
        let sum = drops.iter().map(|(_, _, count)| count).sum();
        let before = std::mem::replace(&mut self.dropped, sum);
        let foreign = self.counts.foreign_commands();
        let foreign_before = std::mem::replace(&mut self.foreign_commands, foreign);
        let (level, message) = if foreign > foreign_before {
            let text = "another node writes on the command topic";
            (Level::Error, text.to_owned())
        } else if sum > before {
            let text = format!("messages dropped of late: {}", sum - before);
            (Level::Warn, text)
        } else {
            (Level::Ok, "nothing was dropped of late".to_owned())
        };
        let of_drops = drops.into_iter().map(|(source, refusal, count)| {
            let key = format!("{}: {}", source.section(), refusal.code());
            (key, count.to_string())
        });
        let foreign = (foreign > 0).then(|| ("commands of others".to_owned(), foreign.to_string()));
        Part {
            name: "tread_agent: base",
            level,
            message,
            values: of_drops.chain(foreign).collect(),
        }
    }
}

fn control(snapshot: &Snapshot) -> Part {
    let (level, message) = match state(snapshot.mode, snapshot.fault) {
        (Level::Ok, _) if snapshot.is_on_hold => (Level::Ok, "holds its mission"),
        known => known,
    };
    let gate = snapshot.gate.cause.map(|cause| format!("{cause:?}"));
    let mut values = vec![
        ("mode".to_owned(), format!("{:?}", snapshot.mode)),
        ("gate".to_owned(), gate.unwrap_or_else(|| "open".to_owned())),
        ("ticks".to_owned(), snapshot.ticks.to_string()),
    ];
    if let Some(mission) = snapshot.mission {
        values.push(("mission".to_owned(), mission.id.to_string()));
        let progress = format!("{:.2} of {:.2}", mission.driven_m, mission.length_m);
        values.push(("driven, m".to_owned(), progress));
        let off = format!("{:.3}", mission.cross_track_m);
        values.push(("cross-track error, m".to_owned(), off));
    }
    Part {
        name: "tread_agent: control",
        level,
        message: message.to_owned(),
        values,
    }
}

fn link(silence: Duration) -> Part {
    let is_silent = silence >= SILENT_SERVER;
    Part {
        name: "tread_agent: link",
        level: if is_silent { Level::Warn } else { Level::Ok },
        message: if is_silent {
            "the server is silent".to_owned()
        } else {
            "the server is heard".to_owned()
        },
        values: vec![(
            "server silent for, s".to_owned(),
            format!("{:.1}", silence.as_secs_f64()),
        )],
    }
}

fn estimator(snapshot: &Snapshot) -> Part {
    let (level, message) = if snapshot.dug_in_at.is_some() {
        (Level::Warn, "the wheels turn without progress")
    } else if snapshot.surface_change.is_some() {
        (Level::Warn, "the ground is not as the map says")
    } else if snapshot.payload_change.is_some() {
        (Level::Warn, "the payload has changed")
    } else if let Some(why) = snapshot.no_estimate {
        (Level::Ok, why.reason())
    } else if snapshot.excited {
        (Level::Ok, "learns")
    } else {
        (Level::Ok, "learns nothing new from this motion")
    };
    let number = |value: Option<f64>| value.map_or("unknown".to_owned(), |it| format!("{it:.4}"));
    let measured = snapshot.theta_measured;
    let help = snapshot.no_estimate.and_then(NoEstimate::help);
    Part {
        name: "tread_agent: estimator",
        level,
        message: message.to_owned(),
        values: vec![
            ("what would help".to_owned(), help.unwrap_or("-").to_owned()),
            ("theta".to_owned(), number(measured.map(|it| it.theta))),
            (
                "standard deviation of theta".to_owned(),
                number(measured.map(|it| it.std_dev)),
            ),
            ("theta of the law".to_owned(), number(snapshot.theta_loop)),
            (
                "apparent mass over configured mass".to_owned(),
                number(
                    snapshot
                        .robot_parameters
                        .map(|it| it.apparent_mass_ratio.value),
                ),
            ),
            (
                "yaw inertia over mass over configured".to_owned(),
                number(
                    snapshot
                        .robot_parameters
                        .map(|it| it.yaw_inertia_ratio.value),
                ),
            ),
        ],
    }
}

fn theta(snapshot: &Snapshot, into: &mut Vec<u8>) {
    let measured = snapshot.theta_measured;
    let numbers = [
        measured.map_or(f64::NAN, |it| it.theta),
        measured.map_or(f64::NAN, |it| it.std_dev),
        snapshot.theta_loop.unwrap_or(f64::NAN),
    ];
    let dimensions = [MultiArrayDimension {
        label: THETA_LABEL,
        size: 3,
        stride: 3,
    }];
    let message = Float64MultiArray {
        layout: MultiArrayLayout {
            dim: Sequence::from(&dimensions),
            data_offset: 0,
        },
        data: Sequence::from(&numbers),
    };
    encode(&message, into);
}

fn diagnostics(parts: &[Part], robot: &str, wall_ns: i64, into: &mut Vec<u8>) {
    let values: Vec<Vec<KeyValue<'_>>> = parts
        .iter()
        .map(|part| {
            let values = part.values.iter();
            values.map(|(key, value)| KeyValue { key, value }).collect()
        })
        .collect();
    let status: Vec<DiagnosticStatus<'_>> = parts
        .iter()
        .zip(&values)
        .map(|(part, values)| DiagnosticStatus {
            level: part.level as u8,
            name: part.name,
            message: &part.message,
            hardware_id: robot,
            values: Sequence::from(values.as_slice()),
        })
        .collect();
    let message = DiagnosticArray {
        header: header(wall_ns, ""),
        status: Sequence::from(status.as_slice()),
    };
    encode(&message, into);
}

#[cfg(test)]
mod tests;
