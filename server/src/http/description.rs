//! Completes the OpenAPI description, so that other programs can generate clients from it.

use axum::http::StatusCode;
use tread_api::problem::PROBLEM_MEDIA_TYPE;
use utoipa::openapi::path::Operation;
use utoipa::openapi::schema::Schema;
use utoipa::openapi::{Components, Content, OpenApi, Ref, RefOr, Response, ResponseBuilder};

use super::identity;

/// Returns the description with problems as the responses to errors, credentials, a description of
/// each response and named schemas for the content of variants.
pub(super) fn complete(mut openapi: OpenApi) -> OpenApi {
    identity::access::describe(&mut openapi);
    for item in openapi.paths.paths.values_mut() {
        let operations = [
            &mut item.get,
            &mut item.put,
            &mut item.post,
            &mut item.delete,
            &mut item.patch,
        ];
        for operation in operations.into_iter().flatten() {
            describe_responses(operation);
        }
    }
    if let Some(components) = &mut openapi.components {
        name_variants(components);
    }
    openapi
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
