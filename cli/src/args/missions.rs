//! Arguments of the commands that create and control missions.

use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, Subcommand, ValueEnum};
use tread_api::geometry::Point;
use tread_api::ids::RobotId;
use tread_api::mission::{LinkPolicy, MissionState, StartPolicy};
use tread_api::trajectory::Waypoint;

use super::durations::{silence, wait_time};
use super::values::{finite, mission_state, point, waypoint};
use super::{Connection, MissionName};

#[derive(Debug, Args)]
pub(crate) struct SendArguments {
    #[command(subcommand)]
    pub(crate) trajectory: SendTrajectory,
}

impl SendArguments {
    pub(super) fn connection(&self) -> &Connection {
        match &self.trajectory {
            SendTrajectory::Circle(circle) => &circle.order.connection,
            SendTrajectory::Waypoints(waypoints) => &waypoints.order.connection,
        }
    }
}

#[derive(Debug, Subcommand)]
pub(crate) enum SendTrajectory {
    /// Drive turns on a circle
    Circle(SendCircle),
    /// Drive a smooth path through points
    Waypoints(SendWaypoints),
}

/// Options that circles and waypoints have in common.
#[derive(Debug, Args)]
pub(crate) struct MissionOptions {
    /// Robot that is to drive
    #[arg(long)]
    pub(crate) robot: RobotId,
    /// Let the mission expire if it has not started within this time from now
    #[arg(long, value_name = "TIME", value_parser = wait_time)]
    pub(crate) start_within: Option<Duration>,
    /// Effect on the robot's other missions
    #[arg(long, value_enum, default_value_t = Start::Append)]
    pub(crate) start: Start,
    /// Priority, -100 to 100; missions of a higher priority are driven first
    #[arg(long, default_value_t = 0, allow_hyphen_values = true)]
    pub(crate) priority: i32,
    /// Stop the robot when the server has been silent for this time; if absent, it drives on
    #[arg(long, value_name = "TIME", value_parser = silence)]
    pub(crate) stop_after_silence: Option<Duration>,
    /// Let the mission fail when the robot has been offline for this time
    #[arg(long, value_name = "TIME", value_parser = silence)]
    pub(crate) lost_after: Option<Duration>,
    /// Speed of the approach to the trajectory, metres per second; that of the trajectory if absent
    #[arg(long, value_name = "M/S", value_parser = finite, allow_negative_numbers = true)]
    pub(crate) approach_speed: Option<f64>,
    /// Vary the speed periodically (excitation), so that friction is measurable without torque
    /// sensing
    #[arg(long)]
    pub(crate) excite: bool,
    /// Replace the trajectory of this mission instead of creating a mission; an identifier, or its
    /// end or beginning
    #[arg(long, value_name = "MISSION")]
    pub(crate) replaces: Option<MissionName>,
    /// Only check the trajectory and show its plan; nothing moves
    #[arg(long, conflicts_with_all = ["replaces", "wait"])]
    pub(crate) check: bool,
    /// Wait until the mission has ended, showing its progress
    #[arg(long)]
    pub(crate) wait: bool,
    /// Wait at most for this time; the mission continues
    #[arg(long, value_name = "TIME", value_parser = wait_time, requires = "wait")]
    pub(crate) timeout: Option<Duration>,
    #[command(flatten)]
    pub(crate) connection: Connection,
}

/// Effect of a new mission on the robot's other missions.
#[derive(Debug, Clone, Copy, ValueEnum)]
pub(crate) enum Start {
    /// The new mission waits behind the others
    Append,
    /// The other missions are cancelled
    Replace,
    /// The new mission is refused if there are others
    Refuse,
}

impl MissionOptions {
    pub(crate) fn start_policy(&self) -> StartPolicy {
        match self.start {
            Start::Append => StartPolicy::Append,
            Start::Replace => StartPolicy::Replace,
            Start::Refuse => StartPolicy::Refuse,
        }
    }

    pub(crate) fn link_policy(&self) -> LinkPolicy {
        match self.stop_after_silence {
            None => LinkPolicy::Continue,
            Some(silence) => LinkPolicy::StopAfter {
                silence_s: silence.as_secs_f64(),
            },
        }
    }
}

#[derive(Debug, Args)]
pub(crate) struct SendCircle {
    /// Centre, metres in the site frame
    #[arg(long, value_name = "X,Y", value_parser = point)]
    pub(crate) center: Point,
    /// Radius, metres
    #[arg(long, value_name = "M", value_parser = finite, allow_negative_numbers = true)]
    pub(crate) radius: f64,
    /// Speed along the circle, metres per second
    #[arg(long, value_name = "M/S", default_value_t = 0.5, value_parser = finite, allow_negative_numbers = true)]
    pub(crate) speed: f64,
    /// Number of turns
    #[arg(long, default_value_t = 1.0, value_parser = finite, allow_negative_numbers = true)]
    pub(crate) turns: f64,
    /// Drive clockwise; counter-clockwise if absent
    #[arg(long)]
    pub(crate) clockwise: bool,
    #[command(flatten)]
    pub(crate) order: MissionOptions,
}

#[derive(Debug, Args)]
pub(crate) struct SendWaypoints {
    /// Points in driving order, metres in the site frame
    #[arg(
        value_name = "X,Y",
        value_parser = waypoint,
        required_unless_present = "file"
    )]
    pub(crate) points: Vec<Waypoint>,
    /// File with the points: one line `x,y` each, or a JSON list of `{"x_m": …, "y_m": …}`
    #[arg(long, value_name = "FILE", conflicts_with = "points")]
    pub(crate) file: Option<PathBuf>,
    /// Speed, metres per second
    #[arg(long, value_name = "M/S", default_value_t = 0.5, value_parser = finite, allow_negative_numbers = true)]
    pub(crate) speed: f64,
    #[command(flatten)]
    pub(crate) order: MissionOptions,
}

#[derive(Debug, Args)]
pub(crate) struct MissionsArguments {
    #[command(subcommand)]
    pub(crate) action: Option<MissionsAction>,
    /// Show only missions of this robot
    #[arg(long)]
    pub(crate) robot: Option<RobotId>,
    /// Show only missions in this state
    #[arg(long, value_parser = mission_state())]
    pub(crate) state: Option<MissionState>,
    /// Maximum number of missions, newest first
    #[arg(long, default_value_t = 20, value_parser = clap::value_parser!(u32).range(1..=1000))]
    pub(crate) limit: u32,
    #[command(flatten)]
    pub(crate) connection: Connection,
}

#[derive(Debug, Subcommand)]
pub(crate) enum MissionsAction {
    /// Show a mission with its history
    Show {
        /// Mission identifier, or its end or beginning: at least 4 digits that name no other mission
        mission: MissionName,
    },
    /// Wait until missions have ended, showing their progress; exits with 1 if one did not succeed
    #[command(visible_alias = "follow")]
    Wait {
        /// Mission identifiers, or their ends or beginnings
        #[arg(required = true, value_name = "MISSION")]
        missions: Vec<MissionName>,
        /// Wait at most for this time; the missions continue
        #[arg(long, value_name = "TIME", value_parser = wait_time)]
        timeout: Option<Duration>,
    },
    /// Pause a mission: its robot brakes along the path and stays at rest
    Pause {
        /// Mission identifier, or its end or beginning: at least 4 digits that name no other mission
        mission: MissionName,
    },
    /// Resume a paused mission
    Resume {
        /// Mission identifier, or its end or beginning: at least 4 digits that name no other mission
        mission: MissionName,
    },
    /// Cancel a mission: its robot brakes along the path
    Cancel {
        /// Mission identifier, or its end or beginning: at least 4 digits that name no other mission
        mission: MissionName,
    },
}
