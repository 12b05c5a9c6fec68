//! Withdrawn hours of robots.

use jiff::Timestamp;

/// Withdrawn hours of a robot, both ends included.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct WithdrawalRow {
    /// Its number.
    pub pk: i64,
    /// Key of the robot.
    pub robot_pk: i64,
    /// First hour, since 1970.
    pub from_h: i64,
    /// Last hour, since 1970.
    pub to_h: i64,
    /// Reason.
    pub reason: String,
    /// Author.
    pub by: String,
    /// Time of the withdrawal.
    pub at: Timestamp,
}

impl WithdrawalRow {
    /// Returns whether what a robot measured in an hour is withdrawn.
    pub fn includes(&self, robot_pk: i64, hour: i64) -> bool {
        self.robot_pk == robot_pk && (self.from_h..=self.to_h).contains(&hour)
    }
}
