//! `tread`: the operator's command line, and a whole fleet in one command.
//!
//! Everything but `demo` speaks REST to a running server and knows nothing else of it. `demo`
//! starts this executable again as server and as agents, so that what runs is what would run in
//! the field: separate processes that speak zenoh.

mod args;
mod client;
mod commands;
mod demo;
mod output;

use std::process::ExitCode;

use clap::Parser;

use crate::args::{Arguments, Command};

fn main() -> ExitCode {
    match Arguments::parse().command {
        Command::Server(arguments) => {
            tread_server::run_from_args(arguments.for_program("tread-server"))
        }
        Command::Agent(arguments) => {
            tread_agent::run_from_args(arguments.for_program("tread-agent"))
        }
        Command::Demo(arguments) => finish(demo::run(arguments)),
        Command::Remote(command) => finish(commands::run(command)),
    }
}

/// Runs a command to its end and turns what went wrong into a sentence and an exit code.
fn finish(command: impl Future<Output = anyhow::Result<ExitCode>>) -> ExitCode {
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build();
    let outcome = match runtime {
        Ok(runtime) => runtime.block_on(command),
        Err(error) => Err(error.into()),
    };
    outcome.unwrap_or_else(|error| output::report(&error))
}
