//! Who is behind requests, as far as shares of connections, sockets, streams and the audit log are
//! concerned: a token with all its sessions, or a person with all theirs.

use std::fmt;

use tread_api::ids::{PersonId, TokenId};

/// Whoever has a share of his own.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum SubjectId {
    /// A token, with the sessions that were opened with it.
    Token(TokenId),
    /// A person who signed in at the provider, with all their sessions.
    Person(PersonId),
}

impl fmt::Display for SubjectId {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Token(token) => token.fmt(formatter),
            Self::Person(person) => person.fmt(formatter),
        }
    }
}

impl SubjectId {
    /// The token, if it is one.
    pub const fn token(self) -> Option<TokenId> {
        match self {
            Self::Token(token) => Some(token),
            Self::Person(_) => None,
        }
    }
}
