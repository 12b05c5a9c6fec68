//! Bodies from the schemas of the description, and what is done to them.

use serde_json::{Map, Value, json};
use tread_tests::random::Random;

/// Deepest nesting of a body that is made from a schema.
const DEPTH_MAX: usize = 8;
/// Texts that are unlike others.
const ODD_TEXTS: [&str; 12] = [
    "",
    " ",
    "\u{0}",
    "\u{1b}[31mred\r\nx-injected: yes",
    "\u{202e}txet",
    "e\u{301}\u{301}\u{301}",
    "\u{feff}yard",
    "../../etc/passwd",
    "'; DROP TABLE robots; --",
    "<script>alert(1)</script>",
    "\u{1f916}\u{200d}\u{1f916}",
    "%00%2e%2e%2f",
];
/// Numbers that are unlike others, as they are written.
const ODD_NUMBERS: [&str; 10] = [
    "-1",
    "0",
    "-0.0",
    "1e308",
    "-1e308",
    "1e-320",
    "1e999",
    "9223372036854775808",
    "340282366920938463463374607431768211456",
    "0.1",
];
/// Nesting of what is too deep.
const DEEP: usize = 100_000;
/// Bytes of what is too large.
const LARGE_BYTES: usize = 2 * 1024 * 1024;

/// A body with the type that it is sent as.
#[derive(Debug, Clone)]
pub(super) struct Body {
    pub(super) bytes: Vec<u8>,
    pub(super) media_type: &'static str,
}

/// A text that is unlike others.
pub(super) fn odd_text(random: &mut Random) -> String {
    let text = ODD_TEXTS[random.index(ODD_TEXTS.len())];
    if random.chance(0.1) {
        return text.repeat(5_000);
    }
    text.to_owned()
}

/// A value of a schema.
pub(super) fn of_schema(document: &Value, schema: &Value, random: &mut Random) -> Value {
    value(document, schema, random, 0)
}

fn value(document: &Value, schema: &Value, random: &mut Random, depth: usize) -> Value {
    if depth > DEPTH_MAX {
        return Value::Null;
    }
    if let Some(pointer) = schema["$ref"].as_str() {
        let found = document.pointer(pointer.trim_start_matches('#'));
        return value(document, found.unwrap_or(&Value::Null), random, depth + 1);
    }
    for choice in ["oneOf", "anyOf"] {
        if let Some(of) = schema[choice].as_array().filter(|of| !of.is_empty()) {
            return value(document, &of[random.index(of.len())], random, depth + 1);
        }
    }
    if let Some(of) = schema["allOf"].as_array() {
        let mut all = Map::new();
        for part in of {
            if let Value::Object(fields) = value(document, part, random, depth + 1) {
                all.extend(fields);
            }
        }
        return Value::Object(all);
    }
    if let Some(of) = schema["enum"].as_array().filter(|of| !of.is_empty()) {
        return of[random.index(of.len())].clone();
    }
    let kind = schema["type"].as_array().filter(|kinds| !kinds.is_empty());
    let kind = kind.map_or(&schema["type"], |kinds| &kinds[random.index(kinds.len())]);
    match kind.as_str() {
        Some("object") => object(document, schema, random, depth),
        Some("array") => {
            let items =
                (0..random.index(4)).map(|_| value(document, &schema["items"], random, depth + 1));
            Value::Array(items.collect())
        }
        Some("string") => text(schema, random),
        Some("integer") => json!(random.index(50)),
        Some("number") => json!(random.between(-5.0..5.0)),
        Some("boolean") => json!(random.chance(0.5)),
        _ => Value::Null,
    }
}

fn object(document: &Value, schema: &Value, random: &mut Random, depth: usize) -> Value {
    let required = schema["required"].as_array().cloned().unwrap_or_default();
    let mut fields = Map::new();
    for (name, of) in schema["properties"].as_object().into_iter().flatten() {
        let is_required = required.iter().any(|field| field == name);
        if is_required || random.chance(0.5) {
            fields.insert(name.clone(), value(document, of, random, depth + 1));
        }
    }
    Value::Object(fields)
}

fn text(schema: &Value, random: &mut Random) -> Value {
    match schema["format"].as_str() {
        Some("uuid") => json!("01a20366-00c7-728b-8be7-56a782511a65"),
        Some("date-time") => json!("2026-11-22T13:00:00Z"),
        _ => {
            let texts = ["yard", "honest", "slab", "rover-1", "a name", "gravel"];
            json!(texts[random.index(texts.len())])
        }
    }
}

/// All places of a body that can be changed.
fn places(value: &Value, at: &str, places: &mut Vec<String>) {
    places.push(at.to_owned());
    match value {
        Value::Object(fields) => {
            for (name, field) in fields {
                let name = name.replace('~', "~0").replace('/', "~1");
                self::places(field, &format!("{at}/{name}"), places);
            }
        }
        Value::Array(items) => {
            for (index, item) in items.iter().enumerate() {
                self::places(item, &format!("{at}/{index}"), places);
            }
        }
        Value::Null | Value::Bool(_) | Value::Number(_) | Value::String(_) => {}
    }
}

/// A body that is not as the description says, in one way or another.
pub(super) fn mutated(mut value: Value, random: &mut Random) -> Body {
    const JSON: &str = "application/json";
    let mut at = Vec::new();
    places(&value, "", &mut at);
    let place = at[random.index(at.len())].clone();
    let json = |bytes: Vec<u8>| Body {
        bytes,
        media_type: JSON,
    };
    match random.index(14) {
        0 => {
            // A field is missing, or the whole body is another.
            if let (Some((parent, name)), true) = (place.rsplit_once('/'), !place.is_empty())
                && let Some(Value::Object(fields)) = value.pointer_mut(parent)
            {
                fields.remove(name);
            }
        }
        1 | 2 => {
            let other = [
                json!(null),
                json!([]),
                json!({}),
                json!(true),
                json!(7),
                json!("x"),
            ];
            if let Some(found) = value.pointer_mut(&place) {
                *found = other[random.index(other.len())].clone();
            }
        }
        3 => {
            if let Some(found) = value.pointer_mut(&place) {
                *found = json!(odd_text(random));
            }
        }
        4 => {
            // As it is written: no JSON value of ours holds such numbers.
            const MARK: &str = "\u{7}number\u{7}";
            if let Some(found) = value.pointer_mut(&place) {
                *found = json!(MARK);
            }
            let number = ODD_NUMBERS[random.index(ODD_NUMBERS.len())];
            let mark = json!(MARK).to_string();
            return json(value.to_string().replace(&mark, number).into_bytes());
        }
        5 => {
            let depth = [200, DEEP][random.index(2)];
            let open = ["[", "{\"a\":"][random.index(2)];
            return json(open.repeat(depth).into_bytes());
        }
        6 => {
            if let Some(found) = value.pointer_mut(&place) {
                *found = json!("x".repeat(LARGE_BYTES));
            }
        }
        7 => {
            let mut bytes = value.to_string().into_bytes();
            bytes.truncate(random.index(bytes.len().max(1)));
            return json(bytes);
        }
        8 => {
            let types = [
                "text/plain",
                "application/xml",
                "multipart/form-data; boundary=x",
                "",
                "\u{7f}",
            ];
            return Body {
                bytes: value.to_string().into_bytes(),
                media_type: types[random.index(types.len())],
            };
        }
        9 => return json(vec![0xff, 0xfe, b'{', 0xc3, 0x28, b'}']),
        10 => {
            if let Value::Object(fields) = &mut value {
                fields.insert("no_such_field".to_owned(), json!(1));
            }
        }
        11 => {
            let text = value.to_string();
            let twice = text.replacen('{', "{\"site\":\"a\",\"site\":\"b\",", 1);
            return json(twice.into_bytes());
        }
        12 => return json(b"{\"name\":\"\\ud800\",\"site\":\"\\u0000\"}".to_vec()),
        _ => return json(Vec::new()),
    }
    json(value.to_string().into_bytes())
}
