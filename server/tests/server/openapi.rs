//! The description of the API is part of the API.

use crate::harness::{Yard, folder_of_the_crate};

#[test]
fn the_description_is_the_committed_one() {
    let path = folder_of_the_crate().join("openapi.json");
    let mut now = serde_json::to_string_pretty(&tread_server::http::openapi()).unwrap();
    now.push('\n');
    if std::env::var_os("UPDATE_OPENAPI").is_some() {
        std::fs::write(&path, &now).unwrap();
    }
    let committed = std::fs::read_to_string(&path).unwrap_or_default();
    assert!(
        committed == now,
        "run the tests with UPDATE_OPENAPI=1 and commit openapi.json"
    );
}

/// All references in a description.
fn references(value: &serde_json::Value, found: &mut Vec<String>) {
    match value {
        serde_json::Value::Object(fields) => {
            found.extend(
                fields
                    .get("$ref")
                    .and_then(|to| to.as_str())
                    .map(str::to_owned),
            );
            fields.values().for_each(|field| references(field, found));
        }
        serde_json::Value::Array(items) => items.iter().for_each(|item| references(item, found)),
        serde_json::Value::Null
        | serde_json::Value::Bool(_)
        | serde_json::Value::Number(_)
        | serde_json::Value::String(_) => {}
    }
}

#[test]
fn everything_that_the_description_refers_to_is_in_it() {
    let description = serde_json::to_value(tread_server::http::openapi()).unwrap();
    let mut found = Vec::new();
    references(&description, &mut found);
    assert!(found.len() > 100);
    for reference in found {
        let pointer = reference.trim_start_matches('#');
        assert!(
            description.pointer(pointer).is_some(),
            "{reference} is missing"
        );
    }
}

/// OpenAPI 3.1 requires it, and generators of clients refuse a description without it.
#[test]
fn every_response_has_a_description() {
    let description = serde_json::to_value(tread_server::http::openapi()).unwrap();
    let mut count = 0;
    for (path, operations) in description["paths"].as_object().unwrap() {
        for (method, operation) in operations.as_object().unwrap() {
            for (status, response) in operation["responses"].as_object().unwrap() {
                let text = response["description"].as_str().unwrap_or_default();
                assert!(!text.is_empty(), "{method} {path} {status}");
                count += 1;
            }
        }
    }
    assert!(count > 300, "{count}");
}

/// Generators of clients name types after schemas; one of them drops what is nested in a variant.
#[test]
fn the_content_of_each_variant_is_a_schema_with_a_name() {
    let description = serde_json::to_value(tread_server::http::openapi()).unwrap();
    let schemas = description["components"]["schemas"].as_object().unwrap();
    assert!(schemas.contains_key("LinkPolicyStopAfter"));
    for (name, schema) in schemas {
        for variant in schema["oneOf"].as_array().into_iter().flatten() {
            for (tag, content) in variant["properties"].as_object().into_iter().flatten() {
                assert!(content["properties"].is_null(), "{name}: {tag}");
            }
        }
    }
}

/// A request with an unknown field is refused; a response may have fields that a newer server adds.
#[test]
fn requests_refuse_unknown_fields_and_responses_do_not() {
    let description = serde_json::to_value(tread_server::http::openapi()).unwrap();
    let is_closed = |name: &str| {
        let schema = &description["components"]["schemas"][name];
        assert!(schema.is_object(), "{name}");
        schema["additionalProperties"] == false
    };
    for request in ["CreateMission", "ReplaceGeofence", "UpdateRobot"] {
        assert!(is_closed(request), "{request}");
    }
    for other in ["Mission", "Waypoints", "StopRobot", "StopFleet"] {
        assert!(!is_closed(other), "{other}");
    }
}

#[test]
fn every_operation_has_a_name_of_its_own() {
    let description = serde_json::to_value(tread_server::http::openapi()).unwrap();
    let mut names = Vec::new();
    for (path, operations) in description["paths"].as_object().unwrap() {
        for (method, operation) in operations.as_object().unwrap() {
            let name = operation["operationId"].as_str();
            names.push(
                name.unwrap_or_else(|| panic!("{method} {path} has none"))
                    .to_owned(),
            );
        }
    }
    let count = names.len();
    names.sort();
    names.dedup();
    assert_eq!(names.len(), count, "{names:?}");
    assert!(count >= 20, "{names:?}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_page_that_shows_it_needs_nothing_from_elsewhere() {
    let yard = Yard::start().await;
    let (status, page) = yard.get_value("/docs/").await;
    assert_eq!(status, 200);
    let page = page.as_str().unwrap().to_owned();
    assert!(page.contains("swagger"), "{page}");
    assert!(
        !page.contains("https://") && !page.contains("http://"),
        "{page}"
    );
    let (status, script) = yard.get_value("/docs/swagger-ui-bundle.js").await;
    assert_eq!(status, 200);
    assert!(script.as_str().unwrap().len() > 100_000);
    let (status, description) = yard.get_value("/openapi.json").await;
    assert_eq!(status, 200);
    assert_eq!(description["info"]["title"], "Tread");
    yard.server.stop().await.unwrap();
}
