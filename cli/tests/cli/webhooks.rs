//! `tread webhooks` against a real server and a receiver on this machine.

use serde_json::json;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpListener;

use crate::yard::Yard;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_webhook_is_added_tested_disabled_and_removed_by_its_name() {
    let yard = Yard::start().await;
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let url = format!("http://{}/tread", listener.local_addr().unwrap());
    let kinds = "robot-lost,mission-failed";
    let words = [
        "webhooks", "add", "on call", &url, "--kinds", kinds, "--for", "yard",
    ];
    let added = yard.run(&words).await;
    assert_eq!(added.code, Some(0), "{}", added.errors);
    assert!(added.text.starts_with("tread_w_"), "{}", added.text);
    assert!(!added.errors.contains("tread_w_"), "{}", added.errors);
    let listed = yard.json(&["webhooks"]).await;
    assert_eq!(listed[0]["name"], "on call");
    assert_eq!(listed[0]["kinds"], json!(["mission-failed", "robot-lost"]));
    assert_eq!(listed[0]["sites"], json!(["yard"]));

    let answering = async {
        let (mut stream, _) = listener.accept().await.unwrap();
        let mut text = Vec::new();
        while !String::from_utf8_lossy(&text).contains("\"event\":\"test\"") {
            let mut piece = [0; 4_096];
            let count = stream.read(&mut piece).await.unwrap();
            assert!(count > 0, "the request ended early");
            text.extend_from_slice(&piece[..count]);
        }
        let answer = b"HTTP/1.1 200 OK\r\ncontent-length: 0\r\n\r\n";
        stream.write_all(answer).await.unwrap();
        stream.shutdown().await.unwrap();
    };
    let (tested, ()) = tokio::join!(yard.run(&["webhooks", "test", "on call"]), answering);
    assert_eq!(tested.code, Some(0), "{}", tested.errors);
    assert!(tested.text.contains("it arrived"), "{}", tested.text);
    drop(listener);
    let tested = yard.run(&["webhooks", "test", "on call"]).await;
    assert_eq!(tested.code, Some(1), "{}", tested.text);
    assert!(tested.text.contains("did not arrive"), "{}", tested.text);
    let log = yard.json(&["webhooks", "deliveries", "on call"]).await;
    let states = [&log[0]["state"], &log[1]["state"]];
    assert_eq!(states, ["pending", "delivered"]);

    let disabled = yard.json(&["webhooks", "disable", "on call"]).await;
    assert_eq!(disabled["enabled"], false);
    assert_eq!(disabled["kinds"], listed[0]["kinds"]);
    let id = listed[0]["id"].as_str().unwrap();
    let removed = yard.run(&["webhooks", "remove", id]).await;
    assert_eq!(removed.code, Some(0), "{}", removed.errors);
    let unknown = yard.run(&["webhooks", "enable", "on call"]).await;
    assert_ne!(unknown.code, Some(0));
    let said = unknown.errors;
    assert!(said.contains("there is no webhook `on call`"), "{said}");
    yard.end().await;
}
