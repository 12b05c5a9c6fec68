//! Reduces the JSON body of a request to what the audit log stores: short fields, without secrets.

use std::collections::BTreeMap;

use serde_json::value::RawValue;
use serde_json::{Map, Value};

/// Maximum size of the JSON that is stored, in bytes.
pub const KEPT_MAX: usize = 1_024;
/// Maximum length of a string field in characters, if the body exceeds [`KEPT_MAX`]; fields with
/// longer strings are left out.
const TEXT_MAX: usize = 100;
/// Substrings of the names of fields that are never stored, in lower case.
const SECRET_NAMES: [&str; 5] = ["token", "secret", "password", "passphrase", "key"];

/// Maximum size of a body that is parsed completely, in bytes. Of a larger one, such as a path with
/// many points, only the outermost fields are parsed, which saves memory.
const WHOLE_MAX: usize = 4 * KEPT_MAX;

/// Parses the JSON body of a request and reduces it by [`redacted`]; a body larger than `WHOLE_MAX`
/// keeps at most its short outermost fields. Invalid JSON gives `null`.
pub fn redacted_text(body: &[u8]) -> Value {
    if body.len() <= WHOLE_MAX {
        return redacted(&serde_json::from_slice(body).unwrap_or_default());
    }
    let fields: BTreeMap<String, &RawValue> = serde_json::from_slice(body).unwrap_or_default();
    let short = fields.into_iter().filter_map(|(name, field)| {
        let text = field.get();
        let is_nested = text.starts_with(['{', '[']);
        let is_short = !is_nested && text.len() <= KEPT_MAX;
        let value = is_short.then(|| serde_json::from_str(text).ok())??;
        Some((name, value))
    });
    redacted(&Value::Object(short.collect()))
}

/// Returns `body` without secret fields. If the result exceeds [`KEPT_MAX`], only its short
/// outermost fields remain; `null` if even these exceed it.
pub fn redacted(body: &Value) -> Value {
    let clean = without_secrets(body);
    if is_short(&clean) {
        return clean;
    }
    let Value::Object(fields) = clean else {
        return Value::Null;
    };
    let mut kept = Map::new();
    for (name, field) in fields {
        let short = match field {
            Value::String(text) if text.chars().count() > TEXT_MAX => continue,
            Value::Array(_) | Value::Object(_) => continue,
            short @ (Value::String(_) | Value::Null | Value::Bool(_) | Value::Number(_)) => short,
        };
        kept.insert(name, short);
        if !is_short(&Value::Object(kept.clone())) {
            return Value::Null;
        }
    }
    Value::Object(kept)
}

fn is_short(value: &Value) -> bool {
    serde_json::to_string(value).is_ok_and(|text| text.len() <= KEPT_MAX)
}

fn is_secret(name: &str) -> bool {
    let name = name.to_ascii_lowercase();
    SECRET_NAMES.iter().any(|secret| name.contains(secret))
}

fn without_secrets(value: &Value) -> Value {
    match value {
        Value::Object(fields) => Value::Object(
            fields
                .iter()
                .filter(|(name, _)| !is_secret(name))
                .map(|(name, field)| (name.clone(), without_secrets(field)))
                .collect(),
        ),
        Value::Array(items) => Value::Array(items.iter().map(without_secrets).collect()),
        Value::Null | Value::Bool(_) | Value::Number(_) | Value::String(_) => value.clone(),
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn secrets_are_left_out_however_deep() {
        let body = json!({"name": "x", "token": "tread_a_1", "in": [{"Join_Secret": 1, "y": 2}]});
        assert_eq!(redacted(&body), json!({"name": "x", "in": [{"y": 2}]}));
    }

    #[test]
    fn a_long_body_keeps_its_short_fields() {
        let points: Vec<Value> = (0..1_000).map(|x| json!({"x_m": x, "y_m": 0})).collect();
        let body = json!({"site": "yard", "priority": 3, "trajectory": {"points": points},
                          "note": "n".repeat(2_000)});
        assert_eq!(redacted(&body), json!({"site": "yard", "priority": 3}));
        assert_eq!(redacted(&json!(["x".repeat(2_000)])), Value::Null);
        let wide: Map<String, Value> = (0..999).map(|n| (format!("f{n}"), json!(n))).collect();
        assert_eq!(redacted(&Value::Object(wide)), Value::Null);
    }

    #[test]
    fn of_a_long_body_the_short_outermost_fields_are_kept_without_secrets() {
        let points: Vec<Value> = (0..5_000).map(|x_m| json!({"x_m": x_m})).collect();
        let body = json!({"robot": "rover-1", "api_token": "s", "trajectory": {"points": points}});
        let kept = redacted_text(&serde_json::to_vec(&body).unwrap());
        assert_eq!(kept, json!({"robot": "rover-1"}));
        assert_eq!(redacted_text(b"no json"), Value::Null);
    }
}
