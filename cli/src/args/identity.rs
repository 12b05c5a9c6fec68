//! Arguments of the commands about identities: tokens, sessions, authority, audit log and
//! enrolment.

use std::path::PathBuf;
use std::str::FromStr;
use std::time::Duration;

use clap::{Args, Subcommand};
use tread_agent::membership::Fingerprint;
use tread_api::enrolment::{JOIN_MINUTES_MAX, TrustId};
use tread_api::identity::{Role, TOKEN_DAYS_DEFAULT, TOKEN_DAYS_MAX};
use tread_api::ids::{JoinTokenId, RobotId, SessionId, Tag, TokenId};
use tread_api::rights::Right;

use super::Connection;
use super::durations::within;
use super::values::{JOIN_TOKENS, SESSIONS, TOKENS, identifier};
use crate::client::TrustAnchor;

/// Options for authentication and for the trust in the server.
#[derive(Debug, Clone, Default, Args)]
pub(crate) struct AuthenticationOptions {
    /// File with the token; if absent, `TREAD_TOKEN`, else the token that `tread login` stored for
    /// the server
    #[arg(long, global = true, value_name = "FILE")]
    pub(crate) token_file: Option<PathBuf>,
    /// PEM file with the certificate of the authority to trust, instead of those of the system
    #[arg(long, global = true, env = "TREAD_CA", value_name = "FILE")]
    pub(crate) ca: Option<PathBuf>,
    /// SHA-256 fingerprint of the certificate to trust instead of those of the system: the server's
    /// own, or its authority's if the server sends that too. `tread login` stores it for the
    /// server; `--ca` takes precedence
    #[arg(
        long,
        global = true,
        env = "TREAD_CA_FINGERPRINT",
        value_name = "SHA256"
    )]
    pub(crate) ca_fingerprint: Option<Fingerprint>,
}

impl AuthenticationOptions {
    /// Returns which certificates of a server to trust.
    pub(crate) fn trusted(&self, kept: Option<Fingerprint>) -> TrustAnchor<'_> {
        match (&self.ca, self.ca_fingerprint.or(kept)) {
            (Some(file), _) => TrustAnchor::Authority(file),
            (None, Some(fingerprint)) => TrustAnchor::Fingerprint(fingerprint),
            (None, None) => TrustAnchor::System,
        }
    }
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
    /// List tokens, newest first, including expired and revoked ones
    List,
    /// Create a token; its secret is printed only once
    Create {
        /// Name of the token, for people
        name: String,
        /// Role: viewer, operator or admin
        #[arg(long, required_unless_present = "rights", conflicts_with = "rights")]
        role: Option<Role>,
        /// Rights instead of a role, separated by commas: `stop`, `read`, `drive`, `clear_stop`,
        /// `hold`, `release_hold`, `dispatch`, `acknowledge`, `configure`, `administer`
        #[arg(long, value_name = "RIGHTS", value_delimiter = ',')]
        rights: Option<Vec<Right>>,
        /// Sites and robots for which the rights hold, each SITE or SITE/ROBOT, separated by
        /// commas; all if absent
        #[arg(long = "for", value_name = "PLACES", value_delimiter = ',')]
        places: Vec<String>,
        /// Validity, days
        #[arg(long, value_name = "DAYS", default_value_t = TOKEN_DAYS_DEFAULT,
            value_parser = clap::value_parser!(u32).range(1..=i64::from(TOKEN_DAYS_MAX)))]
        valid_days: u32,
    },
    /// Revoke a token: it is refused from now on, and its open connections are closed
    Revoke {
        /// Identifier of the token, as `tread tokens` lists it
        #[arg(value_parser = identifier::<TokenId>(TOKENS))]
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
    /// List sessions, newest first
    List,
    /// End sessions: they are refused from now on, and their open connections are closed
    End {
        /// Identifiers of the sessions, as `tread sessions` lists them
        #[arg(required = true, value_name = "SESSION", value_parser = identifier::<SessionId>(SESSIONS))]
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
    /// Show the authority that signs robots' certificates and, during a rotation, the robots that
    /// have not moved to it
    Status,
    /// Start a rotation: a new authority signs from now on, and both are trusted until it is
    /// finished
    Start,
    /// Finish a rotation by retiring the former authority; refused while robots hold its
    /// certificates
    Finish {
        /// Identifier of the rotation, as `start` and `status` show it
        #[arg(value_parser = rotation)]
        rotation: TrustId,
        /// Finish it although robots hold certificates of the former authority; they must join
        /// again
        #[arg(long)]
        force: bool,
    },
    /// Replace an authority whose key was stolen: all its certificates become invalid at once, and
    /// every robot must join again
    Replace {
        /// Skip the confirmation prompt
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
    /// Show only requests of the token or person with this name
    #[arg(long)]
    pub(crate) who: Option<String>,
    /// Show only requests that were refused or failed
    #[arg(long)]
    pub(crate) refused: bool,
    /// Maximum number of entries, newest first
    #[arg(long, default_value_t = 50, value_parser = clap::value_parser!(u32).range(1..=1000))]
    pub(crate) limit: u32,
    #[command(flatten)]
    pub(crate) connection: Connection,
}

#[derive(Debug, Subcommand)]
pub(crate) enum AuditAction {
    /// Write all entries as JSON Lines, the oldest first
    Export {
        /// New file to write to, readable by its owner only, instead of standard output
        #[arg(long, value_name = "FILE")]
        output: Option<PathBuf>,
        /// Write only entries with a number above this one
        #[arg(long, value_name = "NUMBER")]
        after: Option<u64>,
    },
    /// Verify the hash chain and report entries that were changed, removed or inserted
    Verify {
        /// Exported file to verify instead of the server's log
        file: Option<PathBuf>,
        /// Number and hash from an earlier `verify`; fails if that entry has changed since
        #[arg(long, value_name = "NUMBER:HASH")]
        noted: Option<RecordedEntry>,
    },
}

/// Number and hash of an entry that were recorded earlier.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct RecordedEntry {
    pub(crate) id: u64,
    pub(crate) hash: String,
}

impl FromStr for RecordedEntry {
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
    /// Create a join token, which is valid for one robot once; its secret is printed only once
    JoinToken(JoinTokenArguments),
    /// List all robots of the site that have ever joined, with their certificates
    Enrolments(PlainArguments),
    /// Change the name of a robot for people
    Rename(RenameArguments),
    /// Replace the tags of a robot, which group the robots of a fleet
    Tag(TagArguments),
    /// Retire a robot: its missions are cancelled, it gets no new ones and is not listed
    Retire(RobotArguments),
    /// Release robots after the server was restored from a backup: missions are sent to them again
    Release(ReleaseArguments),
    /// Restore a retired robot
    Restore(RobotArguments),
    /// Revoke a robot's enrolment; it can join again only with a join token that names it
    Revoke(RobotArguments),
}

impl RobotsAction {
    pub(crate) fn connection(&self) -> &Connection {
        match self {
            Self::JoinToken(arguments) => &arguments.connection,
            Self::Enrolments(arguments) => &arguments.connection,
            Self::Rename(arguments) => &arguments.connection,
            Self::Tag(arguments) => &arguments.connection,
            Self::Release(arguments) => &arguments.connection,
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
    /// Robot that the token is for; if absent, any robot that is new to the site
    #[arg(long, value_name = "ROBOT")]
    pub(crate) name: Option<RobotId>,
    /// Create a token for each robot, of all sites, that must join again because its authority was
    /// retired
    #[arg(long, conflicts_with = "name")]
    pub(crate) all: bool,
    /// Validity, such as `30m` or `1h`, at most one day
    #[arg(long, value_name = "TIME", default_value = "1h", value_parser = join_time)]
    pub(crate) expires: u32,
    #[command(flatten)]
    pub(crate) connection: Connection,
}

#[derive(Debug, Subcommand)]
pub(crate) enum JoinTokenAction {
    /// List join tokens, newest first, including used, expired and revoked ones
    List,
    /// Revoke a join token
    Revoke {
        /// Identifier of the join token, as `list` shows it
        #[arg(value_parser = identifier::<JoinTokenId>(JOIN_TOKENS))]
        join_token: JoinTokenId,
    },
}

#[derive(Debug, Args)]
pub(crate) struct RenameArguments {
    /// Robot to rename; its identifier does not change
    pub(crate) robot: RobotId,
    /// New name
    pub(crate) name: String,
    #[command(flatten)]
    pub(crate) connection: Connection,
}

#[derive(Debug, Args)]
pub(crate) struct TagArguments {
    /// Robot to tag
    pub(crate) robot: RobotId,
    /// All tags that it is to have: a-z, 0-9 and `-`
    #[arg(value_name = "TAG", required_unless_present = "none")]
    pub(crate) tags: Vec<Tag>,
    /// Remove all tags
    #[arg(long, conflicts_with = "tags")]
    pub(crate) none: bool,
    #[command(flatten)]
    pub(crate) connection: Connection,
}

#[derive(Debug, Args)]
pub(crate) struct ReleaseArguments {
    /// Robots to release
    #[arg(required_unless_present = "all", conflicts_with = "all")]
    pub(crate) robots: Vec<RobotId>,
    /// Release all robots of the site
    #[arg(long)]
    pub(crate) all: bool,
    #[command(flatten)]
    pub(crate) connection: Connection,
}

#[derive(Debug, Args)]
pub(crate) struct RobotArguments {
    /// Robot identifier
    pub(crate) robot: RobotId,
    #[command(flatten)]
    pub(crate) connection: Connection,
}

/// Parses a validity such as `1h` to minutes, rounded up.
fn join_time(text: &str) -> Result<u32, String> {
    let bounds = Duration::from_secs(1)..=Duration::from_mins(u64::from(JOIN_MINUTES_MAX));
    let time = within(text, &bounds)?;
    Ok(u32::try_from(time.as_secs().div_ceil(60)).unwrap_or(JOIN_MINUTES_MAX))
}
