//! The words of the command line.

mod identity;
mod values;

use std::ffi::OsString;
use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, Parser, Subcommand};
use tread_api::geometry::Point;
use tread_api::ids::{HolderId, MissionId, RobotId, SiteId, StopId, TerrainId};
use tread_api::trajectory::Waypoint;

use self::identity::Showing;
pub(crate) use self::identity::{
    AuditArguments, JoinTokenAction, JoinTokenArguments, PlainArguments, RobotsAction,
    TokensAction, TokensArguments,
};
use self::values::{duration, finite, look_interval, point, positive};
pub(crate) use self::values::{shield_negative_points, waypoint};

/// Where a server answers, unless told otherwise.
pub(crate) const SERVER_DEFAULT: &str = "http://127.0.0.1:8420";
/// The site that a server makes for itself, unless told otherwise.
pub(crate) const SITE_DEFAULT: &str = "yard";
/// Most robots of a demo; each is a process of its own.
const DEMO_ROBOTS_MAX: i64 = 50;

const EXIT_CODES: &str = "\
Exit codes: 0 done; 1 done, and it went wrong (a mission failed); 2 wrong words on the command
line; 3 no server answers; 4 the server refused.";

/// Runs fleets of skid-steered robots and maps how the ground grips while they drive.
#[derive(Debug, Parser)]
#[command(name = "tread", version, after_help = EXIT_CODES)]
pub(crate) struct Arguments {
    #[command(subcommand)]
    pub(crate) command: Command,
}

#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    /// Start a whole fleet here: server, database, router and simulated robots on missions
    Demo(DemoArguments),
    #[command(flatten)]
    Remote(RemoteCommand),
    /// The server, as `tread demo` starts it
    #[command(hide = true, disable_help_flag = true)]
    Server(PassedOn),
    /// An agent, as `tread demo` starts it
    #[command(hide = true, disable_help_flag = true)]
    Agent(PassedOn),
}

/// Arguments of another program.
#[derive(Debug, Args)]
pub(crate) struct PassedOn {
    #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
    rest: Vec<OsString>,
}

impl PassedOn {
    /// The arguments as `program` would see them.
    pub(crate) fn for_program(self, program: &str) -> Vec<OsString> {
        std::iter::once(program.into()).chain(self.rest).collect()
    }
}

/// Commands that talk to a running server.
#[derive(Debug, Subcommand)]
pub(crate) enum RemoteCommand {
    /// List the robots of a site, show one, let one join, or put one out
    Robots(Box<RobotsArguments>),
    /// Send a robot on a circle or through waypoints
    Send(SendArguments),
    /// List missions, show one with its history, pause, resume or cancel one
    Missions(MissionsArguments),
    /// List the terrains of a site
    Terrains(TerrainsArguments),
    /// Show what is known of the friction of a site's ground
    Friction(FrictionArguments),
    /// Stop robots at once, and latch it; exits with 1 while one has not confirmed
    Stop(StopArguments),
    /// Clear a robot's stop, when it stands; nothing starts by it
    Clear(ClearArguments),
    /// Drive a robot by hand, in this terminal
    Drive(DriveArguments),
    /// List, set or end what other programs hold or slow a robot by
    Limits(LimitsArguments),
    /// Show or replace where the robots of a site may be
    Geofence(GeofenceArguments),
    /// Show robots and missions as they change, until interrupted
    Watch(WatchArguments),
    /// Sign in to a server: the token is read from the input, or from `--token-file`, and kept
    Login(PlainArguments),
    /// Forget the token of a server
    Logout(PlainArguments),
    /// Show who the token in use is, and what it may do
    Whoami(PlainArguments),
    /// Print the token in use, for other programs such as curl
    Token(PlainArguments),
    /// List tokens, make or revoke one
    Tokens(TokensArguments),
    /// Show who changed what, and who was refused
    Audit(AuditArguments),
}

impl RemoteCommand {
    pub(crate) fn connection(&self) -> &Connection {
        match self {
            Self::Robots(arguments) => arguments.connection(),
            Self::Send(arguments) => match &arguments.trajectory {
                SendTrajectory::Circle(circle) => &circle.order.connection,
                SendTrajectory::Waypoints(waypoints) => &waypoints.order.connection,
            },
            Self::Missions(arguments) => &arguments.connection,
            Self::Terrains(arguments) => &arguments.connection,
            Self::Friction(arguments) => &arguments.connection,
            Self::Watch(arguments) => &arguments.connection,
            Self::Login(arguments)
            | Self::Logout(arguments)
            | Self::Whoami(arguments)
            | Self::Token(arguments) => &arguments.connection,
            Self::Tokens(arguments) => &arguments.connection,
            Self::Audit(arguments) => &arguments.connection,
            Self::Stop(arguments) => &arguments.connection,
            Self::Clear(arguments) => &arguments.connection,
            Self::Drive(arguments) => &arguments.connection,
            Self::Limits(arguments) => &arguments.connection,
            Self::Geofence(arguments) => &arguments.connection,
        }
    }
}

/// Which server and site, and how to print.
#[derive(Debug, Clone, Args)]
pub(crate) struct Connection {
    /// Address of the server
    #[arg(long, global = true, env = "TREAD_SERVER", default_value = SERVER_DEFAULT, value_name = "URL")]
    pub(crate) server: String,
    #[command(flatten)]
    pub(crate) showing: Showing,
    /// Site to look at
    #[arg(long, global = true, env = "TREAD_SITE", default_value = SITE_DEFAULT)]
    pub(crate) site: SiteId,
    /// Print JSON instead of a table
    #[arg(long, global = true)]
    pub(crate) json: bool,
}

#[derive(Debug, Args)]
#[command(args_conflicts_with_subcommands = true)]
pub(crate) struct RobotsArguments {
    #[command(subcommand)]
    pub(crate) action: Option<RobotsAction>,
    /// Show only this one, with the age of every value
    pub(crate) robot: Option<RobotId>,
    #[command(flatten)]
    pub(crate) connection: Connection,
}

impl RobotsArguments {
    fn connection(&self) -> &Connection {
        match &self.action {
            None => &self.connection,
            Some(action) => action.connection(),
        }
    }
}

#[derive(Debug, Args)]
pub(crate) struct SendArguments {
    #[command(subcommand)]
    pub(crate) trajectory: SendTrajectory,
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
    /// Missions of a higher priority are driven first
    #[arg(long, default_value_t = 0, allow_hyphen_values = true)]
    pub(crate) priority: i32,
    /// Speed on the way to the trajectory, metres per second; the trajectory's own when absent
    #[arg(long, value_name = "M/S", value_parser = finite, allow_negative_numbers = true)]
    pub(crate) approach_speed: Option<f64>,
    /// Wiggle the speed, so that a base without torque sensing can measure friction
    #[arg(long)]
    pub(crate) excite: bool,
    /// Swap this mission for the new trajectory instead of queueing another
    #[arg(long, value_name = "MISSION")]
    pub(crate) replaces: Option<MissionId>,
    /// Only tell what it would ask of the robot; nothing moves
    #[arg(long, conflicts_with_all = ["replaces", "wait"])]
    pub(crate) check: bool,
    /// Wait until the mission has ended, showing its progress
    #[arg(long)]
    pub(crate) wait: bool,
    #[command(flatten)]
    pub(crate) connection: Connection,
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
        mission: MissionId,
    },
    /// Hold a mission: its robot brakes along the path and stands
    Pause {
        /// The mission
        mission: MissionId,
    },
    /// Let a paused mission go on
    Resume {
        /// The mission
        mission: MissionId,
    },
    /// Cancel a mission: its robot brakes along the path
    Cancel {
        /// The mission
        mission: MissionId,
    },
}

#[derive(Debug, Args)]
pub(crate) struct TerrainsArguments {
    #[command(flatten)]
    pub(crate) connection: Connection,
}

#[derive(Debug, Args)]
pub(crate) struct FrictionArguments {
    /// Show only this terrain
    #[arg(conflicts_with = "cells")]
    pub(crate) terrain: Option<TerrainId>,
    /// List cells instead of terrains
    #[arg(long)]
    pub(crate) cells: bool,
    #[command(flatten)]
    pub(crate) connection: Connection,
}

#[derive(Debug, Args)]
pub(crate) struct WatchArguments {
    /// Least time between two pictures
    #[arg(long, value_name = "TIME", default_value = "500ms", value_parser = look_interval)]
    pub(crate) every: Duration,
    /// Only this robot
    #[arg(long)]
    pub(crate) robot: Option<RobotId>,
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
        holder: HolderId,
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
    /// End a holder's limit
    End {
        /// Who limits
        holder: HolderId,
    },
}

#[derive(Debug, Args)]
pub(crate) struct GeofenceArguments {
    /// Replace it by this file: JSON `{"keep_in": [[{"x_m": …, "y_m": …}, …], …], "keep_out": […]}`
    #[arg(long, value_name = "FILE")]
    pub(crate) set: Option<PathBuf>,
    /// Only if it is still at this revision
    #[arg(long, requires = "set")]
    pub(crate) revision: Option<u64>,
    #[command(flatten)]
    pub(crate) connection: Connection,
}

#[derive(Debug, Args)]
pub(crate) struct DemoArguments {
    /// How many robots, out of the scenario
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..=DEMO_ROBOTS_MAX))]
    pub(crate) robots: u32,
    /// Scenario file instead of the one built in
    #[arg(long, value_name = "FILE")]
    pub(crate) scenario: Option<PathBuf>,
    /// End when all missions have ended, or after this time at the latest; else at Ctrl-C
    #[arg(long, value_name = "TIME", value_parser = duration)]
    pub(crate) exit_after: Option<Duration>,
    /// Print one JSON object at the end instead of progress and tables
    #[arg(long)]
    pub(crate) json: bool,
    /// Port of the REST API on loopback; the next free one if it is taken
    #[arg(long, default_value_t = 8420)]
    pub(crate) port: u16,
    /// Folder for the database, the agents' stores and the logs; a temporary one when absent
    #[arg(long, value_name = "DIR")]
    pub(crate) data_dir: Option<PathBuf>,
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    use super::*;

    #[test]
    fn the_command_line_has_no_contradictions() {
        Arguments::command().debug_assert();
    }

    #[test]
    fn negative_coordinates_are_values_wherever_options_stand() {
        for line in [
            "tread send circle --center -1.5,-2 --radius 3 --robot r",
            "tread send waypoints --robot r 0,0 -4,2.5",
            "tread send waypoints -4,2.5 0,0 --robot r --start-within 5s",
            "tread send circle --robot r --center 0,0 --radius 3 --speed -1",
            "tread missions show 0192f0c1-2b3c-7d4e-8f50-617283940a1b --json",
        ] {
            let words = line
                .split(' ')
                .map(OsString::from)
                .map(shield_negative_points);
            if let Err(refused) = Arguments::try_parse_from(words) {
                panic!("`{line}` was refused: {refused}");
            }
        }
    }
}
