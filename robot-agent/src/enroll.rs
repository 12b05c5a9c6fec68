//! `tread-agent enroll`: a robot joins the fleet.

use std::io::Read as _;
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use clap::Args;
use tread_api::ids::RobotId;

use crate::clock::{Clock as _, SystemClock};
use crate::config::{Flags, place};
use crate::membership::{self, Enrolment, Fingerprint, Trust};

/// Largest join token that is read, bytes; longer ones are cut off.
const TOKEN_BYTES_MAX: u64 = 4 * 1024;

/// Arguments of `tread-agent enroll`.
#[derive(Debug, Clone, Args)]
pub(crate) struct EnrollArgs {
    /// Address of the server's REST API, such as <https://tread.example:8420>
    #[arg(long, value_name = "URL")]
    server: String,
    /// File with the join token, `-` for standard input; if absent, `TREAD_JOIN_TOKEN`. No flag
    /// takes the token itself, because every user of the machine can read command lines
    #[arg(long, value_name = "FILE")]
    token_file: Option<PathBuf>,
    /// PEM file with the certificate of the REST API's authority, instead of those of the system
    #[arg(long, value_name = "FILE", conflicts_with = "ca_fingerprint")]
    ca: Option<PathBuf>,
    /// SHA-256 of the REST API's own certificate, or of its authority's if the API sends that too
    #[arg(long, value_name = "SHA256")]
    ca_fingerprint: Option<Fingerprint>,
    /// Configuration file, for the robot's identifier and folder
    #[arg(long, env = "TREAD_AGENT_CONFIG")]
    config: Option<PathBuf>,
    /// Identifier of the robot; not needed if the token names it
    #[arg(long)]
    robot: Option<RobotId>,
    /// Folder of the robot, to which certificate and key are written
    #[arg(long)]
    data_dir: Option<PathBuf>,
    /// Endpoint for robots, such as `tls/tread.example:7447`, if not the one that the server names
    #[arg(long, value_name = "ENDPOINT")]
    endpoint: Option<String>,
}

/// Joins the fleet with a join token, stores certificate and key in the robot's folder, and prints
/// the robot and site to standard error.
///
/// # Errors
/// There is no token, the server cannot be reached or refuses it, or the folder cannot be written.
pub(crate) async fn run(args: EnrollArgs) -> anyhow::Result<()> {
    let place = place(&Flags {
        config: args.config,
        robot: args.robot,
        data_dir: args.data_dir,
        ..Flags::default()
    })?;
    let trust = match (args.ca, args.ca_fingerprint) {
        (Some(file), _) => Trust::Authority(read_text(&file)?),
        (None, Some(fingerprint)) => Trust::Fingerprint(fingerprint),
        (None, None) => Trust::Machine,
    };
    let enrolment = Enrolment {
        server: args.server,
        trust,
        token: join_token(args.token_file.as_deref())?,
        robot: place.robot,
        endpoint: args.endpoint,
    };
    let joined = membership::enrol(&enrolment, SystemClock::new().wall()).await?;
    joined.save(&place.data_dir)?;
    eprintln!(
        "`{}` has joined site `{}`; its certificate is valid for {} s and is renewed automatically",
        joined.robot, joined.site, joined.lifetime_s
    );
    Ok(())
}

fn read_text(file: &Path) -> anyhow::Result<String> {
    std::fs::read_to_string(file).with_context(|| format!("cannot read {}", file.display()))
}

fn join_token(file: Option<&Path>) -> anyhow::Result<String> {
    match file {
        Some(file) if file == Path::new("-") => {
            let mut token = String::new();
            let mut input = std::io::stdin().lock().take(TOKEN_BYTES_MAX);
            input.read_to_string(&mut token).context("no join token")?;
            Ok(token)
        }
        Some(file) => read_text(file),
        None => std::env::var("TREAD_JOIN_TOKEN")
            .context("give a join token by --token-file or TREAD_JOIN_TOKEN"),
    }
}
