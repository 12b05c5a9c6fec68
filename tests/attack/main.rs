//! `attack`: what anybody could send to a server, sent to one of our own.
//!
//! Each attack starts a server as a process of its own on the loopback, and is bounded in time and in
//! number. `README.md` beside this file lists them.

mod floods;
mod pace;
mod payloads;
mod requests;

use std::process::ExitCode;

use clap::{Parser, Subcommand};
use nix::sys::resource::{Resource, getrlimit, setrlimit};

/// Attacks a server of our own, on the loopback, and says whether it holds.
#[derive(Debug, Parser)]
#[command(name = "attack")]
struct Arguments {
    #[command(subcommand)]
    attack: Attack,
    /// Print one JSON object instead of a table
    #[arg(long, global = true)]
    json: bool,
}

#[derive(Debug, Subcommand)]
enum Attack {
    /// All floods at once, while honest people and robots work
    Floods(floods::Arguments),
    /// Requests from the description of the API, as it says and not, by everybody
    Requests(requests::Arguments),
    /// Damaged payloads of a robot with a certificate, and raw bytes at the robots' port
    Payloads(payloads::Arguments),
    /// The attackers' side of `floods`, which starts it as a process of its own
    #[command(hide = true)]
    Attackers(floods::attackers::Arguments),
}

/// Thousands of connections need as many files.
fn allow_files() -> anyhow::Result<()> {
    let (_, most) = getrlimit(Resource::RLIMIT_NOFILE)?;
    Ok(setrlimit(Resource::RLIMIT_NOFILE, most, most)?)
}

#[tokio::main]
async fn main() -> anyhow::Result<ExitCode> {
    let _ = rustls::crypto::ring::default_provider().install_default();
    allow_files()?;
    let Arguments { attack, json } = Arguments::parse();
    match attack {
        Attack::Floods(arguments) => floods::run(&arguments, json).await,
        Attack::Requests(arguments) => requests::run(&arguments, json).await,
        Attack::Payloads(arguments) => payloads::run(&arguments, json).await,
        Attack::Attackers(arguments) => floods::attackers::run(&arguments).await,
    }
}
