//! Tokens of people and programs. Only the hash of a secret is stored.

use jiff::Timestamp;
use tread_api::identity::{Role, Token};
use tread_api::ids::TokenId;
use tread_api::rights::{Rights, Scope};

use super::secrets::{TokenRow, look_up_tokens};
use super::{
    Connection, EngineError, corrupt, from_json, from_us, parse, scope_text, to_json, to_us,
};
use tread_store::Fingerprint;

struct Raw {
    id: String,
    name: String,
    role: Option<String>,
    rights: Option<String>,
    scope: Option<String>,
    created_at_us: i64,
    created_by: String,
    expires_at_us: i64,
    revoked_at_us: Option<i64>,
    last_used_at_us: Option<i64>,
}

pub(super) fn role(name: &str) -> Result<Role, EngineError> {
    Role::from_name(name).ok_or_else(|| corrupt("role", name))
}

fn scope(text: &str) -> Result<Scope, EngineError> {
    let names: Vec<String> = from_json("scope", text)?;
    let names = names.iter().map(String::as_str);
    Scope::from_names(names).map_err(|_invalid| corrupt("scope", text))
}

impl TryFrom<Raw> for Token {
    type Error = EngineError;

    fn try_from(raw: Raw) -> Result<Self, EngineError> {
        let role = raw.role.as_deref().map(role).transpose()?;
        let rights = match (role, &raw.rights) {
            (Some(role), None) => Rights::from(role),
            (None, Some(rights)) => from_json("rights", rights)?,
            (Some(_), Some(_)) | (None, None) => return Err(corrupt("token's rights", &raw.id)),
        };
        Ok(Self {
            id: parse("token", &raw.id)?,
            name: raw.name,
            role,
            rights,
            sites: match &raw.scope {
                Some(text) => scope(text)?,
                None => Scope::EVERYWHERE,
            },
            created_at: from_us(raw.created_at_us)?,
            created_by: raw.created_by,
            expires_at: from_us(raw.expires_at_us)?,
            revoked_at: raw.revoked_at_us.map(from_us).transpose()?,
            last_used_at: raw.last_used_at_us.map(from_us).transpose()?,
        })
    }
}

macro_rules! tokens {
    ($condition:tt $(, $argument:expr)* $(,)?) => {
        sqlx::query_as!(
            Raw,
            r#"SELECT id, name, role, rights, scope, created_at_us, created_by, expires_at_us,
                   revoked_at_us, last_used_at_us
               FROM tokens "# + $condition
            $(, $argument)*
        )
    };
}

/// Returns the tokens within a scope that are older than one, newest first, with expired and
/// revoked ones.
pub async fn list(
    db: &mut Connection,
    within: &Scope,
    before: Option<TokenId>,
    limit: u32,
) -> Result<Vec<Token>, EngineError> {
    let before = before.map(|id| id.to_string());
    let within = scope_text(within)?;
    let raw = tokens!(
        "WHERE (CAST($1 AS TEXT) IS NULL OR id < $1)
           AND (CAST($3 AS TEXT) IS NULL OR (scope IS NOT NULL AND NOT EXISTS (
               SELECT 1 FROM json_each(tokens.scope) AS own
               WHERE own.value NOT IN (SELECT value FROM json_each($3))
                 AND substr(own.value, 1, instr(own.value || '/', '/') - 1)
                     NOT IN (SELECT value FROM json_each($3)))))
         ORDER BY id DESC LIMIT $2",
        before,
        i64::from(limit),
        within
    )
    .fetch_all(db)
    .await?;
    raw.into_iter().map(Token::try_from).collect()
}

look_up_tokens!("tokens", tokens, "token", TokenId, Token);

/// Returns the token of a name that is valid at a time.
pub async fn valid_by_name(
    db: &mut Connection,
    name: &str,
    at: Timestamp,
) -> Result<Option<Token>, EngineError> {
    let at_us = to_us(at);
    let raw = tokens!(
        "WHERE name = $1 AND revoked_at_us IS NULL AND expires_at_us > $2 LIMIT 1",
        name,
        at_us
    )
    .fetch_optional(db)
    .await?;
    raw.map(Token::try_from).transpose()
}

/// Returns the numbers of tokens that are valid at a time: of all, and of admins of the whole
/// server.
pub async fn valid_counts(db: &mut Connection, at: Timestamp) -> Result<(i64, i64), EngineError> {
    let at_us = to_us(at);
    let row = sqlx::query!(
        r#"SELECT COUNT(*) AS "all_count!: i64",
               COUNT(CASE WHEN role = 'admin' AND scope IS NULL THEN 1 END) AS "admin_count!: i64"
           FROM tokens WHERE revoked_at_us IS NULL AND expires_at_us > $1"#,
        at_us
    )
    .fetch_one(db)
    .await?;
    Ok((row.all_count, row.admin_count))
}

/// Returns the number of tokens within a scope that are valid at a time.
pub async fn valid_count_within(
    db: &mut Connection,
    within: &Scope,
    at: Timestamp,
) -> Result<i64, EngineError> {
    let (within, at_us) = (scope_text(within)?, to_us(at));
    let row = sqlx::query!(
        r#"SELECT COUNT(*) AS "count!: i64" FROM tokens
           WHERE revoked_at_us IS NULL AND expires_at_us > $1
             AND (CAST($2 AS TEXT) IS NULL OR (scope IS NOT NULL AND NOT EXISTS (
                 SELECT 1 FROM json_each(tokens.scope) AS own
                 WHERE own.value NOT IN (SELECT value FROM json_each($2))
                   AND substr(own.value, 1, instr(own.value || '/', '/') - 1)
                       NOT IN (SELECT value FROM json_each($2)))))"#,
        at_us,
        within
    )
    .fetch_one(db)
    .await?;
    Ok(row.count)
}

/// Stores a new token.
pub async fn insert(
    db: &mut Connection,
    token: &Token,
    fingerprint: &Fingerprint,
) -> Result<(), EngineError> {
    let (id, role) = (token.id.to_string(), token.role.map(Role::as_str));
    let rights = match token.role {
        Some(_) => None,
        None => Some(to_json("rights", &token.rights)?),
    };
    let scope = scope_text(&token.sites)?;
    let (lookup, hash) = (fingerprint.lookup(), fingerprint.as_bytes());
    let (created_at_us, expires_at_us) = (to_us(token.created_at), to_us(token.expires_at));
    sqlx::query!(
        "INSERT INTO tokens (id, name, role, rights, scope, lookup, hash, created_at_us,
             created_by, expires_at_us)
         VALUES ($1, $2, $3, $4, $5, $6, $7, $8, $9, $10)",
        id,
        token.name,
        role,
        rights,
        scope,
        lookup,
        hash,
        created_at_us,
        token.created_by,
        expires_at_us,
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Revokes a token and ends its sessions; only the first time counts.
pub async fn revoke(db: &mut Connection, id: TokenId, at: Timestamp) -> Result<(), EngineError> {
    let (id, at_us) = (id.to_string(), to_us(at));
    sqlx::query!(
        "UPDATE tokens SET revoked_at_us = COALESCE(revoked_at_us,
             MAX($1, created_at_us, COALESCE(last_used_at_us, created_at_us)))
         WHERE id = $2",
        at_us,
        id
    )
    .execute(&mut *db)
    .await?;
    sqlx::query!("DELETE FROM sessions WHERE token_id = $1", id)
        .execute(db)
        .await?;
    Ok(())
}

/// Sets the time of a token's last use; a time before the stored one changes nothing.
pub async fn touch(db: &mut Connection, id: TokenId, at: Timestamp) -> Result<(), EngineError> {
    let (id, at_us) = (id.to_string(), to_us(at));
    sqlx::query!(
        "UPDATE tokens SET last_used_at_us =
             MAX($1, created_at_us, COALESCE(last_used_at_us, created_at_us))
         WHERE id = $2",
        at_us,
        id
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Deletes at most `limit` tokens that expired or were revoked before a time, and their sessions.
pub async fn delete_ended(
    db: &mut Connection,
    before: Timestamp,
    limit: u32,
) -> Result<(), EngineError> {
    let before_us = to_us(before);
    sqlx::query!(
        "DELETE FROM sessions WHERE token_id IN (
             SELECT id FROM tokens
             WHERE MIN(expires_at_us, COALESCE(revoked_at_us, expires_at_us)) < $1
             ORDER BY id LIMIT $2)",
        before_us,
        i64::from(limit),
    )
    .execute(&mut *db)
    .await?;
    sqlx::query!(
        "DELETE FROM tokens WHERE id IN (
             SELECT id FROM tokens
             WHERE MIN(expires_at_us, COALESCE(revoked_at_us, expires_at_us)) < $1
             ORDER BY id LIMIT $2)",
        before_us,
        i64::from(limit),
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Returns every token that is valid at a time; fails if one row cannot be read.
pub async fn all_valid(
    db: &mut Connection,
    at: Timestamp,
) -> Result<Vec<TokenRow<Token>>, EngineError> {
    let at_us = to_us(at);
    let rows = sqlx::query!(
        "SELECT id, hash, name, role, rights, scope, created_at_us, created_by, expires_at_us,
             revoked_at_us, last_used_at_us
         FROM tokens WHERE revoked_at_us IS NULL AND expires_at_us > $1",
        at_us
    )
    .fetch_all(db)
    .await?;
    let kept = rows.into_iter().map(|row| {
        let token = Raw {
            id: row.id,
            name: row.name,
            role: row.role,
            rights: row.rights,
            scope: row.scope,
            created_at_us: row.created_at_us,
            created_by: row.created_by,
            expires_at_us: row.expires_at_us,
            revoked_at_us: row.revoked_at_us,
            last_used_at_us: row.last_used_at_us,
        };
        Ok(TokenRow {
            hash: row.hash,
            token: token.try_into()?,
        })
    });
    kept.collect()
}
