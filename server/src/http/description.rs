//! Completes the OpenAPI description, so that other programs can generate clients from it.

use std::collections::{BTreeMap, BTreeSet};

use axum::http::StatusCode;
use serde::Serialize;
use serde_json::Value;
use tread_api::page::PAGE_LIMIT_MAX;
use tread_api::problem::PROBLEM_MEDIA_TYPE;
use utoipa::openapi::path::{Operation, PathItem};
use utoipa::openapi::schema::{AdditionalProperties, Object, Schema};
use utoipa::openapi::{Components, Content, OpenApi, Ref, RefOr, Response, ResponseBuilder};

use super::identity;

/// Requests whose body may have any form: a stop is refused only for a wrong `site`.
const LENIENT_REQUESTS: [&str; 2] = ["StopFleet", "StopRobot"];

/// Completes the description: problems as the responses to errors, credentials, a description of each
/// response, the range of `limit`, named schemas for the content of variants, and requests without
/// unknown fields.
pub(super) fn complete(mut openapi: OpenApi) -> OpenApi {
    identity::access::describe(&mut openapi);
    let (mut sent, mut received) = (BTreeSet::new(), BTreeSet::new());
    for item in openapi.paths.paths.values_mut() {
        for operation in operations(item) {
            describe_responses(operation);
            bound_limit(operation);
            add_references(&operation.request_body, &mut received);
            add_references(&operation.responses, &mut sent);
        }
    }
    if let Some(components) = &mut openapi.components {
        name_variants(components);
        let sent = closure(&components.schemas, sent);
        for name in closure(&components.schemas, received) {
            // A client may get fields that a newer server has added.
            if !sent.contains(&name)
                && !LENIENT_REQUESTS.contains(&name.as_str())
                && let Some(RefOr::T(Schema::Object(request))) = components.schemas.get_mut(&name)
            {
                refuse_unknown_fields(request);
            }
        }
    }
    openapi
}

fn operations(item: &mut PathItem) -> impl Iterator<Item = &mut Operation> {
    let operations = [
        &mut item.get,
        &mut item.put,
        &mut item.post,
        &mut item.delete,
        &mut item.patch,
    ];
    operations.into_iter().flatten()
}

/// Adds the names of the schemas to which a part of the description refers.
fn add_references(part: &impl Serialize, names: &mut BTreeSet<String>) {
    fn visit(value: &Value, names: &mut BTreeSet<String>) {
        match value {
            Value::Object(fields) => {
                let reference = fields.get("$ref").and_then(Value::as_str);
                let name = reference.and_then(|reference| reference.rsplit('/').next());
                names.extend(name.map(str::to_owned));
                fields.values().for_each(|field| visit(field, names));
            }
            Value::Array(items) => items.iter().for_each(|item| visit(item, names)),
            Value::Null | Value::Bool(_) | Value::Number(_) | Value::String(_) => {}
        }
    }
    if let Ok(value) = serde_json::to_value(part) {
        visit(&value, names);
    }
}

/// Returns these schemas and all to which they refer.
fn closure(schemas: &BTreeMap<String, RefOr<Schema>>, names: BTreeSet<String>) -> BTreeSet<String> {
    let mut open: Vec<String> = names.into_iter().collect();
    let mut closed = BTreeSet::new();
    while let Some(name) = open.pop() {
        if closed.insert(name.clone()) {
            let mut next = BTreeSet::new();
            if let Some(schema) = schemas.get(&name) {
                add_references(schema, &mut next);
            }
            open.extend(next);
        }
    }
    closed
}

/// States that a request with other fields is refused.
fn refuse_unknown_fields(request: &mut Object) {
    if !request.properties.is_empty() && request.additional_properties.is_none() {
        request.additional_properties = Some(Box::new(AdditionalProperties::FreeForm(false)));
    }
}

/// Adds the range of the number of entries of a page.
fn bound_limit(operation: &mut Operation) {
    for parameter in operation.parameters.iter_mut().flatten() {
        if let RefOr::T(parameter) = parameter
            && parameter.name == "limit"
            && let Some(RefOr::T(Schema::Object(schema))) = &mut parameter.schema
        {
            schema.minimum = Some(1.into());
            schema.maximum = Some(PAGE_LIMIT_MAX.into());
        }
    }
}

fn describe_responses(operation: &mut Operation) {
    let problem = ResponseBuilder::new()
        .description("Problem details; `type` is one of the problem types")
        .content(
            PROBLEM_MEDIA_TYPE,
            Content::new(Some(Ref::from_schema_name("ProblemBody"))),
        );
    let responses = &mut operation.responses.responses;
    responses.insert("default".to_owned(), problem.into());
    for (status, response) in responses {
        let RefOr::T(response) = response else {
            continue;
        };
        add_description(status, response);
        if status.starts_with(['4', '5'])
            && let Some(content) = response.content.swap_remove("application/json")
        {
            response
                .content
                .insert(PROBLEM_MEDIA_TYPE.to_owned(), content);
        }
    }
}

/// Adds the reason phrase of the status to a response without a description, which OpenAPI 3.1
/// requires.
fn add_description(status: &str, response: &mut Response) {
    if !response.description.is_empty() {
        return;
    }
    let status = StatusCode::from_bytes(status.as_bytes()).ok();
    let phrase = status.and_then(|status| status.canonical_reason());
    phrase
        .unwrap_or("Response")
        .clone_into(&mut response.description);
}

/// Gives the content of each variant a schema of its own, `LinkPolicyStopAfter` for `stop_after` of
/// `LinkPolicy`: generators of clients name types after schemas, and some drop nested ones.
fn name_variants(components: &mut Components) {
    let mut named = Vec::new();
    for (of, schema) in &mut components.schemas {
        let RefOr::T(Schema::OneOf(one_of)) = schema else {
            continue;
        };
        for variant in &mut one_of.items {
            let RefOr::T(Schema::Object(variant)) = variant else {
                continue;
            };
            for (tag, content) in &mut variant.properties {
                let is_nested = matches!(content, RefOr::T(Schema::Object(object)) if !object.properties.is_empty());
                if is_nested {
                    let name = format!("{of}{}", pascal_case(tag));
                    let schema = std::mem::replace(content, Ref::from_schema_name(&name).into());
                    named.push((name, schema));
                }
            }
        }
    }
    components.schemas.extend(named);
}

fn pascal_case(snake_case: &str) -> String {
    let mut starts_word = true;
    let mut name = String::with_capacity(snake_case.len());
    for character in snake_case.chars() {
        if character == '_' {
            starts_word = true;
        } else if std::mem::take(&mut starts_word) {
            name.extend(character.to_uppercase());
        } else {
            name.push(character);
        }
    }
    name
}
