//! Sums of the friction map. Pure.
//!
//! Statistics of segments are additive ([`sums`]) and in fixed point ([`fixed`]), per cell, robot,
//! configuration and epoch ([`epochs`]).

pub mod epochs;
pub mod fixed;
pub mod sums;

pub use self::epochs::{Epoch, Horizons, epoch_h, epoch_h_at};
pub use self::sums::Sums;
