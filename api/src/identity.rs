//! Who may do what: roles, tokens, sessions of browsers, and the audit log.

use std::fmt;
use std::str::FromStr;

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::ids::{SessionId, TokenId};

/// Most days that a token may be valid.
pub const TOKEN_DAYS_MAX: u32 = 1_826;
/// Days that a token is valid when nothing is said.
pub const TOKEN_DAYS_DEFAULT: u32 = 90;
/// Longest name of a token, in characters.
pub const TOKEN_NAME_MAX: usize = 80;

/// What a person or a program may do; each role may do what those before it may.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, ToSchema,
)]
#[serde(rename_all = "snake_case")]
pub enum Role {
    /// Sees everything but tokens and the audit log, and may stop robots.
    Viewer,
    /// Gives missions, draws terrains, drives robots.
    Operator,
    /// Makes sites, gives and revokes tokens, reads the audit log.
    Admin,
}

impl Role {
    /// Every role, the weakest first.
    pub const ALL: [Self; 3] = [Self::Viewer, Self::Operator, Self::Admin];

    /// The name on the wire.
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Viewer => "viewer",
            Self::Operator => "operator",
            Self::Admin => "admin",
        }
    }

    /// The role of that name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|role| role.as_str() == name)
    }

    /// Whether this role may do what `needed` may.
    pub fn includes(self, needed: Self) -> bool {
        self >= needed
    }
}

impl fmt::Display for Role {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(self.as_str())
    }
}

/// Why a text is no role.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("a role is `viewer`, `operator` or `admin`")]
pub struct InvalidRole;

impl FromStr for Role {
    type Err = InvalidRole;

    fn from_str(text: &str) -> Result<Self, InvalidRole> {
        Self::from_name(text).ok_or(InvalidRole)
    }
}

/// A token as it is listed: everything but its secret, which nobody keeps.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Token {
    /// Its identifier, for revoking it; no secret.
    pub id: TokenId,
    /// What people call it.
    pub name: String,
    /// What it may do.
    pub role: Role,
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

/// Asks for a new token.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct CreateToken {
    /// What people call it; no other valid token may have this name.
    pub name: String,
    /// What it may do.
    pub role: Role,
    /// Days until it is refused, 1 to 1826; 90 when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub valid_days: Option<u32>,
}

/// A new token with its secret, which is told this once.
#[derive(Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct CreatedToken {
    /// The token.
    pub token: Token,
    /// What its holder sends as `authorization: Bearer …`.
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

/// Who asks.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Session {
    /// The name of the token that was shown.
    pub name: String,
    /// What it may do.
    pub role: Role,
    /// The token.
    pub token: TokenId,
    /// The browser's session, if it is one.
    pub session: Option<SessionId>,
    /// From when on it is refused.
    pub expires_at: Timestamp,
}

/// One line of the audit log: somebody changed something, or was refused.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct AuditEntry {
    /// Its number; they grow with time.
    pub id: u64,
    /// When it was answered.
    pub at: Timestamp,
    /// The name of the token that was shown; `null` for a request without a good one.
    pub who: Option<String>,
    /// That token.
    pub token: Option<TokenId>,
    /// Its role.
    pub role: Option<Role>,
    /// The address of the other side; a proxy's if there is one.
    pub address: String,
    /// The request's method.
    pub method: String,
    /// The route, as `/openapi.json` names it.
    pub route: String,
    /// The path asked for, without its query.
    pub path: String,
    /// The status of the answer.
    pub status: u16,
    /// The `x-request-id` of the answer, which the log has too.
    pub request_id: String,
    /// What was asked: the body without secrets, shortened where it was long.
    pub what: Option<serde_json::Value>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_role_may_do_what_the_weaker_ones_may_and_no_more() {
        for (index, role) in Role::ALL.into_iter().enumerate() {
            for (other_index, other) in Role::ALL.into_iter().enumerate() {
                assert_eq!(role.includes(other), index >= other_index);
            }
            assert_eq!(role.as_str().parse(), Ok(role));
        }
    }

    #[test]
    fn secrets_are_not_shown_by_accident() {
        let asked = CreateSession {
            token: "tread_a_secret".to_owned(),
        };
        assert!(!format!("{asked:?}").contains("secret"));
    }
}
