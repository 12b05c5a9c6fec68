//! The REST API over TLS.

use std::path::Path;

use rcgen::{CertifiedKey, generate_simple_self_signed};
use reqwest::{Certificate, StatusCode, header};
use serde_json::json;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;
use tread_server::config::TlsFiles;

use crate::harness::{PATIENCE, Yard};

/// Writes a new certificate for this machine and gives it as PEM.
fn write_certificate(folder: &Path) -> (TlsFiles, String) {
    let names = vec!["localhost".to_owned(), "127.0.0.1".to_owned()];
    let CertifiedKey { cert, signing_key } = generate_simple_self_signed(names).unwrap();
    let files = TlsFiles {
        certificate: folder.join("cert.pem"),
        key: folder.join("key.pem"),
    };
    std::fs::write(&files.certificate, cert.pem()).unwrap();
    std::fs::write(&files.key, signing_key.serialize_pem()).unwrap();
    (files, cert.pem())
}

fn trusting(pem: &str) -> reqwest::Client {
    let _ = rustls::crypto::ring::default_provider().install_default();
    let certificate = Certificate::from_pem(pem.as_bytes()).unwrap();
    let builder = reqwest::Client::builder().tls_certs_only([certificate]);
    builder.build().unwrap()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn over_tls_tokens_and_cookies_work_and_plain_text_does_not() {
    let folder = tempfile::tempdir().unwrap();
    let (files, pem) = write_certificate(folder.path());
    let yard = Yard::start_with_tls(files).await;
    let address = yard.server.http_address();
    let client = trusting(&pem);
    let sites = client.get(format!("https://{address}/v1/sites"));
    let answer = sites.bearer_auth(yard.admin()).send().await.unwrap();
    assert_eq!(answer.status(), StatusCode::OK);
    assert_eq!(
        answer.headers()["strict-transport-security"],
        "max-age=31536000"
    );
    let sign_in = client
        .post(format!("https://{address}/v1/session"))
        .json(&json!({"token": yard.admin()}));
    let answer = sign_in.send().await.unwrap();
    let cookie = answer.headers()[header::SET_COOKIE].to_str().unwrap();
    assert!(
        cookie.starts_with("__Host-tread_session=") && cookie.contains("Secure"),
        "{cookie}"
    );

    let (_, other) = write_certificate(tempfile::tempdir().unwrap().path());
    let doubting = trusting(&other).get(format!("https://{address}/healthz"));
    assert!(
        doubting.send().await.is_err(),
        "a foreign certificate was trusted"
    );
    let mut plain = TcpStream::connect(address).await.unwrap();
    plain
        .write_all(b"GET /healthz HTTP/1.1\r\nhost: localhost\r\n\r\n")
        .await
        .unwrap();
    let mut said = Vec::new();
    let ended = tokio::time::timeout(PATIENCE, plain.read_to_end(&mut said)).await;
    assert!(ended.is_ok() && !said.starts_with(b"HTTP"), "{said:?}");
    let health = client.get(format!("https://{address}/healthz"));
    assert_eq!(health.send().await.unwrap().status(), StatusCode::OK);
    assert!(yard.server.app().counters().values().http_tls_failed >= 2);
    yard.server.stop().await.unwrap();
}

#[test]
fn a_new_certificate_is_taken_and_a_broken_one_is_not() {
    let folder = tempfile::tempdir().unwrap();
    let (files, _) = write_certificate(folder.path());
    let tls = tread_server::http::tls::Tls::load(files.clone()).unwrap();
    write_certificate(folder.path());
    tls.reload().unwrap();
    std::fs::write(&files.key, "no key").unwrap();
    assert!(tls.reload().is_err());
    let error = tread_server::http::tls::Tls::load(files).unwrap_err();
    assert!(error.to_string().contains("key.pem"), "{error}");
}
