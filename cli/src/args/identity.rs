//! The words of the commands about tokens, and about who is of the fleet.

use std::path::PathBuf;
use std::str::FromStr;

use clap::{Args, Subcommand};
use tread_api::enrolment::{JOIN_MINUTES_MAX, TrustId};
use tread_api::identity::{Role, TOKEN_DAYS_DEFAULT, TOKEN_DAYS_MAX};
use tread_api::ids::{JoinTokenId, RobotId, SessionId, TokenId};
use tread_api::rights::Right;

use super::{Connection, duration};

/// How to show who asks, and whom to trust.
#[derive(Debug, Clone, Default, Args)]
pub(crate) struct Showing {
    /// File with the token; else `TREAD_TOKEN`, else what `tread login` keeps for the server
    #[arg(long, global = true, value_name = "FILE")]
    pub(crate) token_file: Option<PathBuf>,
    /// Certificate of the authority to trust, PEM, instead of the machine's
    #[arg(long, global = true, env = "TREAD_CA", value_name = "FILE")]
    pub(crate) ca: Option<PathBuf>,
}

#[derive(Debug, Args)]
pub(crate) struct PlainArguments {
    #[command(flatten)]
    pub(crate) connection: Connection,
}

#[derive(Debug, Args)]
pub(crate) struct TokensArguments {
    #[command(subcommand)]
    pub(crate) action: Option<TokensAction>,
    #[command(flatten)]
    pub(crate) connection: Connection,
}

#[derive(Debug, Subcommand)]
pub(crate) enum TokensAction {
    /// List tokens, newest first, dead ones too
    List,
    /// Make a token; it is printed this once
    Create {
        /// What people call it
        name: String,
        /// What it may do: viewer, operator or admin
        #[arg(long, required_unless_present = "rights", conflicts_with = "rights")]
        role: Option<Role>,
        /// What it may do, in place of a role, with commas: `stop`, `read`, `drive`, `clear_stop`,
        /// `hold`, `release_hold`, `dispatch`, `acknowledge`, `configure`, `administer`
        #[arg(long, value_name = "RIGHTS", value_delimiter = ',')]
        rights: Option<Vec<Right>>,
        /// Where it may do that, with commas, each SITE or SITE/ROBOT; everywhere without it
        #[arg(long = "for", value_name = "PLACES", value_delimiter = ',')]
        places: Vec<String>,
        /// Days until it is refused
        #[arg(long, value_name = "DAYS", default_value_t = TOKEN_DAYS_DEFAULT,
            value_parser = clap::value_parser!(u32).range(1..=i64::from(TOKEN_DAYS_MAX)))]
        valid_days: u32,
    },
    /// Revoke a token: it is refused from now on, and what it has open closes
    Revoke {
        /// The token's identifier, as `tread tokens` lists it
        token: TokenId,
    },
}

#[derive(Debug, Args)]
pub(crate) struct SessionsArguments {
    #[command(subcommand)]
    pub(crate) action: Option<SessionsAction>,
    #[command(flatten)]
    pub(crate) connection: Connection,
}

#[derive(Debug, Subcommand)]
pub(crate) enum SessionsAction {
    /// List who is signed in at the provider, newest first
    List,
    /// End sessions: they are refused from now on, and what they have open closes
    End {
        /// The sessions' identifiers, as `tread sessions` lists them
        #[arg(required = true, value_name = "SESSION")]
        sessions: Vec<SessionId>,
    },
}

#[derive(Debug, Args)]
pub(crate) struct AuthorityArguments {
    #[command(subcommand)]
    pub(crate) action: Option<AuthorityAction>,
    #[command(flatten)]
    pub(crate) connection: Connection,
}

#[derive(Debug, Subcommand)]
pub(crate) enum AuthorityAction {
    /// Show who signs robots' certificates and, during a rotation, which robots are left
    Status,
    /// Start a rotation: another authority signs from now on, and both are trusted until it is finished
    Start,
    /// Finish a rotation: the former authority is retired; refused while robots are left
    Finish {
        /// The rotation, as `start` and `status` show it
        #[arg(value_parser = rotation)]
        rotation: TrustId,
        /// Finish it though robots are left; each of them must join again
        #[arg(long)]
        force: bool,
    },
    /// Replace an authority whose key was stolen: nothing that it has signed counts any more, and every
    /// robot must join again
    Replace {
        /// Do not ask
        #[arg(long)]
        yes: bool,
    },
}

fn rotation(text: &str) -> Result<TrustId, String> {
    let wrong = |_| "a rotation is 16 hexadecimal digits, as `tread authority` shows it".to_owned();
    text.parse().map_err(wrong)
}

#[derive(Debug, Args)]
#[command(args_conflicts_with_subcommands = true)]
pub(crate) struct AuditArguments {
    #[command(subcommand)]
    pub(crate) action: Option<AuditAction>,
    /// Only what was asked with the token, or by the person, of this name
    #[arg(long)]
    pub(crate) who: Option<String>,
    /// Only what was refused or failed
    #[arg(long)]
    pub(crate) refused: bool,
    /// At most so many, newest first
    #[arg(long, default_value_t = 50, value_parser = clap::value_parser!(u32).range(1..=1000))]
    pub(crate) limit: u32,
    #[command(flatten)]
    pub(crate) connection: Connection,
}

#[derive(Debug, Subcommand)]
pub(crate) enum AuditAction {
    /// Write all entries as JSON Lines, the oldest first
    Export {
        /// Write them into this new file, which only its owner can read, instead of printing them
        #[arg(long, value_name = "FILE")]
        output: Option<PathBuf>,
        /// Only those after the entry of this number
        #[arg(long, value_name = "NUMBER")]
        after: Option<u64>,
    },
    /// Compute the hashes of all entries here, and say which was changed, removed or put in between
    Verify {
        /// Verify what was exported into this file instead of asking the server
        file: Option<PathBuf>,
        /// Number and hash that an earlier `verify` printed: the entry must still be the same
        #[arg(long, value_name = "NUMBER:HASH")]
        noted: Option<Noted>,
    },
}

/// An entry of the audit log that was noted before.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Noted {
    pub(crate) id: u64,
    pub(crate) hash: String,
}

impl FromStr for Noted {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let wrong = || "write number and hash with a colon between them".to_owned();
        let (id, hash) = text.split_once(':').ok_or_else(wrong)?;
        let is_hash = hash.len() == 64 && hash.bytes().all(|byte| byte.is_ascii_hexdigit());
        let id = id.parse().map_err(|_error| wrong())?;
        if !is_hash {
            return Err(wrong());
        }
        let hash = hash.to_ascii_lowercase();
        Ok(Self { id, hash })
    }
}

#[derive(Debug, Subcommand)]
pub(crate) enum RobotsAction {
    /// Make a token by which one robot may join once; it is printed this once
    JoinToken(JoinTokenArguments),
    /// List how each robot of the site stands that has ever joined
    Enrolments(PlainArguments),
    /// Give a robot another name for people
    Rename(RenameArguments),
    /// Retire a robot: its missions are cancelled, it gets no more and is not listed
    Retire(RobotArguments),
    /// Take a retired robot back
    Restore(RobotArguments),
    /// Put a robot out of the fleet; it comes back only by a join token that names it
    Revoke(RobotArguments),
}

impl RobotsAction {
    pub(crate) fn connection(&self) -> &Connection {
        match self {
            Self::JoinToken(arguments) => &arguments.connection,
            Self::Enrolments(arguments) => &arguments.connection,
            Self::Rename(arguments) => &arguments.connection,
            Self::Retire(arguments) | Self::Restore(arguments) | Self::Revoke(arguments) => {
                &arguments.connection
            }
        }
    }
}

#[derive(Debug, Args)]
#[command(args_conflicts_with_subcommands = true)]
pub(crate) struct JoinTokenArguments {
    #[command(subcommand)]
    pub(crate) action: Option<JoinTokenAction>,
    /// The robot that it is for; without it any may join that is new to the site
    #[arg(long, value_name = "ROBOT")]
    pub(crate) name: Option<RobotId>,
    /// One for each robot of all sites that must join again because its authority was retired
    #[arg(long, conflicts_with = "name")]
    pub(crate) all: bool,
    /// How long it may be used, such as `30m` or `1h`, at most a day
    #[arg(long, value_name = "TIME", default_value = "1h", value_parser = join_time)]
    pub(crate) expires: u32,
    #[command(flatten)]
    pub(crate) connection: Connection,
}

#[derive(Debug, Subcommand)]
pub(crate) enum JoinTokenAction {
    /// List join tokens, newest first, dead ones too
    List,
    /// Revoke a join token
    Revoke {
        /// The join token's identifier, as `list` shows it
        join_token: JoinTokenId,
    },
}

#[derive(Debug, Args)]
pub(crate) struct RenameArguments {
    /// The robot; its identifier stays
    pub(crate) robot: RobotId,
    /// Its name
    pub(crate) name: String,
    #[command(flatten)]
    pub(crate) connection: Connection,
}

#[derive(Debug, Args)]
pub(crate) struct RobotArguments {
    /// The robot
    pub(crate) robot: RobotId,
    #[command(flatten)]
    pub(crate) connection: Connection,
}

/// Whole minutes out of a time such as `1h`.
fn join_time(text: &str) -> Result<u32, String> {
    let time = duration(text)?;
    let minutes = u32::try_from(time.as_secs().div_ceil(60)).unwrap_or(u32::MAX);
    if (1..=JOIN_MINUTES_MAX).contains(&minutes) {
        Ok(minutes)
    } else {
        Err("it must be a minute to a day".to_owned())
    }
}
