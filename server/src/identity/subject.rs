//! Identifies the subject to which limits on connections, sockets, streams and audit log entries
//! apply: a token or a person, each with all its sessions. Also defines how people and tokens are
//! named where only a name is recorded, so that a token cannot be confused with a person.

use tread_api::ids::PersonId;
pub use tread_store::SubjectId;

/// Prefix of people's names, followed by a colon. It keeps the names that people choose at the
/// provider apart from the names of tokens, which must not have it.
const PEOPLE: &str = "oidc";

/// Returns the name under which a person is recorded: `oidc:` and the display name at the provider.
pub fn name_of_person(name: &str) -> String {
    format!("{PEOPLE}:{name}")
}

/// Returns whether `name` is allowed for a token: it neither begins with the prefix of people's
/// names nor parses as a [`PersonId`], which names the owner of a person's limits.
pub fn may_name_token(name: &str) -> bool {
    let kind = name.split(':').next().unwrap_or_default().trim();
    !kind.eq_ignore_ascii_case(PEOPLE) && name.parse::<PersonId>().is_err()
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
        // A token named `oidc` could be confused with a person once `:` and a name follow it.
        for name in ["oidc:", "OIDC:anna", "oidc", " Oidc : anna", &person] {
            assert!(!may_name_token(name), "{name}");
        }
    }
}
