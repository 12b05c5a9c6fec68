//! Sessions of people: rights of several groups, who lists and ends them, and how long they last.

use std::time::Duration;

use reqwest::StatusCode;
use serde_json::{Value, json};
use tread_api::identity::Role;

use super::provider::{Browser, Kind, Provider};
use super::{body, config, is_signed_in, start};
use crate::events::read_until;
use crate::harness::{Yard, client, eventually};
use crate::ports::free_address;
use crate::robot::Robot;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn somebody_in_several_groups_has_at_each_site_what_one_of_them_gives_there() {
    let port = free_address().port();
    let _provider = Provider::start(port, &Kind::default()).await;
    let yard = start(port).await;
    yard.post("/v1/sites", &json!({"id": "field"})).await;
    let rover = Robot::join(&yard, "rover-1").await;
    let mut browser = Browser::new(&yard);
    let answer = browser.sign_in("bert").await;
    // Operator at the yard, viewer everywhere.
    let session = is_signed_in(&mut browser, answer).await;
    assert_eq!(session["role"], Value::Null);
    assert_eq!(session["rights"], json!(["stop", "read"]));
    assert_eq!(session["grants"].as_array().unwrap().len(), 2);
    for path in [
        "/v1/sites/yard/robots",
        "/v1/sites/field/robots",
        "/v1/server",
    ] {
        assert_eq!(browser.get(path).await.status(), 200, "{path}");
    }
    let limit = |site: &str| format!("/v1/sites/{site}/robots/{}/limits/gate", rover.id);
    assert_eq!(browser.delete(&limit("yard")).await.status(), 204);
    let refused = browser.delete(&limit("field")).await;
    assert_eq!(refused.status(), StatusCode::FORBIDDEN);
    let detail = body(refused).await["detail"].as_str().unwrap().to_owned();
    assert!(detail.contains("`oidc:bert` is for yard alone"), "{detail}");
    let origin = browser.delete("/v1/sites/field/origin").await;
    assert_eq!(origin.status(), StatusCode::FORBIDDEN);
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_admin_lists_and_ends_sessions_within_his_scope_and_streams_close_at_once() {
    let port = free_address().port();
    let _provider = Provider::start(port, &Kind::default()).await;
    let yard = start(port).await;
    let (mut anna, mut bert) = (Browser::new(&yard), Browser::new(&yard));
    let answer = anna.sign_in("anna").await;
    is_signed_in(&mut anna, answer).await;
    let answer = bert.sign_in("bert").await;
    is_signed_in(&mut bert, answer).await;
    let (_, listed) = yard.get_value("/v1/sessions").await;
    let listed = listed["items"].as_array().unwrap().clone();
    assert_eq!(listed.len(), 2);
    assert_eq!(
        (&listed[0]["name"], &listed[1]["name"]),
        (&json!("bert"), &json!("anna"))
    );
    assert_eq!(listed[1]["groups"], json!(["operators"]));
    assert_eq!(listed[0]["groups"], json!(["operators", "viewers"]));

    // An admin of the yard sees and ends who is for the yard alone, be it a person or a token.
    let mut carl = Browser::new(&yard);
    let answer = carl.sign_in("carl").await;
    is_signed_in(&mut carl, answer).await;
    let own = body(carl.get("/v1/sessions").await).await;
    let names: Vec<&Value> = own["items"]
        .as_array()
        .unwrap()
        .iter()
        .map(|session| &session["name"])
        .collect();
    assert_eq!(
        names,
        [&json!("anna")],
        "carl is a viewer everywhere himself"
    );
    let session = |of: &Value| format!("/v1/sessions/{}", of["id"].as_str().unwrap());
    let (of_anna, of_bert) = (session(&listed[1]), session(&listed[0]));
    assert_eq!(carl.delete(&of_bert).await.status(), StatusCode::FORBIDDEN);

    let mut stream = anna.get("/v1/events").await;
    assert_eq!(stream.status(), 200);
    let mut text = String::new();
    read_until(&mut stream, &mut text, |text| text.contains("snapshot_end")).await;
    assert_eq!(carl.delete(&of_anna).await.status(), StatusCode::NO_CONTENT);
    let closed = async { while let Ok(Some(_)) = stream.chunk().await {} };
    tokio::time::timeout(crate::harness::PATIENCE, closed)
        .await
        .unwrap();
    assert_eq!(anna.get("/v1/session").await.status(), 401);
    assert_eq!(bert.get("/v1/session").await.status(), 200);
    assert_eq!(carl.delete(&of_anna).await.status(), StatusCode::NOT_FOUND);
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_session_outlives_a_restart_with_the_rights_that_the_configuration_gives_then() {
    let port = free_address().port();
    let _provider = Provider::start(port, &Kind::default()).await;
    let yard = start(port).await;
    let mut browser = Browser::new(&yard);
    let answer = browser.sign_in("anna").await;
    is_signed_in(&mut browser, answer).await;
    let cookie = browser.cookie("tread_session").unwrap().clone();
    let folder = yard.folder;
    yard.server.stop().await.unwrap();
    for (role, seen) in [
        (Some(Role::Operator), Some("operator")),
        (Some(Role::Viewer), Some("viewer")),
        (None, None),
    ] {
        let mut config = crate::harness::config(folder.path(), "127.0.0.1:0");
        let mut oidc = self::config(port, folder.path());
        match role {
            Some(role) => oidc.groups.get_mut("operators").unwrap().role = Some(role),
            None => drop(oidc.groups.remove("operators")),
        }
        config.oidc = Some(oidc);
        let server = tread_server::Server::start(config).await.unwrap();
        let asked = client(None).get(format!("http://{}/v1/session", server.http_address()));
        let asked = asked.header("cookie", format!("tread_session={cookie}"));
        let answer = asked.send().await.unwrap();
        let status = answer.status();
        let said = body(answer).await;
        match seen {
            Some(role) => assert_eq!(said["role"], role, "{said}"),
            None => assert_eq!(status, StatusCode::UNAUTHORIZED),
        }
        server.stop().await.unwrap();
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_person_has_one_share_of_sessions_and_is_never_called_like_a_token() {
    let port = free_address().port();
    let _provider = Provider::start(port, &Kind::default()).await;
    let yard = start(port).await;
    // There is a token `tests`.
    let mut first = Browser::new(&yard);
    let answer = first.sign_in("tests").await;
    let session = is_signed_in(&mut first, answer).await;
    assert_eq!(session["name"], "oidc:tests");
    let mut last = Browser::new(&yard);
    for _ in 0..tread_server::app::identity::SESSIONS_EACH_MAX {
        let answer = last.sign_in("tests").await;
        assert_eq!(answer.status(), StatusCode::SEE_OTHER);
    }
    assert_eq!(
        first.get("/v1/session").await.status(),
        401,
        "the oldest has ended"
    );
    assert_eq!(last.get("/v1/session").await.status(), 200);
    let token = client(Some(yard.admin())).get(yard.url("/v1/session"));
    assert_eq!(yard.send(token).await.1["name"], "tests");
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_token_that_is_made_with_the_name_of_a_person_is_distinguished_from_them_everywhere() {
    let port = free_address().port();
    let _provider = Provider::start(port, &Kind::default()).await;
    let yard = start(port).await;
    let mut anna = Browser::new(&yard);
    let answer = anna.sign_in("anna").await;
    let session = is_signed_in(&mut anna, answer).await;
    let token = yard.token("anna", Role::Operator).await;
    // Both are refused the same thing.
    let path = format!("/v1/tokens/{}", token.token.id);
    assert_eq!(anna.delete(&path).await.status(), StatusCode::FORBIDDEN);
    let asked = client(Some(&token.secret)).delete(yard.url(&path));
    assert_eq!(yard.send(asked).await.0, StatusCode::FORBIDDEN);
    let asked = client(Some(&token.secret)).get(yard.url("/v1/session"));
    let of_token = yard.send(asked).await.1;
    let names = [&session["name"], &of_token["name"]];
    assert_eq!(names, [&json!("oidc:anna"), &json!("anna")]);
    for (name, token, person) in [
        ("oidc:anna", &Value::Null, &session["person"]),
        ("anna", &of_token["token"], &Value::Null),
    ] {
        let entries = eventually("the refusal is in the audit log", async || {
            let (_, entries) = yard.get_value(&format!("/v1/audit?who={name}")).await;
            let entries = entries["items"].as_array().unwrap().clone();
            let is_there = entries.iter().any(|entry| entry["status"] == 403);
            if is_there { Ok(entries) } else { Err(entries) }
        })
        .await;
        for entry in entries {
            let who = [&entry["token"], &entry["person"]];
            assert_eq!(who, [token, person], "{entry}");
        }
    }
    // And no token takes a name that people have.
    let id = session["person"]["id"].as_str().unwrap();
    for name in ["oidc:anna", "OIDC : anna", "oidc", id] {
        let body = json!({"name": name, "role": "viewer"});
        let (status, said) = yard.post("/v1/tokens", &body).await;
        assert_eq!(status, StatusCode::UNPROCESSABLE_ENTITY, "{said}");
        assert!(
            said["detail"].as_str().unwrap().contains("`oidc:NAME`"),
            "{said}"
        );
    }
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_session_lasts_as_long_as_is_configured() {
    let port = free_address().port();
    let _provider = Provider::start(port, &Kind::default()).await;
    let folder = tempfile::tempdir().unwrap();
    let now = tread_server::clock::Clock::system().now();
    let yard = Yard::start_with(now, |config| {
        let mut oidc = self::config(port, folder.path());
        oidc.session_hours = 2;
        config.oidc = Some(oidc);
    })
    .await;
    super::is_found(&yard).await;
    let mut browser = Browser::new(&yard);
    let answer = browser.sign_in("anna").await;
    is_signed_in(&mut browser, answer).await;
    yard.server.app().clock().advance(Duration::from_mins(119));
    assert_eq!(browser.get("/v1/session").await.status(), 200);
    yard.server.app().clock().advance(Duration::from_mins(1));
    assert_eq!(browser.get("/v1/session").await.status(), 401);
    yard.server.stop().await.unwrap();
}
