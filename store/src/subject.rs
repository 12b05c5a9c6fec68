//! Owners of limits, of idempotency keys and of credentials.

use std::fmt;

use tread_api::ids::{PersonId, TokenId};

/// Subject with limits of its own.
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
    /// Returns the token; `None` for a person.
    pub const fn token(self) -> Option<TokenId> {
        match self {
            Self::Token(token) => Some(token),
            Self::Person(_) => None,
        }
    }
}
