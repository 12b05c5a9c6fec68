//! `tread`: the operator's command line, and the demo of a whole fleet.
//!
//! Every command except `demo`, `completions` and `man` uses the REST API of a running server and
//! nothing else. `demo` starts this executable as server and as agents, so that the demo consists
//! of the same processes as a fleet in the field, connected by zenoh.

mod args;
mod client;
mod commands;
mod credentials;
mod demo;
mod exit;
mod manual;
mod output;
mod signals;
mod socket;

use std::process::ExitCode;

use crate::args::{Arguments, Command};
use crate::output::Output;

fn main() -> ExitCode {
    // Fails only if a provider is installed already, which is not the case here.
    let _first = rustls::crypto::ring::default_provider().install_default();
    let words = std::env::args_os().map(args::protect_negative_points);
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
        Command::Completions { shell, program } => {
            ended(Output::new(false), manual::completions(shell, program))
        }
        Command::Man { dir, program } => {
            ended(Output::new(false), manual::man_pages(&dir, program))
        }
    }
}

/// Makes the kernel terminate this process when the demo that started it has ended, in whatever
/// way.
fn die_with_the_demo() {
    // Where the kernel does not support it, the processes of a killed demo keep running.
    #[cfg(target_os = "linux")]
    let _unsupported = nix::sys::prctl::set_pdeathsig(nix::sys::signal::Signal::SIGTERM);
}

/// Runs a command to its end; prints an error and converts it to an exit code.
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
