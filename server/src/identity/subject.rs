//! Who is behind requests, as far as shares of connections, sockets, streams and the audit log are
//! concerned: a token with all its sessions, or a person with all theirs. And how they are called where
//! there is a name alone, so that none passes for another.

use std::fmt;

use tread_api::ids::{PersonId, TokenId};

/// What stands before the names of people, with a colon. People choose theirs at the provider, at any time,
/// and no token is called so.
const PEOPLE: &str = "oidc";

/// What a person is called here who has a name at the provider.
pub fn name_of_person(name: &str) -> String {
    format!("{PEOPLE}:{name}")
}

/// Whether a token may have a name: not one that reads like a person's, and not the identifier of one, by
/// which people own limits.
pub fn may_name_token(name: &str) -> bool {
    let kind = name.split(':').next().unwrap_or_default().trim();
    !kind.eq_ignore_ascii_case(PEOPLE) && name.parse::<PersonId>().is_err()
}

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

#[cfg(test)]
mod tests {
    use tread_api::ids::OidcSubject;

    use super::*;

    #[test]
    fn no_token_is_called_like_a_person_or_like_what_owns_a_persons_limits() {
        for name in [
            "anna",
            "anna@example.org",
            "oidcs",
            "desk: oidc:anna",
            "desk oidc",
        ] {
            assert!(may_name_token(name), "{name}");
            assert!(!may_name_token(&name_of_person(name)), "{name}");
        }
        let person = PersonId::of(OidcSubject {
            issuer: "https://login.test",
            subject: "anna",
        })
        .to_string();
        // With a name that somebody gives behind it the third would read like a person too.
        for name in ["oidc:", "OIDC:anna", "oidc", " Oidc : anna", &person] {
            assert!(!may_name_token(name), "{name}");
        }
    }
}
