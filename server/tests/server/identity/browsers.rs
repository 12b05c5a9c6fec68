//! Browsers: sessions by cookie, foreign pages, hosts, headers.

use reqwest::{Method, RequestBuilder, StatusCode, header};
use serde_json::{Value, json};
use tread_api::identity::Role;

use crate::harness::{Yard, client, time};

/// Signs in and gives the cookie to send.
pub(crate) async fn sign_in(yard: &Yard, token: &str) -> String {
    let asked = client(None)
        .post(yard.url("/v1/session"))
        .json(&json!({ "token": token }));
    let answer = asked.send().await.unwrap();
    assert_eq!(answer.status(), StatusCode::CREATED);
    let given = answer.headers()[header::SET_COOKIE]
        .to_str()
        .unwrap()
        .to_owned();
    for wanted in ["HttpOnly", "SameSite=Strict", "Path=/", "Max-Age="] {
        assert!(given.contains(wanted), "{given}");
    }
    given.split(';').next().unwrap().to_owned()
}

pub(crate) fn by_cookie(yard: &Yard, method: Method, path: &str, cookie: &str) -> RequestBuilder {
    let asked = client(None).request(method, yard.url(path));
    asked.header(header::COOKIE, cookie)
}

fn site(id: &str) -> Value {
    json!({ "id": id })
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_session_reads_and_changes_only_from_the_servers_own_page() {
    let yard = Yard::start().await;
    let cookie = sign_in(&yard, yard.admin()).await;
    let (status, who) = yard
        .send(by_cookie(&yard, Method::GET, "/v1/session", &cookie))
        .await;
    assert_eq!(status, StatusCode::OK);
    assert!(who["session"].is_string(), "{who}");
    let own = yard.url("").trim_end_matches('/').to_owned();
    let create = |id: &str| by_cookie(&yard, Method::POST, "/v1/sites", &cookie).json(&site(id));
    for (id, origin, fetch_site, wanted) in [
        ("a", None, None, 403),
        ("b", Some("https://evil.test"), None, 403),
        ("c", Some("null"), None, 403),
        ("d", Some("https://dash.test"), Some("cross-site"), 403),
        ("e", Some(own.as_str()), Some("same-site"), 403),
        ("f", None, Some("none"), 403),
        ("g", Some("https://evil.test"), Some("same-origin"), 403),
        ("h", Some(own.as_str()), Some("same-origin"), 201),
        ("i", Some(own.as_str()), None, 201),
        ("j", None, Some("same-origin"), 201),
    ] {
        let mut asked = create(id);
        if let Some(origin) = origin {
            asked = asked.header("origin", origin);
        }
        if let Some(fetch_site) = fetch_site {
            asked = asked.header("sec-fetch-site", fetch_site);
        }
        let (status, said) = yard.send(asked).await;
        assert_eq!(status, wanted, "{origin:?} {fetch_site:?}: {said}");
    }
    let twice = create("k")
        .header("origin", &own)
        .header("origin", "https://evil.test");
    assert_eq!(yard.send(twice).await.0, StatusCode::FORBIDDEN);
    assert_eq!(yard.server.app().counters().values().refused_origin, 8);
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_session_ends_when_it_is_signed_out_or_its_token_revoked() {
    let yard = Yard::start().await;
    let made = yard.token("desk", Role::Operator).await;
    let (first, second) = (
        sign_in(&yard, &made.secret).await,
        sign_in(&yard, &made.secret).await,
    );
    let sees = async |cookie: &str| {
        yard.send(by_cookie(&yard, Method::GET, "/v1/sites", cookie))
            .await
            .0
    };
    let out = by_cookie(&yard, Method::DELETE, "/v1/session", &first)
        .header("sec-fetch-site", "same-origin");
    let answer = out.send().await.unwrap();
    assert_eq!(answer.status(), StatusCode::NO_CONTENT);
    let taken = answer.headers()[header::SET_COOKIE].to_str().unwrap();
    assert!(taken.contains("Max-Age=0"), "{taken}");
    assert_eq!(sees(&first).await, StatusCode::UNAUTHORIZED);
    assert_eq!(sees(&second).await, StatusCode::OK);
    yard.server.app().revoke_token(made.token.id).await.unwrap();
    assert_eq!(sees(&second).await, StatusCode::UNAUTHORIZED);
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_session_lasts_twelve_hours_and_its_secret_is_no_token() {
    let yard = Yard::start_at(time("2026-11-01T00:00:00Z")).await;
    let cookie = sign_in(&yard, yard.admin()).await;
    let sees = async || {
        yard.send(by_cookie(&yard, Method::GET, "/v1/sites", &cookie))
            .await
            .0
    };
    let secret = cookie.split_once('=').unwrap().1;
    let as_token = client(Some(secret)).get(yard.url("/v1/sites"));
    assert_eq!(yard.send(as_token).await.0, StatusCode::UNAUTHORIZED);
    let token_as_cookie = format!("tread_session={}", yard.admin());
    let swapped = by_cookie(&yard, Method::GET, "/v1/sites", &token_as_cookie);
    assert_eq!(yard.send(swapped).await.0, StatusCode::UNAUTHORIZED);
    assert_eq!(sees().await, StatusCode::OK);
    yard.server
        .app()
        .clock()
        .advance(std::time::Duration::from_hours(12));
    assert_eq!(sees().await, StatusCode::UNAUTHORIZED);
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_page_of_a_stranger_cannot_sign_anybody_in() {
    let yard = Yard::start().await;
    let sign_in = |token: &str| {
        client(None)
            .post(yard.url("/v1/session"))
            .json(&json!({ "token": token }))
    };
    let foreign = sign_in(yard.admin()).header("origin", "https://evil.test");
    assert_eq!(yard.send(foreign).await.0, StatusCode::FORBIDDEN);
    let (wrong, said) = yard.send(sign_in("tread_a_no")).await;
    assert_eq!(wrong, StatusCode::UNAUTHORIZED, "{said}");
    let own = sign_in(yard.admin()).header("sec-fetch-site", "same-origin");
    assert_eq!(yard.send(own).await.0, StatusCode::CREATED);
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_socket_of_a_strangers_page_is_refused_whatever_it_shows() {
    let yard = Yard::start().await;
    let cookie = sign_in(&yard, yard.admin()).await;
    let own = yard.url("").trim_end_matches('/').to_owned();
    let upgrade = |asked: RequestBuilder, origin: Option<&str>| {
        let asked = asked
            .header("upgrade", "websocket")
            .header("connection", "upgrade");
        match origin {
            Some(origin) => asked.header("origin", origin),
            None => asked,
        }
    };
    let by_token = |origin| upgrade(yard.client().get(yard.url("/v1/sites")), origin);
    let by_session = |origin| upgrade(by_cookie(&yard, Method::GET, "/v1/sites", &cookie), origin);
    for (origin, with_token, with_session) in [
        (None, 200, 403),
        (Some(own.as_str()), 200, 200),
        (Some("https://dash.test"), 200, 403),
        (Some("https://evil.test"), 403, 403),
        (Some("null"), 403, 403),
    ] {
        assert_eq!(
            yard.send(by_token(origin)).await.0,
            with_token,
            "token, {origin:?}"
        );
        assert_eq!(
            yard.send(by_session(origin)).await.0,
            with_session,
            "session, {origin:?}"
        );
    }
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn foreign_dashboards_are_those_of_the_list() {
    let yard = Yard::start().await;
    let preflight = async |origin: &str| {
        let asked = client(None)
            .request(Method::OPTIONS, yard.url("/v1/missions"))
            .header("origin", origin)
            .header("access-control-request-method", "POST")
            .header("access-control-request-headers", "authorization");
        asked.send().await.unwrap().headers().clone()
    };
    let allowed = preflight("https://dash.test").await;
    assert_eq!(allowed["access-control-allow-origin"], "https://dash.test");
    assert!(!allowed.contains_key("access-control-allow-credentials"));
    let refused = preflight("https://evil.test").await;
    assert!(!refused.contains_key("access-control-allow-origin"));
    let asked = yard
        .client()
        .get(yard.url("/v1/sites"))
        .header("origin", "https://dash.test");
    let answer = asked.send().await.unwrap();
    assert_eq!(
        answer.headers()["access-control-allow-origin"],
        "https://dash.test"
    );
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_name_that_is_not_the_servers_is_refused() {
    let yard = Yard::start().await;
    for (host, wanted) in [
        ("127.0.0.1", 200),
        ("localhost:8420", 200),
        ("tread.test", 200),
        ("rebound.evil.test:8420", 421),
        ("tread.test.evil.test", 421),
        ("", 421),
    ] {
        let asked = yard
            .client()
            .get(yard.url("/v1/sites"))
            .header("host", host);
        assert_eq!(yard.send(asked).await.0, wanted, "{host}");
    }
    let metrics = format!("http://{}/metrics", yard.server.metrics_address().unwrap());
    let asked = client(None).get(metrics).header("host", "evil.test");
    assert_eq!(yard.send(asked).await.0, 421);
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn every_answer_says_what_browsers_may_do_with_it() {
    let yard = Yard::start().await;
    for (path, policy, is_data) in [
        (
            "/v1/sites",
            "default-src 'none'; frame-ancestors 'none'",
            true,
        ),
        (
            "/v1/nothing",
            "default-src 'none'; frame-ancestors 'none'",
            true,
        ),
        ("/healthz", "default-src 'none'", false),
        ("/docs/", "script-src 'self'", false),
        ("/", "default-src 'none'; script-src 'self'", false),
        (
            "/page/app.js",
            "default-src 'none'; script-src 'self'",
            false,
        ),
    ] {
        let answer = yard.client().get(yard.url(path)).send().await.unwrap();
        let headers = answer.headers();
        assert_eq!(headers["x-content-type-options"], "nosniff", "{path}");
        assert_eq!(headers["x-frame-options"], "DENY", "{path}");
        assert_eq!(headers["referrer-policy"], "no-referrer", "{path}");
        let said = headers["content-security-policy"].to_str().unwrap();
        assert!(
            said.contains(policy) && !said.contains("unsafe-eval"),
            "{path}: {said}"
        );
        assert_eq!(
            headers
                .get("cache-control")
                .is_some_and(|kept| kept == "no-store"),
            is_data
        );
        assert!(
            !headers.contains_key("strict-transport-security"),
            "there is no TLS"
        );
    }
    yard.server.stop().await.unwrap();
}
