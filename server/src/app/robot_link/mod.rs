//! Interface of the use cases to the robots' network: two traits, which `fleet` implements with
//! zenoh and tests with a simulated network.

mod commands;
mod drive;

use std::sync::Arc;
use std::time::Duration;

pub use self::commands::{Answering, CommandTransport, Commands, Undelivered};
pub use self::drive::{DrivePublisher, DriveTransport, Opening};
use super::stops::STOP_CONFIRM_MAX;
use crate::supervisor::Supervisor;

/// Connections to the robots; clones share them.
#[derive(Debug, Clone)]
pub struct RobotLink {
    /// Transport of commands, which are answered.
    pub commands: Arc<dyn CommandTransport>,
    /// Transport of drive commands, which are not answered.
    pub drive: Arc<dyn DriveTransport>,
    /// Supervisor of tasks that outlive their request.
    pub supervisor: Supervisor,
    /// Maximum time that a stop request waits for its confirmation: [`STOP_CONFIRM_MAX`], except in
    /// simulated time.
    pub stop_confirm_max: Duration,
}

impl RobotLink {
    /// Creates a link that reaches no robot, for programs that work on the database alone.
    pub fn unconnected(supervisor: Supervisor) -> Self {
        Self {
            commands: Arc::new(NullTransport),
            drive: Arc::new(NullTransport),
            supervisor,
            stop_confirm_max: STOP_CONFIRM_MAX,
        }
    }
}

/// A transport that delivers nothing.
#[derive(Debug)]
pub struct NullTransport;
