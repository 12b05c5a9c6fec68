//! The program `tread-server`; see [`tread_server::run_from_args`].

use std::process::ExitCode;

fn main() -> ExitCode {
    tread_server::run_from_args(std::env::args_os())
}
