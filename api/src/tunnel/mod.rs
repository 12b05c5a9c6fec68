//! The TLS tunnel through which a robot's zenoh session reaches the server's router.
//!
//! ```text
//!  agent                                          server
//!  TLS 1.3, both certificates, ALPN tread/2  ───►
//!                                            ◄─── length (2 bytes, big-endian) + RouterCredentials (JSON)
//!  zenoh session, as the user named there    ◄──► router
//! ```
//!
//! The certificate says which robot this is. The router cannot see the certificate; it knows the
//! robot by user name and password, which the server hands to whoever has shown the certificate.
//! The server compares the user name that the session shows with the certificate's robot, so
//! another robot's credentials are of no use.

#[cfg(feature = "splice")]
mod splice;

use std::fmt;
use std::num::ParseIntError;
use std::str::FromStr;
use std::time::Duration;

use serde::{Deserialize, Serialize};

#[cfg(feature = "splice")]
pub use splice::splice;

/// The protocol that both sides name in the TLS handshake (ALPN).
pub const ALPN: &[u8] = b"tread/2";
/// Bytes of the length in front of the credentials.
pub const LENGTH_BYTES: usize = 2;
/// Most bytes that credentials take as JSON.
pub const CREDENTIALS_BYTES_MAX: usize = 1_024;
/// What the kernel takes of what it cannot send yet, bytes: it has lost its priority too.
pub const NOT_SENT_BYTES_MAX: u32 = 4 * 1024;
/// After this long without an answer to what was sent, the kernel gives a connection up: the session has given it
/// up long before.
pub const UNANSWERED_MAX: Duration = Duration::from_secs(10);

/// What a robot's zenoh session shows to the router.
#[derive(Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct RouterCredentials {
    /// The user name, `{robot}.{site}`.
    pub user: String,
    /// The password of that user.
    pub password: String,
    /// What the session's zenoh id must begin with.
    pub session_prefix: SessionPrefix,
}

impl fmt::Debug for RouterCredentials {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter
            .debug_struct("RouterCredentials")
            .field("user", &self.user)
            .finish_non_exhaustive()
    }
}

/// Credentials that cannot be sent.
#[derive(Debug, thiserror::Error)]
#[error("credentials take more than {CREDENTIALS_BYTES_MAX} bytes, or are no JSON")]
pub struct CredentialsUnwritable;

impl RouterCredentials {
    /// The bytes that the server sends first: the length, then JSON.
    ///
    /// # Errors
    /// [`CredentialsUnwritable`]: they are longer than the receiver reads.
    pub fn to_bytes(&self) -> Result<Vec<u8>, CredentialsUnwritable> {
        let json = serde_json::to_vec(self).map_err(|_| CredentialsUnwritable)?;
        if json.len() > CREDENTIALS_BYTES_MAX {
            return Err(CredentialsUnwritable);
        }
        let length = u16::try_from(json.len()).map_err(|_| CredentialsUnwritable)?;
        Ok([&length.to_be_bytes()[..], &json].concat())
    }
}

/// The upper half of the zenoh ids that one robot's sessions may have.
///
/// A router takes a second session with an id that it knows for another link of the first. With a
/// prefix of its own, a robot cannot come with an id of another robot.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct SessionPrefix(u64);

impl SessionPrefix {
    /// Makes a prefix of 63 free bits. The uppermost bit is always set: zenoh writes its ids
    /// without leading zeros.
    pub fn new(bits: u64) -> Self {
        Self(bits | 1 << 63)
    }

    /// The zenoh id with this prefix and another lower half, as zenoh's configuration has it.
    pub fn session_id(self, lower: u64) -> String {
        format!("{:016x}{lower:016x}", self.0)
    }

    /// Whether a zenoh id, as a number, has this prefix.
    pub fn is_of(self, session_id: u128) -> bool {
        session_id >> 64 == u128::from(self.0)
    }
}

impl fmt::Display for SessionPrefix {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "{:016x}", self.0)
    }
}

impl FromStr for SessionPrefix {
    type Err = ParseIntError;

    fn from_str(text: &str) -> Result<Self, ParseIntError> {
        u64::from_str_radix(text, 16).map(Self::new)
    }
}

impl Serialize for SessionPrefix {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

impl<'de> Deserialize<'de> for SessionPrefix {
    fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let text = String::deserialize(deserializer)?;
        text.parse().map_err(serde::de::Error::custom)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn session_ids_have_their_own_prefix_and_no_other(bits: u64, other: u64, lower: u64) {
            let (own, other) = (SessionPrefix::new(bits), SessionPrefix::new(other));
            let id = own.session_id(lower);
            prop_assert_eq!(id.len(), 32);
            let id = u128::from_str_radix(&id, 16).unwrap();
            prop_assert!(own.is_of(id));
            prop_assert_eq!(other.is_of(id), own == other);
        }

        #[test]
        fn credentials_are_read_back_as_they_were_sent(user in "[a-z0-9.-]{1,127}", password in "[0-9a-f]{64}", bits: u64) {
            let sent = RouterCredentials { user, password, session_prefix: SessionPrefix::new(bits) };
            let bytes = sent.to_bytes().unwrap();
            let (length, json) = bytes.split_at(LENGTH_BYTES);
            prop_assert_eq!(usize::from(length[0]) * 256 + usize::from(length[1]), json.len());
            let read: RouterCredentials = serde_json::from_slice(json).unwrap();
            prop_assert_eq!(read, sent);
        }
    }

    #[test]
    fn credentials_longer_than_a_receiver_reads_are_not_sent() {
        let long = RouterCredentials {
            user: "a".repeat(CREDENTIALS_BYTES_MAX),
            password: "secret".to_owned(),
            session_prefix: SessionPrefix::new(1),
        };
        assert!(long.to_bytes().is_err());
        assert!(!format!("{long:?}").contains("secret"));
    }
}
