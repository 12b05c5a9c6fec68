//! Tread's agent: the program on every robot.
//!
//! A loop thread tracks trajectories with `tread-control` and measures the friction of the ground;
//! the other parts receive missions from the server and upload measurements without loss or
//! duplication.
//!
//! * [`agent`] starts and stops all parts; [`program`] is the process; [`config`] is `robot.toml`.
//! * The loop: `control_loop`, the base behind [`drive`], the simulated one in [`sim`].
//! * Around it: [`missions`] (state of missions), `dispatcher` (answers commands), `alerts`,
//!   `recorder` and [`outbox`] (durable records), `reporter` (published state), `state_rate`
//!   (how often), [`fleet`] (the only user of zenoh).
//! * [`membership`]: enrolment and renewal of the robot's certificate.
//! * `safety`: stops, limits and teleoperation.
//! * `recording`: records of the loop's inputs and outputs, and their replay.
//! * `realtime`: priority of the loop's thread; `service_manager`: messages to systemd.
//! * `testing` runs the loop tick by tick, for tests and reports; no shipped program contains it.
//! * Used by all: [`clock`], `supervisor`, [`geometry`] (conversions between wire and controller).
//!
//! No module has global state: several agents may run in one process.

pub mod agent;
pub mod clock;
pub mod config;
pub mod drive;
pub mod fleet;
pub mod geometry;
pub mod membership;
pub mod missions;
pub mod outbox;
pub mod program;
pub mod sim;
#[cfg(any(test, feature = "testing"))]
pub mod testing;

mod alerts;
mod base;
mod checksum;
mod control_loop;
mod dispatcher;
mod doctor;
mod durable;
mod enroll;
mod knowledge;
mod online;
mod realtime;
mod recorder;
mod recording;
mod reporter;
mod ros2_status;
mod safety;
mod service_manager;
pub mod start_error;
mod state_rate;
mod supervisor;

pub use agent::{Agent, RunningAgent};
pub use config::recording::{FILE_MIB_RANGE, FILES_RANGE, RecordingConfig};
pub use config::{AgentConfig, Servers};
pub use control_loop::channels::Fault;
pub use program::{command_line, run_from_args};
pub use realtime::{PRIORITY_RANGE, RealtimeConfig, RealtimeError};
pub use supervisor::PartEnded;
