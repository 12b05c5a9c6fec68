//! Sign-ins that do not succeed.

use std::time::Duration;

use reqwest::{Response, StatusCode, Url, header};
use tread_server::clock::Clock;

use super::provider::{Browser, Kind, PUBLIC, Provider, location};
use super::{body, config, is_found, is_signed_in, start};
use crate::harness::{Yard, eventually};
use crate::ports::free_address;

/// Refused with a problem of a type, and nobody is signed in.
async fn is_refused(browser: &mut Browser, answer: Response, kind: &str) -> String {
    let status = answer.status();
    assert!(status.is_client_error(), "{answer:?}");
    let said = body(answer).await;
    assert_eq!(said["type"], format!("/problems/{kind}"), "{said}");
    assert!(browser.cookie("tread_session").is_none());
    said["detail"].as_str().unwrap().to_owned()
}

/// An address with one parameter of its query replaced.
fn with(url: &str, name: &str, value: &str) -> String {
    let mut url: Url = url.parse().unwrap();
    let pairs: Vec<(String, String)> = url.query_pairs().into_owned().collect();
    assert!(pairs.iter().any(|(own, _)| own == name), "{url}");
    let mut query = url.query_pairs_mut();
    query.clear();
    for (own, old) in pairs {
        let new = if own == name { value } else { &old };
        query.append_pair(&own, new);
    }
    drop(query);
    url.into()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_answer_counts_once_and_in_the_browser_alone_in_which_the_sign_in_began() {
    let port = free_address().port();
    let _provider = Provider::start(port, &Kind::default()).await;
    let yard = start(port).await;
    let mut browser = Browser::new(&yard);
    let begun = browser.begin().await;
    let back = browser.at_provider(begun, "anna").await;

    // In another browser: none began there, or another one.
    let mut other = Browser::new(&yard);
    let answer = other.get(&back).await;
    is_refused(&mut other, answer, "sign-in-failed").await;
    other.begin().await;
    let answer = other.get(&back).await;
    is_refused(&mut other, answer, "sign-in-failed").await;

    // With another state, no state, and the word of another provider. None of these uses it up.
    let kept = browser.cookie("tread_sign_in").unwrap().clone();
    for (name, value) in [
        ("state", "AAAA"),
        ("state", ""),
        ("iss", "https://evil.test"),
    ] {
        let answer = browser.get(&with(&back, name, value)).await;
        is_refused(&mut browser, answer, "sign-in-failed").await;
        // The server takes it away; whoever wants it back has it.
        assert!(browser.cookie("tread_sign_in").is_none());
        let begun = browser.get("/v1/sign-in/oidc").await;
        assert_eq!(begun.status(), StatusCode::SEE_OTHER);
        browser.cookie("tread_sign_in").unwrap().clone_from(&kept);
    }
    // With a code that the provider has not given.
    let answer = browser.get(&with(&back, "code", "guessed")).await;
    let detail = is_refused(&mut browser, answer, "sign-in-failed").await;
    assert!(detail.contains("the server's log"), "{detail}");
    browser.begin().await;
    browser.cookie("tread_sign_in").unwrap().clone_from(&kept);

    let answer = browser.get(&back).await;
    is_signed_in(&mut browser, answer).await;
    // The same again, with the cookie that was taken away.
    let mut thief = Browser::new(&yard);
    thief.begin().await;
    thief.cookie("tread_sign_in").unwrap().clone_from(&kept);
    let answer = thief.get(&back).await;
    is_refused(&mut thief, answer, "sign-in-failed").await;
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_id_token_of_another_sign_in_is_not_believed() {
    let port = free_address().port();
    let _provider = Provider::start(port, &Kind::default()).await;
    let yard = start(port).await;
    let mut browser = Browser::new(&yard);
    let begun = browser.begin().await;
    let foreign = with(begun.as_str(), "nonce", "another");
    let back = browser.at_provider(foreign.parse().unwrap(), "anna").await;
    let answer = browser.get(&back).await;
    is_refused(&mut browser, answer, "sign-in-failed").await;
    // Nor a code of a sign-in with another verifier.
    let begun = browser.begin().await;
    let challenge = "E9Melhoa2OwvFrEMTJguCHaoeK1t8URWbuGJSstw-cM";
    let foreign = with(begun.as_str(), "code_challenge", challenge);
    let back = browser.at_provider(foreign.parse().unwrap(), "anna").await;
    let answer = browser.get(&back).await;
    is_refused(&mut browser, answer, "sign-in-failed").await;
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn whoever_is_in_no_group_is_refused_with_that_reason_as_a_person_and_as_a_program() {
    let port = free_address().port();
    let _provider = Provider::start(port, &Kind::default()).await;
    let yard = start(port).await;
    let mut browser = Browser::new(&yard);
    let answer = browser.sign_in("eve").await;
    assert_eq!(answer.status(), StatusCode::FORBIDDEN);
    let detail = is_refused(&mut browser, answer, "sign-in-refused").await;
    assert!(
        detail.contains("`eve`") && detail.contains("no group"),
        "{detail}"
    );
    let entry = eventually("the refusal is in the audit log", async || {
        let (_, entries) = yard.get_value("/v1/audit?refused=true").await;
        let entry = entries["items"].as_array().unwrap().iter();
        let mut entry = entry.filter(|entry| entry["what"]["refused"] == "no group");
        entry.next().cloned().ok_or(entries.clone())
    })
    .await;
    assert_eq!(entry["what"]["person"]["subject"], "id-eve");

    let begun = browser.begin().await;
    let back = browser.at_provider(begun, "eve").await;
    let asked = browser
        .asking(&back)
        .header(header::ACCEPT, "text/html,application/xhtml+xml,*/*;q=0.8");
    let answer = browser.send("/", asked).await;
    assert_eq!(answer.status(), StatusCode::FORBIDDEN);
    assert_eq!(
        answer.headers()[header::CONTENT_TYPE],
        "text/html; charset=utf-8"
    );
    let policy = answer.headers()[header::CONTENT_SECURITY_POLICY]
        .to_str()
        .unwrap();
    assert!(policy.starts_with("default-src 'none'"), "{policy}");
    let page = answer.text().await.unwrap();
    assert!(
        page.contains("You have no rights on this server") && page.contains("eve"),
        "{page}"
    );

    // The provider itself says no.
    let answer = browser.sign_in("nobody").await;
    let detail = is_refused(&mut browser, answer, "sign-in-failed").await;
    assert!(detail.contains("access_denied"), "{detail}");
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_id_token_that_is_over_or_of_the_future_is_not_believed() {
    let port = free_address().port();
    let _provider = Provider::start(port, &Kind::default()).await;
    let now = Clock::system().now();
    for wall in [now + Duration::from_mins(7), now - Duration::from_mins(3)] {
        let folder = tempfile::tempdir().unwrap();
        let yard = Yard::start_with(wall, |config| {
            config.oidc = Some(self::config(port, folder.path()));
        })
        .await;
        is_found(&yard).await;
        let mut browser = Browser::new(&yard);
        let answer = browser.sign_in("anna").await;
        is_refused(&mut browser, answer, "sign-in-failed").await;
        yard.server.stop().await.unwrap();
    }
    // Half a minute is none.
    let folder = tempfile::tempdir().unwrap();
    let yard = Yard::start_with(now - Duration::from_secs(20), |config| {
        config.oidc = Some(self::config(port, folder.path()));
    })
    .await;
    is_found(&yard).await;
    let mut browser = Browser::new(&yard);
    let begun = browser.begin().await;
    // Who took too long at the provider begins again.
    let back = browser.at_provider(begun.clone(), "anna").await;
    let kept = browser.cookie("tread_sign_in").unwrap().clone();
    let answer = browser.get(&back).await;
    is_signed_in(&mut browser, answer).await;
    let mut late = Browser::new(&yard);
    let begun = late.begin().await;
    let back = late.at_provider(begun, "anna").await;
    assert_ne!(late.cookie("tread_sign_in").unwrap(), &kept);
    yard.server.app().clock().advance(Duration::from_mins(10));
    let answer = late.get(&back).await;
    let detail = is_refused(&mut late, answer, "sign-in-failed").await;
    assert!(detail.contains("10 minutes"), "{detail}");
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn no_address_sends_a_browser_elsewhere_after_the_sign_in() {
    let port = free_address().port();
    let _provider = Provider::start(port, &Kind::default()).await;
    let yard = start(port).await;
    let mut browser = Browser::new(&yard);
    let hints = "?return_to=https://evil.test&next=//evil.test&redirect_uri=https://evil.test";
    let begun = browser.get(&format!("/v1/sign-in/oidc{hints}")).await;
    let sent = location(&begun);
    assert!(!sent.contains("evil"), "{sent}");
    let back = browser.at_provider(sent.parse().unwrap(), "anna").await;
    let answer = browser.get(&format!("{back}&{}", &hints[1..])).await;
    assert_eq!(location(&answer), "/#signed-in");
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_browser_at_another_name_of_the_server_is_sent_to_the_one_that_the_provider_knows() {
    let port = free_address().port();
    let _provider = Provider::start(port, &Kind::default()).await;
    let yard = Yard::start_configured(|config, folder| {
        config.oidc = Some(self::config(port, folder));
        config.web.hosts = vec!["tread.test".to_owned()];
    })
    .await;
    is_found(&yard).await;
    let mut browser = Browser::new(&yard);
    for host in ["tread.test", "localhost:8420", "127.0.0.1", "[::1]:8420"] {
        let asked = browser.asking_at(host, "/v1/sign-in/oidc");
        let sent = browser.send("/", asked).await;
        assert_eq!(sent.status(), StatusCode::SEE_OTHER, "{host}");
        assert_eq!(location(&sent), format!("{PUBLIC}/"), "{host}");
        assert!(browser.cookie("tread_sign_in").is_none(), "{host}");
    }
    // From there it works.
    let answer = browser.sign_in("anna").await;
    is_signed_in(&mut browser, answer).await;
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_foreign_page_begins_no_sign_in() {
    let port = free_address().port();
    let _provider = Provider::start(port, &Kind::default()).await;
    let yard = start(port).await;
    let mut browser = Browser::new(&yard);
    let path = "/v1/sign-in/oidc";
    for site in ["cross-site", "same-site", "", "elsewhere"] {
        for mode in ["navigate", "no-cors"] {
            let asked = browser.asking(path).header("sec-fetch-site", site);
            let asked = asked.header("sec-fetch-mode", mode);
            let sent = browser.send("/", asked).await;
            assert_eq!(location(&sent), format!("{PUBLIC}/"), "{site} {mode}");
            assert!(browser.cookie("tread_sign_in").is_none(), "{site} {mode}");
        }
    }
    // Nor does it disturb one that is under way.
    let begun = browser.begin().await;
    let kept = browser.cookie("tread_sign_in").cloned();
    let asked = browser.asking(path).header("sec-fetch-site", "cross-site");
    browser.send("/", asked).await;
    assert_eq!(browser.cookie("tread_sign_in").cloned(), kept);
    let back = browser.at_provider(begun, "anna").await;
    let came = browser.asking(&back).header("sec-fetch-site", "cross-site");
    let answer = browser.send("/", came).await;
    is_signed_in(&mut browser, answer).await;

    // The page's own link, and an address that was typed, do.
    for site in ["same-origin", "none"] {
        let mut browser = Browser::new(&yard);
        let asked = browser.asking(path).header("sec-fetch-site", site);
        let sent = browser.send("/", asked).await;
        assert!(location(&sent).contains("code_challenge="), "{site}");
        assert!(browser.cookie("tread_sign_in").is_some(), "{site}");
    }
    yard.server.stop().await.unwrap();
}
