//! Browser sessions: opening, listing and ending.

use std::sync::Arc;

use jiff::Timestamp;
use tread_api::identity::PersonSession;
use tread_api::ids::SessionId;
use tread_api::page::Page;
use tread_api::rights::Scope;

use super::{Credential, SESSION_LIFETIME_MAX, SESSIONS_EACH_MAX, SignInError, new_secret};
use crate::app::{App, AppError, page};
use crate::db::sessions::{NewSession, Owner, PeopleSessionFilter, SessionRow};
use crate::db::{self, DbError, Tx};
use crate::identity::secret::{Kind, Secret};
use crate::identity::subject::SubjectId;

/// Maximum number of sessions of all people together.
pub const SESSIONS_OF_PEOPLE_MAX: usize = 10_000;

impl App {
    /// Opens a session for a browser that has shown a token, and returns the session's secret.
    ///
    /// # Errors
    /// The database failed, or the operating system provides no random numbers.
    pub async fn open_session(
        &self,
        credential: &Credential,
    ) -> Result<(Arc<Credential>, Secret), AppError> {
        let SubjectId::Token(token) = credential.subject else {
            let detail = "a session is opened with a token".to_owned();
            return Err(AppError::BeyondRights(detail));
        };
        let lasts_until = self.clock().now().checked_add(SESSION_LIFETIME_MAX);
        let lasts_until = lasts_until.unwrap_or(Timestamp::MAX);
        let expires_at = lasts_until.min(credential.expires_at);
        let opened = self.open_session_of(Owner::Token(token), expires_at);
        opened.await?.ok_or(AppError::UnknownToken(token))
    }

    /// Opens a session of a token or person; `None` if the token or person is no longer valid.
    pub(super) async fn open_session_of(
        &self,
        owner: Owner,
        expires_at: Timestamp,
    ) -> Result<Option<(Arc<Credential>, Secret)>, AppError> {
        let now = self.clock().now();
        let secret = new_secret(Kind::Session)?;
        let (token, person) = match &owner {
            Owner::Token(token) => (Some(*token), None),
            Owner::Person(signed_in) => (None, Some(signed_in.person.id)),
        };
        let session = NewSession {
            id: self.clock().new_id::<SessionId>(),
            owner,
            fingerprint: secret.fingerprint(),
            created_at: now,
            expires_at,
        };
        let mut tx = self.db().write_uncounted("identity").await?;
        if let Some(token) = token {
            let valid = db::tokens::find(&mut tx, token).await?;
            if valid.is_none_or(|token| token.revoked_at.is_some()) {
                return Ok(None);
            }
        }
        db::sessions::delete_expired(&mut tx, now).await?;
        db::sessions::insert(&mut tx, &session).await?;
        let surplus = db::sessions::surplus(&mut tx, (token, person), SESSIONS_EACH_MAX).await?;
        for &id in &surplus {
            db::sessions::delete(&mut tx, id).await?;
        }
        if person.is_some() {
            let count = db::sessions::count_of_people(&mut tx, now).await?;
            if usize::try_from(count).is_ok_and(|count| count > SESSIONS_OF_PEOPLE_MAX) {
                return Err(AppError::TooMany {
                    what: "sessions of people",
                    count: SESSIONS_OF_PEOPLE_MAX,
                });
            }
        }
        let app = self.clone();
        let ending = move |_outcome| {
            // Ending no session would only cause look-ups to be repeated.
            if !surplus.is_empty() {
                app.end_known_sessions(&surplus);
            }
        };
        tx.commit_then(ending).await?;
        match self.look_up(&secret).await {
            Ok(opened) => Ok(Some((opened, secret))),
            Err(SignInError::Storage(cause)) => Err(AppError::Storage(cause)),
            Err(
                SignInError::Malformed
                | SignInError::Unknown
                | SignInError::Expired
                | SignInError::Revoked
                | SignInError::Locked(_),
            ) => Ok(None),
        }
    }

    /// Ends a browser's session: its requests are refused from now on, and its open connections
    /// close.
    pub async fn end_session(&self, id: SessionId) -> Result<(), AppError> {
        let mut tx = self.db().write_uncounted("identity").await?;
        db::sessions::delete(&mut tx, id).await?;
        let app = self.clone();
        tx.commit_then(move |_outcome| app.end_known_sessions(&[id]))
            .await?;
        Ok(())
    }

    fn end_known_sessions(&self, ids: &[SessionId]) {
        let is_ended = |session| ids.contains(&session);
        let known = &self.identity().known;
        known.end(|known| known.session.is_some_and(is_ended));
        if let Some(people) = self.people() {
            people.id_tokens.remove(ids);
        }
    }

    /// Returns the sessions of people whose grants are within a scope, newest first.
    pub async fn sessions_of_people(
        &self,
        within: &Scope,
        before: Option<SessionId>,
        limit: u32,
    ) -> Result<Page<PersonSession>, AppError> {
        let Some(people) = self.people() else {
            return Ok(page(Vec::new(), limit, |_: &PersonSession| String::new()));
        };
        let (groups, elsewhere) = people.groups_by_scope(within);
        let filter = PeopleSessionFilter {
            issuer: people.issuer(),
            within: &groups,
            elsewhere: &elsewhere,
            // An admin of the whole server also sees sessions whose groups are no longer
            // configured.
            any: within.is_everywhere(),
            at: self.clock().now(),
            before,
        };
        let mut tx = self.db().read("identity").await?;
        let kept = db::sessions::list(&mut tx, &filter, limit + 1).await?;
        let listed = kept.into_iter().filter_map(|kept| self.listed(kept));
        Ok(page(listed.collect(), limit, |session| {
            session.id.to_string()
        }))
    }

    fn listed(&self, kept: SessionRow) -> Option<PersonSession> {
        let Owner::Person(signed_in) = kept.owner else {
            return None;
        };
        let grants = self.people()?.grants_of(&signed_in);
        Some(PersonSession {
            id: kept.id,
            name: signed_in.name,
            person: signed_in.person,
            groups: signed_in.groups,
            grants: grants.map_or_else(Vec::new, |grants| grants.as_slice().to_vec()),
            created_at: kept.created_at,
            expires_at: kept.expires_at,
            last_used_at: kept.last_used_at,
        })
    }

    /// Ends another person's session.
    ///
    /// # Errors
    /// [`AppError::UnknownSession`].
    pub async fn end_session_of(&self, id: SessionId) -> Result<(), AppError> {
        let found = {
            let mut tx = self.db().read("identity").await?;
            db::sessions::find(&mut tx, id).await?
        };
        found.ok_or(AppError::UnknownSession(id))?;
        self.end_session(id).await
    }

    /// Returns the scope of a session; `None` if it is not known.
    pub async fn session_scope(&self, id: SessionId) -> Result<Option<Scope>, AppError> {
        let mut tx = self.db().read("identity").await?;
        let Some(kept) = db::sessions::find(&mut tx, id).await? else {
            return Ok(None);
        };
        match kept.owner {
            Owner::Token(token) => {
                let token = db::tokens::find(&mut tx, token).await?;
                Ok(token.map(|token| token.sites))
            }
            Owner::Person(signed_in) => {
                let people = self.people();
                let grants = people.and_then(|people| people.grants_of(&signed_in));
                // A session without any grant belongs to admins of the whole server.
                let scope = grants.map_or(Scope::EVERYWHERE, |grants| grants.scope());
                Ok(Some(scope))
            }
        }
    }
}

/// Returns whether a credential is still valid in the database at `now`.
pub(super) async fn still_holds(
    tx: &mut Tx,
    who: &Credential,
    now: Timestamp,
) -> Result<bool, DbError> {
    match (who.subject, who.session) {
        (SubjectId::Token(token), _) => {
            let own = db::tokens::find(tx, token).await?;
            Ok(own.is_some_and(|own| own.revoked_at.is_none() && own.expires_at > now))
        }
        (SubjectId::Person(_), Some(session)) => {
            let own = db::sessions::find(tx, session).await?;
            Ok(own.is_some_and(|own| own.expires_at > now))
        }
        (SubjectId::Person(_), None) => Ok(false),
    }
}
