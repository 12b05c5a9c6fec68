//! What the product is measured with, and no package contains.
//!
//! * [`mod@paper`] is the paper this began with, exactly; its law is a bench, not what ships.
//! * [`mod@bench`] holds laws written only for comparison, and the run that compares.
//! * `held_out`: the rough world's drives on the contacts of a simulator that is not ours, by a process of
//!   its own.
//! * [`parallel`]: drives on all processors.
//! * [`report`]: the table of goals that report programs print.
//! * `rough`: a second world, written from the physics alone: robots, contacts and sensors that
//!   differ from the agent's own simulator and from each other.
//! * `teleoperation_trials`: random drivers on a bad network who fall silent.
//!
//! `held_out`, `rough` and `teleoperation_trials` drive the agent's own loop, which the feature `agent` brings (on by default). What
//! needs the controller alone compiles much sooner with `--no-default-features`.

pub mod bench;
#[cfg(feature = "agent")]
pub mod held_out;
pub mod paper;
pub mod parallel;
pub mod random;
pub mod report;
#[cfg(feature = "agent")]
pub mod rough;
#[cfg(feature = "agent")]
pub mod teleoperation_trials;
