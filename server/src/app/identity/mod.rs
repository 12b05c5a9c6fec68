//! Who asks: tokens and sessions recognised, browser sessions opened and ended.
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
//! What is valid is known from the start of the server, and read again every few seconds, so that
//! what `tread-server init` revokes in its own process ends here too. So nobody who may come in
//! needs a look-up but after `init`; look-ups take turns, of which a Stop has one of its own.

pub mod audit;
mod id_tokens;
mod known;
pub mod people;
pub(super) mod quota;
pub mod sessions;
pub mod tokens;

use std::net::IpAddr;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::time::Duration;

use jiff::{SignedDuration, Timestamp};
use tokio::sync::{Semaphore, SemaphorePermit};
use tokio_util::sync::CancellationToken;
use tread_api::identity::Token;
use tread_api::ids::SessionId;

use self::audit::{AuditLog, Used};
pub use self::known::Credential;
use self::known::{Known, Valid};
use self::people::People;
use super::{App, AppError};
use crate::connections::Purpose;
use crate::db::sessions::Owner;
use crate::db::{self, DbError, Tx};
use crate::identity::attempts::{Attempts, Source};
use crate::identity::secret::{Fingerprint, Kind, SECRET_RANDOM_BYTES, Secret};
use crate::identity::subject::SubjectId;

/// Most sessions of one token or person; the oldest ends when another begins.
pub const SESSIONS_EACH_MAX: u32 = 20;
/// How long a session lasts, at the most as long as its token.
pub const SESSION_LASTS: SignedDuration = SignedDuration::from_hours(12);
/// How long a request waits for whoever is known to be looked up again.
const RECHECK_MAX: Duration = Duration::from_millis(250);
/// How often a look-up is repeated that something was ended during.
const LOOK_UPS_MAX: u32 = 5;
/// Secrets that are looked up at once: of four connections that read, strangers get two.
const LOOK_UP_TURNS: usize = 2;
/// The same of those who ask for a Stop.
const STOP_LOOK_UP_TURNS: usize = 1;
/// How long a secret waits for its turn to be looked up.
const LOOK_UP_WAIT_MAX: Duration = Duration::from_secs(5);
/// How often what is valid is read again.
const READ_AGAIN: Duration = Duration::from_secs(2);

/// What is remembered of who asks.
#[derive(Debug)]
pub(super) struct Identity {
    known: Known,
    attempts: Mutex<Attempts>,
    audit: AuditLog,
    turns: Semaphore,
    stop_turns: Semaphore,
    people: OnceLock<People>,
}

impl Default for Identity {
    fn default() -> Self {
        Self {
            known: Known::default(),
            attempts: Mutex::default(),
            audit: AuditLog::default(),
            turns: Semaphore::new(LOOK_UP_TURNS),
            stop_turns: Semaphore::new(STOP_LOOK_UP_TURNS),
            people: OnceLock::new(),
        }
    }
}

/// How a secret was shown.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Shown {
    /// As a token, in a header or at the sign-in.
    Token,
    /// As a browser's session, in a cookie.
    Session,
}

/// Why a secret opens nothing. The answer says no more than that; the rest is for the counters.
#[derive(Debug, thiserror::Error)]
pub enum SignInError {
    /// It cannot be one: a digit is wrong.
    #[error("the token is not valid")]
    Malformed,
    /// Nothing is kept of it.
    #[error("the token is not valid")]
    Unknown,
    /// Its time is over.
    #[error("the token is not valid")]
    Expired,
    /// It was revoked.
    #[error("the token is not valid")]
    Revoked,
    /// It opens nothing, and there were too many such before.
    #[error("there were too many failed attempts; try again in {} s", .0.as_secs() + 1)]
    Locked(Duration),
    /// The database failed.
    #[error("the database failed")]
    Storage(#[from] DbError),
}

impl App {
    /// Who shows a secret.
    ///
    /// # Errors
    /// [`SignInError`]; all but its kinds `Locked` and `Storage` look the same from outside.
    pub async fn authenticate(
        &self,
        address: IpAddr,
        text: &str,
        shown: Shown,
        purpose: Purpose,
    ) -> Result<Arc<Credential>, SignInError> {
        let secret = Secret::read(text).filter(|secret| match secret.kind() {
            Kind::Token(_) => shown == Shown::Token,
            Kind::Session => shown == Shown::Session,
            Kind::Join => false,
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
                let _turn = self.look_up_turn(purpose).await?;
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

    /// Waits until a secret that is not known may be looked up.
    pub(super) async fn look_up_turn(
        &self,
        purpose: Purpose,
    ) -> Result<SemaphorePermit<'_>, DbError> {
        let turns = match purpose {
            Purpose::Stop => &self.identity().stop_turns,
            Purpose::Other => &self.identity().turns,
        };
        let turn = tokio::time::timeout(LOOK_UP_WAIT_MAX, turns.acquire()).await;
        let turn = turn.ok().and_then(Result::ok);
        turn.ok_or(DbError::Sqlite(sqlx::Error::PoolTimedOut))
    }

    /// Reads which tokens and sessions are valid: tokens are known from now on, and who is known
    /// and no longer valid is ended with what they have open.
    ///
    /// # Errors
    /// The database failed; everything stays as it was.
    pub async fn know_tokens(&self) -> Result<(), AppError> {
        let known = &self.identity().known;
        let (generation, began_at) = (known.generation(), self.clock().elapsed());
        let mut valid = self.valid().await?;
        if known.any_gone(&valid, began_at) {
            // A row that was lost for want of memory reads as none, but not twice.
            valid.join(self.valid().await?);
        }
        known.read_again(valid, generation, began_at);
        Ok(())
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

    /// Who is known in memory, and still holds.
    async fn known(&self, secret: &Secret) -> Option<Arc<Credential>> {
        let known = &self.identity().known;
        let credential = known.find(&secret.fingerprint(), self.clock().now())?;
        if credential.is_fresh(self.clock().elapsed()) {
            return Some(credential);
        }
        // Who was let in before is let in while the database fails or is slow, for a Stop above
        // all: what is revoked here ends in memory, and elsewhere as soon as it can be read.
        let Some(recheck) = known.recheck(self.clock().elapsed()) else {
            return Some(credential);
        };
        let check = || tokio::time::timeout(RECHECK_MAX, self.kept(secret));
        let mut checked = check().await;
        if matches!(&checked, Ok(Err(gone)) if !matches!(gone, SignInError::Storage(_))) {
            // A row that was lost for want of memory reads as none, but not twice.
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

    /// What the database says of a secret.
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
            // It lets robots join and opens nothing.
            Kind::Join => return Err(SignInError::Unknown),
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
        let now = self.clock().now();
        if credential.touch(now) {
            let used = match (credential.subject, credential.session) {
                (SubjectId::Token(token), _) => Used::Token(token),
                (SubjectId::Person(_), Some(session)) => Used::Session(session),
                (SubjectId::Person(_), None) => return,
            };
            self.note_use(used, now);
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
            if let Some(kept) = known.keep(fingerprint, credential, generation, now) {
                return Ok(kept);
            }
        }
        Err(SignInError::Unknown)
    }
}

/// Reads again and again what is valid, until the stop.
pub async fn run(app: App, stop: CancellationToken) {
    loop {
        tokio::select! {
            () = stop.cancelled() => return,
            () = tokio::time::sleep(READ_AGAIN) => {}
        }
        if let Err(error) = db::limited(app.know_tokens()).await {
            app.log_failure("read the valid tokens", &error);
        }
    }
}

/// The token of a secret, and when it expires.
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

/// A new secret of the operating system's random numbers: the only place that makes one.
pub(super) fn new_secret(kind: Kind) -> Result<Secret, AppError> {
    let mut random = [0; SECRET_RANDOM_BYTES];
    getrandom::fill(&mut random).map_err(|error| AppError::NoRandomness(error.to_string()))?;
    Ok(Secret::from_random(kind, &random))
}
