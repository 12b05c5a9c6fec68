//! The server's program. Flags → logging → configuration → server → until a signal: see
//! [`tread_server::run`].

use std::process::ExitCode;

fn main() -> ExitCode {
    tread_server::run_from_args(std::env::args_os())
}
