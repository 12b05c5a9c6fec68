//! Reads the claims of a person from an OpenID provider: groups and display name, by claim name or
//! dotted path.

use serde_json::{Map, Value};
use tread_api::text::{cleaned, line};

/// Maximum length of a person's display name, in characters. Longer claims are skipped; a longer
/// subject is cut.
pub const NAME_MAX: usize = 80;
/// Maximum length of a subject (`sub`), in characters, as in OpenID Connect Core 1.0.
pub const SUBJECT_MAX: usize = 255;
/// Claims used as the display name if the configured claim is absent, in order of preference.
const NAMES: [&str; 2] = ["preferred_username", "email"];

/// Claims about one person, from an ID token or the user info endpoint.
pub type Claims = Map<String, Value>;

/// Returns the claim with the name `path`, or else the nested claim at the dotted path, such as
/// `realm_access.roles`. A name that itself contains dots, such as `https://example.org/roles`, has
/// precedence. `None` if there is no such claim.
pub fn claim<'claims>(claims: &'claims Claims, path: &str) -> Option<&'claims Value> {
    if let Some(value) = claims.get(path) {
        return Some(value);
    }
    let dots = path.match_indices('.');
    dots.into_iter().find_map(|(at, _)| {
        let inner = claims.get(&path[..at])?.as_object()?;
        claim(inner, &path[at + 1..])
    })
}

/// Returns the groups in the claim at `path`, which is a string or a list of strings. Other values
/// give no groups.
pub fn groups<'claims>(claims: &'claims Claims, path: &str) -> Vec<&'claims str> {
    match claim(claims, path) {
        Some(Value::String(one)) => vec![one],
        Some(Value::Array(several)) => several.iter().filter_map(Value::as_str).collect(),
        Some(Value::Null | Value::Bool(_) | Value::Number(_) | Value::Object(_)) | None => {
            Vec::new()
        }
    }
}

/// Returns the display name of a person: the configured claim, else `preferred_username`, else
/// `email`, else the subject. A claim that is longer than [`NAME_MAX`] or no single line is
/// skipped.
pub fn shown_name(claims: &Claims, configured: Option<&str>, subject: &str) -> String {
    let names = configured.into_iter().chain(NAMES);
    let mut texts = names.filter_map(|name| claim(claims, name)?.as_str());
    let name = texts.find_map(|text| line(text, NAME_MAX).ok());
    name.map_or_else(|| cleaned(subject, NAME_MAX), str::to_owned)
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn claims(value: Value) -> Claims {
        serde_json::from_value(value).unwrap()
    }

    #[test]
    fn a_claim_is_found_by_its_name_first_and_then_by_its_path() {
        let claims = claims(json!({
            "groups": ["a"],
            "realm_access": {"roles": ["b", 7, null, "c"]},
            "https://example.org/roles": ["d"],
            "resource_access": {"tread.example": {"roles": "e"}},
            "odd": {"roles": 7},
        }));
        for (path, named) in [
            ("groups", vec!["a"]),
            ("realm_access.roles", vec!["b", "c"]),
            ("https://example.org/roles", vec!["d"]),
            ("resource_access.tread.example.roles", vec!["e"]),
            ("odd.roles", vec![]),
            ("realm_access", vec![]),
            ("groups.0", vec![]),
            ("nothing.at.all", vec![]),
            ("", vec![]),
        ] {
            assert_eq!(groups(&claims, path), named, "{path}");
        }
    }

    #[test]
    fn a_person_is_called_by_the_best_name_that_there_is() {
        let all = json!({"preferred_username": "anna", "email": "a@b.test", "nick": "an"});
        assert_eq!(shown_name(&claims(all.clone()), None, "7"), "anna");
        assert_eq!(shown_name(&claims(all), Some("nick"), "7"), "an");
        let email = json!({"email": "a@b.test", "preferred_username": ""});
        assert_eq!(shown_name(&claims(email), Some("nick"), "7"), "a@b.test");
        assert_eq!(shown_name(&Claims::new(), None, "f:7"), "f:7");
        // What could be taken for something else on a screen is no name.
        let odd = json!({"preferred_username": "an\u{202e}na", "email": "x".repeat(500)});
        assert_eq!(shown_name(&claims(odd), None, "7\n8"), "7 8");
    }
}
