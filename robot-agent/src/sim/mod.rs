//! The simulated robot: the free four-wheel plant on a scenario's ground, with its sensors.
//!
//! It stands where a real base would: behind [`crate::drive::Drive`]. Nothing of the truth passes
//! that seam except through the sensors.

pub mod battery;
pub mod ground;
pub mod scenario;
pub mod sensors;
