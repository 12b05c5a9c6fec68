//! Authentication: recognises tokens and sessions, and opens and ends browser sessions.
//!
//! ```text
//!  secret shown ─► known in memory? ─yes────────────────────────────────────► who it is
//!                     │ no
//!                  reads? ─yes─► its turn ─► kept and valid? ─yes─► known ───► who it is
//!                     │ no                      │ no
//!                  counted for the lock ◄───────┘
//!                     └─► refused, the same for every cause; while locked: come back later
//! ```
//!
//! Valid tokens are cached at the start of the server and read again every few seconds, so that
//! tokens revoked by `tread-server init` in its own process are refused here too. A token holder
//! therefore needs a look-up only after `init`. Look-ups are limited in number, with a separate
//! limit for Stop requests.

pub mod audit;
mod credential_cache;
mod id_tokens;
pub mod people;
pub(super) mod quota;
pub mod sessions;
pub mod tokens;

use std::net::IpAddr;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use jiff::{SignedDuration, Timestamp};
use tokio::sync::{Semaphore, SemaphorePermit};
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;
use tread_api::identity::Token;
use tread_api::ids::SessionId;

use self::audit::{AuditLog, UsedCredential};
pub use self::credential_cache::Credential;
use self::credential_cache::{CredentialCache, Valid};
use self::people::People;
use super::{App, AppError};
use crate::config::AuditConfig;
use crate::connections::Purpose;
use crate::db::sessions::Owner;
use crate::db::{self, DbError, Tx};
use crate::identity::attempts::{Attempts, Source};
use crate::identity::secret::{Fingerprint, Kind, SECRET_RANDOM_BYTES, Secret};
use crate::identity::subject::SubjectId;

/// Maximum number of sessions of one token or person; opening another ends the oldest.
pub const SESSIONS_EACH_MAX: u32 = 20;
/// Maximum duration of a session; it also ends with its token.
pub const SESSION_LIFETIME_MAX: SignedDuration = SignedDuration::from_hours(12);
/// Maximum time that a request waits for the check of a cached credential.
const RECHECK_MAX: Duration = Duration::from_millis(250);
/// Maximum number of repetitions of a look-up during which something was ended.
const LOOK_UPS_MAX: u32 = 5;
/// Maximum number of look-ups at once: two of the four reading connections.
const LOOK_UP_TURNS: usize = 2;
/// Maximum number of look-ups at once for Stop requests.
const STOP_LOOK_UP_TURNS: usize = 1;
/// Maximum time that a look-up waits for its turn.
const LOOK_UP_WAIT_MAX: Duration = Duration::from_secs(5);
/// Interval at which valid tokens and sessions are read again: of other processes only `init` changes them.
pub const READ_AGAIN: Duration = Duration::from_secs(2);
/// The same in a standby, where another server changes them.
pub const READ_AGAIN_BY_STANDBY: Duration = Duration::from_millis(500);

/// State of authentication in memory.
#[derive(Debug)]
pub(super) struct Identity {
    known: CredentialCache,
    attempts: Mutex<Attempts>,
    audit: AuditLog,
    turns: Semaphore,
    stop_turns: Semaphore,
    people: Option<People>,
    /// When the valid tokens and sessions were read last.
    read_at: Mutex<Option<Instant>>,
}

impl Identity {
    pub(super) fn new(people: Option<People>, audit: AuditConfig) -> Self {
        Self {
            known: CredentialCache::default(),
            attempts: Mutex::default(),
            audit: AuditLog::new(audit),
            turns: Semaphore::new(LOOK_UP_TURNS),
            stop_turns: Semaphore::new(STOP_LOOK_UP_TURNS),
            people,
            read_at: Mutex::default(),
        }
    }
}

/// How a request presents its secret.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CredentialKind {
    /// As a token, in a header or at the sign-in.
    Token,
    /// As a browser's session, in a cookie.
    Session,
}

/// Reason why a secret is refused. The answer does not contain it; it is only counted.
#[derive(Debug, thiserror::Error)]
pub enum SignInError {
    /// The secret is malformed, for instance by a wrong check digit.
    #[error("the token is not valid")]
    Malformed,
    /// The secret is not in the database.
    #[error("the token is not valid")]
    Unknown,
    /// The token or session has expired.
    #[error("the token is not valid")]
    Expired,
    /// The token was revoked.
    #[error("the token is not valid")]
    Revoked,
    /// The secret is invalid, after too many failures. Holds the time until the next attempt.
    #[error("there were too many failed attempts; try again in {} s", .0.as_secs() + 1)]
    Locked(Duration),
    /// The database failed.
    #[error("the database failed")]
    Storage(#[from] DbError),
}

impl App {
    /// Returns the credential of a secret.
    ///
    /// # Errors
    /// [`SignInError`]; all but its kinds `Locked` and `Storage` look the same from outside.
    pub async fn authenticate(
        &self,
        address: IpAddr,
        text: &str,
        shown: CredentialKind,
        purpose: Purpose,
    ) -> Result<Arc<Credential>, SignInError> {
        let secret = Secret::read(text).filter(|secret| match secret.kind() {
            Kind::Token(_) => shown == CredentialKind::Token,
            Kind::Session => shown == CredentialKind::Session,
            Kind::Join | Kind::Webhook => false,
        });
        if let Some(secret) = &secret
            && let Some(credential) = self.known(secret).await
        {
            self.used(&credential);
            return Ok(credential);
        }
        let mut sources = vec![Source::of_address(address)];
        sources.extend(
            secret
                .as_ref()
                .map(|secret| Source::Prefix(secret.prefix().to_owned())),
        );
        let found = match &secret {
            Some(secret) => {
                let _turn = self.lookup_permit(purpose).await?;
                self.look_up(secret).await
            }
            None => Err(SignInError::Malformed),
        };
        match found {
            Ok(credential) => {
                self.used(&credential);
                Ok(credential)
            }
            Err(error @ SignInError::Storage(_)) => Err(error),
            Err(error) => {
                if let Some(left) = self.locked_for(&sources) {
                    return Err(SignInError::Locked(left));
                }
                self.failed(sources);
                Err(error)
            }
        }
    }

    /// Waits for permission to look up a secret that is not cached.
    pub(super) async fn lookup_permit(
        &self,
        purpose: Purpose,
    ) -> Result<SemaphorePermit<'_>, DbError> {
        let turns = match purpose {
            Purpose::Stop => &self.identity().stop_turns,
            Purpose::Other => &self.identity().turns,
        };
        let turn = tokio::time::timeout(LOOK_UP_WAIT_MAX, turns.acquire()).await;
        let turn = turn.ok().and_then(Result::ok);
        turn.ok_or(DbError::Busy)
    }

    /// Reads the valid tokens and sessions from the database: caches all valid tokens, and ends
    /// cached credentials that are no longer valid.
    ///
    /// # Errors
    /// The database failed; the cache is unchanged.
    pub async fn load_tokens(&self) -> Result<(), AppError> {
        let known = &self.identity().known;
        let (generation, began_at) = (known.generation(), self.clock().elapsed());
        let asked_at = Instant::now();
        let mut valid = self.valid().await?;
        if known.any_gone(&valid, began_at) {
            // SQLite can return no row for lack of memory, but not twice in a row.
            valid.join(self.valid().await?);
        }
        known.read_again(valid, generation, began_at);
        let mut read_at = self.identity().read_at.lock();
        *read_at
            .as_deref_mut()
            .unwrap_or_else(|poisoned| poisoned.get_mut()) = Some(asked_at);
        Ok(())
    }

    /// Returns the time since the valid tokens and sessions were read; `None` if they never were.
    pub fn tokens_age(&self) -> Option<Duration> {
        let read_at = self.identity().read_at.lock();
        let at = *read_at.unwrap_or_else(PoisonError::into_inner);
        Some(at?.elapsed())
    }

    async fn valid(&self) -> Result<Valid, AppError> {
        let (now, elapsed) = (self.clock().now(), self.clock().elapsed());
        let mut tx = self.db().read("identity").await?;
        let kept = db::tokens::all_valid(&mut tx, now).await?;
        let sessions = db::sessions::all_valid(&mut tx, now).await?;
        let mut valid = Valid::default();
        for db::secrets::TokenRow { hash, token } in kept {
            let expires_at = token.expires_at;
            valid.token_ids.insert(token.id);
            if let Some(fingerprint) = Fingerprint::from_kept(&hash) {
                let credential = Credential::new(&token, None, expires_at, elapsed);
                valid.tokens.push((fingerprint, credential));
            }
        }
        valid.sessions.extend(sessions);
        Ok(valid)
    }

    /// Returns the cached credential of a secret, if it is still valid.
    async fn known(&self, secret: &Secret) -> Option<Arc<Credential>> {
        let known = &self.identity().known;
        let credential = known.find(&secret.fingerprint(), self.clock().now())?;
        if credential.is_fresh(self.clock().elapsed()) {
            return Some(credential);
        }
        // A cached credential remains valid while the database fails or is slow, above all for a
        // Stop. Revocations of this process take effect in memory, those of others as soon as they
        // can be read.
        let Some(recheck) = known.recheck(self.clock().elapsed()) else {
            return Some(credential);
        };
        let check = || tokio::time::timeout(RECHECK_MAX, self.kept(secret));
        let mut checked = check().await;
        if matches!(&checked, Ok(Err(gone)) if !matches!(gone, SignInError::Storage(_))) {
            // SQLite can return no row for lack of memory, but not twice in a row.
            checked = check().await;
        }
        match checked {
            Ok(Ok(_)) => {
                credential.checked(self.clock().elapsed());
                recheck.succeeded();
            }
            Ok(Err(SignInError::Storage(cause))) => {
                self.log_failure("look up again who is signed in", &cause);
            }
            Err(_slow) => {}
            Ok(Err(_gone)) => {
                recheck.succeeded();
                known.end(|other| std::ptr::eq(other, &raw const *credential));
                return None;
            }
        }
        Some(credential)
    }

    /// Looks up the credential of a secret in the database.
    async fn kept(&self, secret: &Secret) -> Result<Credential, SignInError> {
        let (now, elapsed) = (self.clock().now(), self.clock().elapsed());
        let fingerprint = secret.fingerprint();
        let mut tx = self.db().read("identity").await?;
        let (token, session, expires_at) = match secret.kind() {
            Kind::Token(_) => token_of(&mut tx, &fingerprint).await?,
            Kind::Session => {
                let kept = db::sessions::by_lookup(&mut tx, &fingerprint).await?;
                let kept = kept.filter(|kept| fingerprint.matches(&kept.hash));
                let kept = kept.ok_or(SignInError::Unknown)?;
                match kept.owner {
                    Owner::Token(token) => {
                        let token = db::tokens::find(&mut tx, token).await?;
                        let token = token.ok_or(SignInError::Unknown)?;
                        let expires_at = kept.expires_at.min(token.expires_at);
                        (token, Some(kept.id), expires_at)
                    }
                    Owner::Person(_) if kept.expires_at <= now => return Err(SignInError::Expired),
                    Owner::Person(_) => {
                        let person = self.person_of(kept, elapsed);
                        return person.ok_or(SignInError::Unknown);
                    }
                }
            }
            // A join token gives no access, and a webhook's secret only signs.
            Kind::Join | Kind::Webhook => return Err(SignInError::Unknown),
        };
        if token.revoked_at.is_some() {
            Err(SignInError::Revoked)
        } else if expires_at <= now {
            Err(SignInError::Expired)
        } else {
            Ok(Credential::new(&token, session, expires_at, elapsed))
        }
    }

    fn used(&self, credential: &Credential) {
        // A standby cannot store it.
        if self.is_standby() {
            return;
        }
        let now = self.clock().now();
        if credential.touch(now) {
            let used = match (credential.subject, credential.session) {
                (SubjectId::Token(token), _) => UsedCredential::Token(token),
                (SubjectId::Person(_), Some(session)) => UsedCredential::Session(session),
                (SubjectId::Person(_), None) => return,
            };
            self.record_use(used, now);
        }
    }

    pub(super) fn locked_for(&self, sources: &[Source]) -> Option<Duration> {
        let now = self.clock().elapsed();
        let attempts = &self.identity().attempts;
        let attempts = attempts.lock().unwrap_or_else(PoisonError::into_inner);
        let locked = |source| attempts.locked_for(source, now);
        sources.iter().filter_map(locked).max()
    }

    pub(super) fn failed(&self, sources: Vec<Source>) {
        let now = self.clock().elapsed();
        let attempts = &self.identity().attempts;
        let mut attempts = attempts.lock().unwrap_or_else(PoisonError::into_inner);
        for source in sources {
            attempts.failed(source, now);
        }
    }

    async fn look_up(&self, secret: &Secret) -> Result<Arc<Credential>, SignInError> {
        let fingerprint = secret.fingerprint();
        let known = &self.identity().known;
        for _ in 0..LOOK_UPS_MAX {
            let generation = known.generation();
            let credential = self.kept(secret).await?;
            let now = self.clock().now();
            if let Some(kept) = known.insert(fingerprint, credential, generation, now) {
                return Ok(kept);
            }
        }
        Err(SignInError::Unknown)
    }
}

/// Reads the valid tokens and sessions at an interval until the stop.
pub async fn run(app: App, every: Duration, stop: CancellationToken) {
    loop {
        tokio::select! {
            () = stop.cancelled() => return,
            () = tokio::time::sleep(every) => {}
        }
        if let Err(error) = db::limited(app.load_tokens()).await {
            app.log_failure("read the valid tokens", &error);
        }
    }
}

/// Returns the token of a secret and its expiry.
async fn token_of(
    tx: &mut Tx,
    fingerprint: &Fingerprint,
) -> Result<(Token, Option<SessionId>, Timestamp), SignInError> {
    let kept = db::tokens::by_lookup(tx, fingerprint).await?;
    let kept = kept.filter(|kept| fingerprint.matches(&kept.hash));
    let token = kept.ok_or(SignInError::Unknown)?.token;
    let expires_at = token.expires_at;
    Ok((token, None, expires_at))
}

/// Returns a new secret from the operating system's random numbers; all secrets are made here.
pub(super) fn new_secret(kind: Kind) -> Result<Secret, AppError> {
    let mut random = [0; SECRET_RANDOM_BYTES];
    getrandom::fill(&mut random).map_err(|error| AppError::NoRandomness(error.to_string()))?;
    Ok(Secret::from_random(kind, &random))
}
