//! The audit log says who did what, from where, and nothing secret.

use std::time::Duration;

use jiff::Timestamp;
use reqwest::StatusCode;
use serde_json::{Value, json};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;
use tokio::task::JoinSet;
use tokio::time::Instant;
use tread_api::audit::{AuditChain, Broken, Verifier};
use tread_api::identity::{AuditEntry, Role};
use tread_api::page::Page;
use tread_server::app::identity::audit::SHARE_BURST;
use tread_server::db;
use tread_server::db::audit::AuditRetention;

use crate::harness::{Yard, client, eventually};

/// How long a viewer asks for as much as the server answers.
const FLOOD_LASTS: Duration = Duration::from_secs(10);
/// Requests that are sent before their answers are read.
const PIPELINED: usize = 100;
/// Changes of an admin meanwhile.
const CHANGES: usize = 48;

async fn entries(yard: &Yard, query: &str) -> Vec<Value> {
    let (status, page) = yard.get_value(&format!("/v1/audit?{query}")).await;
    assert_eq!(status, StatusCode::OK, "{page}");
    page["items"].as_array().unwrap().clone()
}

async fn until(yard: &Yard, query: &str, count: usize) -> Vec<Value> {
    eventually("the audit log is written", async || {
        let entries = entries(yard, query).await;
        if entries.len() >= count {
            Ok(entries)
        } else {
            Err(entries)
        }
    })
    .await
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn changes_and_refusals_are_written_and_secrets_are_not() {
    let yard = Yard::start().await;
    let viewer = yard.token("screen", Role::Viewer).await.secret;
    let (status, _) = yard
        .post("/v1/sites", &json!({"id": "field", "cell_m": 2.0}))
        .await;
    assert_eq!(status, StatusCode::CREATED);
    let (status, _) = yard.post("/v1/sites", &json!({"id": "field"})).await;
    assert_eq!(status, StatusCode::CONFLICT);
    let refused = client(Some(&viewer))
        .post(yard.url("/v1/sites"))
        .json(&json!({"id": "x"}));
    assert_eq!(yard.send(refused).await.0, StatusCode::FORBIDDEN);
    let guessed = client(Some("tread_a_guess")).get(yard.url("/v1/sites"));
    assert_eq!(yard.send(guessed).await.0, StatusCode::UNAUTHORIZED);
    let sign_in = client(None)
        .post(yard.url("/v1/session"))
        .json(&json!({"token": viewer}));
    assert_eq!(yard.send(sign_in).await.0, StatusCode::CREATED);
    yard.get_value("/v1/sites").await;

    let all = until(&yard, "", 6).await;
    let seen: Vec<(&str, &str, u64)> = all
        .iter()
        .rev()
        .map(|entry| {
            let who = entry["who"].as_str().unwrap_or("-");
            (
                who,
                entry["route"].as_str().unwrap(),
                entry["status"].as_u64().unwrap(),
            )
        })
        .collect();
    assert_eq!(
        seen,
        [
            ("init", "tread-server init", 201),
            ("tests", "/v1/sites", 201),
            ("tests", "/v1/sites", 409),
            ("screen", "/v1/sites", 403),
            ("-", "/v1/sites", 401),
            ("screen", "/v1/session", 201),
        ]
    );
    let made = &all[all.len() - 2];
    assert_eq!(made["what"], json!({"id": "field", "cell_m": 2.0}));
    assert_eq!(
        (&made["address"], &made["role"]),
        (&json!("127.0.0.1"), &json!("admin"))
    );
    assert_eq!(made["request_id"].as_str().unwrap().len(), 36);
    let said = Value::from(all.clone()).to_string();
    assert!(!said.contains(&viewer) && !said.contains("guess"), "{said}");

    assert_eq!(entries(&yard, "refused=true").await.len(), 3);
    assert_eq!(entries(&yard, "who=screen").await.len(), 2);
    let (_, first) = yard.get_value("/v1/audit?limit=4").await;
    let cursor = first["next_cursor"].as_str().unwrap();
    assert_eq!(
        entries(&yard, &format!("limit=4&cursor={cursor}"))
            .await
            .len(),
        2
    );
    let (status, _) = yard.get_value("/v1/audit?cursor=x").await;
    assert_eq!(status, StatusCode::BAD_REQUEST);
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_was_answered_before_a_stop_is_in_the_log_after_it() {
    let yard = Yard::start().await;
    for number in 0..50 {
        let (status, _) = yard
            .post("/v1/sites", &json!({"id": format!("s-{number}")}))
            .await;
        assert_eq!(status, StatusCode::CREATED);
    }
    let yard = yard.restart().await;
    let created = entries(&yard, "limit=1000").await;
    let created = created.iter().filter(|entry| entry["route"] == "/v1/sites");
    assert_eq!(created.count(), 50);
    yard.server.stop().await.unwrap();
}

/// Signs out again and again on one connection, as fast as it is answered; how often.
async fn sign_out_until(address: std::net::SocketAddr, token: String, end: Instant) -> usize {
    let mut stream = TcpStream::connect(address).await.unwrap();
    let request = format!(
        "DELETE /v1/session HTTP/1.1\r\nhost: localhost\r\nauthorization: Bearer {token}\r\n\r\n"
    );
    let burst = request.repeat(PIPELINED);
    let mut answered = 0;
    let mut text = vec![0; 64 * 1024];
    while Instant::now() < end {
        stream.write_all(burst.as_bytes()).await.unwrap();
        let mut left = PIPELINED;
        let mut tail = Vec::new();
        while left > 0 {
            let length = stream.read(&mut text).await.unwrap();
            assert!(length > 0, "the connection was closed");
            tail.extend_from_slice(&text[..length]);
            let found = tail.windows(4).filter(|window| window == b"\r\n\r\n");
            let count = found.count();
            if let Some(at) = tail.windows(4).rposition(|window| window == b"\r\n\r\n") {
                tail.drain(..at + 4);
            }
            left = left.saturating_sub(count);
            answered += count;
        }
    }
    answered
}

/// All entries, the oldest first.
async fn all_entries(yard: &Yard) -> Vec<AuditEntry> {
    let mut entries: Vec<AuditEntry> = Vec::new();
    let mut cursor = String::new();
    loop {
        let path = format!("/v1/audit?order=oldest&limit=1000{cursor}");
        let page: Page<AuditEntry> = yard.get(&path).await;
        entries.extend(page.items);
        let Some(next) = page.next_cursor else {
            return entries;
        };
        cursor = format!("&cursor={next}");
    }
}

/// Computes all hashes again, as whoever does not trust the server does.
async fn verified(yard: &Yard) -> Result<u64, Broken> {
    let chain: AuditChain = yard.get("/v1/audit/chain").await;
    let entries = all_entries(yard).await;
    let mut verifier = Verifier::after(chain.before_id, &chain.before_hash);
    let until = entries.iter().filter(|entry| entry.id <= chain.last_id);
    until
        .into_iter()
        .try_for_each(|entry| verifier.take(entry))?;
    verifier.end(&chain)?;
    Ok(verifier.count())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_viewer_who_floods_pushes_no_change_of_an_admin_out_of_the_log() {
    let yard = Yard::start().await;
    let viewer = yard.token("screen", Role::Viewer).await.secret;
    let end = Instant::now() + FLOOD_LASTS;
    let address = yard.server.http_address();
    let mut flood = JoinSet::new();
    for _ in 0..4 {
        flood.spawn(sign_out_until(address, viewer.clone(), end));
    }
    for number in 0..CHANGES {
        let body = json!({"name": format!("desk-{number}"), "role": "viewer"});
        let (status, said) = yard.post("/v1/tokens", &body).await;
        assert_eq!(status, StatusCode::CREATED, "{said}");
        tokio::time::sleep(FLOOD_LASTS / 60).await;
    }
    let answered: usize = flood.join_all().await.into_iter().sum();
    let each_s = answered / usize::try_from(FLOOD_LASTS.as_secs()).unwrap();
    eprintln!("{answered} requests of the viewer, {each_s} a second");
    assert_eq!(yard.counters().await.audit_dropped, 0);
    // A stop writes what is still counted.
    let yard = yard.restart().await;
    let entries = all_entries(&yard).await;
    for number in 0..CHANGES {
        let name = json!(format!("desk-{number}"));
        let is_it = |entry: &&AuditEntry| {
            let what = entry.what.as_ref();
            entry.method == "POST" && what.is_some_and(|what| what["name"] == name)
        };
        let found: Vec<_> = entries.iter().filter(is_it).collect();
        assert_eq!(found.len(), 1, "{name}: {found:?}");
        assert_eq!(found[0].count, 1);
    }
    let of_viewer = entries.iter().filter(|entry| entry.method == "DELETE");
    let (rows, asked) = of_viewer.fold((0, 0), |(rows, asked), entry| {
        (rows + 1, asked + entry.count)
    });
    assert_eq!(asked, u64::try_from(answered).unwrap(), "nothing is lost");
    assert!(rows < SHARE_BURST + 10, "{rows} entries of the viewer");
    verified(&yard).await.unwrap();
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn whoever_changes_a_row_of_the_database_is_found_by_its_number() {
    let yard = Yard::start().await;
    for number in 0..12 {
        let body = json!({"id": format!("s-{number}"), "cell_m": 0.1 + f64::from(number) / 3.0});
        assert_eq!(yard.post("/v1/sites", &body).await.0, StatusCode::CREATED);
    }
    let written = until(&yard, "", 13).await;
    assert_eq!(
        verified(&yard).await,
        Ok(u64::try_from(written.len()).unwrap())
    );
    // The oldest go, and the rest is verified all the same.
    let mut tx = yard.server.app().db().write("test").await.unwrap();
    let kept = AuditRetention {
        since: Timestamp::UNIX_EPOCH,
        newest_max: 10,
    };
    db::audit::prune(&mut tx, kept, 100).await.unwrap();
    tx.commit().await.unwrap();
    assert_eq!(verified(&yard).await, Ok(10));

    let change = async |statement: &'static str| {
        let mut tx = yard.server.app().db().write("test").await.unwrap();
        sqlx::query(statement)
            .execute(&mut **tx.as_sqlite().unwrap())
            .await
            .unwrap();
        tx.commit().await.unwrap();
        verified(&yard).await
    };
    for (statement, undone, found) in [
        (
            "UPDATE audit SET status = 403 WHERE id = 7",
            "UPDATE audit SET status = 201 WHERE id = 7",
            Broken::Changed(7),
        ),
        (
            "UPDATE audit SET who = 'nobody' WHERE id = 13",
            "UPDATE audit SET who = 'tests' WHERE id = 13",
            Broken::Changed(13),
        ),
        (
            "UPDATE audit SET id = 99 WHERE id = 13",
            "UPDATE audit SET id = 13 WHERE id = 99",
            Broken::Ends {
                found: 12,
                expected: 13,
            },
        ),
        (
            "UPDATE audit SET hash = NULL WHERE id = 9",
            "DELETE FROM audit WHERE id = 9",
            Broken::Unhashed(9),
        ),
    ] {
        assert_eq!(change(statement).await, Err(found), "{statement}");
        let _ = change(undone).await;
    }
    let missing = Broken::Missing { last: 8, next: 10 };
    assert_eq!(verified(&yard).await, Err(missing));
    yard.server.stop().await.unwrap();
}
