//! Commands and arguments of the command line.

#[cfg(test)]
mod documented;
mod durations;
mod examples;
mod identity;
mod leading;
mod map;
mod mission_name;
mod missions;
mod safety;
mod values;
mod webhooks;

use std::ffi::OsString;
use std::path::PathBuf;
use std::time::Duration;

use clap::{
    ArgMatches, Args, CommandFactory as _, FromArgMatches as _, Parser, Subcommand, ValueEnum,
};
use clap_complete::Shell;
use tread_api::ids::{RobotId, SiteId};
use tread_server::config::SITE_DEFAULT;

pub(crate) use self::durations::format_duration;
use self::durations::wait_time;
use self::identity::AuthenticationOptions;
pub(crate) use self::identity::{
    AuditAction, AuditArguments, AuthorityAction, AuthorityArguments, JoinTokenAction,
    JoinTokenArguments, PlainArguments, RecordedEntry, ReleaseArguments, RobotArguments,
    RobotsAction, SessionsAction, SessionsArguments, TokensAction, TokensArguments,
};
pub(crate) use self::map::{
    FrictionAction, FrictionArguments, HistoryArguments, SitesAction, SitesArguments,
    TerrainsAction, TerrainsArguments,
};
pub(crate) use self::mission_name::MissionName;
pub(crate) use self::missions::{
    MissionOptions, MissionsAction, MissionsArguments, SendArguments, SendCircle, SendTrajectory,
    SendWaypoints,
};
pub(crate) use self::safety::{
    AlertsAction, AlertsArguments, ClearArguments, DriveArguments, GeofenceArguments, LimitsAction,
    LimitsArguments, StopArguments, StopsArguments, WatchArguments,
};
pub(crate) use self::values::{HistoryPlace, protect_negative_points, waypoint};
pub(crate) use self::webhooks::{NamedWebhook, WebhooksAction, WebhooksArguments};
use crate::credentials;
use crate::exit::Exit;
use crate::output::{failure, print_note};

/// Address of the server if neither a flag nor a login names one.
pub(crate) const SERVER_DEFAULT: &str = "http://127.0.0.1:8420";
/// Maximum number of robots of a demo; each is a separate process.
const DEMO_ROBOTS_MAX: i64 = 50;

/// Runs fleets of skid-steered robots and maps the friction of the ground while they drive.
///
/// Give `--server`, `--site`, `--token-file`, `--ca` and `--json` before or after the command.
#[derive(Debug, Parser)]
#[command(name = "tread", version = tread_api::release::long_version())]
pub(crate) struct Arguments {
    #[command(subcommand)]
    pub(crate) command: Command,
}

impl Arguments {
    /// Returns the command line with the examples in its help texts.
    pub(crate) fn whole() -> clap::Command {
        examples::with_examples(Self::command())
    }

    /// Parses the arguments. On an error, prints it and exits the process.
    pub(crate) fn read(words: impl Iterator<Item = OsString>) -> Self {
        let whole = Self::whole();
        let words = leading::options_after_command(words.collect(), &whole);
        let is_for_programs = words.iter().any(|word| word == "--json");
        let read = whole
            .try_get_matches_from(words)
            .and_then(|matches: ArgMatches| Self::from_arg_matches(&matches));
        read.unwrap_or_else(|error| {
            // Help and version are not errors and are printed as usual.
            if is_for_programs && error.use_stderr() {
                refuse_for_programs(&error);
            }
            error.exit()
        })
    }
}

/// Prints a usage error as one JSON object, in the format of all other errors, and exits.
fn refuse_for_programs(error: &clap::Error) -> ! {
    let text = error.to_string();
    // Tips and usage follow after an empty line.
    let first = text
        .lines()
        .map(str::trim)
        .take_while(|line| !line.is_empty());
    let message = first.collect::<Vec<_>>().join(" ");
    let message = message.strip_prefix("error: ").unwrap_or(&message);
    let next_step = "see the same command with --help for its arguments";
    print_note(&failure(message, Exit::Usage, Some(next_step), None).to_string());
    std::process::exit(error.exit_code())
}

#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    /// Start a whole fleet on this machine: server, database, router and simulated robots with
    /// missions
    Demo(DemoArguments),
    #[command(flatten)]
    Remote(RemoteCommand),
    /// Print the completion script of a shell
    Completions {
        /// Shell to print the script for
        shell: Shell,
        /// Program to print the script for
        #[arg(long, value_enum, default_value_t)]
        program: Program,
    },
    /// Write the manual as man pages, one for each command
    Man {
        /// Folder to write them to; created if it does not exist
        #[arg(long, value_name = "DIR")]
        dir: PathBuf,
        /// Program to write the manual of
        #[arg(long, value_enum, default_value_t)]
        program: Program,
    },
    /// Run the server; used by `tread demo`
    #[command(hide = true, disable_help_flag = true)]
    Server(ForwardedArguments),
    /// Run an agent; used by `tread demo`
    #[command(hide = true, disable_help_flag = true)]
    Agent(ForwardedArguments),
}

/// A program whose command line is documented.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, ValueEnum)]
pub(crate) enum Program {
    /// This one
    #[default]
    Tread,
    /// The server
    TreadServer,
    /// The agent on a robot
    TreadAgent,
}

/// Arguments that are passed on to another program.
#[derive(Debug, Args)]
pub(crate) struct ForwardedArguments {
    #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
    rest: Vec<OsString>,
}

impl ForwardedArguments {
    /// Returns the arguments in the form in which `program` receives them, its name first.
    pub(crate) fn for_program(self, program: &str) -> Vec<OsString> {
        std::iter::once(program.into()).chain(self.rest).collect()
    }
}

/// Commands that connect to a running server.
#[derive(Debug, Subcommand)]
pub(crate) enum RemoteCommand {
    /// Show version, uptime and counters of the server
    Status(PlainArguments),
    /// Check the server, the token, clocks, robots and their links, and print what is wrong; exits
    /// with 1 if anything is
    Doctor(PlainArguments),
    /// List sites, create one, or set its position in WGS 84
    Sites(SitesArguments),
    /// List the robots of a site, or show, rename, retire, enrol or revoke one
    Robots(Box<RobotsArguments>),
    /// Send a robot on a circle or through waypoints, or check such a trajectory without driving it
    Send(Box<SendArguments>),
    /// List missions, show, pause, resume or cancel one, or wait for some
    Missions(MissionsArguments),
    /// List the terrains of a site, or show, create, change or delete one
    Terrains(TerrainsArguments),
    /// Show the friction of a site's ground and its uncertainty
    Friction(Box<FrictionArguments>),
    /// Stop robots at once and latch the stop; exits with 1 while a robot has not confirmed it
    Stop(StopArguments),
    /// List stops with their confirmation and clearing
    Stops(StopsArguments),
    /// Clear the stop of a robot at rest; the robot does not start to move by itself
    Clear(ClearArguments),
    /// List alerts, or acknowledge one
    Alerts(AlertsArguments),
    /// List the webhooks to which alerts are sent, or add, test or remove one
    Webhooks(WebhooksArguments),
    /// Teleoperate a robot from this terminal
    Drive(DriveArguments),
    /// List the leases of teleoperation: who drives which robot
    Leases(PlainArguments),
    /// List, set or end the limits by which other programs hold or slow a robot
    Limits(LimitsArguments),
    /// Show or replace the geofence of a site
    Geofence(GeofenceArguments),
    /// Show robots, missions and alerts live, until interrupted
    Watch(WatchArguments),
    /// Sign in to a server: read a token from standard input or `--token-file` and store it
    Login(PlainArguments),
    /// Delete the stored token of a server; the token stays valid
    Logout(PlainArguments),
    /// Show name, rights and expiry of the token in use
    Whoami(PlainArguments),
    /// Print the token in use, for other programs such as curl
    Token(PlainArguments),
    /// List, create or revoke tokens
    Tokens(TokensArguments),
    /// List or end the sessions of people who signed in at the OpenID provider
    Sessions(SessionsArguments),
    /// Show, rotate or replace the fleet's certificate authority
    Authority(AuthorityArguments),
    /// Show, export or verify the audit log: changes and refused requests
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
            | Self::Doctor(arguments)
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
            Self::Webhooks(arguments) => &arguments.connection,
            Self::Drive(arguments) => &arguments.connection,
            Self::Limits(arguments) => &arguments.connection,
            Self::Geofence(arguments) => &arguments.connection,
        }
    }
}

/// Options for the connection to the server, and for the format of the output.
#[derive(Debug, Clone, Args)]
pub(crate) struct Connection {
    /// Address of the server; if absent, that of the last `tread login`, else of this machine, port
    /// 8420
    #[arg(long, global = true, env = "TREAD_SERVER", value_name = "URL")]
    pub(crate) server: Option<String>,
    #[command(flatten)]
    pub(crate) authentication: AuthenticationOptions,
    /// Site to use
    #[arg(long, global = true, env = "TREAD_SITE", default_value = SITE_DEFAULT)]
    pub(crate) site: SiteId,
    /// Print JSON instead of tables
    #[arg(long, global = true)]
    pub(crate) json: bool,
}

impl Connection {
    /// Returns the address of the server: the given one, else that of the last `tread login`, else
    /// the built-in one.
    ///
    /// # Errors
    /// The file of the last login cannot be read.
    pub(crate) fn server(&self) -> anyhow::Result<String> {
        if let Some(given) = &self.server {
            return Ok(given.clone());
        }
        let kept = credentials::last_server()?;
        Ok(kept.unwrap_or_else(|| SERVER_DEFAULT.to_owned()))
    }
}

#[derive(Debug, Args)]
#[command(args_conflicts_with_subcommands = true)]
pub(crate) struct RobotsArguments {
    #[command(subcommand)]
    pub(crate) action: Option<RobotsAction>,
    /// Show only this robot, with the age of every value
    pub(crate) robot: Option<RobotId>,
    /// Include retired robots
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
    /// Number of robots, taken from the scenario
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..=DEMO_ROBOTS_MAX))]
    pub(crate) robots: u32,
    /// Scenario file to use instead of the built-in one
    #[arg(long, value_name = "FILE")]
    pub(crate) scenario: Option<PathBuf>,
    /// End when all missions have ended, or after this time at the latest; if absent, run until
    /// Ctrl-C, which prints the results so far
    #[arg(long, value_name = "TIME", value_parser = wait_time)]
    pub(crate) exit_after: Option<Duration>,
    /// Print one JSON object at the end instead of progress and tables
    #[arg(long)]
    pub(crate) json: bool,
    /// Port of the REST API on the loopback interface; if it is in use, the next free one
    #[arg(long, default_value_t = 8420)]
    pub(crate) port: u16,
    /// Folder for database, outboxes and logs; a temporary one if absent
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
    fn a_time_of_zero_and_an_unknown_identifier_are_refused_in_words() {
        for (line, said) in [
            ("demo --exit-after 0s", "give a time from 1ms"),
            ("missions wait 0a1b --timeout 0s", "give a time from 1ms"),
            (
                "send waypoints --robot r --wait --timeout 0ms 0,0 4,2",
                "give a time from 1ms",
            ),
            (
                "send waypoints --robot r --start-within 0h 0,0 4,2",
                "give a time from 1ms",
            ),
            (
                "send waypoints --robot r --stop-after-silence 0s 0,0 4,2",
                "give a time from 1s to 24h",
            ),
            (
                "send waypoints --robot r --lost-after 0s 0,0 4,2",
                "give a time from 1s to 24h",
            ),
            (
                "limits rover-1 set lidar --hold --for 0s",
                "give a time from 1ms to 1h",
            ),
            ("friction history lawn --step 0s", "give a time from 1m"),
            ("watch --every 0s", "give a time from 100ms to 1h"),
            (
                "robots join-token --expires 0s",
                "give a time from 1s to 24h",
            ),
            ("tokens revoke nope", "`tread tokens` lists them"),
            (
                "robots join-token revoke nope",
                "`tread robots join-token list` lists them",
            ),
            ("sessions end nope", "`tread sessions` lists them"),
            ("alerts acknowledge nope", "`tread alerts` lists them"),
            ("clear rover-1 nope", "`tread stops` lists them"),
        ] {
            let words = std::iter::once("tread").chain(line.split(' '));
            let refused = Arguments::try_parse_from(words).unwrap_err().to_string();
            assert!(refused.contains(said), "`{line}`: {refused}");
        }
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
                .map(protect_negative_points);
            if let Err(refused) = Arguments::try_parse_from(words) {
                panic!("`{line}` was refused: {refused}");
            }
        }
    }
}
