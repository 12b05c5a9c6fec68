//! State of a sign-in that is in progress at the OpenID provider. Only the browser's cookie holds
//! it.
//!
//! The server puts a random number and the time into a cookie for each sign-in. The other values
//! are derived from the cookie by HMAC with a key that the server generates at each start:
//!
//! ```text
//!  cookie   = time . random number
//!  state    = HMAC(key, "state"    ‖ cookie)   in the request, returned with the code
//!  nonce    = HMAC(key, "nonce"    ‖ cookie)   returned inside the ID token
//!  verifier = HMAC(key, "verifier" ‖ cookie)   PKCE: sent with the code
//! ```
//!
//! The server therefore stores nothing for a sign-in, and starting many sign-ins exhausts no
//! memory. The provider's answer is accepted only from the browser that began the sign-in, for
//! [`SIGN_IN_TIMEOUT`]. Without the key nobody can compute the state of a cookie.

use base64::Engine as _;
use base64::engine::general_purpose::URL_SAFE_NO_PAD;
use jiff::{SignedDuration, Timestamp};
use ring::hmac;

/// Maximum time from the start of a sign-in to the provider's answer; a later answer is refused.
pub const SIGN_IN_TIMEOUT: SignedDuration = SignedDuration::from_mins(10);
/// Number of random bytes in the cookie of a sign-in, and in a [`PendingKey`].
pub const SIGN_IN_RANDOM_BYTES: usize = 32;
/// Maximum length of a sign-in cookie, in bytes; a longer one is refused.
const COOKIE_MAX: usize = 80;

/// HMAC key from which the values of all sign-ins of one server run are derived.
#[derive(Debug)]
pub struct PendingKey(hmac::Key);

impl PendingKey {
    /// Creates the key from `random`, which must come from the operating system's random generator.
    pub fn from_random(random: &[u8; SIGN_IN_RANDOM_BYTES]) -> Self {
        Self(hmac::Key::new(hmac::HMAC_SHA256, random))
    }
}

/// What a browser presents when the provider redirects it back.
#[derive(Clone, Copy)]
pub struct Presented<'browser> {
    /// Its cookie, as [`Pending::cookie`].
    pub cookie: &'browser str,
    /// The `state` that the provider returned.
    pub state: &'browser str,
}

/// A sign-in that is in progress at the provider.
#[derive(Clone, PartialEq, Eq)]
pub struct Pending {
    cookie: String,
    /// OAuth 2.0 `state`: sent to the provider, which returns it with the authorisation code.
    pub state: String,
    /// OpenID Connect `nonce`, which the ID token must contain.
    pub nonce: String,
    /// PKCE code verifier (RFC 7636), sent with the authorisation code.
    pub verifier: String,
}

impl std::fmt::Debug for Pending {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.debug_struct("Pending").finish_non_exhaustive()
    }
}

impl Pending {
    /// Begins a sign-in at the time `now`. `random` must come from the operating system's
    /// generator.
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

    /// Returns the value of the cookie to set in the browser.
    pub fn cookie(&self) -> &str {
        &self.cookie
    }

    /// Restores the sign-in from what the browser presents.
    ///
    /// Returns `None` if `state` was not derived from `cookie` with `key`, or if the sign-in began
    /// [`SIGN_IN_TIMEOUT`] ago or earlier.
    pub fn resume(key: &PendingKey, presented: Presented<'_>, now: Timestamp) -> Option<Self> {
        use subtle::ConstantTimeEq as _;
        let Presented { cookie, state } = presented;
        if cookie.len() > COOKIE_MAX {
            return None;
        }
        let pending = Self::of(key, cookie.to_owned());
        if !bool::from(pending.state.as_bytes().ct_eq(state.as_bytes())) {
            return None;
        }
        // The matching state authenticates the cookie, so its time can be trusted from here on.
        let (began_s, _random) = cookie.split_once('.')?;
        let began = Timestamp::from_second(began_s.parse().ok()?).ok()?;
        let age = now.duration_since(began);
        (age < SIGN_IN_TIMEOUT).then_some(pending)
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
        let resume = |key: &PendingKey, presented: Presented<'_>, second| {
            Pending::resume(key, presented, time(second))
        };
        let (cookie, state) = (pending.cookie(), pending.state.as_str());
        let own = Presented { cookie, state };
        assert_eq!(resume(&key(1), own, 599), Some(pending.clone()));
        assert_eq!(resume(&key(1), own, 600), None, "too late");
        assert_eq!(resume(&key(2), own, 0), None, "another server's");
        let other = Pending::begin(&key(1), &[3; SIGN_IN_RANDOM_BYTES], time(0));
        for state in [&other.state, ""] {
            let presented = Presented { cookie, state };
            assert_eq!(resume(&key(1), presented, 0), None);
        }
        let cookie_of_other = Presented {
            cookie: other.cookie(),
            ..own
        };
        assert_eq!(resume(&key(1), cookie_of_other, 0), None);
        // Changing the time of the cookie changes the state that it needs.
        let later = cookie.replacen("1800000000", "1800000600", 1);
        assert_ne!(later, cookie);
        let later = Presented {
            cookie: &later,
            ..own
        };
        assert_eq!(resume(&key(1), later, 600), None);
        for odd in ["", ".", "1800000000", &"9".repeat(COOKIE_MAX + 1)] {
            let state = &Pending::of(&key(1), odd.to_owned()).state;
            let presented = Presented { cookie: odd, state };
            assert_eq!(resume(&key(1), presented, 0), None, "{odd}");
        }
    }

    #[test]
    fn what_goes_to_the_provider_tells_nothing_of_the_rest() {
        let pending = Pending::begin(&key(1), &[2; SIGN_IN_RANDOM_BYTES], time(0));
        let texts = [&pending.state, &pending.nonce, &pending.verifier];
        // PKCE requires 43 to 128 unreserved characters.
        assert!(texts.iter().all(|text| text.len() == 43));
        assert!(texts[0] != texts[1] && texts[1] != texts[2] && texts[0] != texts[2]);
        assert!(!format!("{pending:?}").contains(&pending.verifier));
    }
}
