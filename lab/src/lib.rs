//! What the product is measured with, and no package contains.
//!
//! * [`rough`]: a second world, written from the physics alone: robots, contacts and sensors that
//!   differ from the agent's own simulator and from each other.

pub mod random;
pub mod rough;
