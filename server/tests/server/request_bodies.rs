//! The bodies of all requests: what the description requires the server requires, and nothing else;
//! a list is no object; and with a database that somebody else has locked each is refused as busy.

use futures_util::future::join_all;
use reqwest::{Method, StatusCode, header};
use serde_json::{Map, Value, json};
use sqlx::{Connection as _, SqliteConnection};

use crate::harness::{Yard, client, database};

const ID: &str = "0192f0c1-2b3c-7d4e-8f50-617283940a1b";

/// Operations that take whatever body there is: a stop is not refused for its words.
const TAKE_ANY_BODY: [&str; 2] = ["stop_robot", "stop_fleet"];
/// Fields that may be absent, though not with what the examples say beside them.
const ONE_OF_SEVERAL: [(&str, &str, &str); 5] = [
    ("circle", "speed_m_s", "a speed or a period"),
    ("set_limit", "hold", "a hold or a speed"),
    ("set_limit", "linear_max_m_s", "a hold or a speed"),
    ("create_token", "role", "a role or rights"),
    ("create_token", "rights", "a role or rights"),
];

/// Bodies of every operation that takes one, with all fields that there are.
fn examples() -> Vec<(&'static str, Value)> {
    let point = json!({"x_m": 1.0, "y_m": 2.0});
    let polygon =
        json!([{"x_m": 0.0, "y_m": 0.0}, {"x_m": 9.0, "y_m": 0.0}, {"x_m": 9.0, "y_m": 9.0}]);
    let options = json!({"approach_speed_m_s": 0.5,
        "excitation": {"depth_ratio": 0.4, "period_s": 4.0}});
    let circle = json!({"circle": {"center": point, "radius_m": 3.0, "speed_m_s": 0.5,
        "direction": "clockwise", "turns": 2.0, "options": options}});
    let waypoint = json!({"x_m": 1.0, "y_m": 2.0, "heading_rad": 0.5, "speed_m_s": 0.4});
    let waypoints = json!({"waypoints": {"points": [waypoint, {"x_m": 5.0, "y_m": 2.0}],
        "speed_m_s": 0.5, "options": options}});
    let mission = |trajectory: &Value| {
        json!({"site": "yard", "robot": "rover-1", "trajectory": trajectory, "priority": 3,
            "start_policy": "append", "latest_start": "2036-01-01T00:00:00Z", "lost_after_s": 60.0,
            "link_policy": {"stop_after": {"silence_s": 5.0}}})
    };
    let check = |trajectory: &Value| {
        json!({"site": "yard", "robot": "rover-1", "trajectory": trajectory, "priority": 3,
            "start_policy": "append", "replaces": ID, "theta": 0.2,
            "start": {"x_m": 0.0, "y_m": 0.0, "heading_rad": 0.0}})
    };
    let origin = json!({"latitude_deg": 48.0, "longitude_deg": 11.0, "x_axis_deg": 30.0});
    let terrain = json!({"name": "Lawn", "class": "grass", "polygon": polygon, "layer": 1});
    let mut new_terrain = terrain.clone();
    new_terrain["id"] = json!("lawn");
    let webhook = json!({"name": "on call", "url": "https://alerts.example.org/tread",
        "kinds": ["robot-lost"], "sites": ["yard"], "enabled": true});
    vec![
        (
            "enrol_robot",
            json!({"token": "x", "certificate_request": "x", "robot": "rover-1"}),
        ),
        (
            "renew_certificate",
            json!({"certificate": "x", "certificate_request": "x", "proof": "x"}),
        ),
        (
            "create_join_token",
            json!({"site": "yard", "robot": "rover-1", "valid_minutes": 5}),
        ),
        ("create_mission", mission(&circle)),
        ("create_mission", mission(&waypoints)),
        ("replace_mission", json!({"trajectory": circle})),
        ("replace_mission", json!({"trajectory": waypoints})),
        ("check_trajectory", check(&circle)),
        ("check_trajectory", check(&waypoints)),
        ("create_session", json!({"token": "x"})),
        (
            "create_site",
            json!({"id": "field", "name": "Field", "cell_m": 2.0, "origin": origin}),
        ),
        (
            "get_path_friction",
            json!({"robot": "rover-1", "points": [point, {"x_m": 4.0, "y_m": 2.0}],
                "normalisation": "all", "as_of": "2026-01-01T00:00:00Z"}),
        ),
        (
            "replace_geofence",
            json!({"keep_in": [polygon], "keep_out": [polygon]}),
        ),
        ("set_site_origin", origin),
        ("update_robot", json!({"name": "Rover", "retired": false})),
        (
            "set_limit",
            json!({"for_ms": 500, "hold": false, "linear_max_m_s": 0.5}),
        ),
        ("stop_robot", json!({"by": "Ann", "reason": "a test"})),
        (
            "stop_fleet",
            json!({"site": "yard", "by": "Ann", "reason": "a test"}),
        ),
        ("clear_stop", json!({"stop": ID, "by": "Ann"})),
        (
            "withdraw_measurements",
            json!({"from": "2026-01-01T00:00:00Z", "to": "2026-01-01T01:00:00Z", "reason": "a test"}),
        ),
        (
            "finish_authority_rotation",
            json!({"rotation": "0011223344556677", "force": false}),
        ),
        ("replace_authority", json!({"signing": "00"})),
        ("create_webhook", webhook.clone()),
        ("replace_webhook", webhook),
        ("create_terrain", new_terrain),
        ("replace_terrain", terrain),
        (
            "create_token",
            json!({"name": "tests", "role": "viewer", "valid_days": 3}),
        ),
        (
            "create_token",
            json!({"name": "more tests", "rights": ["drive"],
                "sites": [{"site": "yard", "robots": ["rover-1"]}]}),
        ),
    ]
}

/// One operation of the description.
struct Operation {
    id: String,
    method: Method,
    path: String,
    body: Option<Value>,
}

fn operations(description: &Value) -> Vec<Operation> {
    let mut operations = Vec::new();
    for (path, methods) in description["paths"].as_object().unwrap() {
        for (method, operation) in methods.as_object().unwrap() {
            let body = &operation["requestBody"]["content"]["application/json"]["schema"];
            operations.push(Operation {
                id: operation["operationId"].as_str().unwrap().to_owned(),
                method: method.to_uppercase().parse().unwrap(),
                path: filled(path),
                body: Some(body.clone()).filter(|body| !body.is_null()),
            });
        }
    }
    operations
}

fn filled(path: &str) -> String {
    let part = |part: &str| match part {
        "{site}" => "yard".to_owned(),
        "{mission}" | "{alert}" | "{token}" | "{webhook}" => ID.to_owned(),
        other if other.starts_with('{') => "rover-1".to_owned(),
        other => other.to_owned(),
    };
    path.split('/').map(part).collect::<Vec<_>>().join("/")
}

/// A schema without references and without `null`, of several the one that fits an example.
fn resolved(schema: &Value, example: &Value, description: &Value) -> Value {
    if let Some(reference) = schema["$ref"].as_str() {
        let name = reference.rsplit('/').next().unwrap();
        let found = &description["components"]["schemas"][name];
        return resolved(found, example, description);
    }
    let Some(choices) = schema["oneOf"].as_array() else {
        return schema.clone();
    };
    let choices = choices.iter().filter(|choice| choice["type"] != "null");
    let choices: Vec<Value> = choices
        .map(|choice| resolved(choice, example, description))
        .collect();
    let fits = |choice: &&Value| {
        let fields = choice["required"].as_array();
        let names = fields.into_iter().flatten().filter_map(Value::as_str);
        let has_all = names.into_iter().all(|name| example.get(name).is_some());
        has_all && (choice["type"] == "object") == example.is_object()
    };
    let first = choices.iter().find(fits).or(choices.first());
    first.cloned().unwrap_or_default()
}

/// What is done to one place of a body.
#[derive(Debug, Clone, PartialEq)]
enum Change {
    /// A field is left out.
    Without { field: String, is_required: bool },
    /// A list stands for an object.
    List,
    /// A field that nobody knows is there.
    Unknown,
}

/// Every change of an example, with the place where it is made.
fn changes(
    schema: &Value,
    example: &Value,
    description: &Value,
    place: &str,
    found: &mut Vec<(String, Change)>,
) {
    let schema = resolved(schema, example, description);
    if let Some(fields) = example.as_object() {
        let required = schema["required"].as_array().cloned().unwrap_or_default();
        for (name, field) in fields {
            let of_field = &schema["properties"][name];
            assert!(!of_field.is_null(), "{place}/{name} is not described");
            let without = Change::Without {
                field: name.clone(),
                is_required: required.contains(&json!(name)),
            };
            found.push((place.to_owned(), without));
            changes(
                of_field,
                field,
                description,
                &format!("{place}/{name}"),
                found,
            );
        }
        found.push((place.to_owned(), Change::List));
        found.push((place.to_owned(), Change::Unknown));
    } else if let Some(items) = example.as_array() {
        for (index, item) in items.iter().enumerate() {
            let of_item = &schema["items"];
            changes(
                of_item,
                item,
                description,
                &format!("{place}/{index}"),
                found,
            );
        }
    }
}

fn changed(example: &Value, place: &str, change: &Change) -> Value {
    let mut body = example.clone();
    let spot = body.pointer_mut(place).unwrap();
    let fields = spot.as_object_mut().unwrap();
    match change {
        Change::Without { field, .. } => {
            fields.remove(field);
        }
        Change::List => {
            *spot = std::mem::take(fields)
                .into_iter()
                .map(|(_, field)| field)
                .collect();
        }
        Change::Unknown => {
            fields.insert("nobody_knows".to_owned(), json!(1));
        }
    }
    body
}

/// What the server says against a body, if it does.
async fn refusal(yard: &Yard, operation: &Operation, body: &Value) -> Option<String> {
    let url = yard.url(&operation.path);
    let asked = yard
        .client()
        .request(operation.method.clone(), url)
        .json(body);
    let (status, said) = yard.send(asked).await;
    assert!(
        !status.is_server_error() || status == 503,
        "{status} {said}"
    );
    let of_body = ["malformed-body", "invalid-body", "unknown-field"];
    let kind = said["type"].as_str().unwrap_or_default();
    let is_of_body = of_body.iter().any(|name| kind.ends_with(name));
    is_of_body.then(|| said.to_string())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_server_requires_what_the_description_requires_and_takes_no_list_for_an_object() {
    let yard = Yard::start().await;
    let description = serde_json::to_value(tread_server::http::openapi()).unwrap();
    let mut wrong = Vec::new();
    let mut count = 0;
    for operation in operations(&description) {
        let Some(schema) = &operation.body else {
            continue;
        };
        let id = operation.id.as_str();
        let examples: Vec<Value> = examples()
            .into_iter()
            .filter_map(|(of, example)| (of == id).then_some(example))
            .collect();
        assert!(!examples.is_empty(), "there is no example for {id}");
        for example in examples {
            let refused = refusal(&yard, &operation, &example).await;
            assert_eq!(refused, None, "{id}: the example is refused: {example}");
            let mut found = Vec::new();
            changes(schema, &example, &description, "", &mut found);
            for (place, change) in found {
                let body = changed(&example, &place, &change);
                let said = refusal(&yard, &operation, &body).await;
                let is_excused = |(of, name, _why): &(&str, &str, &str)| {
                    let is_here = *of == id || place.ends_with(&format!("/{of}"));
                    matches!(&change, Change::Without { field, .. } if is_here && field == name)
                };
                if ONE_OF_SEVERAL.iter().any(is_excused) {
                    continue;
                }
                let expected = match change {
                    _ if TAKE_ANY_BODY.contains(&id) => false,
                    Change::Without { is_required, .. } => is_required,
                    Change::List | Change::Unknown => true,
                };
                count += 1;
                if said.is_some() != expected {
                    wrong.push(format!("{id} {place} {change:?}: {said:?}"));
                }
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
    assert!(count > 200, "{count} bodies");
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn while_somebody_locks_the_database_each_route_says_when_to_ask_again() {
    let yard = Yard::start().await;
    let path = database(yard.folder.path());
    let address = format!("sqlite:{}", path.display());
    let mut other = SqliteConnection::connect(&address).await.unwrap();
    sqlx::query("BEGIN IMMEDIATE")
        .execute(&mut other)
        .await
        .unwrap();
    let description = serde_json::to_value(tread_server::http::openapi()).unwrap();
    let examples = examples();
    let yard = &yard;
    let asking = operations(&description).into_iter().map(|operation| {
        let example = examples.iter().find(|(of, _)| *of == operation.id);
        let mut body = example.map(|(_, body)| body.clone());
        let mut is_sign_in = false;
        if operation.id == "create_session" {
            is_sign_in = true;
            body = Some(json!({"token": yard.admin()}));
        }
        if let Some(fields) = body.as_mut().and_then(Value::as_object_mut)
            && operation.id == "create_token"
        {
            rename(fields);
        }
        async move {
            let token = (!is_sign_in).then(|| yard.admin());
            let asked = client(token).request(operation.method.clone(), yard.url(&operation.path));
            let asked = match body {
                Some(body) => asked.json(&body),
                None => asked,
            };
            let answer = asked.send().await.unwrap();
            let retry = answer.headers().get(header::RETRY_AFTER).is_some();
            (operation.id, answer.status(), retry)
        }
    });
    let answers = join_all(asking).await;
    sqlx::query("ROLLBACK").execute(&mut other).await.unwrap();
    other.close().await.unwrap();
    let failed = answers
        .iter()
        .filter(|(_, status, _)| status.is_server_error());
    let failed: Vec<_> = failed.collect();
    let right = |(_, status, retry): &(String, StatusCode, bool)| {
        *status == StatusCode::SERVICE_UNAVAILABLE && *retry
    };
    assert!(failed.iter().all(|answer| right(answer)), "{failed:?}");
    for id in ["create_session", "create_site", "create_token"] {
        assert!(
            failed.iter().any(|(of, ..)| of == id),
            "{id} did not wait: {answers:?}"
        );
    }
}

/// A name that no other token has.
fn rename(fields: &mut Map<String, Value>) {
    fields.insert("name".to_owned(), json!("another"));
}
