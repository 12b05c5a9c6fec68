//! Tokens and sessions: made, shown, ended.
//!
//! ```text
//!  secret shown ─► known in memory? ─yes────────────────────────────────────► who it is
//!                     │ no
//!                  address or prefix locked? ─yes─► come back later
//!                     │ no
//!                  reads, is kept, is valid? ─yes─► known from now on ──────► who it is
//!                     │ no
//!                  counted for the lock ─► refused, the same for every cause
//! ```

pub mod audit;
mod known;

use std::net::IpAddr;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use jiff::{SignedDuration, Timestamp};
use tread_api::identity::{
    AuditEntry, CreateToken, CreatedToken, Role, TOKEN_DAYS_DEFAULT, TOKEN_DAYS_MAX,
    TOKEN_NAME_MAX, Token,
};
use tread_api::ids::{SessionId, TokenId};
use tread_api::page::Page;

use self::audit::AuditLog;
pub use self::known::Credential;
use self::known::Known;
use super::{App, AppError, page};
use crate::db::sessions::NewSession;
use crate::db::{self, DbError, Tx};
use crate::identity::attempts::{Attempts, Source};
use crate::identity::secret::{Fingerprint, Kind, RANDOM_BYTES, Secret};

/// Most tokens that are valid at once.
pub const TOKENS_MAX: usize = 1_000;
/// Most sessions of one token; the oldest ends when another begins.
pub const SESSIONS_PER_TOKEN_MAX: u32 = 20;
/// How long a session lasts, at the most as long as its token.
pub const SESSION_LASTS: SignedDuration = SignedDuration::from_hours(12);
/// How long dead tokens are listed.
const DEAD_KEPT: SignedDuration = SignedDuration::from_hours(400 * 24);
/// Dead tokens that are forgotten with each new one.
const FORGET_MAX: u32 = 10;
/// How long a request waits for whoever is known to be looked up again.
const RECHECK_MAX: Duration = Duration::from_millis(250);
/// How often a look-up is repeated that something was ended during.
const LOOK_UPS_MAX: u32 = 5;

/// What is remembered of who asks.
#[derive(Debug, Default)]
pub(super) struct Identity {
    known: Known,
    attempts: Mutex<Attempts>,
    audit: AuditLog,
}

/// How a secret was shown.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Shown {
    /// As a token, in a header or at the sign-in.
    Token,
    /// As a browser's session, in a cookie.
    Session,
}

/// Why a secret opens nothing. Who asks is told no more than that; the rest is for the counters.
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
    /// There were too many failures; nothing was looked up.
    #[error("there were too many failed attempts; try again in {} s", .0.as_secs() + 1)]
    Locked(Duration),
    /// The database failed.
    #[error("the database failed")]
    Storage(#[from] DbError),
}

/// Asks for the first token of a server.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FirstAdmin {
    /// What people call it.
    pub name: String,
    /// Days until it is refused.
    pub valid_days: u32,
    /// Make it even if there is an admin, in place of a valid token of the same name.
    pub force: bool,
}

impl App {
    /// Makes a token.
    ///
    /// # Errors
    /// An impossible name or time, a name that is taken, or too many tokens.
    pub async fn create_token(
        &self,
        request: CreateToken,
        created_by: &str,
    ) -> Result<CreatedToken, AppError> {
        let mut tx = self.db().write().await?;
        let created = self.new_token(&mut tx, request, created_by).await?;
        tx.commit().await?;
        Ok(created)
    }

    /// Makes an admin's token where nobody is there to ask for it.
    ///
    /// # Errors
    /// There is a valid admin's token, unless it is forced.
    pub async fn create_first_admin(&self, first: FirstAdmin) -> Result<CreatedToken, AppError> {
        let now = self.clock().now();
        let mut tx = self.db().write().await?;
        let (_, admin_count) = db::tokens::valid_counts(&mut tx, now).await?;
        if admin_count > 0 && !first.force {
            return Err(AppError::AlreadyExists {
                what: "an admin's token",
                id: "init".to_owned(),
            });
        }
        let name = first.name.trim();
        let replaced = db::tokens::valid_by_name(&mut tx, name, now).await?;
        if let Some(replaced) = &replaced {
            db::tokens::revoke(&mut tx, replaced.id, now).await?;
        }
        let request = CreateToken {
            name: first.name,
            role: Role::Admin,
            valid_days: Some(first.valid_days),
        };
        let created = self.new_token(&mut tx, request, "init").await?;
        let entry = AuditEntry {
            id: 0,
            at: now,
            who: Some("init".to_owned()),
            token: None,
            role: None,
            address: "this machine".to_owned(),
            method: "RUN".to_owned(),
            route: "tread-server init".to_owned(),
            path: "tread-server init".to_owned(),
            status: 201,
            request_id: String::new(),
            what: Some(serde_json::json!({"name": created.token.name, "role": "admin"})),
        };
        db::audit::insert(&mut tx, &entry).await?;
        tx.commit().await?;
        if let Some(replaced) = replaced {
            self.identity()
                .known
                .end(|known| known.token == replaced.id);
        }
        Ok(created)
    }

    /// How many admins' tokens are valid.
    pub async fn admin_count(&self) -> Result<i64, AppError> {
        let mut tx = self.db().read().await?;
        let counts = db::tokens::valid_counts(&mut tx, self.clock().now()).await?;
        Ok(counts.1)
    }

    async fn new_token(
        &self,
        tx: &mut Tx,
        request: CreateToken,
        created_by: &str,
    ) -> Result<CreatedToken, AppError> {
        let now = self.clock().now();
        let name = token_name(&request.name)?;
        let expires_at = expiry(now, request.valid_days)?;
        let (valid_count, _) = db::tokens::valid_counts(tx, now).await?;
        if usize::try_from(valid_count).is_ok_and(|count| count >= TOKENS_MAX) {
            return Err(AppError::TooMany {
                what: "valid tokens",
                count: TOKENS_MAX,
            });
        }
        if db::tokens::valid_by_name(tx, &name, now).await?.is_some() {
            return Err(AppError::AlreadyExists {
                what: "token",
                id: name,
            });
        }
        let secret = new_secret(Kind::Token(request.role))?;
        let token = Token {
            id: TokenId::from_uuid(self.clock().mission_id().as_uuid()),
            name,
            role: request.role,
            created_at: now,
            created_by: created_by.to_owned(),
            expires_at,
            revoked_at: None,
            last_used_at: None,
        };
        db::tokens::insert(tx, &token, &secret.fingerprint()).await?;
        if let Ok(before) = now.checked_sub(DEAD_KEPT) {
            db::tokens::forget_dead(tx, before, FORGET_MAX).await?;
        }
        Ok(CreatedToken {
            token,
            secret: secret.reveal().to_owned(),
        })
    }

    /// Tokens, newest first; dead ones too.
    pub async fn tokens(
        &self,
        before: Option<TokenId>,
        limit: u32,
    ) -> Result<Page<Token>, AppError> {
        let mut tx = self.db().read().await?;
        let tokens = db::tokens::list(&mut tx, before, limit + 1).await?;
        Ok(page(tokens, limit, |token: &Token| token.id.to_string()))
    }

    /// Revokes a token: from now on it is refused, its sessions end, and what it has open closes.
    ///
    /// # Errors
    /// [`AppError::UnknownToken`].
    pub async fn revoke_token(&self, id: TokenId) -> Result<Token, AppError> {
        let mut tx = self.db().write().await?;
        db::tokens::revoke(&mut tx, id, self.clock().now()).await?;
        let token = db::tokens::find(&mut tx, id).await?;
        let token = token.ok_or(AppError::UnknownToken(id))?;
        tx.commit().await?;
        self.identity().known.end(|known| known.token == id);
        Ok(token)
    }

    /// Who shows a secret.
    ///
    /// # Errors
    /// [`SignInError`]; all but its kinds `Locked` and `Storage` look the same from outside.
    pub async fn authenticate(
        &self,
        address: IpAddr,
        text: &str,
        shown: Shown,
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
        if let Some(left) = self.locked_for(&sources) {
            return Err(SignInError::Locked(left));
        }
        let found = match &secret {
            Some(secret) => self.look_up(secret).await,
            None => Err(SignInError::Malformed),
        };
        match &found {
            Ok(credential) => self.used(credential),
            Err(SignInError::Storage(_)) => {}
            Err(_) => self.failed(sources),
        }
        found
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
        let check = || tokio::time::timeout(RECHECK_MAX, self.kept(secret));
        let mut checked = check().await;
        if matches!(&checked, Ok(Err(gone)) if !matches!(gone, SignInError::Storage(_))) {
            // A row that was lost for want of memory reads as none, but not twice.
            checked = check().await;
        }
        match checked {
            Ok(Ok(_)) => credential.checked(self.clock().elapsed()),
            Ok(Err(SignInError::Storage(cause))) => {
                self.log_failure("look up again who is signed in", &cause);
            }
            Err(_slow) => {}
            Ok(Err(_gone)) => {
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
        let mut tx = self.db().read().await?;
        let (token, session, expires_at) = match secret.kind() {
            Kind::Token(_) => token_of(&mut tx, &fingerprint).await?,
            Kind::Session => session_of(&mut tx, &fingerprint).await?,
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
            self.note_use(credential.token, now);
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

    /// Opens a session for a browser that has shown a token, and tells its secret.
    ///
    /// # Errors
    /// The database failed, or the operating system gives no random numbers.
    pub async fn open_session(
        &self,
        credential: &Credential,
    ) -> Result<(Arc<Credential>, Secret), AppError> {
        let now = self.clock().now();
        let secret = new_secret(Kind::Session)?;
        let lasts_until = now.checked_add(SESSION_LASTS).unwrap_or(Timestamp::MAX);
        let session = NewSession {
            id: SessionId::from_uuid(self.clock().mission_id().as_uuid()),
            token: credential.token,
            fingerprint: secret.fingerprint(),
            created_at: now,
            expires_at: lasts_until.min(credential.expires_at),
        };
        let mut tx = self.db().write().await?;
        let valid = db::tokens::find(&mut tx, credential.token).await?;
        let valid = valid.filter(|token| token.revoked_at.is_none());
        if valid.is_none() {
            return Err(AppError::UnknownToken(credential.token));
        }
        db::sessions::forget_expired(&mut tx, now).await?;
        db::sessions::insert(&mut tx, &session).await?;
        let surplus =
            db::sessions::surplus(&mut tx, credential.token, SESSIONS_PER_TOKEN_MAX).await?;
        for &id in &surplus {
            db::sessions::delete(&mut tx, id).await?;
        }
        tx.commit().await?;
        if !surplus.is_empty() {
            let is_surplus = |known: &Credential| {
                known
                    .session
                    .is_some_and(|session| surplus.contains(&session))
            };
            self.identity().known.end(is_surplus);
        }
        let opened = self.look_up(&secret).await.map_err(|error| match error {
            SignInError::Storage(cause) => AppError::Storage(cause),
            SignInError::Malformed
            | SignInError::Unknown
            | SignInError::Expired
            | SignInError::Revoked
            | SignInError::Locked(_) => AppError::UnknownToken(credential.token),
        })?;
        Ok((opened, secret))
    }

    /// Ends a browser's session.
    pub async fn end_session(&self, id: SessionId) -> Result<(), AppError> {
        let mut tx = self.db().write().await?;
        db::sessions::delete(&mut tx, id).await?;
        tx.commit().await?;
        self.identity().known.end(|known| known.session == Some(id));
        Ok(())
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

/// The session of a secret with its token, and when the first of them expires.
async fn session_of(
    tx: &mut Tx,
    fingerprint: &Fingerprint,
) -> Result<(Token, Option<SessionId>, Timestamp), SignInError> {
    let kept = db::sessions::by_lookup(tx, fingerprint).await?;
    let kept = kept.filter(|kept| fingerprint.matches(&kept.hash));
    let session = kept.ok_or(SignInError::Unknown)?;
    let token = db::tokens::find(tx, session.token).await?;
    let token = token.ok_or(SignInError::Unknown)?;
    let expires_at = session.expires_at.min(token.expires_at);
    Ok((token, Some(session.id), expires_at))
}

/// A new secret of the operating system's random numbers: the only place that makes one.
pub(super) fn new_secret(kind: Kind) -> Result<Secret, AppError> {
    let mut random = [0; RANDOM_BYTES];
    getrandom::fill(&mut random).map_err(|error| AppError::NoRandomness(error.to_string()))?;
    Ok(Secret::from_random(kind, &random))
}

fn token_name(name: &str) -> Result<String, AppError> {
    let trimmed = name.trim();
    let is_visible = !trimmed.chars().any(char::is_control);
    if trimmed.is_empty() || trimmed.chars().count() > TOKEN_NAME_MAX || !is_visible {
        let detail = format!("a name has 1 to {TOKEN_NAME_MAX} visible characters");
        return Err(AppError::Invalid {
            field: "name",
            detail,
        });
    }
    Ok(trimmed.to_owned())
}

fn expiry(now: Timestamp, valid_days: Option<u32>) -> Result<Timestamp, AppError> {
    let days = valid_days.unwrap_or(TOKEN_DAYS_DEFAULT);
    if !(1..=TOKEN_DAYS_MAX).contains(&days) {
        let detail = format!("valid_days must be 1 to {TOKEN_DAYS_MAX}, not {days}");
        return Err(AppError::Invalid {
            field: "valid_days",
            detail,
        });
    }
    let span = SignedDuration::from_hours(24 * i64::from(days));
    Ok(now.checked_add(span).unwrap_or(Timestamp::MAX))
}
