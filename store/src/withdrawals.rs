//! Withdrawn hours of robots.

use jiff::Timestamp;

/// Hours since 1970, both ends included.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Hours {
    /// First hour.
    pub from_h: i64,
    /// Last hour.
    pub to_h: i64,
}

impl Hours {
    /// Returns whether an hour is one of these.
    pub fn contains(self, hour: i64) -> bool {
        (self.from_h..=self.to_h).contains(&hour)
    }
}

/// Withdrawn hours of a robot.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct WithdrawalRow {
    /// Its number.
    pub pk: i64,
    /// Key of the robot.
    pub robot_pk: i64,
    /// The hours.
    pub hours: Hours,
    /// Reason.
    pub reason: String,
    /// Author.
    pub by: String,
    /// Time of the withdrawal.
    pub at: Timestamp,
}
