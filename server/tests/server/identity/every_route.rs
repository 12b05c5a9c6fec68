//! Every route × everybody who may ask, generated from the description of the API. A route that
//! is added later is in here without a word, and one without a right makes this fail.

use std::collections::{BTreeMap, BTreeSet};

use reqwest::{Method, StatusCode};
use serde_json::{Value, json};
use tread_api::identity::Role;
use tread_api::rights::{Right, Rights};
use tread_server::http::{Access, PUBLIC, RouteRequirement};
use tread_server::identity::secret::{Kind, Secret};

use crate::harness::{Yard, client};

/// What anybody may ask for. It stands here a second time, so that a change of the server's list
/// is a change of this test.
const OPEN: [(&str, &str); 14] = [
    ("GET", "/"),
    ("GET", "/page/{file}"),
    ("GET", "/healthz"),
    ("GET", "/readyz"),
    ("POST", "/v1/session"),
    ("GET", "/v1/sign-in"),
    ("GET", "/v1/sign-in/oidc"),
    ("GET", "/v1/sign-in/oidc/callback"),
    ("POST", "/v1/enrolments"),
    ("POST", "/v1/enrolments/renew"),
    ("GET", "/openapi.json"),
    ("GET", "/docs"),
    ("GET", "/docs/"),
    ("GET", "/docs/{*rest}"),
];
/// What an operator may not ask for.
const ADMINS_ONLY: [(&str, &str); 23] = [
    ("GET", "/v1/tokens"),
    ("POST", "/v1/tokens"),
    ("DELETE", "/v1/tokens/{token}"),
    ("GET", "/v1/sessions"),
    ("DELETE", "/v1/sessions/{session}"),
    ("GET", "/v1/join-tokens"),
    ("POST", "/v1/join-tokens"),
    ("DELETE", "/v1/join-tokens/{token}"),
    ("DELETE", "/v1/sites/{site}/enrolments/{robot}"),
    ("POST", "/v1/authority/rotation"),
    ("POST", "/v1/authority/rotation/finish"),
    ("POST", "/v1/authority/replace"),
    ("GET", "/v1/audit"),
    ("GET", "/v1/audit/chain"),
    ("POST", "/v1/sites"),
    ("GET", "/v1/webhooks"),
    ("POST", "/v1/webhooks"),
    ("GET", "/v1/webhooks/{webhook}"),
    ("PUT", "/v1/webhooks/{webhook}"),
    ("DELETE", "/v1/webhooks/{webhook}"),
    ("POST", "/v1/webhooks/{webhook}/secret"),
    ("POST", "/v1/webhooks/{webhook}/test"),
    ("GET", "/v1/webhooks/{webhook}/deliveries"),
];

/// One operation of the description.
pub(super) struct Operation {
    pub(super) method: Method,
    pub(super) path: String,
    security: Value,
    /// The right that it names; `Stop`, which everybody has, where it names none.
    pub(super) right: Right,
    /// The names of its query's parameters.
    pub(super) query: BTreeSet<String>,
}

/// Every operation of the description.
pub(super) fn operations() -> Vec<Operation> {
    let description = serde_json::to_value(tread_server::http::openapi()).unwrap();
    let mut operations = Vec::new();
    for (path, methods) in description["paths"].as_object().unwrap() {
        for (method, operation) in methods.as_object().unwrap() {
            let security = operation["security"].clone();
            let right = security[0]["token"][0].as_str().and_then(Right::from_name);
            let parameters = operation["parameters"].as_array().into_iter().flatten();
            let of_query = parameters.filter(|parameter| parameter["in"] == "query");
            let name = |parameter: &Value| parameter["name"].as_str().unwrap().to_owned();
            operations.push(Operation {
                method: method.to_uppercase().parse().unwrap(),
                path: path.clone(),
                security,
                right: right.unwrap_or(Right::Stop),
                query: of_query.map(name).collect(),
            });
        }
    }
    operations
}

pub(super) fn is_open(method: &Method, path: &str) -> bool {
    OPEN.contains(&(method.as_str(), path))
}

/// A path with something in the place of each parameter.
fn filled(path: &str) -> String {
    let mut filled = String::new();
    for part in path.split('/').skip(1) {
        filled.push('/');
        filled.push_str(match part {
            "{site}" => "yard",
            "{mission}" | "{alert}" | "{token}" | "{session}" | "{webhook}" => {
                "0192f0c1-2b3c-7d4e-8f50-617283940a1b"
            }
            "{*rest}" => "index.html",
            other if other.starts_with('{') => "nothing-of-that-name",
            other => other,
        });
    }
    filled
}

#[test]
fn every_operation_names_one_right_or_is_on_the_named_list() {
    let public = PUBLIC
        .each_ref()
        .map(|(method, path)| (method.as_str(), *path));
    assert_eq!(public, OPEN);
    let access = tread_server::http::access();
    for operation in operations() {
        let Operation {
            method,
            path,
            security,
            ..
        } = operation;
        if is_open(&method, &path) {
            assert!(
                security.is_null(),
                "{method} {path} is public and names a right"
            );
            continue;
        }
        let right = security[0]["token"][0].as_str().and_then(Right::from_name);
        let right = right.unwrap_or_else(|| panic!("{method} {path} names no right: {security}"));
        assert_eq!(
            security,
            json!([{"token": [right]}, {"session": [right]}]),
            "{method} {path}"
        );
        let is_admins = ADMINS_ONLY.contains(&(method.as_str(), path.as_str()));
        assert_eq!(
            right == Right::Administer,
            is_admins,
            "{method} {path} takes {right}"
        );
        let needed = access.needed(&method, &path);
        assert_eq!(
            needed,
            Some(RouteRequirement::Right(right)),
            "{method} {path}"
        );
        let reads = method == Method::GET || path.ends_with("/friction/path");
        let is_anybodys = path == "/v1/session" || path.ends_with("/stop");
        if reads {
            let viewer = Rights::from(Role::Viewer);
            assert!(
                viewer.includes(right) || is_admins,
                "{method} {path} is a read"
            );
        } else if is_anybodys {
            assert_eq!(right, Right::Stop, "{method} {path}");
        } else {
            let only_watches = Rights::from_iter([right]).only_watches();
            assert!(!only_watches, "{method} {path} changes something");
        }
    }
    assert_eq!(Access::default().needed(&Method::GET, "/healthz"), None);
}

/// Asks every route as somebody and says how it was answered.
async fn answers(yard: &Yard, token: Option<&str>) -> BTreeMap<(String, String), StatusCode> {
    let client = client(token);
    let mut answers = BTreeMap::new();
    for Operation { method, path, .. } in operations() {
        // Who signs out signs out; it is the last thing to be asked.
        if (&method, path.as_str()) == (&Method::DELETE, "/v1/session") {
            continue;
        }
        let asked = client.request(method.clone(), yard.url(&filled(&path)));
        let asked = match method {
            Method::GET | Method::DELETE => asked,
            _ => asked.json(&json!({})),
        };
        let answer = asked.send().await.unwrap();
        answers.insert((method.to_string(), path), answer.status());
    }
    answers
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn every_route_answers_every_role_and_right_as_its_description_says() {
    let yard = Yard::start().await;
    let needed_by = tread_server::http::access();
    let mut tokens = Vec::new();
    for role in Role::ALL {
        let token = yard.token(role.as_str(), role).await.secret;
        tokens.push((role.to_string(), Rights::from(role), token));
    }
    for right in Right::ALL {
        // Whoever may hold alone holds by the name of the token.
        let name = if right == Right::Hold {
            "nothing-of-that-name"
        } else {
            right.as_str()
        };
        let token = yard.limited(name, &[right], &[]).await;
        tokens.push((right.to_string(), Rights::from_iter([right]), token));
    }
    for (role, rights, token) in tokens {
        for ((method, path), status) in answers(&yard, Some(&token)).await {
            let method: Method = method.parse().unwrap();
            let needed = needed_by.needed(&method, &path).unwrap();
            let may = match needed {
                RouteRequirement::Nothing => true,
                RouteRequirement::Right(needed) => rights.includes(needed),
            };
            let refused = status == StatusCode::FORBIDDEN || status == StatusCode::UNAUTHORIZED;
            if is_open(&method, &path) {
                assert!(
                    !refused || path == "/v1/session",
                    "{role}: {method} {path}: {status}"
                );
            } else if may {
                assert!(!refused, "{role}: {method} {path}: {status}");
            } else {
                assert_eq!(status, StatusCode::FORBIDDEN, "{role}: {method} {path}");
            }
        }
    }
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn no_route_is_open_to_a_token_that_is_missing_wrong_expired_or_revoked() {
    let yard = Yard::start_at(crate::harness::time("2026-11-01T00:00:00Z")).await;
    let expired = yard.token("expired", Role::Admin).await.secret;
    let revoked = yard.token("revoked", Role::Admin).await;
    yard.server
        .app()
        .revoke_token(revoked.token.id)
        .await
        .unwrap();
    let days = std::time::Duration::from_hours(24 * 91);
    yard.server.app().clock().advance(days);
    let wrong = Secret::from_random(Kind::Token(Some(Role::Admin)), &[7; 32]);
    let strangers = [
        ("nothing", None),
        ("garbage", Some("garbage")),
        ("wrong", Some(wrong.reveal())),
        ("expired", Some(expired.as_str())),
        ("revoked", Some(revoked.secret.as_str())),
    ];
    let mut said = BTreeMap::new();
    for (who, token) in strangers {
        for Operation { method, path, .. } in operations() {
            // Before the lock comes: that answer would hide the one that is looked for.
            yard.server
                .app()
                .clock()
                .advance(std::time::Duration::from_hours(2));
            let asked = client(token).request(method.clone(), yard.url(&filled(&path)));
            let asked = match method {
                Method::POST | Method::PUT | Method::PATCH => asked.json(&json!({})),
                _ => asked,
            };
            let answer = asked.send().await.unwrap();
            let status = answer.status();
            if is_open(&method, &path) {
                assert_ne!(status, StatusCode::UNAUTHORIZED, "{who}: {method} {path}");
                continue;
            }
            assert_eq!(status, StatusCode::UNAUTHORIZED, "{who}: {method} {path}");
            assert_eq!(
                answer.headers()["www-authenticate"],
                "Bearer realm=\"tread\""
            );
            let text = answer.text().await.unwrap();
            said.entry(text).or_insert_with(Vec::new).push(who);
        }
    }
    assert_eq!(said.len(), 1, "the cause shows: {said:?}");
    let counters = yard.server.app().counters().values();
    for counted in [
        counters.refused_no_token,
        counters.refused_token_malformed,
        counters.refused_token_unknown,
        counters.refused_token_expired,
        counters.refused_token_revoked,
    ] {
        assert!(counted > 20, "{counters:?}");
    }
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_the_description_does_not_know_is_not_there() {
    let yard = Yard::start().await;
    for (method, path, status) in [
        (Method::PUT, "/v1/missions", 405),
        (Method::TRACE, "/v1/missions", 405),
        (Method::HEAD, "/v1/missions", 200),
        (Method::GET, "/v1/nothing", 404),
        (Method::GET, "/metrics", 404),
        (Method::GET, "//v1/missions", 404),
        (Method::GET, "/v1/missions/", 404),
    ] {
        let asked = yard.client().request(method.clone(), yard.url(path));
        assert_eq!(
            asked.send().await.unwrap().status(),
            status,
            "{method} {path}"
        );
    }
    yard.server.stop().await.unwrap();
}
