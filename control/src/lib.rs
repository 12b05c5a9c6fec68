//! Tread's control part: everything a robot computes between its sensors and its wheels.
//!
//! Pure: no I/O, no clock, no randomness, no `async`, and no allocation in a control tick. Units
//! are SI and stand last in a name. Frames are right-handed: the site's frame is metric with
//! headings counter-clockwise from x; the body frame has x ahead and y to the left.
//!
//! * Words: [`geometry`], [`robot`], [`friction`], [`slip`], [`measured`].
//! * Planning (may allocate): [`trajectory`] is what is asked for, [`path`] its geometry,
//!   [`profile`] its timing, [`excitation`] a variation of it, [`plan`] all, from where the robot stands.
//! * Driving (one call per tick): [`mod@reference`] walks along the plan, [`tracking`] turns errors
//!   into wheel speeds, [`follower`] runs one mission, [`mod@gate`] has the last word within [`twist_limits`], [`fence`] says
//!   how fast a robot may be where it is.
//! * Knowing: [`localisation`] says where the robot is, [`estimation`] the friction of the ground,
//!   [`consistency`] whether the sensors agree.
//! * [`plant`] is the simulated base.

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
pub mod robot;
mod sliding;
pub mod slip;
pub mod tracking;
pub mod trajectory;
pub mod twist_limits;
