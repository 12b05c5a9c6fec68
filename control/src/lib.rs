//! Tread's control library: all computation on a robot between sensors and wheel commands.
//!
//! No I/O, clock, randomness or `async`, and no allocation in a control tick. Units are SI and
//! stand last in a name. Frames are right-handed: the site frame is metric with headings
//! counter-clockwise from x; the body frame has x forward and y to the left.
//!
//! * Basic types: [`geometry`], [`robot`], [`friction`], [`slip`], [`measured`].
//! * Planning (may allocate): [`trajectory`] is the request, [`path`] its geometry, [`profile`] its
//!   timing, [`excitation`] an optional variation of speed, [`plan`] combines them from a start
//!   pose.
//! * Driving (one call per tick): [`mod@reference`] advances a reference along the plan,
//!   [`tracking`] computes wheel speeds from tracking errors, [`follower`] runs one mission,
//!   [`mod@gate`] limits the final command within [`twist_limits`], [`fence`] computes the speed
//!   limit near a fence, [`progress`] detects a robot that is stuck.
//! * Estimation: [`localisation`] estimates the robot's pose, [`estimation`] the friction of the
//!   ground, [`consistency`] detects sensors that contradict each other.
//! * [`plant`] simulates the base.

pub mod consistency;
pub mod estimation;
pub mod excitation;
pub mod fence;
pub mod follower;
pub mod friction;
pub mod gate;
pub mod geometry;
pub mod localisation;
pub mod measured;
pub mod path;
pub mod plan;
pub mod plant;
pub mod profile;
pub mod progress;
pub mod reference;
mod repeats;
pub mod robot;
mod sliding;
pub mod slip;
pub mod tracking;
pub mod trajectory;
pub mod twist_limits;
