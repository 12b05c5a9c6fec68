//! Every block says its language, and every JSON in the documentation is JSON.
//!
//! A comment above a `json` block says what it is, and it is held against the description of the API:
//! `POST /v1/missions body`, `POST /v1/missions reply 201`, or `schema Trajectory`. `zenoh` is an
//! envelope between robot and server, `outline` a shape with `…` for what may stand there.

use std::fmt::Write as _;

use serde_json::Value;
use tread_tests::markdown::{Block, documents};
use tread_tests::repository::root;

use crate::schema;

/// What a block may be written in.
const LANGUAGES: [&str; 5] = ["json", "python", "sh", "text", "toml"];
/// What stands for whatever may be there in an outline.
const ANYTHING: char = '…';

/// The schema that a note names.
fn named<'api>(api: &'api Value, note: &str) -> Option<&'api Value> {
    let words: Vec<&str> = note.split_whitespace().collect();
    match *words.as_slice() {
        ["schema", name] => api["components"]["schemas"].get(name),
        [method, path, "body"] => {
            let operation = &api["paths"][path][method.to_lowercase()];
            operation["requestBody"]["content"]["application/json"].get("schema")
        }
        [method, path, "reply", status] => {
            let reply = &api["paths"][path][method.to_lowercase()]["responses"][status];
            let contents = reply["content"].as_object()?;
            contents.values().next()?.get("schema")
        }
        _ => None,
    }
}

/// What is wrong with a block of JSON.
fn fault(api: &Value, block: &Block) -> Option<String> {
    let Some(note) = &block.note else {
        return Some("a comment above must say what this JSON is".to_owned());
    };
    let text = if note == "outline" {
        outline(&block.text)
    } else {
        block.text.clone()
    };
    // One after the other, as examples of one kind are shown.
    let values: Result<Vec<Value>, _> = serde_json::Deserializer::from_str(&text)
        .into_iter()
        .collect();
    let values = match values {
        Ok(values) => values,
        Err(refused) => return Some(format!("this is no JSON: {refused}")),
    };
    if note == "outline" || note == "zenoh" {
        let is_envelope = |value: &Value| value["v"].is_u64() && value["body"].is_object();
        let is_good = note == "outline" || values.iter().all(is_envelope);
        return (!is_good).then(|| "this is no envelope".to_owned());
    }
    let Some(schema) = named(api, note) else {
        return Some(format!("the description of the API has no `{note}`"));
    };
    let mut faults = values
        .iter()
        .flat_map(|value| schema::faults(api, schema, value));
    faults.next()
}

/// JSON of an outline: `…` stands for a value, or for further fields and items.
fn outline(text: &str) -> String {
    let mut json = String::new();
    let mut is_quoted = false;
    for letter in text.chars() {
        is_quoted ^= letter == '"';
        if letter != ANYTHING || is_quoted {
            json.push(letter);
            continue;
        }
        let before = json.trim_end();
        if before.ends_with(':') {
            json.push_str("null");
        } else {
            json = before.trim_end_matches(',').to_owned();
        }
    }
    json
}

#[test]
fn every_block_says_its_language_and_every_json_is_what_the_api_describes() {
    let api = std::fs::read_to_string(root().join("server/openapi.json")).unwrap();
    let api: Value = serde_json::from_str(&api).unwrap();
    let mut faults = String::new();
    for document in documents() {
        let name = &document.name;
        for block in &document.blocks {
            let line = block.line;
            if !LANGUAGES.contains(&block.language.as_str()) {
                let language = &block.language;
                let _ = writeln!(faults, "{name}:{line}: `{language}` is no language");
            }
            if block.language == "json"
                && let Some(fault) = fault(&api, block)
            {
                let _ = writeln!(faults, "{name}:{line}: {fault}");
            }
        }
        // In sentences and tables JSON may be an outline, and has to be one.
        for code in document
            .codes
            .iter()
            .filter(|code| code.text.starts_with("{\""))
        {
            let read: Result<Value, _> = serde_json::from_str(&outline(&code.text));
            if let Err(refused) = read {
                let _ = writeln!(
                    faults,
                    "{name}:{}: `{}` is no JSON: {refused}",
                    code.line, code.text
                );
            }
        }
    }
    assert!(faults.is_empty(), "\n{faults}");
}

#[test]
fn what_an_outline_leaves_out_is_put_in() {
    for (text, expected) in [
        (r#"{"a": …}"#, r#"{"a": null}"#),
        (r#"{"a": [1, …], "b": {…}}"#, r#"{"a": [1], "b": {}}"#),
        (r#"{"a": {"b": 1, …}}"#, r#"{"a": {"b": 1}}"#),
        (r#"{"a": "x…"}"#, r#"{"a": "x…"}"#),
    ] {
        assert_eq!(outline(text), expected);
    }
}
