//! The sign-in at an OpenID provider, with one that is not ours.

mod provider;
mod refused;
mod sessions;

use std::collections::BTreeMap;
use std::os::unix::fs::PermissionsExt as _;
use std::path::Path;

use reqwest::{Response, StatusCode, header};
use serde_json::{Value, json};
use tread_api::identity::Role;
use tread_api::rights::Right;
use tread_server::config::oidc::{GroupConfig, OidcConfig};

use self::provider::{Browser, Kind, PUBLIC, Provider, location};
use crate::harness::{Yard, client, eventually};
use crate::ports::free_address;

/// A configuration for the provider at a port.
fn config(port: u16, folder: &Path) -> OidcConfig {
    let secret = folder.join("client-secret");
    std::fs::write(&secret, "s3cret\n").unwrap();
    std::fs::set_permissions(&secret, std::fs::Permissions::from_mode(0o600)).unwrap();
    let role = |role, sites: Option<&[&str]>| GroupConfig {
        role: Some(role),
        rights: None,
        sites: sites.map(|sites| sites.iter().map(|&site| site.to_owned()).collect()),
    };
    let groups = [
        ("admins", role(Role::Admin, None)),
        ("yard admins", role(Role::Admin, Some(&["yard"]))),
        ("operators", role(Role::Operator, Some(&["yard"]))),
        ("viewers", role(Role::Viewer, None)),
        (
            "night shift",
            GroupConfig {
                rights: Some(vec![Right::Drive]),
                ..GroupConfig::default()
            },
        ),
    ];
    OidcConfig {
        issuer: format!("http://127.0.0.1:{port}"),
        client_id: "tread".to_owned(),
        client_secret_file: Some(secret),
        public_url: PUBLIC.parse().unwrap(),
        scopes: ["openid", "profile", "email", "groups"]
            .map(str::to_owned)
            .into(),
        groups_claim: "groups".to_owned(),
        name_claim: None,
        label: "the company".to_owned(),
        ca: None,
        session_hours: 12,
        groups: BTreeMap::from(groups.map(|(name, group)| (name.to_owned(), group))),
    }
}

/// A server that people may sign in to, and that has found the provider.
async fn start(port: u16) -> Yard {
    let yard = Yard::start_configured(|config, folder| {
        config.oidc = Some(self::config(port, folder));
    });
    let yard = yard.await;
    is_found(&yard).await;
    yard
}

async fn is_found(yard: &Yard) {
    eventually("the provider is found", async || {
        let paths = client(None).get(yard.url("/v1/sign-in"));
        let (status, paths) = yard.send(paths).await;
        assert_eq!(status, StatusCode::OK);
        if paths["oidc"]["available"] == true {
            Ok(())
        } else {
            Err(paths)
        }
    })
    .await;
}

async fn body(answer: Response) -> Value {
    let text = answer.text().await.unwrap();
    serde_json::from_str(&text).unwrap_or(Value::String(text))
}

async fn is_signed_in(browser: &mut Browser, answer: Response) -> Value {
    let status = answer.status();
    let to = (status == StatusCode::SEE_OTHER).then(|| location(&answer));
    let said = body(answer).await;
    assert_eq!(to.as_deref(), Some("/#signed-in"), "{status}: {said}");
    let session = browser.get("/v1/session").await;
    assert_eq!(session.status(), StatusCode::OK);
    body(session).await
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn somebody_signs_in_does_what_the_groups_give_and_signs_out() {
    let port = free_address().port();
    let _provider = Provider::start(port, &Kind::default()).await;
    let yard = start(port).await;
    let paths = body(
        client(None)
            .get(yard.url("/v1/sign-in"))
            .send()
            .await
            .unwrap(),
    )
    .await;
    let wanted = json!({"token": true,
        "oidc": {"label": "the company", "path": "/v1/sign-in/oidc", "available": true}});
    assert_eq!(paths, wanted);

    let mut browser = Browser::new(&yard);
    let begun = browser.get("/v1/sign-in/oidc").await;
    let cookie = begun.headers()[header::SET_COOKIE].to_str().unwrap();
    for wanted in ["tread_sign_in=", "HttpOnly", "SameSite=Lax", "Max-Age=600"] {
        assert!(cookie.contains(wanted), "{cookie}");
    }
    let asked = location(&begun);
    for wanted in [
        "response_type=code",
        "code_challenge_method=S256",
        "code_challenge=",
        "nonce=",
        "scope=openid+profile+email+groups",
        "redirect_uri=http%3A%2F%2F127.0.0.1%3A8420%2Fv1%2Fsign-in%2Foidc%2Fcallback",
    ] {
        assert!(asked.contains(wanted), "{asked}");
    }
    let back = browser.at_provider(asked.parse().unwrap(), "anna").await;
    let answer = browser.get(&back).await;
    let given: Vec<&str> = answer
        .headers()
        .get_all(header::SET_COOKIE)
        .iter()
        .map(|given| given.to_str().unwrap())
        .collect();
    let is_session =
        |given: &&str| given.starts_with("tread_session=") && given.contains("SameSite=Strict");
    assert!(given.iter().any(is_session), "{given:?}");
    let session = is_signed_in(&mut browser, answer).await;
    assert_eq!(session["name"], "oidc:anna");
    assert_eq!(session["role"], "operator");
    assert_eq!(session["sites"], json!([{"site": "yard"}]));
    assert_eq!(session["token"], Value::Null);
    assert_eq!(session["person"]["subject"], "id-anna");
    assert_eq!(
        session["person"]["issuer"],
        format!("http://127.0.0.1:{port}")
    );

    // What the groups give, and no more.
    assert_eq!(browser.get("/v1/sites/yard/robots").await.status(), 200);
    assert_eq!(browser.get("/v1/sites/field/robots").await.status(), 403);
    assert_eq!(browser.get("/v1/tokens").await.status(), 403);

    // The audit log says who it was and how.
    let entry = eventually("the sign-in is in the audit log", async || {
        let (_, entries) = yard.get_value("/v1/audit?who=oidc:anna").await;
        let entry = entries["items"].as_array().unwrap().iter();
        let mut entry = entry.filter(|entry| entry["status"] == 303);
        entry.next().cloned().ok_or(entries.clone())
    })
    .await;
    assert_eq!(entry["person"], session["person"]);
    assert_eq!(entry["what"]["sign_in"], "oidc");
    assert_eq!(entry["route"], "/v1/sign-in/oidc/callback");
    assert_eq!(entry["token"], Value::Null);

    // Out here and there.
    let out = browser.delete("/v1/session").await;
    assert_eq!(out.status(), StatusCode::OK);
    let out = body(out).await;
    let out = out["provider"].as_str().unwrap();
    assert!(
        out.starts_with(&format!("http://127.0.0.1:{port}/session/end?")),
        "{out}"
    );
    assert!(
        out.contains("id_token_hint=ey") && out.contains("client_id=tread"),
        "{out}"
    );
    assert_eq!(browser.get("/v1/session").await.status(), 401);
    let form = browser.get(out).await.text().await.unwrap();
    let field = form.split_once("name=\"xsrf\" value=\"").expect(&form).1;
    let field = field.split_once('"').unwrap().0;
    let confirm = format!("http://127.0.0.1:{port}/session/end/confirm");
    let left = browser
        .post(&confirm, &format!("xsrf={field}&logout=yes"))
        .await;
    assert_eq!(location(&left), format!("{PUBLIC}/"));
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_public_client_takes_es256_a_nested_claim_of_the_user_info_and_an_own_authority() {
    let port = free_address().port();
    let folder = tempfile::tempdir().unwrap();
    let made = rcgen::generate_simple_self_signed(["127.0.0.1".to_owned()]).unwrap();
    let (certificate, key) = (
        folder.path().join("cert.pem"),
        folder.path().join("key.pem"),
    );
    std::fs::write(&certificate, made.cert.pem()).unwrap();
    std::fs::write(&key, made.signing_key.serialize_pem()).unwrap();
    let kind = Kind {
        algorithm: "ES256",
        secret: None,
        groups_in: "user info",
        tls: Some((certificate.clone(), key)),
    };
    let _provider = Provider::start(port, &kind).await;
    let yard = Yard::start_configured(|config, folder| {
        config.oidc = Some(OidcConfig {
            issuer: format!("https://127.0.0.1:{port}"),
            client_secret_file: None,
            groups_claim: "realm_access.roles".to_owned(),
            name_claim: Some("email".to_owned()),
            ca: Some(certificate.clone()),
            ..self::config(port, folder)
        });
    })
    .await;
    is_found(&yard).await;
    let pem = made.cert.pem();
    let mut browser = Browser::trusting(&yard, Some(pem.as_bytes()));
    let answer = browser.sign_in("adam").await;
    let session = is_signed_in(&mut browser, answer).await;
    assert_eq!(session["name"], "oidc:adam@example.org");
    assert_eq!(session["role"], "admin");
    assert_eq!(session["sites"], Value::Null);
    assert_eq!(browser.get("/v1/tokens").await.status(), 200);
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_provider_that_is_down_keeps_nobody_out_who_has_a_token_and_is_found_later() {
    let port = free_address().port();
    let yard = Yard::start_configured(|config, folder| {
        config.oidc = Some(self::config(port, folder));
    })
    .await;
    let mut browser = Browser::new(&yard);
    let answer = browser.get("/v1/sign-in/oidc").await;
    assert_eq!(answer.status(), StatusCode::SERVICE_UNAVAILABLE);
    assert!(answer.headers().contains_key(header::RETRY_AFTER));
    assert_eq!(browser.get("/readyz").await.status(), 200);
    assert_eq!(yard.get_value("/v1/sites").await.0, StatusCode::OK);
    let paths = body(browser.get("/v1/sign-in").await).await;
    assert_eq!(paths["oidc"]["available"], false);

    let provider = Provider::start(port, &Kind::default()).await;
    is_found(&yard).await;
    let answer = browser.sign_in("anna").await;
    is_signed_in(&mut browser, answer).await;

    // Away again in the midst of a sign-in: who is signed in stays so, the sign-in can be tried
    // again.
    let begun = browser.begin().await;
    let back = browser.at_provider(begun, "adam").await;
    drop(provider);
    let answer = browser.get(&back).await;
    assert_eq!(answer.status(), StatusCode::SERVICE_UNAVAILABLE);
    assert_eq!(browser.get("/v1/session").await.status(), 200);

    // Back with other keys, of which the server does not know.
    let _provider = Provider::start(port, &Kind::default()).await;
    let answer = browser.sign_in("adam").await;
    let session = is_signed_in(&mut browser, answer).await;
    assert_eq!(session["role"], "admin");
    yard.server.stop().await.unwrap();
}
