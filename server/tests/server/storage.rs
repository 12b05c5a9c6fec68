//! A database of one server alone, and one that is damaged.

use std::os::unix::fs::{FileExt as _, PermissionsExt as _};

use reqwest::StatusCode;
use sqlx::{Connection as _, SqliteConnection};
use tread_server::Server;
use tread_server::clock::Clock;
use tread_server::config::StorageConfig;

use crate::drive::{Socket, driven_at};
use crate::harness::{Yard, circle, config, database, eventually, time};
use crate::robot::Robot;

/// Bytes of one page of the database.
const PAGE_BYTES: u64 = 4_096;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_second_server_on_the_same_database_is_refused_until_the_first_has_stopped() {
    let yard = Yard::start().await;
    let again = || config(yard.folder.path(), "127.0.0.1:0");
    let refused = Server::start(again()).await.unwrap_err();
    let text = format!("{refused:#}");
    assert!(
        text.contains("is used by another server (process"),
        "{text}"
    );
    yard.server.stop().await.unwrap();
    let second = Server::start(config(yard.folder.path(), "127.0.0.1:0")).await;
    second.unwrap().stop().await.unwrap();
}

/// Overwrites the page that a table or an index begins at.
async fn damage(yard: &Yard, table: &'static str) {
    let db = yard.server.app().db();
    let mut tx = db.read("test").await.unwrap();
    let (page,): (i64,) = sqlx::query_as("SELECT rootpage FROM sqlite_schema WHERE name = ?")
        .bind(table)
        .fetch_one(&mut **tx.as_sqlite().unwrap())
        .await
        .unwrap();
    drop(tx);
    db.close().await;
    let file = std::fs::OpenOptions::new()
        .write(true)
        .open(database(yard.folder.path()))
        .unwrap();
    let at = (u64::try_from(page).unwrap() - 1) * PAGE_BYTES;
    file.write_all_at(&[0xff; 512], at).unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_damaged_table_makes_the_server_unready_and_stop_and_presence_work_on() {
    for table in ["missions", "segment_values"] {
        let yard = Yard::start().await;
        let id = Robot::join(&yard, "rover-1").await.id.clone();
        damage(&yard, table).await;
        let yard = yard.restart().await;
        let robot = Robot::join(&yard, id.as_str()).await;
        let ready = eventually("the server is not ready", async || {
            let (status, body) = yard.get_value("/readyz").await;
            if status == StatusCode::SERVICE_UNAVAILABLE {
                Ok(body)
            } else {
                Err((status, body))
            }
        });
        let body = ready.await;
        assert_eq!(body["type"], "/problems/unavailable", "{body}");
        let alert = eventually("an alert is raised", async || {
            let (_status, body) = yard.get_value("/v1/alerts?site=yard&raised=true").await;
            let items = body["items"].as_array().cloned().unwrap_or_default();
            let found = items
                .into_iter()
                .find(|alert| alert["code"] == "database-damaged");
            found.ok_or(body)
        });
        let alert = alert.await;
        assert!(alert["robot"].is_null() && alert["severity"] == "critical");
        let (_status, status) = yard.get_value("/v1/server").await;
        assert!(status["storage"]["damaged"].is_string(), "{status}");
        let metrics = yard.server.metrics_address().unwrap();
        let text = reqwest::get(format!("http://{metrics}/metrics")).await;
        let text = text.unwrap().text().await.unwrap();
        assert!(text.contains("tread_storage_damaged 1"), "{text}");
        let (status, stop) = yard
            .post("/v1/sites/yard/robots/rover-1/stop", &serde_json::json!({}))
            .await;
        assert_eq!(status, StatusCode::OK, "{stop}");
        assert_eq!(robot.stops().len(), 1);
        let (status, robots) = yard.get_value("/v1/sites/yard/robots").await;
        assert_eq!(status, StatusCode::OK, "{robots}");
        assert_eq!(robots["items"][0]["link"], "online", "{robots}");
        let seen = format!("/v1/alerts/{}/acknowledge", alert["id"].as_str().unwrap());
        let (status, alert) = yard.post(&seen, &serde_json::json!({})).await;
        assert_eq!(status, StatusCode::OK, "{alert}");
        assert!(alert["acknowledged_at"].is_string(), "{alert}");
        drop(robot);
        yard.server.stop().await.unwrap();
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_disk_with_less_room_than_configured_raises_an_alert_and_the_server_is_ready() {
    let clock = time("2026-11-01T00:00:00Z");
    let yard = Yard::start_with(clock, |config| {
        // More than any disk has.
        config.storage = StorageConfig {
            disk_free_min_mib: 1_000_000_000,
        };
    })
    .await;
    let (status, body) = yard.get_value("/readyz").await;
    assert_eq!(status, StatusCode::OK, "{body}");
    let (_status, body) = yard.get_value("/v1/alerts").await;
    assert_eq!(body["items"][0]["code"], "disk-low", "{body}");
    let (_status, status) = yard.get_value("/v1/server").await;
    assert_eq!(status["storage"]["disk_low"], true, "{status}");
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn who_was_signed_in_may_drive_and_stop_robots_while_nothing_can_be_read() {
    let clock = Clock::manual(time("2026-11-01T00:00:00Z"));
    let yard = Yard::start_on(clock.clone()).await;
    let robot = Robot::join(&yard, "rover-1").await;
    let (status, _body) = yard.get_value("/v1/server").await;
    assert_eq!(status, StatusCode::OK);
    // Beyond the time in which a token is not looked up again.
    clock.advance(std::time::Duration::from_mins(1));
    yard.server.app().db().close().await;
    let (status, body) = yard.get_value("/readyz").await;
    assert_eq!(status, StatusCode::SERVICE_UNAVAILABLE, "{body}");
    let mut socket = Socket::open(&yard, "rover-1").await;
    socket.acquire("desk").await;
    socket.drive(0.4).await;
    driven_at(&robot, 0.4).await;
    let path = "/v1/sites/yard/robots/rover-1/stop";
    let (status, stop) = yard.post(path, &serde_json::json!({})).await;
    assert_eq!(status, StatusCode::OK, "{stop}");
    assert_eq!(robot.stops().len(), 1);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_database_that_another_process_holds_refuses_writes_until_it_is_let_go() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let path = format!("sqlite:{}", database(yard.folder.path()).display());
    let mut other = SqliteConnection::connect(&path).await.unwrap();
    sqlx::query("BEGIN IMMEDIATE")
        .execute(&mut other)
        .await
        .unwrap();
    let stop = "/v1/sites/yard/robots/rover-1/stop";
    let (status, stopped) = yard.post(stop, &serde_json::json!({})).await;
    assert_eq!(status, StatusCode::OK, "{stopped}");
    let url = yard.url("/v1/missions");
    let asked = yard.client().post(url).json(&circle(&robot.id)).send();
    let refused = asked.await.unwrap();
    assert_eq!(refused.status(), StatusCode::SERVICE_UNAVAILABLE);
    assert!(refused.headers().contains_key("retry-after"));
    let (status, body) = yard.get_value("/readyz").await;
    assert_eq!(status, StatusCode::SERVICE_UNAVAILABLE, "{body}");
    sqlx::query("ROLLBACK").execute(&mut other).await.unwrap();
    let ready = eventually("the server is ready", async || {
        let (status, body) = yard.get_value("/readyz").await;
        if status == StatusCode::OK {
            Ok(())
        } else {
            Err(body)
        }
    });
    ready.await;
    yard.create_mission(&robot.id).await;
    drop(robot);
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_files_of_the_database_are_its_owners_whatever_the_umask_is() {
    // This test has a process of its own.
    nix::sys::stat::umask(nix::sys::stat::Mode::empty());
    let yard = Yard::start_joining_at(time("2026-11-01T00:00:00Z")).await;
    let (status, _) = yard
        .post("/v1/sites", &serde_json::json!({"id": "field"}))
        .await;
    assert_eq!(status, StatusCode::CREATED);
    let mut seen = Vec::new();
    let mut folders = vec![yard.folder.path().to_owned()];
    while let Some(folder) = folders.pop() {
        for file in std::fs::read_dir(folder).unwrap() {
            let path = file.unwrap().path();
            if path.is_dir() {
                folders.push(path);
                continue;
            }
            let name = path.file_name().unwrap().to_string_lossy().into_owned();
            let mode = std::fs::metadata(&path).unwrap().permissions().mode() & 0o777;
            // The authority's certificate is for everybody.
            let is_public = name == "ca.pem";
            assert!(is_public || mode == 0o600, "{name} has the mode {mode:o}");
            seen.push(name);
        }
    }
    for name in [
        "tread.db",
        "tread.db-wal",
        "tread.db-shm",
        "tread.db.lock",
        "ca.key",
    ] {
        assert!(seen.iter().any(|seen| seen == name), "{name}: {seen:?}");
    }
    yard.server.stop().await.unwrap();
}
