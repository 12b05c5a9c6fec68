//! TLS tunnel through which a robot's zenoh session reaches the server's router.
//!
//! ```text
//!  agent                                          server
//!  TLS 1.3, both certificates, ALPN tread/2  ───►
//!                                            ◄─── length (2 bytes, big-endian) + RouterCredentials (JSON)
//!  zenoh session with this user name          ◄──► router
//! ```
//!
//! The certificate identifies the robot. The router does not see the certificate; it identifies the
//! robot by user name and password, which the server sends to the peer that presented the
//! certificate. The server compares the user name of the session with the robot of the certificate,
//! so credentials of another robot are useless.

#[cfg(feature = "splice")]
mod splice;

use std::fmt;
use std::num::ParseIntError;
use std::str::FromStr;
use std::time::Duration;

use serde::{Deserialize, Serialize};

#[cfg(feature = "splice")]
pub use splice::splice;

/// Protocol identifier that both sides offer in the TLS handshake (ALPN).
pub const ALPN: &[u8] = b"tread/2";
/// Maximum size of credentials as JSON, bytes; longer ones are not sent.
pub const CREDENTIALS_BYTES_MAX: usize = 1_024;
/// Maximum number of bytes that the kernel holds unsent on a connection. It is small, because the
/// priority of messages has no effect on bytes that the kernel holds.
pub const NOT_SENT_BYTES_MAX: u32 = 4 * 1024;
/// Time without an acknowledgement of sent data after which the kernel closes a connection. The
/// zenoh session gives it up long before.
pub const UNANSWERED_MAX: Duration = Duration::from_secs(10);

/// Credentials of a robot's zenoh session at the router.
#[derive(Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct RouterCredentials {
    /// User name, `{robot}.{site}`.
    pub user: String,
    /// Password of the user.
    pub password: String,
    /// Required prefix of the session's zenoh id.
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

/// Error for credentials that cannot be sent.
#[derive(Debug, thiserror::Error)]
#[error("credentials take more than {CREDENTIALS_BYTES_MAX} bytes, or are no JSON")]
pub struct CredentialsUnwritable;

impl RouterCredentials {
    /// Returns the first bytes that the server sends: the length, then the credentials as JSON.
    ///
    /// # Errors
    /// [`CredentialsUnwritable`] if the JSON is longer than [`CREDENTIALS_BYTES_MAX`].
    pub fn to_bytes(&self) -> Result<Vec<u8>, CredentialsUnwritable> {
        let json = serde_json::to_vec(self).map_err(|_| CredentialsUnwritable)?;
        if json.len() > CREDENTIALS_BYTES_MAX {
            return Err(CredentialsUnwritable);
        }
        let length = u16::try_from(json.len()).map_err(|_| CredentialsUnwritable)?;
        Ok([&length.to_be_bytes()[..], &json].concat())
    }
}

/// Upper 64 bits of the zenoh ids that the sessions of one robot may have.
///
/// A router treats a second session with a known id as another link of the first session. With a
/// prefix of its own, a robot cannot use an id of another robot.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct SessionPrefix(u64);

impl SessionPrefix {
    /// Creates a prefix from 63 bits of `bits`. The uppermost bit is always set, because zenoh
    /// writes its ids without leading zeros.
    pub fn new(bits: u64) -> Self {
        Self(bits | 1 << 63)
    }

    /// Returns the zenoh id with this prefix and the given lower 64 bits, as zenoh's configuration
    /// requires it: hexadecimal.
    pub fn session_id(self, lower: u64) -> String {
        format!("{:016x}{lower:016x}", self.0)
    }

    /// Whether the upper 64 bits of a zenoh id equal this prefix.
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
            let (length, json) = bytes.split_at(size_of::<u16>());
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
