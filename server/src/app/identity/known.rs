//! Who has shown a good secret, in memory: looked up once, then known until it expires or is
//! ended, and looked up again now and then, since `tread-server init` may have replaced it.
//!
//! A look-up that began before something was ended must not be kept after it: each end raises the
//! generation, and only what was looked up within the present one is kept.

use std::collections::HashMap;
use std::sync::atomic::{AtomicI64, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use jiff::{SignedDuration, Timestamp};
use tokio_util::sync::CancellationToken;
use tread_api::identity::{Role, Session};
use tread_api::ids::{SessionId, TokenId};

use crate::identity::secret::Fingerprint;

/// Above so many, expired ones are dropped before another is kept. What is valid is bounded by
/// the bounds on tokens and sessions.
const KNOWN_MAX: usize = 4_096;
/// A token's last use is noted this often at the most.
const TOUCH_EVERY: SignedDuration = SignedDuration::from_mins(10);

/// How long who is known is not looked up again.
const FRESH: Duration = Duration::from_secs(5);

/// Somebody who has shown a good secret.
#[derive(Debug)]
pub struct Credential {
    /// The token that was shown, or that the session was opened with.
    pub token: TokenId,
    /// The token's name.
    pub name: String,
    /// What it may do.
    pub role: Role,
    /// The browser's session, if it is one.
    pub session: Option<SessionId>,
    /// From when on it is refused.
    pub expires_at: Timestamp,
    ended: CancellationToken,
    touched_us: AtomicI64,
    /// When it was looked up last, on the monotonic clock.
    checked_ms: AtomicU64,
}

impl Credential {
    pub(super) fn new(
        token: &tread_api::identity::Token,
        session: Option<SessionId>,
        expires_at: Timestamp,
        checked_at: Duration,
    ) -> Self {
        let touched = token.last_used_at;
        Self {
            token: token.id,
            name: token.name.clone(),
            role: token.role,
            session,
            expires_at,
            ended: CancellationToken::new(),
            touched_us: AtomicI64::new(touched.map_or(i64::MIN, Timestamp::as_microsecond)),
            checked_ms: AtomicU64::new(to_ms(checked_at)),
        }
    }

    /// Whether it was looked up a moment ago.
    pub(super) fn is_fresh(&self, now: Duration) -> bool {
        let checked_ms = self.checked_ms.load(Ordering::Relaxed);
        to_ms(now).saturating_sub(checked_ms) < to_ms(FRESH)
    }

    /// Notes that it was looked up and still holds.
    pub(super) fn checked(&self, now: Duration) {
        self.checked_ms.store(to_ms(now), Ordering::Relaxed);
    }

    /// Cancelled when the token is revoked or the session ended; whatever stays open for long
    /// (streams, sockets) must watch it, and [`Self::expires_at`].
    pub fn ended(&self) -> CancellationToken {
        self.ended.clone()
    }

    /// As the API shows it.
    pub fn session(&self) -> Session {
        Session {
            name: self.name.clone(),
            role: self.role,
            token: self.token,
            session: self.session,
            expires_at: self.expires_at,
        }
    }

    /// Whether this use is to be noted.
    pub(super) fn touch(&self, now: Timestamp) -> bool {
        let now_us = now.as_microsecond();
        let every_us = i64::try_from(TOUCH_EVERY.as_micros()).unwrap_or(i64::MAX);
        let due =
            |touched_us: i64| (now_us.saturating_sub(touched_us) >= every_us).then_some(now_us);
        self.touched_us
            .fetch_update(Ordering::Relaxed, Ordering::Relaxed, due)
            .is_ok()
    }
}

fn to_ms(time: Duration) -> u64 {
    u64::try_from(time.as_millis()).unwrap_or(u64::MAX)
}

/// All who are known.
#[derive(Debug, Default)]
pub(super) struct Known {
    inner: Mutex<Inner>,
}

#[derive(Debug, Default)]
struct Inner {
    credentials: HashMap<Fingerprint, Arc<Credential>>,
    generation: u64,
}

impl Known {
    fn lock(&self) -> MutexGuard<'_, Inner> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(super) fn generation(&self) -> u64 {
        self.lock().generation
    }

    /// Who is known by a secret that is still valid.
    pub(super) fn find(&self, secret: &Fingerprint, now: Timestamp) -> Option<Arc<Credential>> {
        let mut inner = self.lock();
        let found = inner.credentials.get(secret)?;
        if found.expires_at > now {
            return Some(Arc::clone(found));
        }
        found.ended.cancel();
        inner.credentials.remove(secret);
        None
    }

    /// Keeps who was looked up within a generation; `None` if it is over, and the look-up is to
    /// be repeated.
    pub(super) fn keep(
        &self,
        secret: Fingerprint,
        credential: Credential,
        generation: u64,
        now: Timestamp,
    ) -> Option<Arc<Credential>> {
        let mut inner = self.lock();
        if inner.generation != generation {
            return None;
        }
        if inner.credentials.len() >= KNOWN_MAX {
            inner.credentials.retain(|_, known| known.expires_at > now);
        }
        let kept = inner.credentials.entry(secret);
        Some(Arc::clone(kept.or_insert_with(|| Arc::new(credential))))
    }

    /// Ends everybody of whom something holds: nothing they ask from now on is answered, and
    /// what they have open closes.
    pub(super) fn end(&self, whom: impl Fn(&Credential) -> bool) {
        let mut inner = self.lock();
        inner.generation += 1;
        inner.credentials.retain(|_, known| {
            let ends = whom(known);
            if ends {
                known.ended.cancel();
            }
            !ends
        });
    }
}

#[cfg(test)]
mod tests {
    use tread_api::identity::Token;

    use super::*;
    use crate::identity::secret::{Kind, Secret};

    fn time(second: i64) -> Timestamp {
        Timestamp::from_second(second).unwrap()
    }

    fn credential(expires_at: Timestamp) -> Credential {
        let token = Token {
            id: TokenId::from_uuid(uuid::Uuid::from_u128(7)),
            name: "desk".to_owned(),
            role: Role::Operator,
            created_at: time(0),
            created_by: "test".to_owned(),
            expires_at,
            revoked_at: None,
            last_used_at: None,
        };
        Credential::new(&token, None, expires_at, Duration::ZERO)
    }

    fn secret(byte: u8) -> Fingerprint {
        Secret::from_random(Kind::Session, &[byte; 32]).fingerprint()
    }

    #[test]
    fn a_look_up_that_began_before_an_end_is_not_kept_after_it() {
        let known = Known::default();
        let generation = known.generation();
        known.end(|_| false);
        let late = known.keep(secret(1), credential(time(9)), generation, time(1));
        assert!(late.is_none());
        assert!(known.find(&secret(1), time(1)).is_none());
    }

    #[test]
    fn who_expires_or_is_ended_is_gone_and_told_so() {
        let known = Known::default();
        let keep = |byte| {
            let generation = known.generation();
            known
                .keep(secret(byte), credential(time(9)), generation, time(1))
                .unwrap()
        };
        let (first, second) = (keep(1), keep(2));
        assert!(known.find(&secret(1), time(8)).is_some());
        assert!(known.find(&secret(1), time(9)).is_none());
        assert!(first.ended().is_cancelled() && !second.ended().is_cancelled());
        known.end(|known| known.name == "desk");
        assert!(second.ended().is_cancelled());
        assert!(known.find(&secret(2), time(1)).is_none());
    }

    #[test]
    fn who_is_known_is_looked_up_again_after_a_while() {
        let known = credential(time(9));
        let seconds = Duration::from_secs;
        assert!(known.is_fresh(seconds(4)) && !known.is_fresh(seconds(5)));
        known.checked(seconds(5));
        assert!(known.is_fresh(seconds(9)) && !known.is_fresh(seconds(10)));
    }

    #[test]
    fn a_use_is_noted_now_and_then() {
        let known = credential(time(9_999));
        let noted = (0..3_600)
            .filter(|&second| known.touch(time(second)))
            .count();
        assert_eq!(noted, 6);
    }
}
