//! A second world, written from the physics and not from the agent's own simulator.
//!
//! What is measured here was not built with it: contacts deflect, curves bend, loads move, motors
//! have limits and gears, encoders count and positions come late. A robot is driven closed-loop by
//! the agent's own control loop, configured as an integrator would: with the data sheet.

pub mod bound;
pub mod curve;
pub mod drive;
pub mod ground_change;
pub mod means;
pub mod plant;
pub mod run;
pub mod sensors;
pub mod spec;
pub mod tracking;
