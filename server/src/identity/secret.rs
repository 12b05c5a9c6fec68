//! Secrets of tokens, sessions and joining robots: 256 random bits, of which only the SHA-256 is kept.
//!
//! A secret reads `tread_<kind>_<64 hex digits><8 hex digits>`. The kind is `v`, `o` or `a` for a
//! token of that role, `t` for one with rights of its own, `s` for a session and `j` for a join token; the last eight digits are a checksum. So a scanner
//! for leaked secrets knows one when it sees it, and a slip of the pen is refused without asking
//! the database. The kind tells people what they hold; what it may do is in the database.

use std::fmt;

use sha2::{Digest as _, Sha256};
use subtle::ConstantTimeEq as _;
use tread_api::identity::Role;

/// Random bytes in a secret.
pub const SECRET_RANDOM_BYTES: usize = 32;
/// Bytes of the checksum.
const CHECKSUM_BYTES: usize = 4;
/// What every secret begins with.
const BRAND: &str = "tread_";
/// Hex digits of a secret.
const DIGITS: usize = 2 * (SECRET_RANDOM_BYTES + CHECKSUM_BYTES);
/// Bytes of a secret as text.
const TEXT_LENGTH: usize = BRAND.len() + 2 + DIGITS;
/// Leading random digits that failures are counted by.
const PREFIX_DIGITS: usize = 8;

/// What a secret is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// A token of that role, or with rights of its own.
    Token(Option<Role>),
    /// A browser's session.
    Session,
    /// The joining of a robot.
    Join,
}

impl Kind {
    const ALL: [Self; 6] = [
        Self::Token(Some(Role::Viewer)),
        Self::Token(Some(Role::Operator)),
        Self::Token(Some(Role::Admin)),
        Self::Token(None),
        Self::Session,
        Self::Join,
    ];

    const fn initial(self) -> char {
        match self {
            Self::Token(Some(Role::Viewer)) => 'v',
            Self::Token(Some(Role::Operator)) => 'o',
            Self::Token(Some(Role::Admin)) => 'a',
            Self::Token(None) => 't',
            Self::Session => 's',
            Self::Join => 'j',
        }
    }
}

/// A secret in memory; it is never shown by `Debug`.
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
    /// The secret of these bytes, which must come from the operating system's generator.
    pub fn from_random(kind: Kind, random: &[u8; SECRET_RANDOM_BYTES]) -> Self {
        let mut text = format!("{BRAND}{}_", kind.initial());
        let sum = checksum(kind, random);
        for byte in random.iter().chain(&sum) {
            text.push(digit(byte >> 4));
            text.push(digit(byte & 0xf));
        }
        Self { kind, text }
    }

    /// Reads a secret; `None` for what cannot be one, such as one with a digit changed.
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

    /// What it is for.
    pub fn kind(&self) -> Kind {
        self.kind
    }

    /// The text, for its owner.
    pub fn reveal(&self) -> &str {
        &self.text
    }

    /// What is kept of it.
    pub fn fingerprint(&self) -> Fingerprint {
        Fingerprint(Sha256::digest(&self.text).into())
    }

    /// The leading digits, by which failures are counted.
    pub fn prefix(&self) -> &str {
        let begin = BRAND.len() + 2;
        &self.text[begin..begin + PREFIX_DIGITS]
    }
}

/// The SHA-256 of a secret. Of 256 random bits nobody finds the secret again, so no slow hash is
/// needed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Fingerprint([u8; 32]);

impl Fingerprint {
    /// What the database keeps; `None` if it is none.
    pub fn from_kept(hash: &[u8]) -> Option<Self> {
        hash.try_into().ok().map(Self)
    }

    /// All of it, for the database.
    pub fn as_bytes(&self) -> &[u8] {
        &self.0
    }

    /// What it is looked up by. How long a look-up takes may tell how many of these bits agree
    /// with a kept one; the rest is compared in constant time.
    pub fn lookup(&self) -> &[u8] {
        &self.0[..8]
    }

    /// Whether this is the kept one, in a time that does not depend on where they differ.
    pub fn matches(&self, kept: &[u8]) -> bool {
        self.0.ct_eq(kept).into()
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

/// The value of a digit; capital letters are none, so that each secret has one spelling.
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
