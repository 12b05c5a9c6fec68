//! The same tests with PostgreSQL as the engine:
//! `TREAD_TEST_ENGINE=postgres store-postgres/with-postgres cargo nextest run -p tread-server --test server`.
//! Tests that look into a database file need the other engine.

mod outages;
mod standby;
mod standby_api;

use std::env;
use std::path::Path;
use std::process::Command;

use reqwest::StatusCode;
use serde_json::json;
use tokio::io::copy_bidirectional;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;
use tokio::task::JoinSet;
use tread_api::friction::StoredSegment;
use tread_api::mission::MissionState;
use tread_api::page::Page;
use tread_api::stop::Stop;
use tread_server::clock::Clock;
use tread_server::db::{self, Db, Location};

use crate::backups::{run, words};
use crate::drive::{Socket, driven_at};
use crate::engine;
pub(crate) use crate::engine::SERVER;
use crate::harness::{Yard, circle, eventually, measured, segment};
use crate::robot::Robot;

/// Returns the database that belongs to a folder, which is created when it is missing; `None` if the
/// tests run with SQLite.
pub(crate) fn database_of(folder: &Path) -> Option<Location> {
    engine::address_for(folder).map(Location::Postgres)
}

/// Returns the address of the server on which tests create databases; `None`, which it reports, without
/// one.
pub(crate) fn server_of_tests() -> Option<String> {
    let server = env::var(SERVER).ok();
    if server.is_none() {
        eprintln!("this test was NOT RUN: {SERVER} names no PostgreSQL server");
    }
    server
}

/// Returns a new database of a server, named after a folder.
pub(crate) fn created(admin: &str, folder: &Path) -> Location {
    Location::Postgres(engine::created(admin, folder))
}

/// Returns the address of a database on a server.
pub(crate) fn address_of(location: &Location) -> String {
    match location {
        Location::Postgres(address) => address.clone(),
        Location::File(_) => unreachable!("it is one of PostgreSQL"),
    }
}

/// A relay to the PostgreSQL server that can be cut.
struct Relay {
    port: u16,
    is_open: watch::Sender<bool>,
}

impl Relay {
    async fn to(server: String) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let port = listener.local_addr().unwrap().port();
        let (is_open, mut open) = watch::channel(true);
        #[expect(
            clippy::disallowed_methods,
            reason = "ends with the test, whose process has nothing else"
        )]
        tokio::spawn(async move {
            let mut relayed = JoinSet::new();
            while let Ok((mut client, _)) = listener.accept().await {
                if !*open.borrow_and_update() {
                    continue;
                }
                let (server, mut open) = (server.clone(), open.clone());
                relayed.spawn(async move {
                    let mut server = TcpStream::connect(server).await.unwrap();
                    tokio::select! {
                        _ = copy_bidirectional(&mut client, &mut server) => {}
                        _ = open.wait_for(|is_open| !is_open) => {}
                    }
                });
            }
        });
        Self { port, is_open }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn robots_are_driven_and_stopped_while_postgresql_is_away_and_nothing_acknowledged_is_lost() {
    let Some(admin) = server_of_tests() else {
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let address = address_of(&created(&admin, folder.path()));
    let (user, rest) = address.rsplit_once('@').unwrap();
    let (server, name) = rest.split_once('/').unwrap();
    let relay = Relay::to(server.to_owned()).await;
    let through = format!("{user}@127.0.0.1:{}/{name}", relay.port);
    let yard = Yard::start_configured(|config, _| config.database = Location::Postgres(through));
    let yard = yard.await;
    let robot = Robot::join(&yard, "rover-1").await;
    let mission = yard.create_mission(&robot.id).await;
    yard.mission_becomes(mission.id, MissionState::Active).await;
    let other = Robot::join(&yard, "rover-2").await;
    let mut socket = Socket::open(&yard, "rover-2").await;
    robot
        .upload(vec![measured(1, segment((2, 2), 0.2, 10))])
        .await
        .unwrap();

    relay.is_open.send_replace(false);
    let away = eventually("the server notices", async || {
        let (status, body) = yard.get_value("/readyz").await;
        (status == StatusCode::SERVICE_UNAVAILABLE)
            .then_some(())
            .ok_or(body)
    });
    away.await;
    socket.acquire("desk").await;
    socket.drive(0.4).await;
    driven_at(&other, 0.4).await;
    let (status, stop) = yard
        .post("/v1/sites/yard/robots/rover-2/stop", &json!({}))
        .await;
    assert_eq!(status, StatusCode::OK, "{stop}");
    let url = yard.url("/v1/missions");
    let refused = yard
        .client()
        .post(url)
        .json(&circle(&other.id))
        .send()
        .await
        .unwrap();
    assert_eq!(refused.status(), StatusCode::SERVICE_UNAVAILABLE);
    // The robot keeps a measurement that is not acknowledged.
    let second = vec![measured(2, segment((2, 2), 0.2, 20))];
    robot.upload(second.clone()).await.unwrap_err();

    relay.is_open.send_replace(true);
    let back = eventually("the server is ready", async || {
        let (status, body) = yard.get_value("/readyz").await;
        (status == StatusCode::OK).then_some(()).ok_or(body)
    });
    back.await;
    eventually("the measurement is taken", async || {
        robot.upload(second.clone()).await
    })
    .await;
    let detail = yard.mission(mission.id).await;
    assert_eq!(detail.mission.state, MissionState::Active, "{detail:?}");
    let stored: Page<StoredSegment> = yard.get("/v1/sites/yard/segments?limit=10").await;
    assert_eq!(stored.items.len(), 2);
    let stops: Page<Stop> = yard.get("/v1/stops?in_force=true").await;
    assert_eq!(stops.items.len(), 1);
    drop((robot, other));
    yard.server.stop().await.unwrap();
}

/// Runs a program of PostgreSQL's.
fn tool(name: &str, arguments: &[&str]) {
    let ran = Command::new(name).args(arguments).output().unwrap();
    let said = String::from_utf8_lossy(&ran.stderr);
    assert!(ran.status.success(), "{name}: {said}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_dump_is_restored_into_another_database_and_holds_the_robots_once_it_is_marked() {
    let Some(admin) = server_of_tests() else {
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let (first, second) = (
        created(&admin, &folder.path().join("first")),
        created(&admin, &folder.path().join("second")),
    );
    let used = first.clone();
    let yard = Yard::start_configured(|config, _| config.database = used).await;
    let robot = Robot::join(&yard, "rover-1").await;
    let mission = yard.create_mission(&robot.id).await;
    let taken_at = Clock::system().now().to_string();
    let run = async |arguments: Vec<String>| {
        let running = tokio::task::spawn_blocking(move || {
            let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
            run(&arguments)
        });
        running.await.unwrap()
    };
    let mark = |location: &Location, at: &str| {
        [
            "mark-restored",
            "--database",
            &address_of(location),
            "--taken-at",
            at,
        ]
        .map(str::to_owned)
        .to_vec()
    };
    let refused = words(&run(mark(&first, &taken_at)).await);
    assert!(refused.contains("a server uses the database"), "{refused}");
    drop(robot);
    yard.server.stop().await.unwrap();

    let dump = folder.path().join("fleet.dump").display().to_string();
    tool(
        "pg_dump",
        &["--format=custom", "--file", &dump, &address_of(&first)],
    );
    tool(
        "pg_restore",
        &["--no-owner", "--dbname", &address_of(&second), &dump],
    );
    let future = words(&run(mark(&second, "2999-01-01T00:00:00Z")).await);
    assert!(future.contains("yet to come"), "{future}");
    let marked = run(mark(&second, &taken_at)).await;
    let said = words(&marked);
    assert!(marked.status.success(), "{said}");
    assert!(said.contains("tread robots release --all"), "{said}");
    assert!(
        !said.contains(admin.split(['/', ':', '@']).nth(4).unwrap()),
        "{said}"
    );
    let database = Db::open(&second).await.unwrap();
    let mut tx = database.read("test").await.unwrap();
    assert_eq!(db::restorations::awaiting_count(&mut tx).await.unwrap(), 1);
    let found = db::missions::find(&mut tx, mission.id).await.unwrap();
    assert_eq!(found.unwrap().mission.trajectory, mission.trajectory);
    drop(tx);
    database.close().await;
    let checked = ["migrate", "--check", "--database", &address_of(&second)].map(str::to_owned);
    let checked = run(checked.to_vec()).await;
    assert_eq!(checked.status.code(), Some(0), "{}", words(&checked));
    let copied = ["backup", "--to", &dump, "--database", &address_of(&second)].map(str::to_owned);
    let copied = words(&run(copied.to_vec()).await);
    assert!(copied.contains("docs/postgresql.md"), "{copied}");
}
