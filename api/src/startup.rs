//! Start of agent and server: gives zenoh more threads than its default.
//!
//! zenoh closes a TCP link with lingering: the closing thread blocks until the kernel has given up
//! sending the remaining data, for up to ten seconds on a dead link. By default zenoh has one
//! thread for sending and two for receiving, so that a peer which reconnects over a new link sends
//! nothing for seconds while the old link closes. With additional threads the new link does not
//! wait.

use std::io::{self, Error};
use std::os::unix::process::CommandExt as _;
use std::process::Command;

/// Environment variable from which zenoh reads its numbers of threads, once.
const VARIABLE: &str = "ZENOH_RUNTIME";
/// One thread more in each pool than links are expected to close at once.
const THREADS: &str =
    "(tx: (worker_threads: 4), rx: (worker_threads: 4), net: (worker_threads: 4))";

/// Replaces this process by the same program with more threads for zenoh, unless the environment
/// variable `ZENOH_RUNTIME` is set already; a process cannot safely change its own environment.
/// Call it at the beginning of `main`, since all state of the process is lost.
///
/// # Errors
/// The error of `exec` if the process cannot be replaced. The program works without it, but may
/// send nothing for seconds after a loss of the link.
pub fn give_zenoh_threads() -> io::Result<()> {
    if std::env::var_os(VARIABLE).is_some() {
        return Ok(());
    }
    let mut words = std::env::args_os();
    let mut same = Command::new(std::env::current_exe()?);
    if let Some(name) = words.next() {
        same.arg0(name);
    }
    let failed: Error = same.args(words).env(VARIABLE, THREADS).exec();
    Err(failed)
}
