//! Transport of teleoperation commands: only the newest counts, and none is answered.

use std::pin::Pin;

use tread_api::wire::safety::DriveCommand;

use super::NullTransport;
use crate::app::presence::RobotKey;

/// A publisher that is being opened; `None` if the network refuses.
pub type Opening = Pin<Box<dyn Future<Output = Option<Box<dyn DrivePublisher>>> + Send>>;

/// Opens publishers of drive commands.
pub trait DriveTransport: std::fmt::Debug + Send + Sync {
    /// Opens the publisher to one robot.
    fn open(&self, robot: &RobotKey) -> Opening;
}

/// Publishes drive commands to one robot.
pub trait DrivePublisher: std::fmt::Debug + Send + Sync {
    /// Publishes a command without waiting for the robot. Returns whether the network took it.
    fn publish(&self, command: &DriveCommand) -> bool;
}

impl DriveTransport for NullTransport {
    fn open(&self, _: &RobotKey) -> Opening {
        Box::pin(std::future::ready(None))
    }
}
