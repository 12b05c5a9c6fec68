//! Exit codes, so that scripts can tell what happened without reading.

use std::process::ExitCode;

/// How a command ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub(crate) enum Exit {
    /// It was done, and what came of it is not what was wished for; or something broke here.
    WentWrong = 1,
    /// The words on the command line make no sense; clap uses the same.
    Usage = 2,
    /// No server answers, or the server cannot reach the robot.
    Unreachable = 3,
    /// The server refused: token, rights, or what was asked for.
    Refused = 4,
    /// What was named is not there.
    NotFound = 5,
    /// The present state does not allow it, or somebody was faster.
    Conflict = 6,
    /// It took longer than was allowed.
    TimedOut = 7,
}

/// The codes for people, below the help.
pub(crate) const EXIT_CODES: &str = "\
Exit codes:
  0  done
  1  done, and it went wrong: a mission failed, a robot has not confirmed its stop
  2  wrong words on the command line
  3  no server answers, or the server cannot reach the robot
  4  the server refused: token, rights, or what was asked for
  5  what was named is not there
  6  the present state does not allow it, or somebody was faster
  7  it took too long";

impl From<Exit> for ExitCode {
    fn from(exit: Exit) -> Self {
        Self::from(exit as u8)
    }
}
