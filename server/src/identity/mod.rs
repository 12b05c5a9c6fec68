//! Pure rules of authentication and authorisation: the format of secrets, the lock-out of clients
//! with failed attempts, the checks of `Host` and `Origin`, and the rights that groups of an OpenID
//! provider give. No I/O, no clock, no randomness.

pub mod address;
pub mod attempts;
pub mod claims;
pub mod grants;
pub mod origin;
pub mod pending;
pub mod redact;
pub mod secret;
pub mod subject;
