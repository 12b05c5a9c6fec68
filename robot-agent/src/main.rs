//! `tread-agent`: see [`tread_agent::program`].

use std::process::ExitCode;

fn main() -> ExitCode {
    tread_agent::run_from_args(std::env::args_os())
}
