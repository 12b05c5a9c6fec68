//! `tread`: the operator's command line, and a whole fleet in one command.
//!
//! Everything but `demo` speaks REST to a running server and knows nothing else of it. `demo`
//! starts this executable again as server and as agents, so that what runs is what would run in
//! the field: separate processes that speak zenoh.

mod args;
mod client;
mod commands;
mod credentials;
mod demo;
mod exit;
mod manual;
mod output;
mod socket;

use std::process::ExitCode;

use crate::args::{Arguments, Command};
use crate::output::Output;

fn main() -> ExitCode {
    // The first call counts, and there is no other.
    let _first = rustls::crypto::ring::default_provider().install_default();
    let words = std::env::args_os().map(args::shield_negative_points);
    match Arguments::read(words).command {
        Command::Server(arguments) => {
            die_with_the_demo();
            tread_server::run_from_args(arguments.for_program("tread-server"))
        }
        Command::Agent(arguments) => {
            die_with_the_demo();
            tread_agent::run_from_args(arguments.for_program("tread-agent"))
        }
        Command::Demo(arguments) => {
            let output = Output::new(arguments.json);
            finish(output, demo::run(arguments))
        }
        Command::Remote(command) => {
            let output = Output::new(command.connection().json);
            finish(output, commands::run(command, output))
        }
        Command::Completions { shell } => ended(Output::new(false), manual::completions(shell)),
        Command::Man { dir } => ended(Output::new(false), manual::man_pages(&dir)),
    }
}

/// Asks the kernel to end this process when the demo that started it is gone, however it ended.
fn die_with_the_demo() {
    // Where the kernel cannot, a demo that is killed leaves its parts behind.
    #[cfg(target_os = "linux")]
    let _unsupported = nix::sys::prctl::set_pdeathsig(nix::sys::signal::Signal::SIGTERM);
}

/// Runs a command to its end and turns what went wrong into a sentence and an exit code.
fn finish(output: Output, command: impl Future<Output = anyhow::Result<ExitCode>>) -> ExitCode {
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build();
    let outcome = match runtime {
        Ok(runtime) => runtime.block_on(command),
        Err(error) => Err(error.into()),
    };
    ended(output, outcome)
}

fn ended(output: Output, outcome: anyhow::Result<ExitCode>) -> ExitCode {
    outcome.unwrap_or_else(|error| output.report(&error))
}
