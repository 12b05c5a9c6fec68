//! What agent and server do before anything else: give zenoh more threads than it takes by itself.
//!
//! zenoh closes a TCP link lingering: the thread that closes one over which nothing gets through
//! stands still until the kernel has given up on what was still to be sent, for up to ten seconds.
//! By itself zenoh has one thread to send with and two to receive, so whoever came back over a new
//! link stayed mute for seconds behind the closing of the old one. With a few threads more the new
//! link does not wait.

use std::io::{self, Error};
use std::os::unix::process::CommandExt as _;
use std::process::Command;

/// What zenoh reads the numbers of its threads from, once.
const VARIABLE: &str = "ZENOH_RUNTIME";
/// As many as links may be closing at once, and one that works.
const THREADS: &str =
    "(tx: (worker_threads: 4), rx: (worker_threads: 4), net: (worker_threads: 4))";

/// Replaces this process by the same one with more threads for zenoh, unless somebody has said how
/// many it is to have: a process cannot safely change its own environment. For the beginning of a
/// program, as everything that it has done is lost.
///
/// # Errors
/// The process cannot be replaced. It works without, but may be mute for seconds after a cut.
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
