//! What use cases need of the network to the robots: two ports, which `fleet` implements with
//! zenoh and a test with a simulated network.

mod commands;
mod drive;

use std::sync::Arc;
use std::time::Duration;

pub use self::commands::{Answering, CommandTransport, Commands, Undelivered};
pub use self::drive::{DrivePublisher, DriveTransport, Opening};
use super::stops::STOP_CONFIRM_MAX;
use crate::supervisor::Supervisor;

/// How use cases reach robots; clones reach them through the same network.
#[derive(Debug, Clone)]
pub struct RobotLink {
    /// Carries commands, which are answered.
    pub commands: Arc<dyn CommandTransport>,
    /// Carries drive commands, which are not.
    pub drive: Arc<dyn DriveTransport>,
    /// Runs what goes on after a request was answered.
    pub supervisor: Supervisor,
    /// How long whoever asked for a stop waits for its confirmation: [`STOP_CONFIRM_MAX`],
    /// but where time is simulated.
    pub stop_confirm_max: Duration,
}

impl RobotLink {
    /// A link over which no robot is reached, for programs that work on the database alone.
    pub fn unconnected(supervisor: Supervisor) -> Self {
        Self {
            commands: Arc::new(Unconnected),
            drive: Arc::new(Unconnected),
            supervisor,
            stop_confirm_max: STOP_CONFIRM_MAX,
        }
    }
}

/// Delivers nothing.
#[derive(Debug)]
pub struct Unconnected;
