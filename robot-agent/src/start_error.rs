//! Reasons why an agent cannot start.

use tread_control::robot::RobotModelError;
use tread_telemetry::TelemetryError;

use crate::fleet::LinkError;
use crate::missions::memory::MemoryError;
use crate::outbox::OutboxError;
use crate::realtime::RealtimeError;
use crate::sim::drive::SimulatedDriveError;

/// Why an agent could not start.
#[derive(Debug, thiserror::Error)]
pub enum StartError {
    /// The robot's model is impossible.
    #[error("the robot's model is impossible")]
    Model(#[from] RobotModelError),
    /// The endpoint of the server or of the robot's bus is invalid.
    #[error(transparent)]
    Link(#[from] LinkError),
    /// The simulated base could not be made.
    #[error(transparent)]
    Drive(#[from] SimulatedDriveError),
    /// The outbox could not be opened.
    #[error(transparent)]
    Outbox(#[from] OutboxError),
    /// The mission memory could not be read.
    #[error(transparent)]
    Memory(#[from] MemoryError),
    /// Traces cannot be sent.
    #[error(transparent)]
    Tracing(#[from] TelemetryError),
    /// The operating system does not give the configured priority, or does not lock the memory.
    #[error(transparent)]
    Realtime(#[from] RealtimeError),
    /// A thread could not be started.
    #[error("no thread for the {part}")]
    Thread {
        /// Name of the part.
        part: &'static str,
        /// Error of the operating system.
        #[source]
        source: std::io::Error,
    },
}
