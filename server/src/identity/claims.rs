//! What a provider says of a person: claims, found by name or by path.

use serde_json::{Map, Value};
use tread_api::text::{cleaned, line};

/// Longest name of a person that is kept, in characters.
pub const NAME_MAX: usize = 80;
/// Longest subject, in characters: what OpenID Connect Core 1.0 allows.
pub const SUBJECT_MAX: usize = 255;
/// The claims that name a person where the configuration names none, the best first.
const NAMES: [&str; 2] = ["preferred_username", "email"];

/// The claims of one person.
pub type Claims = Map<String, Value>;

/// The claim of a name, or at a path such as `realm_access.roles`. A name that has dots itself, such as
/// `https://example.org/roles`, is found first.
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

/// The groups that a claim names: a list of texts, or one text.
pub fn groups<'claims>(claims: &'claims Claims, path: &str) -> Vec<&'claims str> {
    match claim(claims, path) {
        Some(Value::String(one)) => vec![one],
        Some(Value::Array(several)) => several.iter().filter_map(Value::as_str).collect(),
        Some(Value::Null | Value::Bool(_) | Value::Number(_) | Value::Object(_)) | None => {
            Vec::new()
        }
    }
}

/// The name that people know a person by: the configured claim, else the first that there is of
/// `preferred_username` and `email`, else the subject.
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
