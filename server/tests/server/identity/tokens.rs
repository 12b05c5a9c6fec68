//! Tokens: made, used, revoked; failures are counted and lock.

use std::time::Duration;

use reqwest::StatusCode;
use serde_json::{Value, json};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::{TcpSocket, TcpStream};
use tread_api::identity::Role;
use tread_server::app::App;
use tread_server::app::identity::tokens::FirstAdmin;
use tread_server::clock::Clock;
use tread_server::config::{FrictionConfig, StorageConfig};
use tread_server::db::Db;
use tread_server::identity::attempts::{FAILURES_MAX, LOCK_FIRST};
use tread_server::identity::secret::{Kind, Secret};

use crate::harness::{PATIENCE, Yard, client, database, eventually, measured, segment, time};
use crate::robot::Robot;

async fn ask(yard: &Yard, token: &str) -> (StatusCode, Value) {
    yard.send(client(Some(token)).get(yard.url("/v1/sites")))
        .await
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_token_is_shown_once_and_stored_nowhere() {
    let yard = Yard::start().await;
    let (status, made) = yard
        .post(
            "/v1/tokens",
            &json!({"name": " desk ", "role": "operator", "valid_days": 3}),
        )
        .await;
    assert_eq!(status, StatusCode::CREATED, "{made}");
    let secret = made["secret"].as_str().unwrap();
    assert!(secret.starts_with("tread_o_"));
    assert_eq!(made["token"]["name"], "desk");
    assert_eq!(made["token"]["created_by"], "tests");
    assert_eq!(ask(&yard, secret).await.0, StatusCode::OK);
    let (_, listed) = yard.get_value("/v1/tokens").await;
    assert!(!listed.to_string().contains(secret));
    assert_eq!(listed["items"][0]["name"], "desk");
    let (status, who) = yard
        .send(client(Some(secret)).get(yard.url("/v1/session")))
        .await;
    assert_eq!((status, &who["role"]), (StatusCode::OK, &json!("operator")));
    let folder = yard.folder.clone();
    eventually("the audit log and the last use are written", async || {
        let (_, listed) = yard.get_value("/v1/tokens").await;
        let (_, audit) = yard.get_value("/v1/audit").await;
        let used = listed["items"][0]["last_used_at"].is_string();
        let audited = audit["items"]
            .as_array()
            .is_some_and(|items| items.len() > 1);
        if used && audited {
            Ok(())
        } else {
            Err((listed, audit))
        }
    })
    .await;
    yard.server.stop().await.unwrap();
    for file in std::fs::read_dir(folder.path()).unwrap() {
        let kept = std::fs::read(file.unwrap().path()).unwrap();
        let digits = &secret.as_bytes()["tread_o_".len()..];
        assert!(!kept.windows(digits.len()).any(|window| window == digits));
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_a_token_may_not_be_is_refused_with_its_field() {
    let yard = Yard::start().await;
    for (body, status, field) in [
        (json!({"name": "", "role": "viewer"}), 422, "name"),
        (json!({"name": "a\nb", "role": "viewer"}), 422, "name"),
        (
            json!({"name": "x".repeat(81), "role": "viewer"}),
            422,
            "name",
        ),
        (json!({"name": "x", "role": "root"}), 422, "role"),
        (
            json!({"name": "x", "role": "viewer", "valid_days": 0}),
            422,
            "valid_days",
        ),
        (
            json!({"name": "x", "role": "viewer", "valid_days": 1_827}),
            422,
            "valid_days",
        ),
        (
            json!({"name": "x", "role": "viewer", "for_ever": true}),
            422,
            "for_ever",
        ),
        (json!({"name": "tests", "role": "viewer"}), 409, ""),
    ] {
        let (answered, said) = yard.post("/v1/tokens", &body).await;
        assert_eq!(answered, status, "{body}: {said}");
        assert_eq!(
            said["field"].as_str().unwrap_or_default(),
            field,
            "{body}: {said}"
        );
    }
    let unknown = yard.url("/v1/tokens/0192f0c1-2b3c-7d4e-8f50-617283940a1b");
    let (status, _) = yard.send(yard.client().delete(unknown)).await;
    assert_eq!(status, StatusCode::NOT_FOUND);
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_revoked_token_is_refused_at_once_and_its_streams_close() {
    let yard = Yard::start().await;
    let made = yard.token("screen", Role::Viewer).await;
    let screen = client(Some(&made.secret));
    let mut stream = screen.get(yard.url("/v1/events")).send().await.unwrap();
    assert!(stream.chunk().await.unwrap().is_some(), "the stream begins");
    let (status, _) = yard
        .send(
            yard.client()
                .delete(yard.url(&format!("/v1/tokens/{}", made.token.id))),
        )
        .await;
    assert_eq!(status, StatusCode::OK);
    assert_eq!(ask(&yard, &made.secret).await.0, StatusCode::UNAUTHORIZED);
    let ends = async { while let Ok(Some(_)) = stream.chunk().await {} };
    tokio::time::timeout(PATIENCE, ends)
        .await
        .expect("the stream ends with its token");
    yard.server.stop().await.unwrap();
}

/// How soon what is open is cut.
const CUT_MAX: Duration = Duration::from_secs(1);
/// Far more measurements than stand in the buffers between the server and a client that does not read.
const MEASUREMENTS: u64 = 12_000;

/// Begins a download by a client that takes little at a time: what it has read until there is a part.
async fn slow_download(yard: &Yard, path: &str, secret: &str) -> (TcpStream, usize) {
    let socket = TcpSocket::new_v4().unwrap();
    socket.set_recv_buffer_size(16 * 1024).unwrap();
    let mut stream = socket.connect(yard.server.http_address()).await.unwrap();
    let head = format!(
        "GET {path} HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {secret}\r\n\
         Connection: close\r\n\r\n"
    );
    stream.write_all(head.as_bytes()).await.unwrap();
    let mut begin = vec![0; 4_096];
    let read = stream.read(&mut begin).await.unwrap();
    assert!(begin.starts_with(b"HTTP/1.1 200"), "{path}");
    (stream, read)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_downloads_of_a_revoked_token_are_cut_and_nobody_takes_a_part_for_the_whole() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    for batch in 0..MEASUREMENTS / 1_000 {
        let numbers = batch * 1_000..(batch + 1) * 1_000;
        let drive = numbers.map(|seq| {
            let ix = i32::try_from(seq % 100).unwrap();
            let iy = i32::try_from(seq / 100).unwrap();
            measured(seq, segment((ix, iy), 0.2, i64::try_from(seq).unwrap()))
        });
        robot.upload(drive.collect()).await.unwrap();
    }
    for path in [
        "/v1/sites/yard/segments?format=csv",
        "/v1/sites/yard/friction/map?format=csv",
    ] {
        let whole = yard.client().get(yard.url(path)).send().await.unwrap();
        let whole = whole.bytes().await.unwrap().len();
        let made = yard.token(path, Role::Viewer).await;
        let (mut stream, mut read) = slow_download(&yard, path, &made.secret).await;
        let url = yard.url(&format!("/v1/tokens/{}", made.token.id));
        let (status, _) = yard.send(yard.client().delete(url)).await;
        assert_eq!(status, StatusCode::OK);
        // What stands in buffers is its own; after it nothing comes.
        let mut piece = vec![0; 64 * 1024];
        let rest = async {
            while let Ok(more @ 1..) = stream.read(&mut piece).await {
                read += more;
            }
        };
        let ended = tokio::time::timeout(CUT_MAX, rest).await;
        assert!(ended.is_ok(), "{path}: it goes on");
        assert!(read < whole, "{path}: {read} of {whole} bytes");
        // Whoever is not revoked gets all of it, with its end.
        let made = yard.token(&format!("{path} whole"), Role::Viewer).await;
        let (mut stream, mut read) = slow_download(&yard, path, &made.secret).await;
        let mut last = Vec::new();
        read += stream.read_to_end(&mut last).await.unwrap();
        assert!(read >= whole && last.ends_with(b"0\r\n\r\n"), "{path}");
    }
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_token_outlives_a_restart_and_a_revoked_one_does_not_come_back() {
    let yard = Yard::start().await;
    let kept = yard.token("kept", Role::Viewer).await;
    let gone = yard.token("gone", Role::Viewer).await;
    yard.server.app().revoke_token(gone.token.id).await.unwrap();
    let yard = yard.restart().await;
    assert_eq!(ask(&yard, &kept.secret).await.0, StatusCode::OK);
    assert_eq!(ask(&yard, &gone.secret).await.0, StatusCode::UNAUTHORIZED);
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn failures_lock_the_address_for_strangers_and_for_nobody_who_is_signed_in() {
    let yard = Yard::start_at(time("2026-11-01T00:00:00Z")).await;
    let working = yard.token("working", Role::Operator).await.secret;
    let fresh = yard.token("fresh", Role::Operator).await.secret;
    assert_eq!(ask(&yard, &working).await.0, StatusCode::OK);
    for _ in 0..FAILURES_MAX {
        assert_eq!(
            ask(&yard, "tread_a_guess").await.0,
            StatusCode::UNAUTHORIZED
        );
    }
    let guessed = client(Some("tread_a_guess"))
        .get(yard.url("/v1/sites"))
        .send()
        .await
        .unwrap();
    assert_eq!(guessed.status(), StatusCode::TOO_MANY_REQUESTS);
    let wait_s: u64 = guessed.headers()["retry-after"]
        .to_str()
        .unwrap()
        .parse()
        .unwrap();
    assert!((1..=LOCK_FIRST.as_secs() + 1).contains(&wait_s));
    let wrong = Secret::from_random(Kind::Token(Some(Role::Admin)), &[7; 32]);
    let (status, _) = ask(&yard, wrong.reveal()).await;
    assert_eq!(status, StatusCode::TOO_MANY_REQUESTS);
    assert_eq!(
        ask(&yard, &working).await.0,
        StatusCode::OK,
        "who works goes on working"
    );
    assert_eq!(
        ask(&yard, &fresh).await.0,
        StatusCode::OK,
        "and who begins, begins"
    );
    yard.server
        .app()
        .clock()
        .advance(LOCK_FIRST + Duration::from_secs(1));
    assert_eq!(
        ask(&yard, "tread_a_guess").await.0,
        StatusCode::UNAUTHORIZED
    );
    assert!(yard.server.app().counters().values().refused_locked >= 2);
    yard.server.stop().await.unwrap();
}

/// Fails from this machine's address until it is locked.
async fn lock_this_address(yard: &Yard) {
    for _ in 0..FAILURES_MAX {
        let (status, _) = ask(yard, "tread_a_guess").await;
        assert_eq!(status, StatusCode::UNAUTHORIZED);
    }
    let (status, _) = ask(yard, "tread_a_guess").await;
    assert_eq!(status, StatusCode::TOO_MANY_REQUESTS);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn after_a_restart_wrong_tokens_keep_nobody_from_stopping_or_signing_in() {
    let yard = Yard::start().await;
    let viewer = yard.token("screen", Role::Viewer).await.secret;
    let sign_in = |yard: &Yard| {
        let body = json!({"token": viewer});
        client(None).post(yard.url("/v1/session")).json(&body)
    };
    let answer = sign_in(&yard).send().await.unwrap();
    let cookie = answer.headers()["set-cookie"].to_str().unwrap();
    let cookie = cookie.split(';').next().unwrap().to_owned();
    let yard = yard.restart().await;
    lock_this_address(&yard).await;
    // By token and by cookie, on connections of their own, while the address is locked.
    let by_token = client(Some(&viewer)).post(yard.url("/v1/stop"));
    assert_eq!(yard.send(by_token).await.0, StatusCode::OK);
    let by_cookie = client(None)
        .post(yard.url("/v1/stop"))
        .header("cookie", cookie)
        .header("sec-fetch-site", "same-origin");
    assert_eq!(yard.send(by_cookie).await.0, StatusCode::OK);
    assert_eq!(yard.send(sign_in(&yard)).await.0, StatusCode::CREATED);
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_token_of_another_process_is_let_in_while_the_address_is_locked() {
    let yard = Yard::start().await;
    lock_this_address(&yard).await;
    let made = init(&yard, "elsewhere").await;
    let stop = client(Some(&made)).post(yard.url("/v1/stop"));
    assert_eq!(yard.send(stop).await.0, StatusCode::OK);
    yard.server.stop().await.unwrap();
}

/// Makes an admin's token as `tread-server init --force` does, on a connection of its own.
async fn init(yard: &Yard, name: &str) -> String {
    let db = Db::open(&database(yard.folder.path())).await.unwrap();
    let (friction, storage) = (FrictionConfig::default(), StorageConfig::default());
    let app = App::without_robots(db, Clock::system(), friction, storage);
    let admin = FirstAdmin {
        name: name.to_owned(),
        valid_days: 1,
        force: true,
    };
    let secret = app.create_first_admin(admin).await.unwrap().secret;
    app.db().close().await;
    secret
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_token_that_init_replaces_ends_with_its_streams() {
    let yard = Yard::start().await;
    let replaced = client(Some(yard.admin()));
    let mut stream = replaced.get(yard.url("/v1/events")).send().await.unwrap();
    assert!(stream.chunk().await.unwrap().is_some(), "the stream begins");
    let made = init(&yard, "tests").await;
    let ends = async { while let Ok(Some(_)) = stream.chunk().await {} };
    tokio::time::timeout(PATIENCE, ends)
        .await
        .expect("the stream ends with its token");
    assert_eq!(ask(&yard, yard.admin()).await.0, StatusCode::UNAUTHORIZED);
    assert_eq!(ask(&yard, &made).await.0, StatusCode::OK);
    yard.server.stop().await.unwrap();
}
