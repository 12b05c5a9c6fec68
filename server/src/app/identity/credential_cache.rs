//! Cache of credentials by the secret that was shown. A credential is cached until it expires or is
//! ended, and checked in the database from time to time, since `tread-server init` may have
//! replaced it.
//!
//! A look-up that began before something was ended must not be cached afterwards: each end
//! increments the generation, and a look-up is cached only if the generation is unchanged.

use std::collections::{HashMap, HashSet};
use std::sync::atomic::{AtomicI64, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use jiff::{SignedDuration, Timestamp};
use tokio_util::sync::CancellationToken;
use tread_api::identity::{Person, Role, Session};
use tread_api::ids::{OwnerId, RobotId, SessionId, SiteId, TokenId};
use tread_api::rights::{Grant, Right, Rights, Scope};

use crate::app::AppError;
use crate::db::sessions::SignedIn;
use crate::identity::grants::Grants;
use crate::identity::secret::Fingerprint;
use crate::identity::subject::{SubjectId, name_of_person};

/// Number of cached credentials above which expired ones are removed before another is added. The
/// number of valid ones is bounded by the limits on tokens and sessions.
const KNOWN_MAX: usize = 4_096;
/// Minimum interval at which the last use of a token is stored.
const TOUCH_EVERY: SignedDuration = SignedDuration::from_mins(10);

/// Time for which a cached credential is used without another check in the database.
const FRESH: Duration = Duration::from_secs(5);

/// A token or session whose valid secret was shown.
#[derive(Debug)]
pub struct Credential {
    /// The token that was shown or that the session was opened with, or the person.
    pub subject: SubjectId,
    /// The person who signed in at the provider; `None` for a token.
    pub person: Option<Person>,
    /// The token's name, or the person's name in a form that no token can have.
    pub name: String,
    /// Its role; `None` if it has rights of its own.
    pub role: Option<Role>,
    /// Rights that hold everywhere in `scope`; see [`Self::for_right`].
    pub rights: Rights,
    /// Sites and robots for which `rights` hold.
    pub scope: Scope,
    /// All its grants.
    grants: Grants,
    /// The browser's session; `None` if a token was shown directly.
    pub session: Option<SessionId>,
    /// Time from which it is refused.
    pub expires_at: Timestamp,
    ended: CancellationToken,
    touched_us: AtomicI64,
    /// Time of the last check in the database, milliseconds of the monotonic clock.
    checked_ms: AtomicU64,
}

impl Credential {
    pub(super) fn new(
        token: &tread_api::identity::Token,
        session: Option<SessionId>,
        expires_at: Timestamp,
        checked_at: Duration,
    ) -> Self {
        let grants = Grants::of_token(token.role, token.rights, token.sites.clone());
        let touched = token.last_used_at;
        Self {
            subject: SubjectId::Token(token.id),
            person: None,
            name: token.name.clone(),
            role: token.role,
            rights: token.rights,
            scope: token.sites.clone(),
            grants,
            session,
            expires_at,
            ended: CancellationToken::new(),
            touched_us: AtomicI64::new(touched.map_or(i64::MIN, Timestamp::as_microsecond)),
            checked_ms: AtomicU64::new(to_ms(checked_at)),
        }
    }

    /// Makes the credential of a person's session.
    pub(super) fn of_person(
        signed_in: SignedIn,
        grants: Grants,
        (session, expires_at): (SessionId, Timestamp),
        (touched, checked_at): (Option<Timestamp>, Duration),
    ) -> Self {
        let Grant { rights, sites } = grants.in_common();
        Self {
            subject: SubjectId::Person(signed_in.person.id),
            person: Some(signed_in.person),
            name: name_of_person(&signed_in.name),
            role: grants.role(),
            rights,
            scope: sites,
            grants,
            session: Some(session),
            expires_at,
            ended: CancellationToken::new(),
            touched_us: AtomicI64::new(touched.map_or(i64::MIN, Timestamp::as_microsecond)),
            checked_ms: AtomicU64::new(to_ms(checked_at)),
        }
    }

    /// Returns this credential for a request that needs a right: `scope` covers the grants that
    /// include the right, and `rights` those that hold in all of it. `None` if no grant includes
    /// the right.
    pub fn for_right(self: &Arc<Self>, right: Right) -> Option<Arc<Self>> {
        if !self.grants.are_several() {
            return self.rights.includes(right).then(|| Arc::clone(self));
        }
        let Grant { rights, sites } = self.grants.for_right(right)?;
        Some(Arc::new(Self {
            subject: self.subject,
            person: self.person.clone(),
            name: self.name.clone(),
            role: self.role,
            rights,
            scope: sites,
            grants: self.grants.clone(),
            session: self.session,
            expires_at: self.expires_at,
            ended: self.ended.clone(),
            touched_us: AtomicI64::new(self.touched_us.load(Ordering::Relaxed)),
            checked_ms: AtomicU64::new(self.checked_ms.load(Ordering::Relaxed)),
        }))
    }

    /// Returns whether one of its grants gives the right for this robot, whatever right the request
    /// needs.
    pub fn may_at(&self, right: Right, site: &SiteId, robot: &RobotId) -> bool {
        self.grants.includes_at(right, site, robot)
    }

    /// Returns the union of the rights of all its grants, for display.
    pub fn all_rights(&self) -> Rights {
        let grants = self.grants.as_slice().iter();
        grants.fold(Rights::default(), |all, grant| all.union(grant.rights))
    }

    /// Returns whether it was checked in the database within [`FRESH`].
    pub(super) fn is_fresh(&self, now: Duration) -> bool {
        let checked_ms = self.checked_ms.load(Ordering::Relaxed);
        to_ms(now).saturating_sub(checked_ms) < to_ms(FRESH)
    }

    /// Returns whether its last check in the database was before a time.
    fn is_older(&self, than: Duration) -> bool {
        self.checked_ms.load(Ordering::Relaxed) < to_ms(than)
    }

    /// Records that it was checked in the database and is valid.
    pub(super) fn checked(&self, now: Duration) {
        self.checked_ms.store(to_ms(now), Ordering::Relaxed);
    }

    /// Returns a token that is cancelled when the credential is revoked or its session ends.
    /// Long-lived connections (streams, sockets) must watch it, and [`Self::expires_at`].
    pub fn ended(&self) -> CancellationToken {
        self.ended.clone()
    }

    /// Returns its description for the API.
    pub fn session(&self) -> Session {
        Session {
            name: self.name.clone(),
            role: self.role,
            rights: self.rights,
            sites: self.scope.clone(),
            grants: self.grants.as_slice().to_vec(),
            token: self.subject.token(),
            person: self.person.clone(),
            session: self.session,
            expires_at: self.expires_at,
        }
    }

    /// Refuses a robot outside its scope.
    ///
    /// # Errors
    /// [`AppError::OutsideScope`].
    pub fn check_robot(&self, site: &SiteId, robot: &RobotId) -> Result<(), AppError> {
        self.check_in(self.scope.includes_robot(site, robot), || {
            format!("is about robot `{robot}` of site `{site}`")
        })
    }

    /// Refuses a robot's name if no robot of that name can be in its scope.
    ///
    /// # Errors
    /// As [`Self::check_robot`].
    pub fn check_robot_name(&self, robot: &RobotId) -> Result<(), AppError> {
        self.check_in(self.scope.includes_robot_name(robot), || {
            format!("is about robot `{robot}`")
        })
    }

    /// Refuses a site if nothing of it is in its scope.
    ///
    /// # Errors
    /// As [`Self::check_robot`].
    pub fn check_site(&self, site: &SiteId) -> Result<(), AppError> {
        self.check_in(self.scope.includes_site(site), || {
            format!("is about site `{site}`")
        })
    }

    /// Refuses a site unless all of it is in its scope.
    ///
    /// # Errors
    /// As [`Self::check_robot`].
    pub fn check_whole_site(&self, site: &SiteId) -> Result<(), AppError> {
        self.check_in(self.scope.includes_whole_site(site), || {
            format!("is about all of site `{site}`")
        })
    }

    /// Refuses a scope that is not within its own.
    ///
    /// # Errors
    /// As [`Self::check_robot`].
    pub fn check_scope(&self, scope: &Scope) -> Result<(), AppError> {
        self.check_in(self.scope.includes(scope), || format!("is about {scope}"))
    }

    /// Refuses unless its scope is the whole server.
    ///
    /// # Errors
    /// As [`Self::check_robot`].
    pub fn check_everywhere(&self) -> Result<(), AppError> {
        self.check_in(self.scope.is_everywhere(), || {
            "is about the whole server".to_owned()
        })
    }

    fn check_in(&self, is_in: bool, what: impl FnOnce() -> String) -> Result<(), AppError> {
        if is_in {
            return Ok(());
        }
        let (name, own, what) = (&self.name, &self.scope, what());
        let detail = format!("`{name}` is for {own} alone, and this {what}");
        Err(AppError::OutsideScope(detail))
    }

    /// Returns whether it may set and end the limits of an owner: its own limits, or all with
    /// [`Right::ReleaseHold`].
    pub fn may_hold_as(&self, owner: &OwnerId) -> bool {
        self.rights.includes(Right::ReleaseHold)
            || (self.rights.includes(Right::Hold) && self.own_name() == owner.as_str())
    }

    /// Returns the owner of its own limits: a token's name, or a person's identifier, since a
    /// person's name may equal a token's.
    pub fn own_name(&self) -> String {
        match &self.person {
            None => self.name.clone(),
            Some(person) => person.id.to_string(),
        }
    }

    /// Returns the author of a request, for display: this credential's name, followed by the name
    /// claimed in the request if that differs. A claimed name never stands alone.
    pub fn author(&self, claimed: Option<&str>) -> String {
        match claimed.map(str::trim) {
            None | Some("") => self.name.clone(),
            Some(claimed) if claimed == self.name => self.name.clone(),
            Some(claimed) if self.person.is_some() && name_of_person(claimed) == self.name => {
                self.name.clone()
            }
            Some(claimed) => format!("{}: {claimed}", self.name),
        }
    }

    /// Returns whether this use is to be stored as the last one.
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

/// First wait after a failed or slow check in the database; it doubles with each failure.
const BACK_OFF_MIN: Duration = Duration::from_millis(500);
const BACK_OFF_MAX: Duration = Duration::from_secs(16);
/// Tokens and sessions that are valid according to the database.
#[derive(Debug, Default)]
pub(super) struct Valid {
    pub(super) tokens: Vec<(Fingerprint, Credential)>,
    pub(super) token_ids: HashSet<TokenId>,
    pub(super) sessions: HashSet<SessionId>,
}

impl Valid {
    /// Adds what another read found valid.
    pub(super) fn join(&mut self, other: Self) {
        self.tokens.extend(other.tokens);
        self.token_ids.extend(other.token_ids);
        self.sessions.extend(other.sessions);
    }

    fn contains(&self, known: &Credential) -> bool {
        let has_session = known.session.is_none_or(|id| self.sessions.contains(&id));
        let token = known.subject.token();
        has_session && token.is_none_or(|token| self.token_ids.contains(&token))
    }
}

/// Cache of credentials.
#[derive(Debug, Default)]
pub(super) struct CredentialCache {
    inner: Mutex<Inner>,
    rechecks: Mutex<Rechecks>,
}

/// Checks of cached credentials in the database: one at a time, with back-off after failures.
#[derive(Debug, Default)]
struct Rechecks {
    is_under_way: bool,
    not_before: Duration,
    wait: Duration,
}

/// Permission to check a credential in the database. Dropping it counts as a failure, unless
/// [`Recheck::succeeded`] was called.
#[derive(Debug)]
pub(super) struct Recheck<'known> {
    known: &'known CredentialCache,
    began_at: Duration,
    has_succeeded: bool,
}

impl Recheck<'_> {
    /// Ends the check as a success.
    pub(super) fn succeeded(mut self) {
        self.has_succeeded = true;
    }
}

impl Drop for Recheck<'_> {
    fn drop(&mut self) {
        let mut rechecks = self.known.rechecks();
        let wait = if self.has_succeeded {
            Duration::ZERO
        } else {
            (rechecks.wait * 2).clamp(BACK_OFF_MIN, BACK_OFF_MAX)
        };
        *rechecks = Rechecks {
            is_under_way: false,
            not_before: self.began_at + wait,
            wait,
        };
    }
}

#[derive(Debug, Default)]
struct Inner {
    credentials: HashMap<Fingerprint, Arc<Credential>>,
    generation: u64,
}

impl CredentialCache {
    fn lock(&self) -> MutexGuard<'_, Inner> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn rechecks(&self) -> MutexGuard<'_, Rechecks> {
        self.rechecks.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns permission to check a credential; `None` while another check is under way or during
    /// back-off.
    pub(super) fn recheck(&self, now: Duration) -> Option<Recheck<'_>> {
        let mut rechecks = self.rechecks();
        if rechecks.is_under_way || now < rechecks.not_before {
            return None;
        }
        rechecks.is_under_way = true;
        Some(Recheck {
            known: self,
            began_at: now,
            has_succeeded: false,
        })
    }

    pub(super) fn generation(&self) -> u64 {
        self.lock().generation
    }

    /// Returns the credential of a secret, if it is cached and has not expired.
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

    /// Caches a credential looked up at `generation`. Returns `None` if the generation has changed
    /// since; the look-up must be repeated.
    pub(super) fn insert(
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

    /// Returns whether a credential checked last before a time is no longer valid.
    pub(super) fn any_gone(&self, valid: &Valid, before: Duration) -> bool {
        let inner = self.lock();
        let is_gone = |known: &Arc<Credential>| !valid.contains(known) && known.is_older(before);
        inner.credentials.values().any(is_gone)
    }

    /// Updates the cache with what was read from `began_at` on: adds valid tokens, and ends
    /// credentials that are no longer valid. Ignored if the generation has changed since; the next
    /// read follows soon.
    pub(super) fn read_again(&self, valid: Valid, generation: u64, began_at: Duration) {
        let mut inner = self.lock();
        if inner.generation != generation {
            return;
        }
        inner.credentials.retain(|_, known| {
            let is_valid = valid.contains(known);
            if is_valid {
                known.checked(began_at);
            }
            let stays = is_valid || !known.is_older(began_at);
            if !stays {
                known.ended.cancel();
            }
            stays
        });
        for (fingerprint, credential) in valid.tokens {
            let kept = inner.credentials.entry(fingerprint);
            kept.or_insert_with(|| Arc::new(credential));
        }
    }

    /// Ends all credentials that match: their requests are refused from now on, and their open
    /// connections close.
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
mod tests;
