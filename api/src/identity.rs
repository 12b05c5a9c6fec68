//! Who may do what: roles, tokens, sessions of browsers, and the audit log. A role is a name for
//! some [rights](crate::rights).

use std::fmt;

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::ids::{PersonId, SessionId, TokenId};
use crate::rights::{Grant, Right, Rights, Scope, SiteScope};
pub use crate::rights::{InvalidRole, Role};

/// Most days that a token may be valid.
pub const TOKEN_DAYS_MAX: u32 = 1_826;
/// Days that a token is valid when nothing is said.
pub const TOKEN_DAYS_DEFAULT: u32 = 90;
/// Longest name of a token, in characters.
pub const TOKEN_NAME_MAX: usize = 80;

/// A token as it is listed: everything but its secret, which is not stored.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(from = "TokenAnswer")]
pub struct Token {
    /// Its identifier, for revoking it; no secret.
    pub id: TokenId,
    /// What people call it.
    pub name: String,
    /// The role that it was made with; `null` for one with rights of its own.
    pub role: Option<Role>,
    /// What it may do.
    #[schema(value_type = Vec<Right>)]
    pub rights: Rights,
    /// Where it may do that; `null` for everywhere.
    #[schema(value_type = Option<Vec<SiteScope>>)]
    pub sites: Scope,
    /// When it was made.
    pub created_at: Timestamp,
    /// Who made it.
    pub created_by: String,
    /// From when on it is refused.
    pub expires_at: Timestamp,
    /// When it was revoked.
    pub revoked_at: Option<Timestamp>,
    /// When it was used last, to within ten minutes.
    pub last_used_at: Option<Timestamp>,
}

/// A token as servers of any version tell it: before there were rights, the role said all, and a
/// token held everywhere.
#[derive(Deserialize)]
struct TokenAnswer {
    id: TokenId,
    name: String,
    role: Option<Role>,
    rights: Option<Rights>,
    #[serde(default)]
    sites: Scope,
    created_at: Timestamp,
    created_by: String,
    expires_at: Timestamp,
    revoked_at: Option<Timestamp>,
    last_used_at: Option<Timestamp>,
}

impl From<TokenAnswer> for Token {
    fn from(answer: TokenAnswer) -> Self {
        Self {
            id: answer.id,
            name: answer.name,
            role: answer.role,
            rights: rights_of(answer.rights, answer.role),
            sites: answer.sites,
            created_at: answer.created_at,
            created_by: answer.created_by,
            expires_at: answer.expires_at,
            revoked_at: answer.revoked_at,
            last_used_at: answer.last_used_at,
        }
    }
}

fn rights_of(rights: Option<Rights>, role: Option<Role>) -> Rights {
    rights.or(role.map(Rights::from)).unwrap_or_default()
}

/// Asks for a new token, with a role or with rights of its own.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct CreateToken {
    /// What people call it; no other valid token may have this name.
    pub name: String,
    /// What it may do, as a role.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub role: Option<Role>,
    /// What it may do, in place of a role. `stop` comes with every right, and `read` with every
    /// right but `stop`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rights: Option<Vec<Right>>,
    /// Where it may do that; everywhere when absent. At most 100 sites and 1000 robots.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sites: Option<Vec<SiteScope>>,
    /// Days until it is refused, 1 to 1826; 90 when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub valid_days: Option<u32>,
}

impl CreateToken {
    /// One with a role, everywhere.
    pub fn of_role(name: impl Into<String>, role: Role) -> Self {
        Self {
            name: name.into(),
            role: Some(role),
            rights: None,
            sites: None,
            valid_days: None,
        }
    }
}

/// A new token with its secret, which is shown only here.
#[derive(Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct CreatedToken {
    /// The token.
    pub token: Token,
    /// The value to send as `authorization: Bearer …`.
    pub secret: String,
}

impl fmt::Debug for CreatedToken {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter
            .debug_struct("CreatedToken")
            .field("token", &self.token)
            .finish_non_exhaustive()
    }
}

/// Signs a browser in with a token.
#[derive(Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct CreateSession {
    /// The secret of a token.
    pub token: String,
}

impl fmt::Debug for CreateSession {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter
            .debug_struct("CreateSession")
            .finish_non_exhaustive()
    }
}

/// A session as servers of any version tell it.
#[derive(Deserialize)]
struct SessionAnswer {
    name: String,
    role: Option<Role>,
    rights: Option<Rights>,
    #[serde(default)]
    sites: Scope,
    grants: Option<Vec<Grant>>,
    token: Option<TokenId>,
    person: Option<Person>,
    session: Option<SessionId>,
    expires_at: Timestamp,
}

impl From<SessionAnswer> for Session {
    fn from(answer: SessionAnswer) -> Self {
        let rights = rights_of(answer.rights, answer.role);
        let sites = answer.sites;
        let whole = || Grant {
            rights,
            sites: sites.clone(),
        };
        Self {
            name: answer.name,
            role: answer.role,
            rights,
            grants: answer.grants.unwrap_or_else(|| vec![whole()]),
            sites,
            token: answer.token,
            person: answer.person,
            session: answer.session,
            expires_at: answer.expires_at,
        }
    }
}

/// A person who signed in at an OpenID provider.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
pub struct Person {
    /// The person here: of issuer and subject, the same at each sign-in.
    pub id: PersonId,
    /// The provider, by its issuer.
    pub issuer: String,
    /// The person there, the claim `sub`: it stays when names and addresses change.
    pub subject: String,
}

/// Whose session it is.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(from = "SessionAnswer")]
pub struct Session {
    /// The name of the token that was shown, or of the person who signed in.
    pub name: String,
    /// The role; `null` for a token with rights of its own, and a person who has more than one
    /// role or such rights.
    pub role: Option<Role>,
    /// Rights that hold at all of `sites`. A person with several `grants` may have more at some of
    /// them.
    #[schema(value_type = Vec<Right>)]
    pub rights: Rights,
    /// Where it may be done; `null` for everywhere.
    #[schema(value_type = Option<Vec<SiteScope>>)]
    pub sites: Scope,
    /// All that may be done, each with where: whatever any one of these allows. One, unless a
    /// person is in groups that have different rights at different sites.
    #[schema(required = true)]
    pub grants: Vec<Grant>,
    /// The token; `null` for a person who signed in at the provider.
    #[schema(required = true)]
    pub token: Option<TokenId>,
    /// Who signed in at the provider; `null` for a token.
    #[schema(required = true)]
    pub person: Option<Person>,
    /// The browser's session, if it is one.
    pub session: Option<SessionId>,
    /// From when on it is refused.
    pub expires_at: Timestamp,
}

/// How people may sign in.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct SignInMethods {
    /// With a token: always.
    pub token: bool,
    /// At an OpenID provider; `null` if none is configured.
    pub oidc: Option<OidcSignIn>,
}

/// The sign-in at an OpenID provider.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct OidcSignIn {
    /// What people call the provider.
    pub label: String,
    /// Where a browser is sent to sign in.
    pub path: String,
    /// Whether the provider could be reached; the server goes on trying.
    pub available: bool,
}

/// The end of a session.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct SignedOut {
    /// Where a browser is sent to sign out at the provider too.
    pub provider: String,
}

/// A person's session, as it is listed.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct PersonSession {
    /// Its identifier, for ending it; no secret.
    pub id: SessionId,
    /// The person's name when they signed in.
    pub name: String,
    /// Who it is.
    pub person: Person,
    /// The groups that rights come from.
    pub groups: Vec<String>,
    /// What may be done, and where.
    pub grants: Vec<Grant>,
    /// When they signed in.
    pub created_at: Timestamp,
    /// From when on it is refused.
    pub expires_at: Timestamp,
    /// When it was used last, to within ten minutes.
    pub last_used_at: Option<Timestamp>,
}

/// An entry of the audit log: a change, or a request that was refused.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct AuditEntry {
    /// Its number; they grow with time.
    pub id: u64,
    /// When it was answered; the last one, of several.
    pub at: Timestamp,
    /// When the first of several was answered; `null` for one.
    pub since: Option<Timestamp>,
    /// Number of requests. Repeats of a request with the same answer share one entry when their
    /// author sends very many.
    pub count: u64,
    /// The name of the token that was shown or of the person; `null` for a request without a good
    /// one.
    pub who: Option<String>,
    /// That token.
    pub token: Option<TokenId>,
    /// The person who had signed in at an OpenID provider, if it was one.
    // Left out when there is none, so that entries of before there were people keep their hashes.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub person: Option<Person>,
    /// Its role; `null` too for one with rights of its own.
    pub role: Option<Role>,
    /// The address of the other side, or of the client that a trusted proxy names.
    pub address: String,
    /// The request's method.
    pub method: String,
    /// The route, as `/openapi.json` names it.
    pub route: String,
    /// The requested path, without its query.
    pub path: String,
    /// The status of the answer.
    pub status: u16,
    /// The `x-request-id` of the answer, which the log has too.
    pub request_id: String,
    /// The request: the body without secrets, shortened where it was long.
    pub what: Option<serde_json::Value>,
    /// The hash of the entry before it; `null` in entries of versions that had no chain.
    pub previous_hash: Option<String>,
    /// Its own hash, over the one before it and the canonical form of all else.
    pub hash: Option<String>,
}

/// Which entries of the audit log come first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum AuditOrder {
    /// The newest.
    #[default]
    Newest,
    /// The oldest, as the chain goes.
    Oldest,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_role_reads_back_as_it_is_written() {
        for role in Role::ALL {
            assert_eq!(role.as_str().parse(), Ok(role));
        }
    }

    #[test]
    fn what_a_server_without_rights_tells_reads_as_its_role_everywhere() {
        let id = "0192f0c1-2b3c-7d4e-8f50-617283940a1b";
        let session = serde_json::json!({
            "name": "desk", "role": "operator", "token": id, "session": null,
            "expires_at": "2027-01-01T00:00:00Z",
        });
        let session: Session = serde_json::from_value(session).unwrap();
        assert_eq!(session.rights, Rights::from(Role::Operator));
        assert!(session.sites.is_everywhere());
        let token = serde_json::json!({
            "id": id, "name": "desk", "role": "viewer", "created_at": "2026-01-01T00:00:00Z",
            "created_by": "Ann", "expires_at": "2027-01-01T00:00:00Z", "revoked_at": null,
            "last_used_at": null,
        });
        let token: Token = serde_json::from_value(token).unwrap();
        assert_eq!(token.rights, Rights::from(Role::Viewer));
        // Stated rights are never widened by the role.
        let mut value = serde_json::to_value(&token).unwrap();
        value["rights"] = serde_json::json!([]);
        value["sites"] = serde_json::json!([{"site": "yard"}]);
        let token: Token = serde_json::from_value(value).unwrap();
        assert_eq!(token.rights, Rights::default());
        assert!(!token.sites.is_everywhere());
    }

    #[test]
    fn secrets_are_not_shown_by_accident() {
        let asked = CreateSession {
            token: "tread_a_secret".to_owned(),
        };
        assert!(!format!("{asked:?}").contains("secret"));
    }
}
