//! Sessions of browsers, each belonging to a token or to a person who signed in at an OpenID
//! provider.

use jiff::Timestamp;
use tread_api::identity::Person;
use tread_api::ids::{PersonId, SessionId, TokenId};
pub use tread_store::sessions::{NewSession, Owner, PeopleSessionFilter, SessionRow, SignedIn};

use super::{Connection, EngineError, corrupt, from_json, from_us, parse, to_json, to_us};
use tread_store::Fingerprint;

struct Raw {
    id: String,
    token_id: Option<String>,
    person_id: Option<String>,
    issuer: Option<String>,
    subject: Option<String>,
    name: Option<String>,
    groups: Option<String>,
    hash: Vec<u8>,
    created_at_us: i64,
    expires_at_us: i64,
    last_used_at_us: Option<i64>,
}

impl TryFrom<Raw> for SessionRow {
    type Error = EngineError;

    fn try_from(raw: Raw) -> Result<Self, EngineError> {
        let owner = match (&raw.token_id, &raw.person_id) {
            (Some(token), None) => Owner::Token(parse("token", token)?),
            (None, Some(person)) => {
                let missing = || corrupt("session's person", &raw.id);
                let groups = raw.groups.as_deref().ok_or_else(missing)?;
                Owner::Person(SignedIn {
                    person: Person {
                        id: parse("person", person)?,
                        issuer: raw.issuer.ok_or_else(missing)?,
                        subject: raw.subject.ok_or_else(missing)?,
                    },
                    name: raw.name.ok_or_else(missing)?,
                    groups: from_json("groups", groups)?,
                })
            }
            (Some(_), Some(_)) | (None, None) => return Err(corrupt("session's owner", &raw.id)),
        };
        Ok(Self {
            id: parse("session", &raw.id)?,
            owner,
            hash: raw.hash,
            created_at: from_us(raw.created_at_us)?,
            expires_at: from_us(raw.expires_at_us)?,
            last_used_at: raw.last_used_at_us.map(from_us).transpose()?,
        })
    }
}

macro_rules! sessions {
    ($condition:tt $(, $argument:expr)* $(,)?) => {
        sqlx::query_as!(
            Raw,
            r#"SELECT id, token_id, person_id, issuer, subject, name, groups, hash, created_at_us,
                   expires_at_us, last_used_at_us
               FROM sessions "# + $condition
            $(, $argument)*
        )
    };
}

/// Stores a new session.
pub async fn insert(db: &mut Connection, session: &NewSession) -> Result<(), EngineError> {
    let id = session.id.to_string();
    let (token, signed_in) = match &session.owner {
        Owner::Token(token) => (Some(token.to_string()), None),
        Owner::Person(signed_in) => (None, Some(signed_in)),
    };
    let person = signed_in.map(|signed_in| signed_in.person.id.to_string());
    let issuer = signed_in.map(|signed_in| &signed_in.person.issuer);
    let subject = signed_in.map(|signed_in| &signed_in.person.subject);
    let name = signed_in.map(|signed_in| &signed_in.name);
    let groups = signed_in.map(|signed_in| to_json("groups", &signed_in.groups));
    let groups = groups.transpose()?;
    let (lookup, hash) = (session.fingerprint.lookup(), session.fingerprint.as_bytes());
    let (created_at_us, expires_at_us) = (to_us(session.created_at), to_us(session.expires_at));
    sqlx::query!(
        "INSERT INTO sessions (id, token_id, person_id, issuer, subject, name, groups, lookup, hash,
             created_at_us, expires_at_us)
         VALUES ($1, $2, $3, $4, $5, $6, $7, $8, $9, $10, $11)",
        id,
        token,
        person,
        issuer,
        subject,
        name,
        groups,
        lookup,
        hash,
        created_at_us,
        expires_at_us,
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Returns the session whose hash has the same first bytes.
pub async fn by_lookup(
    db: &mut Connection,
    fingerprint: &Fingerprint,
) -> Result<Option<SessionRow>, EngineError> {
    let lookup = fingerprint.lookup();
    let raw = sessions!("WHERE lookup = $1", lookup)
        .fetch_optional(db)
        .await?;
    raw.map(SessionRow::try_from).transpose()
}

/// Returns a session by its identifier.
pub async fn find(db: &mut Connection, id: SessionId) -> Result<Option<SessionRow>, EngineError> {
    let id = id.to_string();
    let raw = sessions!("WHERE id = $1", id).fetch_optional(db).await?;
    raw.map(SessionRow::try_from).transpose()
}

/// Returns sessions of people, newest first.
pub async fn list(
    db: &mut Connection,
    filter: &PeopleSessionFilter<'_>,
    limit: u32,
) -> Result<Vec<SessionRow>, EngineError> {
    let at_us = to_us(filter.at);
    let before = filter.before.map(|id| id.to_string());
    let within = to_json("groups", &filter.within)?;
    let elsewhere = to_json("groups", &filter.elsewhere)?;
    let raw = sessions!(
        "WHERE issuer = $1 AND expires_at_us > $2 AND (CAST($3 AS TEXT) IS NULL OR id < $3)
           AND NOT EXISTS (
               SELECT 1 FROM json_each(sessions.groups) AS own
               WHERE own.value IN (SELECT value FROM json_each($4)))
           AND ($5 OR EXISTS (
               SELECT 1 FROM json_each(sessions.groups) AS own
               WHERE own.value IN (SELECT value FROM json_each($6))))
         ORDER BY id DESC LIMIT $7",
        filter.issuer,
        at_us,
        before,
        elsewhere,
        filter.any,
        within,
        i64::from(limit),
    )
    .fetch_all(db)
    .await?;
    raw.into_iter().map(SessionRow::try_from).collect()
}

/// Returns the number of people's sessions that are valid at a time.
pub async fn count_of_people(db: &mut Connection, at: Timestamp) -> Result<i64, EngineError> {
    let at_us = to_us(at);
    let row = sqlx::query!(
        r#"SELECT COUNT(*) AS "count!: i64" FROM sessions
           WHERE person_id IS NOT NULL AND expires_at_us > $1"#,
        at_us
    )
    .fetch_one(db)
    .await?;
    Ok(row.count)
}

/// Returns every session that is valid at a time.
pub async fn all_valid(db: &mut Connection, at: Timestamp) -> Result<Vec<SessionId>, EngineError> {
    let at_us = to_us(at);
    let ids = sqlx::query_scalar!("SELECT id FROM sessions WHERE expires_at_us > $1", at_us)
        .fetch_all(db)
        .await?;
    ids.iter().map(|id| parse("session", id)).collect()
}

/// Stores the last use of a person's session.
pub async fn touch(db: &mut Connection, id: SessionId, at: Timestamp) -> Result<(), EngineError> {
    let (id, at_us) = (id.to_string(), to_us(at));
    sqlx::query!(
        "UPDATE sessions SET last_used_at_us =
             MAX($1, created_at_us, COALESCE(last_used_at_us, created_at_us))
         WHERE id = $2 AND person_id IS NOT NULL",
        at_us,
        id
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Deletes a session.
pub async fn delete(db: &mut Connection, id: SessionId) -> Result<(), EngineError> {
    let id = id.to_string();
    sqlx::query!("DELETE FROM sessions WHERE id = $1", id)
        .execute(db)
        .await?;
    Ok(())
}

/// Deletes sessions that have expired.
pub async fn delete_expired(db: &mut Connection, at: Timestamp) -> Result<(), EngineError> {
    let at_us = to_us(at);
    sqlx::query!("DELETE FROM sessions WHERE expires_at_us <= $1", at_us)
        .execute(db)
        .await?;
    Ok(())
}

/// Returns the oldest sessions of a token or person beyond the newest `kept`.
pub async fn surplus(
    db: &mut Connection,
    (token, person): (Option<TokenId>, Option<PersonId>),
    kept: u32,
) -> Result<Vec<SessionId>, EngineError> {
    let token = token.map(|id| id.to_string());
    let person = person.map(|id| id.to_string());
    let ids = sqlx::query_scalar!(
        "SELECT id FROM sessions WHERE token_id = $1 OR person_id = $2
         ORDER BY id DESC LIMIT 9223372036854775807 OFFSET $3",
        token,
        person,
        i64::from(kept),
    )
    .fetch_all(db)
    .await?;
    ids.iter().map(|id| parse("session", id)).collect()
}
