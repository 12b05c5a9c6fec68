//! Models, tracking laws and report programs that measure the product; no package contains them.
//!
//! * [`mod@paper`]: the paper's equations with their errata corrected; its law drives no robot.
//! * [`mod@bench`]: tracking laws for comparison, and the runs that compare them.
//! * `held_out`: the rough world's drives on the contacts of a simulator that is not ours, which
//!   runs as a process of its own.
//! * [`parallel`]: drives on all processors.
//! * [`report`]: the table of goals that report programs print.
//! * `rough`: a second world, written from the physics alone: robots, contacts and sensors that
//!   differ from the agent's own simulator and from each other.
//! * `logs`: recordings of other robots, and what the agent's estimator makes of them.
//! * `teleoperation_trials`: random drivers on a bad network who fall silent.
//!
//! `held_out`, `logs`, `rough` and `teleoperation_trials` run the agent's own control loop and need
//! the feature `agent`; `logs` needs that of its name too. Both are on by default. The others
//! compile much sooner without them (`--no-default-features`).

pub mod bench;
#[cfg(feature = "agent")]
pub mod held_out;
#[cfg(feature = "logs")]
pub mod logs;
pub mod paper;
pub mod parallel;
pub mod random;
pub mod report;
#[cfg(feature = "agent")]
pub mod rough;
#[cfg(feature = "agent")]
pub mod teleoperation_trials;
