//! Examines the limits of the operating system.

use nix::sys::resource::{Resource, getrlimit};
use tread_api::diagnosis::{Finding, NextStep};

/// Number of open files that a fully loaded server needs: for its connections, those of robots, and
/// their files.
const FILES_NEEDED: u64 = 8_192;

pub(super) fn findings() -> Vec<Finding> {
    let finding = match getrlimit(Resource::RLIMIT_NOFILE) {
        Ok((_, most)) if most < FILES_NEEDED => Finding::on("file limit").warning(format!("at most {most} files can be open, and a full fleet needs {FILES_NEEDED}"),
            NextStep(
                "raise the hard limit: `LimitNOFILE=` in the unit, or /etc/security/limits.conf; this \
                 is the limit of this shell, the server's may be another",
            ),
        ),
        Ok((_, most)) => Finding::on("file limit").ok(format!("{most} files can be open")),
        Err(error) => Finding::on("file limit").skipped(format!("it is not known: {error}")),
    };
    vec![finding]
}
