//! Scenarios: a fleet in a time of its own, from which figures are read.
//!
//! Server, zenoh, database and agents are the real ones, all in this process; the robots' bases are
//! simulated. All loops go through one simulated time ([`world`]), as fast as the machine lets them
//! and never late, so that figures do not depend on how busy it is.
//!
//! * [`map`]: what a fleet's friction map is worth.
//! * [`yard`]: the site of that scenario, its robots, and their paths.
//! * [`cells`]: fused cells of robots unlike the simulator. Their loops run alone; fusion is the server's.
//! * [`judge`]: what is read from a run, against the truth; [`report`]: what of it must hold.

pub mod cells;
pub mod judge;
pub mod map;
pub mod report;
pub mod world;
pub mod yard;
