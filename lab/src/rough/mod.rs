//! The *rough world*: a second simulator, written independently of the agent's own one.
//!
//! Its models are more detailed than those of the estimator: deflecting contacts, nonlinear
//! friction curves, load transfer, limited motors with gears, quantised encoders and delayed
//! positions. The agent's control loop drives the robot closed-loop, with a configuration from the
//! data sheet as an integrator would write.

mod arithmetic;
pub mod bound;
pub mod curve;
pub mod disturbance;
pub mod drive;
pub mod gravity;
pub mod ground_change;
pub mod means;
pub mod plant;
pub mod run;
pub mod sensors;
pub mod spec;
pub mod tracking;
pub mod width;
