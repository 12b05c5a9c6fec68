//! The simulated robot: the free four-wheel plant on a scenario's ground, with its sensors.
//!
//! It stands where a real base would: behind [`crate::drive::Drive`]. Nothing of the truth passes
//! that interface except through the sensors; [`trace`] keeps it for reports. [`time`] lets several
//! robots of one process go through a time of their own.

pub mod battery;
pub mod faults;
pub mod ground;
pub mod scenario;
pub mod sensors;
pub mod time;
pub mod trace;
