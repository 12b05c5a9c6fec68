//! Exit codes, by which scripts distinguish results and errors.

use std::process::ExitCode;

/// Result of a command that did not succeed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub(crate) enum Exit {
    /// The command was carried out with an unwanted result, or an internal error occurred.
    BadResult = 1,
    /// The arguments are invalid; clap uses the same code.
    Usage = 2,
    /// No server answers, or the server cannot reach the robot.
    Unreachable = 3,
    /// The server refused the token, the rights or the content of the request.
    Refused = 4,
    /// A named object does not exist.
    NotFound = 5,
    /// The present state does not allow the request, or it was changed meanwhile.
    Conflict = 6,
    /// It took longer than allowed.
    TimedOut = 7,
}

/// Description of the exit codes, below the help.
pub(crate) const EXIT_CODES: &str = "\
Exit codes:
  0  success
  1  executed with a bad result: a mission failed, a robot has not confirmed its stop; or a local error
  2  invalid arguments
  3  no server answers, or the server cannot reach the robot
  4  the server refused the token, the rights or the request
  5  the named object does not exist
  6  the present state does not permit the request, or another request was faster
  7  timed out";

impl From<Exit> for ExitCode {
    fn from(exit: Exit) -> Self {
        Self::from(exit as u8)
    }
}
