//! The rules of identity, pure: what a secret looks like, how many failures are borne, which
//! pages of which origins may ask. No I/O, no clock, no randomness.

pub mod address;
pub mod attempts;
pub mod origin;
pub mod redact;
pub mod secret;
