//! The rules of identity, pure: what a secret looks like, how many failures are borne, which
//! pages of which origins may ask, what groups at a provider give. No I/O, no clock, no randomness.

pub mod address;
pub mod attempts;
pub mod claims;
pub mod grants;
pub mod origin;
pub mod pending;
pub mod redact;
pub mod secret;
pub mod subject;
