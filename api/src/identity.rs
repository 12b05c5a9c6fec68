//! Identities and their authorisation: tokens, roles, sessions of browsers and persons, and entries
//! of the audit log. A role is a name for a set of [rights](crate::rights).

use std::fmt;

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::ids::{PersonId, SessionId, TokenId};
use crate::rights::{Grant, Right, Rights, Scope, SiteScope};
pub use crate::rights::{InvalidRole, Role};

/// Maximum validity of a token, days.
pub const TOKEN_DAYS_MAX: u32 = 1_826;
/// Default validity of a token, days.
pub const TOKEN_DAYS_DEFAULT: u32 = 90;
/// Maximum length of a token's name, characters.
pub const TOKEN_NAME_MAX: usize = 80;

/// Token without its secret, which the server does not store.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(from = "TokenAnswer")]
pub struct Token {
    /// Identifier of the token, with which it is revoked; not secret.
    pub id: TokenId,
    /// Name of the token, for people.
    pub name: String,
    /// Role with which the token was created; `null` if it was created with a list of rights.
    pub role: Option<Role>,
    /// Rights of the token.
    #[schema(value_type = Vec<Right>)]
    pub rights: Rights,
    /// Sites and robots for which the rights hold; `null` for all.
    #[schema(value_type = Option<Vec<SiteScope>>)]
    pub sites: Scope,
    /// Time when the token was created.
    pub created_at: Timestamp,
    /// Name of the token or person that created it.
    pub created_by: String,
    /// Time from which the token is refused.
    pub expires_at: Timestamp,
    /// Time when the token was revoked; `null` if it was not.
    pub revoked_at: Option<Timestamp>,
    /// Time of its last use, accurate to ten minutes; `null` if it was never used.
    pub last_used_at: Option<Timestamp>,
}

/// Token as servers of every version send it. Servers before the introduction of rights send a role
/// only, and their tokens hold everywhere.
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

/// Request for a new token, with either a role or a list of rights.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct CreateToken {
    /// Name of the token, for people; no other valid token may have the same name.
    pub name: String,
    /// Role of the token; give this or `rights`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub role: Option<Role>,
    /// Rights of the token; give this or `role`. `stop` is added to every right, and `read` to
    /// every right but `stop`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rights: Option<Vec<Right>>,
    /// Sites and robots for which the rights hold, at most 100 sites and 1000 robots; all when
    /// absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sites: Option<Vec<SiteScope>>,
    /// Validity of the token, days, 1 to 1826; 90 when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub valid_days: Option<u32>,
}

impl CreateToken {
    /// Returns a request for a token with a role that holds everywhere.
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

/// New token with its secret, which no other response contains.
#[derive(Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct CreatedToken {
    /// The token.
    pub token: Token,
    /// Secret of the token, to be sent as `authorization: Bearer …`.
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

/// Request to sign a browser in with a token.
#[derive(Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct CreateSession {
    /// Secret of a token.
    pub token: String,
}

impl fmt::Debug for CreateSession {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter
            .debug_struct("CreateSession")
            .finish_non_exhaustive()
    }
}

/// Session as servers of every version send it.
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

/// Person who signed in at an OpenID provider.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
pub struct Person {
    /// Identifier of the person on this server, derived from issuer and subject; the same at each
    /// sign-in.
    pub id: PersonId,
    /// Issuer URL of the provider.
    pub issuer: String,
    /// Subject of the person at the provider, the claim `sub`; it stays when names and addresses
    /// change.
    pub subject: String,
}

/// Identity and rights of the author of a request.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(from = "SessionAnswer")]
pub struct Session {
    /// Name of the token, or of the person who signed in.
    pub name: String,
    /// Role; `null` for a token with a list of rights, and for a person with several roles or with
    /// a list of rights.
    pub role: Option<Role>,
    /// Rights that hold at all of `sites`. A person with several `grants` may have further rights
    /// at some of these sites.
    #[schema(value_type = Vec<Right>)]
    pub rights: Rights,
    /// Sites and robots for which `rights` hold; `null` for all.
    #[schema(value_type = Option<Vec<SiteScope>>)]
    pub sites: Scope,
    /// All rights, each with the sites and robots for which they hold; a request is allowed if any
    /// one grant allows it. There is one grant, unless a person is in groups that have different
    /// rights at different sites.
    #[schema(required = true)]
    pub grants: Vec<Grant>,
    /// Identifier of the token; `null` for a person who signed in at the provider.
    #[schema(required = true)]
    pub token: Option<TokenId>,
    /// Person who signed in at the provider; `null` for a token.
    #[schema(required = true)]
    pub person: Option<Person>,
    /// Identifier of the browser's session; `null` for a request without one.
    pub session: Option<SessionId>,
    /// Time from which the token or session is refused.
    pub expires_at: Timestamp,
}

/// Ways in which people may sign in.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct SignInMethods {
    /// Whether people may sign in with a token; always true.
    pub token: bool,
    /// Sign-in at an OpenID provider; `null` if none is configured.
    pub oidc: Option<OidcSignIn>,
}

/// Sign-in at an OpenID provider.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct OidcSignIn {
    /// Name of the provider, for people.
    pub label: String,
    /// Path on this server at which a browser starts the sign-in.
    pub path: String,
    /// Whether the provider has answered; the server keeps retrying otherwise.
    pub available: bool,
}

/// Response to the end of a session.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct SignedOut {
    /// Address at which a browser signs out at the provider too.
    pub provider: String,
}

/// Session of a person who signed in at an OpenID provider.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct PersonSession {
    /// Identifier of the session, with which it is ended; not secret.
    pub id: SessionId,
    /// Name of the person at the time of the sign-in.
    pub name: String,
    /// The person.
    pub person: Person,
    /// Groups of the person from which the rights derive.
    pub groups: Vec<String>,
    /// Rights, each with the sites and robots for which they hold.
    pub grants: Vec<Grant>,
    /// Time of the sign-in.
    pub created_at: Timestamp,
    /// Time from which the session is refused.
    pub expires_at: Timestamp,
    /// Time of its last use, accurate to ten minutes; `null` if it was never used.
    pub last_used_at: Option<Timestamp>,
}

/// Entry of the audit log: a change, or a refused request.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct AuditEntry {
    /// Number of the entry; consecutive in the order of time.
    pub id: u64,
    /// Time of the response; that of the last one if the entry stands for several requests.
    pub at: Timestamp,
    /// Time of the first response if the entry stands for several requests; else `null`.
    pub since: Option<Timestamp>,
    /// Number of requests. When an author sends very many, repetitions of a request with the same
    /// response share one entry.
    pub count: u64,
    /// Name of the token or of the person; `null` for a request without valid credentials.
    pub who: Option<String>,
    /// Identifier of the token; `null` without one.
    pub token: Option<TokenId>,
    /// Person who had signed in at an OpenID provider; absent for a token.
    // Omitted when absent, so that entries from versions without persons keep their hashes.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub person: Option<Person>,
    /// Role of the token or person; `null` without one, and for a list of rights.
    pub role: Option<Role>,
    /// Address of the peer, or of the client that a trusted proxy names.
    pub address: String,
    /// HTTP method of the request.
    pub method: String,
    /// Route of the request, as `/openapi.json` names it.
    pub route: String,
    /// Requested path, without its query.
    pub path: String,
    /// HTTP status of the response.
    pub status: u16,
    /// `x-request-id` of the response; that of the last one if the entry stands for several
    /// requests. The server's log contains it too.
    pub request_id: String,
    /// Body of the request without secrets, shortened if it was long; `null` without one.
    pub what: Option<serde_json::Value>,
    /// Hash of the previous entry; `null` in entries of versions without a hash chain.
    pub previous_hash: Option<String>,
    /// Hash of this entry, over `previous_hash` and the canonical form of the entry; `null` in
    /// entries of versions without a hash chain.
    pub hash: Option<String>,
}

/// Order in which entries of the audit log are listed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum AuditOrder {
    /// Newest entry first.
    #[default]
    Newest,
    /// Oldest entry first, the order of the hash chain.
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
        // Rights in the answer take precedence; the role never adds rights to them.
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
