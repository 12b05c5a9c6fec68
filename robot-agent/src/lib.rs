//! Tread's agent: the program on every robot.
//!
//! A loop thread drives trajectories with `tread-control` and measures the friction of the ground;
//! everything around it takes missions from the server, and brings measurements to it without
//! losing or doubling any.
//!
//! * [`agent`] puts it all together; [`program`] makes a process of it; [`config`] is `robot.toml`.
//! * The loop: `control_loop`, the base behind [`drive`], the simulated one in [`sim`].
//! * Around it: [`missions`] (what is held), `dispatcher` (answers), `alerts`, `recorder` and [`outbox`]
//!   (what must not be lost), `reporter` (what may), [`fleet`] (the only one that knows zenoh).
//! * [`membership`]: the robot's certificate, how it gets it and the next one.
//! * `safety`: what may only slow the robot down, and teleoperation.
//! * `recording`: what the loop took and gave, in files, and running such files again.
//! * `testing` steps the loop tick by tick, for tests and figures; no program that ships contains it.
//! * Below all: [`clock`], `supervisor`, [`geometry`] (between wire and controller).
//!
//! No module keeps anything global: several agents may run in one process.

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
mod recorder;
mod recording;
mod reporter;
mod safety;
mod supervisor;

pub use agent::{Agent, RunningAgent};
pub use config::AgentConfig;
pub use control_loop::channels::Fault;
pub use program::{command_line, run_from_args};
pub use recording::{FILE_MIB_RANGE, FILES_RANGE, RecordingConfig};
pub use supervisor::PartEnded;
