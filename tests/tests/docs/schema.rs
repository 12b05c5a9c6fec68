//! Whether a JSON value is what a schema of the OpenAPI description says. It knows the words that
//! the description uses, and is stricter in one: an object has no field that is not described.

use serde_json::{Map, Value};

/// Deepest schema within a schema.
const DEPTH_MAX: usize = 64;

/// What is wrong with a value; empty when nothing is.
pub(crate) fn faults(document: &Value, schema: &Value, value: &Value) -> Vec<String> {
    let mut faults = Vec::new();
    Checker { document, depth: 0 }.check(schema, value, "", &mut faults);
    faults
}

#[derive(Clone, Copy)]
struct Checker<'document> {
    document: &'document Value,
    depth: usize,
}

impl<'document> Checker<'document> {
    fn resolve(self, schema: &'document Value) -> &'document Value {
        match schema["$ref"].as_str() {
            Some(to) => {
                let found = self.document.pointer(to.trim_start_matches('#'));
                found.unwrap_or_else(|| panic!("the description has no {to}"))
            }
            None => schema,
        }
    }

    fn check(self, schema: &'document Value, value: &Value, at: &str, faults: &mut Vec<String>) {
        assert!(self.depth < DEPTH_MAX, "schemas are too deep at {at}");
        let deeper = Self {
            depth: self.depth + 1,
            ..self
        };
        let schema = self.resolve(schema);
        for word in ["oneOf", "anyOf"] {
            let Some(choices) = schema[word].as_array() else {
                continue;
            };
            let mut least: Option<Vec<String>> = None;
            for choice in choices {
                let mut of_choice = Vec::new();
                deeper.check(choice, value, at, &mut of_choice);
                if least
                    .as_ref()
                    .is_none_or(|least| of_choice.len() < least.len())
                {
                    least = Some(of_choice);
                }
            }
            faults.extend(least.unwrap_or_default());
        }
        if let Some(choices) = schema["enum"].as_array()
            && !choices.contains(value)
        {
            faults.push(format!("{at}: {value} is none of {}", schema["enum"]));
        }
        let kinds: Vec<&str> = match &schema["type"] {
            Value::String(kind) => vec![kind],
            Value::Array(kinds) => kinds.iter().filter_map(Value::as_str).collect(),
            Value::Null | Value::Bool(_) | Value::Number(_) | Value::Object(_) => Vec::new(),
        };
        if !kinds.is_empty() && !kinds.iter().any(|kind| is_kind(kind, value)) {
            faults.push(format!("{at}: {value} is no {}", kinds.join(" or ")));
            return;
        }
        match value {
            Value::Object(fields) => deeper.object(schema, fields, at, faults),
            Value::Array(items) => {
                for (index, item) in items.iter().enumerate() {
                    if !schema["items"].is_null() {
                        deeper.check(&schema["items"], item, &format!("{at}/{index}"), faults);
                    }
                }
            }
            Value::Number(_) => {
                let bound = |word: &str| schema[word].as_f64();
                let number = value.as_f64().unwrap_or(f64::NAN);
                if bound("minimum").is_some_and(|least| number < least)
                    || bound("maximum").is_some_and(|most| number > most)
                    || bound("exclusiveMinimum").is_some_and(|least| number <= least)
                {
                    faults.push(format!("{at}: {value} is out of its range"));
                }
            }
            Value::Null | Value::Bool(_) | Value::String(_) => {}
        }
    }

    fn object(
        self,
        schema: &'document Value,
        fields: &Map<String, Value>,
        at: &str,
        faults: &mut Vec<String>,
    ) {
        for name in schema["required"].as_array().into_iter().flatten() {
            if name.as_str().is_some_and(|name| !fields.contains_key(name)) {
                faults.push(format!("{at}: {name} is missing"));
            }
        }
        let (mut known, mut is_open) = (Map::new(), false);
        self.properties(schema, &mut known, &mut is_open);
        for (name, field) in fields {
            let at = format!("{at}/{name}");
            if let Some(of_field) = schema["properties"].get(name) {
                self.check(of_field, field, &at, faults);
            } else if schema["additionalProperties"].is_object() {
                self.check(&schema["additionalProperties"], field, &at, faults);
            } else if !is_open && !known.contains_key(name) {
                faults.push(format!("{at}: nobody knows this field"));
            }
        }
        for part in schema["allOf"].as_array().into_iter().flatten() {
            let part = self.resolve(part);
            for (name, of_field) in part["properties"].as_object().into_iter().flatten() {
                if let Some(field) = fields.get(name) {
                    self.check(of_field, field, &format!("{at}/{name}"), faults);
                }
            }
        }
    }

    /// The fields that a schema and its parts know, and whether there may be others.
    fn properties(self, schema: &Value, known: &mut Map<String, Value>, is_open: &mut bool) {
        if let Some(fields) = schema["properties"].as_object() {
            known.extend(fields.clone());
        }
        let mut parts = Vec::new();
        for word in ["allOf", "oneOf", "anyOf"] {
            parts.extend(schema[word].as_array().into_iter().flatten());
        }
        let describes_nothing = schema["properties"].is_null() && parts.is_empty();
        *is_open |= describes_nothing;
        for part in parts {
            if let Some(to) = part["$ref"].as_str() {
                let found = self.document.pointer(to.trim_start_matches('#'));
                self.properties(found.unwrap_or(&Value::Null), known, is_open);
            } else if part["type"] != "null" {
                self.properties(part, known, is_open);
            }
        }
    }
}

fn is_kind(kind: &str, value: &Value) -> bool {
    match kind {
        "object" => value.is_object(),
        "array" => value.is_array(),
        "string" => value.is_string(),
        "boolean" => value.is_boolean(),
        "null" => value.is_null(),
        "number" => value.is_number(),
        "integer" => value.is_i64() || value.is_u64(),
        other => panic!("the description has a type `{other}`"),
    }
}

#[test]
fn a_value_that_is_not_as_described_is_found() {
    let document = serde_json::json!({"schemas": {
        "Point": {"type": "object", "required": ["x_m"], "properties": {
            "x_m": {"type": "number", "maximum": 10}, "name": {"type": ["string", "null"]}}},
        "Shape": {"oneOf": [
            {"type": "object", "required": ["at"], "properties": {"at": {"$ref": "#/schemas/Point"}}},
            {"type": "string", "enum": ["none"]},
        ]},
    }});
    let of = |text: &str| {
        let value = serde_json::from_str(text).unwrap();
        faults(&document, &document["schemas"]["Shape"], &value)
    };
    for good in [
        r#""none""#,
        r#"{"at": {"x_m": 1}}"#,
        r#"{"at": {"x_m": 1, "name": null}}"#,
    ] {
        assert_eq!(of(good), Vec::<String>::new(), "{good}");
    }
    for bad in [
        r#""some""#,
        "3",
        r#"{"at": {}}"#,
        r#"{"at": {"x_m": 11}}"#,
        r#"{"at": {"x_m": 1, "y": 1}}"#,
        r#"{"at": {"x_m": "1"}}"#,
        r#"{"at": {"x_m": 1}, "to": 2}"#,
    ] {
        assert!(!of(bad).is_empty(), "{bad}");
    }
}
