//! Arguments of the commands that supervise, stop, limit and teleoperate robots.

use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, Subcommand};
use tread_api::ids::{AlertCode, AlertId, OwnerId, RobotId, StopId};

use super::Connection;
use super::durations::{limit_time, watch_interval};
use super::values::{ALERTS, STOPS, finite, identifier, positive};

#[derive(Debug, Args)]
pub(crate) struct WatchArguments {
    /// Minimum time between two updates of the screen
    #[arg(long, value_name = "TIME", default_value = "250ms", value_parser = watch_interval)]
    pub(crate) every: Duration,
    /// Show only this robot
    #[arg(long)]
    pub(crate) robot: Option<RobotId>,
    /// Print a line for each change, even in a terminal
    #[arg(long)]
    pub(crate) lines: bool,
    #[command(flatten)]
    pub(crate) connection: Connection,
}

#[derive(Debug, Args)]
pub(crate) struct StopArguments {
    /// Robots to stop
    #[arg(required_unless_present = "all")]
    pub(crate) robots: Vec<RobotId>,
    /// Stop every robot of every site
    #[arg(long, conflicts_with = "robots")]
    pub(crate) all: bool,
    /// Name of the person who stops the robots, shown to others
    #[arg(long, env = "USER")]
    pub(crate) by: Option<String>,
    /// Reason, for people
    #[arg(long)]
    pub(crate) reason: Option<String>,
    #[command(flatten)]
    pub(crate) connection: Connection,
}

#[derive(Debug, Args)]
pub(crate) struct ClearArguments {
    /// Robot whose stop is cleared
    pub(crate) robot: RobotId,
    /// Identifier of the stop; if absent, the stop is shown with its reason and not cleared
    #[arg(value_parser = identifier::<StopId>(STOPS))]
    pub(crate) stop: Option<StopId>,
    /// Name of the person who clears the stop, shown to others
    #[arg(long, env = "USER")]
    pub(crate) by: Option<String>,
    #[command(flatten)]
    pub(crate) connection: Connection,
}

#[derive(Debug, Args)]
pub(crate) struct StopsArguments {
    /// Show only stops of this robot
    #[arg(long)]
    pub(crate) robot: Option<RobotId>,
    /// Show only stops that are not cleared
    #[arg(long)]
    pub(crate) in_force: bool,
    /// Maximum number of stops, newest first
    #[arg(long, default_value_t = 20, value_parser = clap::value_parser!(u32).range(1..=1000))]
    pub(crate) limit: u32,
    #[command(flatten)]
    pub(crate) connection: Connection,
}

#[derive(Debug, Args)]
pub(crate) struct AlertsArguments {
    #[command(subcommand)]
    pub(crate) action: Option<AlertsAction>,
    /// Show only alerts of this robot
    #[arg(long)]
    pub(crate) robot: Option<RobotId>,
    /// Show only alerts of this kind, such as `robot-lost`
    #[arg(long)]
    pub(crate) kind: Option<AlertCode>,
    /// Show cleared alerts too
    #[arg(long)]
    pub(crate) all: bool,
    /// Maximum number of alerts, newest first
    #[arg(long, default_value_t = 50, value_parser = clap::value_parser!(u32).range(1..=1000))]
    pub(crate) limit: u32,
    #[command(flatten)]
    pub(crate) connection: Connection,
}

#[derive(Debug, Subcommand)]
pub(crate) enum AlertsAction {
    /// Acknowledge an alert: record that a person has seen it; it stays until its cause ends
    #[command(visible_alias = "ack")]
    Acknowledge {
        /// Alert identifier
        #[arg(value_parser = identifier::<AlertId>(ALERTS))]
        alert: AlertId,
    },
}

#[derive(Debug, Args)]
pub(crate) struct DriveArguments {
    /// Robot to drive
    pub(crate) robot: RobotId,
    /// Name of the driver, shown to others
    #[arg(long, env = "USER", default_value = "somebody")]
    pub(crate) name: String,
    /// Take the lease from another driver
    #[arg(long)]
    pub(crate) take: bool,
    /// Speed forwards and backwards, metres per second
    #[arg(long, value_name = "M/S", default_value_t = 0.4, value_parser = positive)]
    pub(crate) speed: f64,
    /// Yaw rate of turns, radians per second
    #[arg(long, value_name = "RAD/S", default_value_t = 0.6, value_parser = positive)]
    pub(crate) turn: f64,
    #[command(flatten)]
    pub(crate) connection: Connection,
}

#[derive(Debug, Args)]
pub(crate) struct LimitsArguments {
    /// Robot whose limits are listed, set or ended
    pub(crate) robot: RobotId,
    #[command(subcommand)]
    pub(crate) action: Option<LimitsAction>,
    #[command(flatten)]
    pub(crate) connection: Connection,
}

#[derive(Debug, Subcommand)]
pub(crate) enum LimitsAction {
    /// Hold or slow the robot for a limited time
    Set {
        /// Owner of the limit
        owner: OwnerId,
        /// Hold the robot at rest
        #[arg(long, required_unless_present = "speed")]
        hold: bool,
        /// Maximum speed, metres per second
        #[arg(long, value_name = "M/S", value_parser = finite)]
        speed: Option<f64>,
        /// Duration of the limit, at most one hour
        #[arg(long = "for", value_name = "TIME", value_parser = limit_time)]
        lasting: Duration,
    },
    /// End the limit of an owner
    End {
        /// Owner of the limit
        owner: OwnerId,
    },
}

#[derive(Debug, Args)]
pub(crate) struct GeofenceArguments {
    /// File with the new geofence, or `-` for standard input: JSON `{"keep_in": [[{"x_m": …, "y_m":
    /// …}, …], …], "keep_out": […]}`, as `--json` prints it
    #[arg(long, value_name = "FILE")]
    pub(crate) set: Option<PathBuf>,
    /// Replace the geofence only if it is still at this revision
    #[arg(long, requires = "set")]
    pub(crate) revision: Option<u64>,
    #[command(flatten)]
    pub(crate) connection: Connection,
}
