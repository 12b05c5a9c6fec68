//! The words of the commands by which people watch over robots, stop them and drive them.

use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, Subcommand};
use tread_api::ids::{AlertId, OwnerId, RobotId, StopId};

use super::Connection;
use super::values::{duration, finite, look_interval, positive};

#[derive(Debug, Args)]
pub(crate) struct WatchArguments {
    /// Least time between two pictures
    #[arg(long, value_name = "TIME", default_value = "250ms", value_parser = look_interval)]
    pub(crate) every: Duration,
    /// Only this robot
    #[arg(long)]
    pub(crate) robot: Option<RobotId>,
    /// A line for each change, also in a terminal
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
    /// Who stops, for others to see
    #[arg(long, env = "USER")]
    pub(crate) by: Option<String>,
    /// Why
    #[arg(long)]
    pub(crate) reason: Option<String>,
    #[command(flatten)]
    pub(crate) connection: Connection,
}

#[derive(Debug, Args)]
pub(crate) struct ClearArguments {
    /// Robot whose stop is cleared
    pub(crate) robot: RobotId,
    /// The stop; shown with its reason when absent, and nothing is cleared
    pub(crate) stop: Option<StopId>,
    /// Who clears, for others to see
    #[arg(long, env = "USER")]
    pub(crate) by: Option<String>,
    #[command(flatten)]
    pub(crate) connection: Connection,
}

#[derive(Debug, Args)]
pub(crate) struct StopsArguments {
    /// Only those of this robot
    #[arg(long)]
    pub(crate) robot: Option<RobotId>,
    /// Only those that are not cleared
    #[arg(long)]
    pub(crate) in_force: bool,
    /// At most so many, newest first
    #[arg(long, default_value_t = 20, value_parser = clap::value_parser!(u32).range(1..=1000))]
    pub(crate) limit: u32,
    #[command(flatten)]
    pub(crate) connection: Connection,
}

#[derive(Debug, Args)]
pub(crate) struct AlertsArguments {
    #[command(subcommand)]
    pub(crate) action: Option<AlertsAction>,
    /// Only those of this robot
    #[arg(long)]
    pub(crate) robot: Option<RobotId>,
    /// Those that have cleared, too
    #[arg(long)]
    pub(crate) all: bool,
    /// At most so many, newest first
    #[arg(long, default_value_t = 50, value_parser = clap::value_parser!(u32).range(1..=1000))]
    pub(crate) limit: u32,
    #[command(flatten)]
    pub(crate) connection: Connection,
}

#[derive(Debug, Subcommand)]
pub(crate) enum AlertsAction {
    /// Note that somebody has seen an alert; it stands until its cause is gone
    #[command(visible_alias = "ack")]
    Acknowledge {
        /// The alert
        alert: AlertId,
    },
}

#[derive(Debug, Args)]
pub(crate) struct DriveArguments {
    /// Robot to drive
    pub(crate) robot: RobotId,
    /// Who drives, for others to see
    #[arg(long, env = "USER", default_value = "somebody")]
    pub(crate) name: String,
    /// Take the lease from whoever drives now
    #[arg(long)]
    pub(crate) take: bool,
    /// Forward speed, metres per second
    #[arg(long, value_name = "M/S", default_value_t = 0.4, value_parser = positive)]
    pub(crate) speed: f64,
    /// Yaw rate, radians per second
    #[arg(long, value_name = "RAD/S", default_value_t = 0.6, value_parser = positive)]
    pub(crate) turn: f64,
    #[command(flatten)]
    pub(crate) connection: Connection,
}

#[derive(Debug, Args)]
pub(crate) struct LimitsArguments {
    /// Robot to look at
    pub(crate) robot: RobotId,
    #[command(subcommand)]
    pub(crate) action: Option<LimitsAction>,
    #[command(flatten)]
    pub(crate) connection: Connection,
}

#[derive(Debug, Subcommand)]
pub(crate) enum LimitsAction {
    /// Hold or slow the robot for a while
    Set {
        /// Who limits
        owner: OwnerId,
        /// The robot is to stand
        #[arg(long, required_unless_present = "speed")]
        hold: bool,
        /// Fastest speed, metres per second
        #[arg(long, value_name = "M/S", value_parser = finite)]
        speed: Option<f64>,
        /// How long it lasts
        #[arg(long = "for", value_name = "TIME", value_parser = duration)]
        lasting: Duration,
    },
    /// End an owner's limit
    End {
        /// Who limits
        owner: OwnerId,
    },
}

#[derive(Debug, Args)]
pub(crate) struct GeofenceArguments {
    /// Replace it by this file, or by the input for `-`: JSON `{"keep_in": [[{"x_m": …, "y_m": …},
    /// …], …], "keep_out": […]}`, as `--json` prints it
    #[arg(long, value_name = "FILE")]
    pub(crate) set: Option<PathBuf>,
    /// Only if it is still at this revision
    #[arg(long, requires = "set")]
    pub(crate) revision: Option<u64>,
    #[command(flatten)]
    pub(crate) connection: Connection,
}
