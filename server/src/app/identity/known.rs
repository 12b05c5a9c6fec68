//! Who has shown a good secret, in memory: looked up once, then known until it expires or is
//! ended, and looked up again now and then, since `tread-server init` may have replaced it.
//!
//! A look-up that began before something was ended must not be kept after it: each end raises the
//! generation, and only what was looked up within the present one is kept.

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
    /// The token that was shown or that the session was opened with, or the person.
    pub subject: SubjectId,
    /// Who signed in at the provider, if it is no token.
    pub person: Option<Person>,
    /// The token's name, or the person's with what tells it from any token's.
    pub name: String,
    /// Its role, if it has no rights of its own.
    pub role: Option<Role>,
    /// What it may do: at all of `scope`, see [`Self::for_right`].
    pub rights: Rights,
    /// Where it may do that.
    pub scope: Scope,
    /// All that it may do.
    grants: Grants,
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

    /// A person's session.
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

    /// Whoever it is, as far as a request goes that needs a right: with the places of the grants
    /// that have this right, and the rights that hold at all of these. `None` if no grant has it.
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

    /// Whether it may do something to a robot, whatever the right of the request.
    pub fn may_at(&self, right: Right, site: &SiteId, robot: &RobotId) -> bool {
        self.grants.includes_at(right, site, robot)
    }

    /// All rights that it has somewhere, for people.
    pub fn all_rights(&self) -> Rights {
        let grants = self.grants.as_slice().iter();
        grants.fold(Rights::default(), |all, grant| all.union(grant.rights))
    }

    /// Whether it was looked up a moment ago.
    pub(super) fn is_fresh(&self, now: Duration) -> bool {
        let checked_ms = self.checked_ms.load(Ordering::Relaxed);
        to_ms(now).saturating_sub(checked_ms) < to_ms(FRESH)
    }

    /// Whether it was looked up last before a time.
    fn is_older(&self, than: Duration) -> bool {
        self.checked_ms.load(Ordering::Relaxed) < to_ms(than)
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
            rights: self.rights,
            sites: self.scope.clone(),
            grants: self.grants.as_slice().to_vec(),
            token: self.subject.token(),
            person: self.person.clone(),
            session: self.session,
            expires_at: self.expires_at,
        }
    }

    /// Refuses a robot that it is not for.
    ///
    /// # Errors
    /// [`AppError::OutsideScope`], as all of these.
    pub fn check_robot(&self, site: &SiteId, robot: &RobotId) -> Result<(), AppError> {
        self.check_in(self.scope.includes_robot(site, robot), || {
            format!("is about robot `{robot}` of site `{site}`")
        })
    }

    /// Refuses a name that no robot has that it is for.
    ///
    /// # Errors
    /// As [`Self::check_robot`].
    pub fn check_robot_name(&self, robot: &RobotId) -> Result<(), AppError> {
        self.check_in(self.scope.includes_robot_name(robot), || {
            format!("is about robot `{robot}`")
        })
    }

    /// Refuses a site of which nothing is in its scope.
    ///
    /// # Errors
    /// As [`Self::check_robot`].
    pub fn check_site(&self, site: &SiteId) -> Result<(), AppError> {
        self.check_in(self.scope.includes_site(site), || {
            format!("is about site `{site}`")
        })
    }

    /// Refuses a site of which not all is in its scope.
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

    /// Refuses unless it is for everything.
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

    /// Whether it may set and end the limits of an owner: of its own, or of any with the right to
    /// release what others hold.
    pub fn may_hold_as(&self, owner: &OwnerId) -> bool {
        self.rights.includes(Right::ReleaseHold)
            || (self.rights.includes(Right::Hold) && self.own_name() == owner.as_str())
    }

    /// The name of its own limits: a token's name. A person may be called like a token, so it is
    /// their identifier.
    pub fn own_name(&self) -> String {
        match &self.person {
            None => self.name.clone(),
            Some(person) => person.id.to_string(),
        }
    }

    /// Who does something, for people: this token's name always, and behind it the name that
    /// whoever shows it gave, if it is another one. Nobody acts under a name alone that is not his token's.
    pub fn said_by(&self, claimed: Option<&str>) -> String {
        match claimed.map(str::trim) {
            None | Some("") => self.name.clone(),
            Some(claimed) if claimed == self.name => self.name.clone(),
            Some(claimed) if self.person.is_some() && name_of_person(claimed) == self.name => {
                self.name.clone()
            }
            Some(claimed) => format!("{}: {claimed}", self.name),
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

/// First and longest wait after a look-up of who is known that failed or took too long; it doubles
/// each time.
const BACK_OFF_MIN: Duration = Duration::from_millis(500);
const BACK_OFF_MAX: Duration = Duration::from_secs(16);
/// What the database says is valid.
#[derive(Debug, Default)]
pub(super) struct Valid {
    pub(super) tokens: Vec<(Fingerprint, Credential)>,
    pub(super) token_ids: HashSet<TokenId>,
    pub(super) sessions: HashSet<SessionId>,
}

impl Valid {
    /// Takes in what another reading says is valid.
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

/// All who are known.
#[derive(Debug, Default)]
pub(super) struct Known {
    inner: Mutex<Inner>,
    rechecks: Mutex<Rechecks>,
}

/// Look-ups of who is known already: one at a time, and fewer while they fail.
#[derive(Debug, Default)]
struct Rechecks {
    is_under_way: bool,
    not_before: Duration,
    wait: Duration,
}

/// The turn to look somebody up again; given back when it is dropped, as one that failed unless
/// [`Recheck::succeeded`].
#[derive(Debug)]
pub(super) struct Recheck<'known> {
    known: &'known Known,
    began_at: Duration,
    has_succeeded: bool,
}

impl Recheck<'_> {
    /// The database has answered.
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

impl Known {
    fn lock(&self) -> MutexGuard<'_, Inner> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn rechecks(&self) -> MutexGuard<'_, Rechecks> {
        self.rechecks.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The turn to look up again who is known; `None` while somebody else does, or for a while
    /// after it failed.
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

    /// Whether somebody who was known before a time is no longer valid.
    pub(super) fn any_gone(&self, valid: &Valid, before: Duration) -> bool {
        let inner = self.lock();
        let is_gone = |known: &Arc<Credential>| !valid.contains(known) && known.is_older(before);
        inner.credentials.values().any(is_gone)
    }

    /// Knows what was read within a generation, from a time on: who is valid is known, who is not
    /// is ended. What was read beside an end says nothing, and is read again soon.
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
mod tests;
