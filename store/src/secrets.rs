//! What is stored of secrets.

use sha2::{Digest as _, Sha256};
use subtle::ConstantTimeEq as _;

/// SHA-256 of a secret's text. A secret has 256 random bits, which cannot be found by search, so no
/// slow password hash is needed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Fingerprint([u8; 32]);

impl Fingerprint {
    /// Returns the hash of a secret's text.
    pub fn of(secret: &str) -> Self {
        Self(Sha256::digest(secret).into())
    }

    /// Reads a hash from the database; `None` unless it has 32 bytes.
    pub fn from_kept(hash: &[u8]) -> Option<Self> {
        hash.try_into().ok().map(Self)
    }

    /// Returns the whole hash, to store it in the database.
    pub fn as_bytes(&self) -> &[u8] {
        &self.0
    }

    /// Returns the first 8 bytes, the key of the database look-up. The time of a look-up may reveal
    /// how many of these bits match a stored hash; [`Self::matches`] compares the rest in constant
    /// time.
    pub fn lookup(&self) -> &[u8] {
        &self.0[..8]
    }

    /// Returns whether this equals the stored hash `kept`, compared in constant time.
    pub fn matches(&self, kept: &[u8]) -> bool {
        self.0.ct_eq(kept).into()
    }
}

/// A token as it is stored.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TokenRow<T> {
    /// The hash of the secret.
    pub hash: Vec<u8>,
    /// The token.
    pub token: T,
}
