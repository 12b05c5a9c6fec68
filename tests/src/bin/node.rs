//! The server or an agent as a process of its own, for tests: `node server …`, `node agent …`; and, to
//! compare with, a zenoh router without a server: `node router …`.

use std::ffi::OsString;
use std::process::ExitCode;

fn main() -> ExitCode {
    // What is left starts with the role, where a program expects its name.
    let arguments: Vec<OsString> = std::env::args_os().skip(1).collect();
    match arguments.first().and_then(|role| role.to_str()) {
        Some("server") => tread_server::run_from_args(arguments),
        Some("agent") => tread_agent::run_from_args(arguments),
        Some("router") => tread_tests::bare_router::run_from_args(arguments),
        _ => ExitCode::from(2),
    }
}
