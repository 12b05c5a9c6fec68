//! Start of agent and server: settings that zenoh and the allocator read from the environment once,
//! before `main`.
//!
//! zenoh closes a TCP link with lingering: the closing thread blocks until the kernel has given up
//! sending the remaining data, for up to ten seconds on a dead link. By default zenoh has one
//! thread for sending and two for receiving, so that a peer which reconnects over a new link sends
//! nothing for seconds while the old link closes. With additional threads the new link does not
//! wait.
//!
//! glibc raises the size from which an allocation is a mapping of its own up to 32 MiB, once such a
//! block was freed, and keeps what is below it in the process: a peak of the load stays there. With
//! a fixed threshold the memory returns to the system: a server that a thousand event clients had
//! used held 168 MB instead of 192 MB.

use std::env;
use std::io::{self, Error};
use std::os::unix::process::CommandExt as _;
use std::process::Command;

/// Environment variables that agent and server run with, unless they are set already.
const ENVIRONMENT: [(&str, &str); 2] = [
    // One thread more in each pool than links are expected to close at once.
    (
        "ZENOH_RUNTIME",
        "(tx: (worker_threads: 4), rx: (worker_threads: 4), net: (worker_threads: 4))",
    ),
    // Bytes: glibc's initial value, which stays.
    ("MALLOC_MMAP_THRESHOLD_", "131072"),
];

/// Replaces this process by the same program with [`ENVIRONMENT`], unless all of its variables are
/// set; a process cannot safely change its own environment. Call it at the beginning of `main`,
/// since all state of the process is lost.
///
/// # Errors
/// The error of `exec` if the process cannot be replaced. The program works without it, but may
/// send nothing for seconds after a loss of the link, and uses more memory.
pub fn apply_environment() -> io::Result<()> {
    let missing =
        ENVIRONMENT.map(|(name, value)| env::var_os(name).is_none().then_some((name, value)));
    if missing.iter().all(Option::is_none) {
        return Ok(());
    }
    let mut words = env::args_os();
    let mut same = Command::new(env::current_exe()?);
    if let Some(name) = words.next() {
        same.arg0(name);
    }
    let failed: Error = same.args(words).envs(missing.into_iter().flatten()).exec();
    Err(failed)
}

/// File in which Linux shows the signals that this process ignores.
const STATUS_FILE: &str = "/proc/self/status";
/// Bit of SIGHUP in the mask of ignored signals.
const HANGUP_BIT: u64 = 1;

/// Returns whether this process was started to ignore SIGHUP, as by `nohup`: then it must not stop
/// when its terminal is closed.
pub fn ignores_hangup() -> bool {
    let status = std::fs::read_to_string(STATUS_FILE).unwrap_or_default();
    mask_of_ignored(&status).is_some_and(|mask| mask & HANGUP_BIT != 0)
}

fn mask_of_ignored(status: &str) -> Option<u64> {
    let mut lines = status.lines();
    let mask = lines.find_map(|line| line.strip_prefix("SigIgn:"))?;
    u64::from_str_radix(mask.trim(), 16).ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_mask_of_ignored_signals_is_found() {
        let status = "Name:\tsh\nSigBlk:\t0000000000000001\nSigIgn:\t0000000000001001\n";
        assert_eq!(mask_of_ignored(status), Some(0x1001));
        assert_eq!(mask_of_ignored("Name:\tsh\n"), None);
    }
}
