//! The words of the command line.

#[cfg(test)]
mod documented;
mod examples;
mod identity;
mod map;
mod missions;
mod safety;
mod values;

use std::ffi::OsString;
use std::path::PathBuf;
use std::time::Duration;

use clap::{ArgMatches, Args, CommandFactory as _, FromArgMatches as _, Parser, Subcommand};
use clap_complete::Shell;
use tread_api::ids::{RobotId, SiteId};
use tread_server::config::SITE_DEFAULT;

use self::identity::Showing;
pub(crate) use self::identity::{
    AuditAction, AuditArguments, AuthorityAction, AuthorityArguments, JoinTokenAction,
    JoinTokenArguments, Noted, PlainArguments, RobotArguments, RobotsAction, SessionsAction,
    SessionsArguments, TokensAction, TokensArguments,
};
pub(crate) use self::map::{
    FrictionAction, FrictionArguments, SitesAction, SitesArguments, TerrainsAction,
    TerrainsArguments,
};
pub(crate) use self::missions::{
    MissionsAction, MissionsArguments, Order, SendArguments, SendCircle, SendTrajectory,
    SendWaypoints,
};
pub(crate) use self::safety::{
    AlertsAction, AlertsArguments, ClearArguments, DriveArguments, GeofenceArguments, LimitsAction,
    LimitsArguments, StopArguments, StopsArguments, WatchArguments,
};
use self::values::duration;
pub(crate) use self::values::{shield_negative_points, waypoint};
use crate::exit::Exit;
use crate::output::{failure, note};

/// Where a server answers, unless configured otherwise.
pub(crate) const SERVER_DEFAULT: &str = "http://127.0.0.1:8420";
/// Most robots of a demo; each is a process of its own.
const DEMO_ROBOTS_MAX: i64 = 50;

/// Runs fleets of skid-steered robots and maps the friction of the ground while they drive.
#[derive(Debug, Parser)]
#[command(name = "tread", version)]
pub(crate) struct Arguments {
    #[command(subcommand)]
    pub(crate) command: Command,
}

impl Arguments {
    /// The command line with its examples.
    pub(crate) fn whole() -> clap::Command {
        examples::with_examples(Self::command())
    }

    /// Reads the words; says what is wrong with them and ends the process otherwise.
    pub(crate) fn read(words: impl Iterator<Item = OsString>) -> Self {
        let words: Vec<OsString> = words.collect();
        let is_for_programs = words.iter().any(|word| word == "--json");
        let read = Self::whole()
            .try_get_matches_from(words)
            .and_then(|matches: ArgMatches| Self::from_arg_matches(&matches));
        read.unwrap_or_else(|error| {
            // Help and version are no errors, and go where they always go.
            if is_for_programs && error.use_stderr() {
                refuse_for_programs(&error);
            }
            error.exit()
        })
    }
}

/// Says what is wrong with the words as one JSON object, as is done with all else that goes wrong.
fn refuse_for_programs(error: &clap::Error) -> ! {
    let text = error.to_string();
    // Tips and usage come after an empty line.
    let first = text
        .lines()
        .map(str::trim)
        .take_while(|line| !line.is_empty());
    let said = first.collect::<Vec<_>>().join(" ");
    let said = said.strip_prefix("error: ").unwrap_or(&said);
    let next_step = "the same command with --help says what it takes";
    note(&failure(said, Exit::Usage, Some(next_step), None).to_string());
    std::process::exit(error.exit_code())
}

#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    /// Start a whole fleet here: server, database, router and simulated robots on missions
    Demo(DemoArguments),
    #[command(flatten)]
    Remote(RemoteCommand),
    /// Print what a shell needs to complete these words
    Completions {
        /// The shell
        shell: Shell,
    },
    /// Write the manual as man pages, one for each command
    Man {
        /// Folder to write them to; it is made when it is not there
        #[arg(long, value_name = "DIR")]
        dir: PathBuf,
    },
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
    /// Show version, uptime and counters of the server
    Status(PlainArguments),
    /// List sites, or make one
    Sites(SitesArguments),
    /// List the robots of a site, show, rename or retire one, let one join, or put one out
    Robots(Box<RobotsArguments>),
    /// Send a robot on a circle or through waypoints, or see what it would ask of the robot
    Send(Box<SendArguments>),
    /// List missions, show one, wait for some, pause, resume or cancel one
    Missions(MissionsArguments),
    /// List the terrains of a site, draw, change or delete one
    Terrains(TerrainsArguments),
    /// Show what is known of the friction of a site's ground
    Friction(Box<FrictionArguments>),
    /// Stop robots at once, and latch it; exits with 1 while one has not confirmed
    Stop(StopArguments),
    /// List stops with their confirmation and their clearing
    Stops(StopsArguments),
    /// Clear a robot's stop, when it stands; nothing starts by it
    Clear(ClearArguments),
    /// List alerts, or note that one was seen
    Alerts(AlertsArguments),
    /// Teleoperate a robot, in this terminal
    Drive(DriveArguments),
    /// List who teleoperates which robot
    Leases(PlainArguments),
    /// List, set or end what other programs hold or slow a robot by
    Limits(LimitsArguments),
    /// Show or replace where the robots of a site may be
    Geofence(GeofenceArguments),
    /// Show robots, missions and alerts as they change, until interrupted
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
    /// List sessions of people who signed in at the provider, or end some
    Sessions(SessionsArguments),
    /// Show the fleet's authority, or rotate it: start, status and finish
    Authority(AuthorityArguments),
    /// Show, export or verify who changed what, and who was refused
    Audit(AuditArguments),
}

impl RemoteCommand {
    pub(crate) fn connection(&self) -> &Connection {
        match self {
            Self::Sites(arguments) => &arguments.connection,
            Self::Robots(arguments) => arguments.connection(),
            Self::Send(arguments) => arguments.connection(),
            Self::Missions(arguments) => &arguments.connection,
            Self::Terrains(arguments) => &arguments.connection,
            Self::Friction(arguments) => &arguments.connection,
            Self::Watch(arguments) => &arguments.connection,
            Self::Status(arguments)
            | Self::Leases(arguments)
            | Self::Login(arguments)
            | Self::Logout(arguments)
            | Self::Whoami(arguments)
            | Self::Token(arguments) => &arguments.connection,
            Self::Tokens(arguments) => &arguments.connection,
            Self::Sessions(arguments) => &arguments.connection,
            Self::Authority(arguments) => &arguments.connection,
            Self::Audit(arguments) => &arguments.connection,
            Self::Stop(arguments) => &arguments.connection,
            Self::Stops(arguments) => &arguments.connection,
            Self::Clear(arguments) => &arguments.connection,
            Self::Alerts(arguments) => &arguments.connection,
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
    /// List retired ones too
    #[arg(long, conflicts_with = "robot")]
    pub(crate) retired: bool,
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
    use super::*;

    #[test]
    fn the_command_line_has_no_contradictions() {
        Arguments::whole().debug_assert();
    }

    #[test]
    fn negative_coordinates_are_values_wherever_options_stand() {
        for line in [
            "tread send circle --center -1.5,-2 --radius 3 --robot r",
            "tread send waypoints --robot r 0,0 -4,2.5",
            "tread send waypoints -4,2.5 0,0 --robot r --start-within 5s",
            "tread send circle --robot r --center 0,0 --radius 3 --speed -1",
            "tread friction cells --box -4,-4,8,8",
            "tread friction point -1,-2 --as-of 2h",
            "tread terrains change sand -1,-1 4,-1 4,4 --layer -2",
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
