//! A sign-in that is under way at the provider, kept by the browser alone.
//!
//! The server makes one random number for each sign-in and puts it into a cookie, with the time. All else
//! derives from it by HMAC with a key that is new at each start of the server:
//!
//! ```text
//!  cookie   = time . random number
//!  state    = HMAC(key, "state"    ‖ cookie)   in the address of the provider, comes back
//!  nonce    = HMAC(key, "nonce"    ‖ cookie)   comes back inside the ID token
//!  verifier = HMAC(key, "verifier" ‖ cookie)   its SHA-256 goes to the provider (PKCE), itself with the code
//! ```
//!
//! So the server keeps nothing of a sign-in, strangers cannot fill anything by beginning many, and the
//! answer of the provider counts in the browser alone in which the sign-in began, for
//! [`SIGN_IN_LASTS`]. Nobody without the key makes a cookie that has a state.

use base64::Engine as _;
use base64::engine::general_purpose::URL_SAFE_NO_PAD;
use jiff::{SignedDuration, Timestamp};
use ring::hmac;

/// How long somebody may take at the provider.
pub const SIGN_IN_LASTS: SignedDuration = SignedDuration::from_mins(10);
/// Random bytes of a sign-in, and of the key.
pub const SIGN_IN_RANDOM_BYTES: usize = 32;
/// Longest cookie that is read.
const COOKIE_MAX: usize = 80;

/// What all sign-ins of one run of the server derive from.
#[derive(Debug)]
pub struct PendingKey(hmac::Key);

impl PendingKey {
    /// The key of these bytes, which must come from the operating system's generator.
    pub fn from_random(random: &[u8; SIGN_IN_RANDOM_BYTES]) -> Self {
        Self(hmac::Key::new(hmac::HMAC_SHA256, random))
    }
}

/// A sign-in that is under way.
#[derive(Clone, PartialEq, Eq)]
pub struct Pending {
    cookie: String,
    /// What goes to the provider and comes back with the code.
    pub state: String,
    /// What comes back inside the ID token.
    pub nonce: String,
    /// What proves to the provider that the code is ours.
    pub verifier: String,
}

impl std::fmt::Debug for Pending {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.debug_struct("Pending").finish_non_exhaustive()
    }
}

impl Pending {
    /// Begins a sign-in.
    pub fn begin(key: &PendingKey, random: &[u8; SIGN_IN_RANDOM_BYTES], now: Timestamp) -> Self {
        let cookie = format!("{}.{}", now.as_second(), URL_SAFE_NO_PAD.encode(random));
        Self::of(key, cookie)
    }

    fn of(key: &PendingKey, cookie: String) -> Self {
        let derive = |what: &str| {
            let mut context = hmac::Context::with_key(&key.0);
            context.update(what.as_bytes());
            context.update(b" ");
            context.update(cookie.as_bytes());
            URL_SAFE_NO_PAD.encode(context.sign())
        };
        Self {
            state: derive("state"),
            nonce: derive("nonce"),
            verifier: derive("verifier"),
            cookie,
        }
    }

    /// What the browser keeps.
    pub fn cookie(&self) -> &str {
        &self.cookie
    }

    /// The sign-in of a cookie and of the state that came back; `None` unless they belong together and
    /// it began here, not too long ago.
    pub fn resume(key: &PendingKey, cookie: &str, state: &str, now: Timestamp) -> Option<Self> {
        use subtle::ConstantTimeEq as _;
        if cookie.len() > COOKIE_MAX {
            return None;
        }
        let pending = Self::of(key, cookie.to_owned());
        if !bool::from(pending.state.as_bytes().ct_eq(state.as_bytes())) {
            return None;
        }
        // Only now is the time known to be the one that was written here.
        let (began_s, _random) = cookie.split_once('.')?;
        let began = Timestamp::from_second(began_s.parse().ok()?).ok()?;
        let age = now.duration_since(began);
        (age < SIGN_IN_LASTS).then_some(pending)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn time(second: i64) -> Timestamp {
        Timestamp::from_second(1_800_000_000 + second).unwrap()
    }

    fn key(byte: u8) -> PendingKey {
        PendingKey::from_random(&[byte; SIGN_IN_RANDOM_BYTES])
    }

    #[test]
    fn a_sign_in_goes_on_with_its_own_cookie_and_state_for_ten_minutes() {
        let pending = Pending::begin(&key(1), &[2; SIGN_IN_RANDOM_BYTES], time(0));
        let resume = |key: &PendingKey, cookie: &str, state: &str, second| {
            Pending::resume(key, cookie, state, time(second))
        };
        let (cookie, state) = (pending.cookie(), pending.state.as_str());
        assert_eq!(resume(&key(1), cookie, state, 599), Some(pending.clone()));
        assert_eq!(resume(&key(1), cookie, state, 600), None, "too late");
        assert_eq!(resume(&key(2), cookie, state, 0), None, "another server's");
        let other = Pending::begin(&key(1), &[3; SIGN_IN_RANDOM_BYTES], time(0));
        assert_eq!(resume(&key(1), other.cookie(), state, 0), None);
        assert_eq!(resume(&key(1), cookie, &other.state, 0), None);
        assert_eq!(resume(&key(1), cookie, "", 0), None);
        // A later time needs another state.
        let later = cookie.replacen("1800000000", "1800000600", 1);
        assert_ne!(later, cookie);
        assert_eq!(resume(&key(1), &later, state, 600), None);
        for odd in ["", ".", "1800000000", &"9".repeat(COOKIE_MAX + 1)] {
            let state = Pending::of(&key(1), odd.to_owned()).state;
            assert_eq!(resume(&key(1), odd, &state, 0), None, "{odd}");
        }
    }

    #[test]
    fn what_goes_to_the_provider_tells_nothing_of_the_rest() {
        let pending = Pending::begin(&key(1), &[2; SIGN_IN_RANDOM_BYTES], time(0));
        let texts = [&pending.state, &pending.nonce, &pending.verifier];
        // PKCE wants 43 to 128 characters out of the unreserved ones.
        assert!(texts.iter().all(|text| text.len() == 43));
        assert!(texts[0] != texts[1] && texts[1] != texts[2] && texts[0] != texts[2]);
        assert!(!format!("{pending:?}").contains(&pending.verifier));
    }
}
