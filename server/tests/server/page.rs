//! The page for people: what a browser gets at `/` without any sign-in.

use reqwest::{StatusCode, header};

use crate::harness::{Yard, client};

/// What the page's text says that a browser should load.
fn named_in(text: &str) -> Vec<String> {
    let parts = text.split(['"', '\'']);
    let paths = parts.filter(|part| part.starts_with('/') && part.contains('.'));
    paths.map(str::to_owned).collect()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_browser_gets_the_page_and_everything_that_it_names() {
    let yard = Yard::start().await;
    let answer = client(None).get(yard.url("/")).send().await.unwrap();
    assert_eq!(answer.status(), StatusCode::OK);
    let headers = answer.headers().clone();
    assert_eq!(headers[header::CONTENT_TYPE], "text/html; charset=utf-8");
    let policy = headers[header::CONTENT_SECURITY_POLICY].to_str().unwrap();
    assert!(policy.starts_with("default-src 'none'; script-src 'self'; style-src 'self';"));
    assert!(!policy.contains("unsafe"), "{policy}");
    let text = answer.text().await.unwrap();
    let names = named_in(&text);
    assert!(names.len() >= 3, "{text}");
    for path in names {
        let answer = client(None).get(yard.url(&path)).send().await.unwrap();
        assert_eq!(answer.status(), StatusCode::OK, "{path}");
        let media_type = answer.headers()[header::CONTENT_TYPE].to_str().unwrap();
        let wanted = match path.rsplit_once('.').unwrap().1 {
            "js" => "text/javascript",
            "css" => "text/css",
            "svg" => "image/svg+xml",
            other => panic!("the page names a `{other}`"),
        };
        assert!(media_type.starts_with(wanted), "{path}: {media_type}");
        assert!(!answer.bytes().await.unwrap().is_empty(), "{path}");
    }
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_browser_that_has_a_file_already_does_not_get_it_again() {
    let yard = Yard::start().await;
    let ask = |encodings: &'static str, known: Option<String>| {
        let asked = client(None).get(yard.url("/page/app.js"));
        let asked = asked.header(header::ACCEPT_ENCODING, encodings);
        match known {
            Some(tag) => asked.header(header::IF_NONE_MATCH, tag),
            None => asked,
        }
    };
    let plain = ask("identity", None).send().await.unwrap();
    assert!(!plain.headers().contains_key(header::CONTENT_ENCODING));
    let plain_tag = plain.headers()[header::ETAG].to_str().unwrap().to_owned();
    let whole = plain.bytes().await.unwrap().len();
    let packed = ask("br, gzip", None).send().await.unwrap();
    assert_eq!(packed.headers()[header::CONTENT_ENCODING], "gzip");
    assert_eq!(packed.headers()[header::VARY], "accept-encoding");
    assert_eq!(packed.headers()[header::CACHE_CONTROL], "no-cache");
    let packed_tag = packed.headers()[header::ETAG].to_str().unwrap().to_owned();
    assert_ne!(plain_tag, packed_tag);
    let bytes = packed.bytes().await.unwrap();
    assert!(bytes.starts_with(&[0x1f, 0x8b]) && bytes.len() * 2 < whole);
    for known in [packed_tag.clone(), format!("\"old\", W/{packed_tag}")] {
        let again = ask("gzip", Some(known)).send().await.unwrap();
        assert_eq!(again.status(), StatusCode::NOT_MODIFIED);
        assert!(again.headers().contains_key("content-security-policy"));
        assert!(again.bytes().await.unwrap().is_empty());
    }
    let other = ask("gzip", Some(plain_tag)).send().await.unwrap();
    assert_eq!(other.status(), StatusCode::OK);
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn nothing_but_the_page_is_served_beside_the_api() {
    let yard = Yard::start().await;
    for path in [
        "/page/",
        "/page/index.html",
        "/page/app.js/",
        "/page/..%2fapp.js",
        "/page/%2e%2e/Cargo.toml",
        "/index.html",
        "/app.js",
    ] {
        let answer = yard.client().get(yard.url(path)).send().await.unwrap();
        assert_eq!(answer.status(), StatusCode::NOT_FOUND, "{path}");
    }
    for (path, status) in [("/", 405), ("/page/app.js", 405)] {
        let answer = yard.client().post(yard.url(path)).send().await.unwrap();
        assert_eq!(answer.status(), status, "{path}");
    }
    let head = client(None).head(yard.url("/")).send().await.unwrap();
    assert_eq!(head.status(), StatusCode::OK);
    yard.server.stop().await.unwrap();
}
