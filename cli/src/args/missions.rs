//! The words of the commands that give robots something to do.

use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, Subcommand, ValueEnum};
use tread_api::geometry::Point;
use tread_api::ids::{MissionId, RobotId};
use tread_api::mission::{LinkPolicy, MissionState, StartPolicy};
use tread_api::trajectory::Waypoint;

use super::Connection;
use super::values::{duration, finite, mission, mission_state, point, waypoint};

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
    /// Turns on a circle
    Circle(SendCircle),
    /// A smooth path through points
    Waypoints(SendWaypoints),
}

/// What circles and waypoints have in common.
#[derive(Debug, Args)]
pub(crate) struct Order {
    /// Robot that is to drive
    #[arg(long)]
    pub(crate) robot: RobotId,
    /// Never start later than this from now
    #[arg(long, value_name = "TIME", value_parser = duration)]
    pub(crate) start_within: Option<Duration>,
    /// What becomes of the robot's other missions
    #[arg(long, value_enum, default_value_t = Start::Append)]
    pub(crate) start: Start,
    /// Missions of a higher priority are driven first
    #[arg(long, default_value_t = 0, allow_hyphen_values = true)]
    pub(crate) priority: i32,
    /// Stop when the server has not been heard for so long; the robot drives on when absent
    #[arg(long, value_name = "TIME", value_parser = duration)]
    pub(crate) stop_after_silence: Option<Duration>,
    /// The mission fails when the robot has been away for so long
    #[arg(long, value_name = "TIME", value_parser = duration)]
    pub(crate) lost_after: Option<Duration>,
    /// Speed on the approach to the trajectory, metres per second; the trajectory's own when absent
    #[arg(long, value_name = "M/S", value_parser = finite, allow_negative_numbers = true)]
    pub(crate) approach_speed: Option<f64>,
    /// Excitation the speed, so that a base without torque sensing can measure friction
    #[arg(long)]
    pub(crate) excite: bool,
    /// Swap this mission for the new trajectory instead of queueing another
    #[arg(long, value_name = "MISSION", value_parser = mission)]
    pub(crate) replaces: Option<MissionId>,
    /// Only tell what it would ask of the robot; nothing moves
    #[arg(long, conflicts_with_all = ["replaces", "wait"])]
    pub(crate) check: bool,
    /// Wait until the mission has ended, showing its progress
    #[arg(long)]
    pub(crate) wait: bool,
    /// Wait at most so long; the mission goes on
    #[arg(long, value_name = "TIME", value_parser = duration, requires = "wait")]
    pub(crate) timeout: Option<Duration>,
    #[command(flatten)]
    pub(crate) connection: Connection,
}

/// What becomes of a robot's other missions.
#[derive(Debug, Clone, Copy, ValueEnum)]
pub(crate) enum Start {
    /// The new one waits for them
    Append,
    /// They are cancelled
    Replace,
    /// The new one is refused if there are any
    Refuse,
}

impl Order {
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
    /// Centre in the site's frame, metres
    #[arg(long, value_name = "X,Y", value_parser = point)]
    pub(crate) center: Point,
    /// Radius, metres
    #[arg(long, value_name = "M", value_parser = finite, allow_negative_numbers = true)]
    pub(crate) radius: f64,
    /// Speed along the circle, metres per second
    #[arg(long, value_name = "M/S", default_value_t = 0.5, value_parser = finite, allow_negative_numbers = true)]
    pub(crate) speed: f64,
    /// How many turns
    #[arg(long, default_value_t = 1.0, value_parser = finite, allow_negative_numbers = true)]
    pub(crate) turns: f64,
    /// Drive clockwise
    #[arg(long)]
    pub(crate) clockwise: bool,
    #[command(flatten)]
    pub(crate) order: Order,
}

#[derive(Debug, Args)]
pub(crate) struct SendWaypoints {
    /// Points in the site's frame, metres, in driving order
    #[arg(
        value_name = "X,Y",
        value_parser = waypoint,
        required_unless_present = "file"
    )]
    pub(crate) points: Vec<Waypoint>,
    /// Read the points from a file: a line `x,y` each, or a JSON list of `{"x_m": …, "y_m": …}`
    #[arg(long, value_name = "FILE", conflicts_with = "points")]
    pub(crate) file: Option<PathBuf>,
    /// Speed, metres per second
    #[arg(long, value_name = "M/S", default_value_t = 0.5, value_parser = finite, allow_negative_numbers = true)]
    pub(crate) speed: f64,
    #[command(flatten)]
    pub(crate) order: Order,
}

#[derive(Debug, Args)]
pub(crate) struct MissionsArguments {
    #[command(subcommand)]
    pub(crate) action: Option<MissionsAction>,
    /// Only those of this robot
    #[arg(long)]
    pub(crate) robot: Option<RobotId>,
    /// Only those in this state
    #[arg(long, value_parser = mission_state())]
    pub(crate) state: Option<MissionState>,
    /// At most so many, newest first
    #[arg(long, default_value_t = 20, value_parser = clap::value_parser!(u32).range(1..=1000))]
    pub(crate) limit: u32,
    #[command(flatten)]
    pub(crate) connection: Connection,
}

#[derive(Debug, Subcommand)]
pub(crate) enum MissionsAction {
    /// Show a mission with its history
    Show {
        /// The mission
        #[arg(value_parser = mission)]
        mission: MissionId,
    },
    /// Wait until missions have ended, showing their progress; exits with 1 if one did not succeed
    #[command(visible_alias = "follow")]
    Wait {
        /// The missions
        #[arg(required = true, value_parser = mission)]
        missions: Vec<MissionId>,
        /// Wait at most so long; the missions go on
        #[arg(long, value_name = "TIME", value_parser = duration)]
        timeout: Option<Duration>,
    },
    /// Hold a mission: its robot brakes along the path and stands
    Pause {
        /// The mission
        #[arg(value_parser = mission)]
        mission: MissionId,
    },
    /// Let a paused mission go on
    Resume {
        /// The mission
        #[arg(value_parser = mission)]
        mission: MissionId,
    },
    /// Cancel a mission: its robot brakes along the path
    Cancel {
        /// The mission
        #[arg(value_parser = mission)]
        mission: MissionId,
    },
}
