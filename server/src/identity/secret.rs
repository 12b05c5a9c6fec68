//! Secrets of tokens, sessions and join tokens: 256 random bits, of which only the SHA-256 is
//! stored. Secrets of webhooks have the same form; they sign, so they are stored as they are.
//!
//! A secret has the form `tread_<kind>_<64 hex digits><8 hex digits>`. The kind is `v`, `o` or `a`
//! for a token of the role viewer, operator or admin, `t` for a token with individual rights, `s`
//! for a session, `j` for a join token and `w` for a webhook. The last eight digits are a checksum:
//! scanners for leaked secrets can recognise a secret, and a mistyped one is refused without a
//! database query. The kind is only informative; the rights are in the database.

use std::fmt;

use sha2::{Digest as _, Sha256};
use tread_api::identity::Role;
pub use tread_store::Fingerprint;

/// Number of random bytes in a secret.
pub const SECRET_RANDOM_BYTES: usize = 32;
/// Length of the checksum, in bytes.
const CHECKSUM_BYTES: usize = 4;
/// Prefix of every secret.
const BRAND: &str = "tread_";
/// Number of hex digits of a secret, checksum included.
const DIGITS: usize = 2 * (SECRET_RANDOM_BYTES + CHECKSUM_BYTES);
/// Length of a secret as text, in bytes.
const TEXT_LENGTH: usize = BRAND.len() + 2 + DIGITS;
/// Number of leading random digits by which failed attempts are counted.
const PREFIX_DIGITS: usize = 8;

/// Kind of a secret.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// A token of the given role; `None` for a token with individual rights.
    Token(Option<Role>),
    /// A browser session.
    Session,
    /// A join token, with which a robot enrols.
    Join,
    /// The key of a webhook's signatures, which is stored as it is.
    Webhook,
}

impl Kind {
    const ALL: [Self; 7] = [
        Self::Token(Some(Role::Viewer)),
        Self::Token(Some(Role::Operator)),
        Self::Token(Some(Role::Admin)),
        Self::Token(None),
        Self::Session,
        Self::Join,
        Self::Webhook,
    ];

    const fn initial(self) -> char {
        match self {
            Self::Token(Some(Role::Viewer)) => 'v',
            Self::Token(Some(Role::Operator)) => 'o',
            Self::Token(Some(Role::Admin)) => 'a',
            Self::Token(None) => 't',
            Self::Session => 's',
            Self::Join => 'j',
            Self::Webhook => 'w',
        }
    }
}

/// A secret in clear text; `Debug` does not print it.
#[derive(Clone, PartialEq, Eq)]
pub struct Secret {
    kind: Kind,
    text: String,
}

impl fmt::Debug for Secret {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter
            .debug_struct("Secret")
            .field("kind", &self.kind)
            .finish_non_exhaustive()
    }
}

impl Secret {
    /// Creates a secret from `random`, which must come from the operating system's random
    /// generator.
    pub fn from_random(kind: Kind, random: &[u8; SECRET_RANDOM_BYTES]) -> Self {
        let mut text = format!("{BRAND}{}_", kind.initial());
        let sum = checksum(kind, random);
        for byte in random.iter().chain(&sum) {
            text.push(digit(byte >> 4));
            text.push(digit(byte & 0xf));
        }
        Self { kind, text }
    }

    /// Parses a secret; `None` if its form or its checksum is wrong.
    pub fn read(text: &str) -> Option<Self> {
        if text.len() != TEXT_LENGTH {
            return None;
        }
        let rest = text.strip_prefix(BRAND)?;
        let (initial, digits) = rest.split_once('_')?;
        let is_kind = |kind: &Kind| initial.chars().eq([kind.initial()]);
        let kind = Kind::ALL.into_iter().find(is_kind)?;
        let mut bytes = [0; SECRET_RANDOM_BYTES + CHECKSUM_BYTES];
        let (pairs, odd) = digits.as_bytes().as_chunks::<2>();
        if pairs.len() != bytes.len() || !odd.is_empty() {
            return None;
        }
        for (byte, [high, low]) in bytes.iter_mut().zip(pairs) {
            *byte = (value(*high)? << 4) | value(*low)?;
        }
        let (random, sum) = bytes.split_first_chunk::<SECRET_RANDOM_BYTES>()?;
        (sum == checksum(kind, random)).then(|| Self {
            kind,
            text: text.to_owned(),
        })
    }

    /// Returns the kind of the secret.
    pub fn kind(&self) -> Kind {
        self.kind
    }

    /// Returns the secret in clear text, to hand it to its owner.
    pub fn reveal(&self) -> &str {
        &self.text
    }

    /// Returns the SHA-256 of the text, which is what the database stores.
    pub fn fingerprint(&self) -> Fingerprint {
        Fingerprint::of(&self.text)
    }

    /// Returns the leading random digits, by which failed attempts are counted.
    pub fn prefix(&self) -> &str {
        let begin = BRAND.len() + 2;
        &self.text[begin..begin + PREFIX_DIGITS]
    }
}

fn checksum(kind: Kind, random: &[u8]) -> [u8; CHECKSUM_BYTES] {
    let mut hash = Sha256::new();
    hash.update(b"tread checksum ");
    hash.update([kind.initial() as u8]);
    hash.update(random);
    let [a, b, c, d, ..]: [u8; 32] = hash.finalize().into();
    [a, b, c, d]
}

fn digit(value: u8) -> char {
    char::from_digit(u32::from(value), 16).unwrap_or('0')
}

/// Returns the value of a lower-case hex digit, else `None`. Upper case is refused, so that each
/// secret has one spelling.
fn value(digit: u8) -> Option<u8> {
    match digit {
        b'0'..=b'9' => Some(digit - b'0'),
        b'a'..=b'f' => Some(digit - b'a' + 10),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn any_kind() -> impl Strategy<Value = Kind> {
        (0..Kind::ALL.len()).prop_map(|index| Kind::ALL[index])
    }

    proptest! {
        #[test]
        fn a_secret_reads_back_and_only_itself_matches(
            kind in any_kind(), random: [u8; 32], other: [u8; 32],
        ) {
            let secret = Secret::from_random(kind, &random);
            let read = Secret::read(secret.reveal()).unwrap();
            prop_assert_eq!(read.kind(), kind);
            let kept = secret.fingerprint();
            prop_assert!(read.fingerprint().matches(kept.as_bytes()));
            let foreign = Secret::from_random(kind, &other).fingerprint();
            prop_assert_eq!(foreign.matches(kept.as_bytes()), random == other);
            prop_assert!(!kept.matches(&kept.as_bytes()[..31]));
        }

        #[test]
        fn one_changed_letter_is_noticed_without_the_database(
            kind in any_kind(), random: [u8; 32], at in 0..TEXT_LENGTH, letter in "[ -~]",
        ) {
            let secret = Secret::from_random(kind, &random);
            let mut text = secret.reveal().to_owned();
            text.replace_range(at..=at, &letter);
            prop_assert_eq!(Secret::read(&text).is_some(), text == secret.reveal());
        }

        #[test]
        fn whatever_comes_is_read_without_harm(text in ".{0,120}") {
            prop_assert!(Secret::read(&text).is_none());
        }
    }

    #[test]
    fn a_secret_has_its_kind_in_front_and_is_not_shown_by_accident() {
        let secret = Secret::from_random(Kind::Token(Some(Role::Operator)), &[0xab; 32]);
        assert!(secret.reveal().starts_with("tread_o_abab"));
        assert_eq!(secret.prefix(), "abababab");
        assert!(!format!("{secret:?}").contains("abab"));
    }
}
