//! Sessions of browsers.

use jiff::Timestamp;
use tread_api::identity::Person;
use tread_api::ids::{SessionId, TokenId};

use crate::Fingerprint;

/// A person as stored with a session.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SignedIn {
    /// Identity at the provider.
    pub person: Person,
    /// Name at the time of sign-in.
    pub name: String,
    /// Groups at the time of sign-in that had a grant.
    pub groups: Vec<String>,
}

/// Owner of a session.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Owner {
    /// The token that it was opened with.
    Token(TokenId),
    /// A person.
    Person(SignedIn),
}

/// A session as it is stored.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SessionRow {
    /// The session.
    pub id: SessionId,
    /// Its owner.
    pub owner: Owner,
    /// The hash of its secret.
    pub hash: Vec<u8>,
    /// When it was opened.
    pub created_at: Timestamp,
    /// Time from which it is refused.
    pub expires_at: Timestamp,
    /// Time of its last use; only for a person's session.
    pub last_used_at: Option<Timestamp>,
}

/// A session to be stored.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NewSession {
    /// The session.
    pub id: SessionId,
    /// Its owner.
    pub owner: Owner,
    /// The hash of its secret.
    pub fingerprint: Fingerprint,
    /// When it was opened.
    pub created_at: Timestamp,
    /// Time from which it is refused.
    pub expires_at: Timestamp,
}

/// Filter of a list of people's sessions.
#[derive(Debug, Clone)]
pub struct PeopleSessionFilter<'filter> {
    /// Those of this provider.
    pub issuer: &'filter str,
    /// Groups whose grants are within the requested scope.
    pub within: &'filter [&'filter str],
    /// Groups whose grants are not within it; sessions with one of them are left out.
    pub elsewhere: &'filter [&'filter str],
    /// Whether to include sessions whose groups have no grant any more.
    pub any: bool,
    /// Only those that are valid at this time.
    pub at: Timestamp,
    /// Only those before this one.
    pub before: Option<SessionId>,
}
