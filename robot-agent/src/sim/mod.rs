//! The simulated robot: the free four-wheel plant on a scenario's ground, with its sensors.
//!
//! It is a base behind [`crate::drive::Drive`]. The true state passes that interface only through
//! the sensors; [`trace`] records it for reports. [`time`] gives several robots of one process a
//! common simulated time.

pub mod battery;
pub mod drive;
pub mod faults;
pub mod ground;
pub mod scenario;
pub mod sensors;
pub mod time;
pub mod trace;
