//! What the product is measured with, and no package contains.
//!
//! * [`mod@paper`] is the paper this began with, exactly; its law is a bench, not what ships.
//! * [`mod@bench`] holds laws written only for comparison, and the run that compares.
//! * [`parallel`]: drives on all processors.
//! * [`report`]: the table of goals that report programs print.
//! * `rough`: a second world, written from the physics alone: robots, contacts and sensors that
//!   differ from the agent's own simulator and from each other.
//! * `logs`: recordings of other robots, and what the agent's estimator makes of them.
//! * `teleoperation_trials`: random drivers on a bad network who fall silent.
//!
//! The last three use the agent's own loop, which the feature `agent` brings, and `logs` that of its
//! name (both on by default). What needs the controller alone compiles much sooner with
//! `--no-default-features`.

pub mod bench;
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
