//! What a standby answers while another server has the database.

use std::io::{BufRead as _, BufReader, Write as _};
use std::net::SocketAddr;
use std::process::{Command, Stdio};
use std::time::Duration;

use reqwest::{Method, StatusCode, header};
use serde_json::{Value, json};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;
use tokio::runtime::Handle;
use tokio::task::JoinSet;
use tokio::time::Instant;
use tread_api::identity::Role;
use tread_api::ids::{MissionId, RobotId};
use tread_api::mission::{Mission, MissionDetail, MissionState};
use tread_server::app::identity::tokens::FirstAdmin;
use tread_server::clock::Clock;
use tread_server::config::{Config, MapConfig};
use tread_server::db::Location;
use tread_server::{RunningServer, Server};

use super::{Relay, address_of, created, server_of_tests};
use crate::drive::{Socket, driven_at};
use crate::events::{last_id, read_until, steps_in};
use crate::harness::{Yard, circle, client, config, eventually, measured, segment};
use crate::identity::browsers::{by_cookie, sign_in};
use crate::map_blocks::{PATHS, answers_at, assert_same, at, drive};
use crate::ports::free_address;
use crate::robot::Robot;

/// Time within which the map of a standby is that of the server after a receipt.
const FOLLOWED_MAX: Duration = Duration::from_secs(1);

/// Missions that are created while a stream of events begins.
const CONCURRENT: usize = 10;

/// A server with its standby.
struct Pair {
    yard: Yard,
    standby: String,
    config: Config,
    clock: Clock,
    /// Whether the server says that it is where nobody answers.
    is_alone: bool,
    client: reqwest::Client,
    /// What is compared.
    paths: Vec<&'static str>,
    taking_over: JoinSet<anyhow::Result<RunningServer>>,
}

impl Pair {
    /// Starts both; the server says of itself that it is at another address if one is given.
    async fn start(
        admin: &str,
        (clock, map): (Clock, MapConfig),
        advertised: Option<SocketAddr>,
    ) -> Self {
        Self::start_with(admin, (clock, map), advertised, |_| {}).await
    }

    /// The same, with a configuration of the standby's own.
    async fn start_with(
        admin: &str,
        (clock, map): (Clock, MapConfig),
        advertised: Option<SocketAddr>,
        change: impl FnOnce(&mut Config),
    ) -> Self {
        let folder = std::sync::Arc::new(tempfile::tempdir().unwrap());
        let mut config = config(folder.path(), "127.0.0.1:0");
        config.database = created(admin, folder.path());
        config.http = free_address();
        let is_alone = advertised.is_some();
        let advertised = advertised.unwrap_or(config.http);
        config.web.advertise_url = Some(format!("http://{advertised}").parse().unwrap());
        let mut of_standby = config.clone();
        config.map = MapConfig::default();
        let server = Server::start_with_clock(config, clock.clone()).await;
        let yard = Yard::of(folder, server.unwrap()).await;
        of_standby.standby = true;
        of_standby.http = free_address();
        of_standby.metrics = Some(free_address());
        of_standby.map = map;
        change(&mut of_standby);
        let mut pair = Self {
            client: client(Some(yard.admin())),
            paths: PATHS.into_iter().filter(|path| *path != "robots").collect(),
            yard,
            standby: format!("http://{}", of_standby.http),
            config: of_standby,
            clock,
            is_alone,
            taking_over: JoinSet::new(),
        };
        pair.start_standby().await;
        pair
    }

    async fn start_standby(&mut self) {
        let (config, clock) = (self.config.clone(), self.clock.clone());
        let runtime = Handle::current();
        self.taking_over
            .spawn_blocking(move || runtime.block_on(Server::start_with_clock(config, clock)));
        self.is_ready().await;
    }

    async fn is_ready(&self) {
        // A standby that cannot forward is not ready, and answers from its map all the same.
        let path = if self.is_alone {
            "/v1/sites/yard/friction/cells"
        } else {
            "/readyz"
        };
        let url = format!("{}{path}", self.standby);
        eventually("the standby is ready", async || {
            let answer = self.yard.client().get(&url).send().await;
            match answer {
                Ok(answer) if answer.status() == StatusCode::OK => Ok(()),
                other => Err(other.map(|answer| answer.status())),
            }
        })
        .await;
    }

    async fn send(&self, request: reqwest::RequestBuilder) -> (StatusCode, Value) {
        self.yard.send(request).await
    }

    /// Waits until the standby answers as the server does.
    async fn agree(&self, when: &str) {
        let (client, paths) = (&self.client, &self.paths);
        let expected = answers_at(client, &self.yard.url(""), paths).await;
        let begun = Instant::now();
        loop {
            let found = answers_at(client, &self.standby, paths).await;
            if found == expected || begun.elapsed() > FOLLOWED_MAX {
                assert_same(&found, &expected, when);
                return;
            }
            // The clock stands, and the map is followed by the machine's.
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    }
}

/// Changes the map in every way, and compares.
async fn maps_agree(map: MapConfig) {
    let Some(admin) = server_of_tests() else {
        return;
    };
    // Whatever is forwarded fails, so the standby's answers are its own.
    let mut pair = Pair::start(&admin, (Clock::manual(at()), map), Some(free_address())).await;
    let clock = pair.clock.clone();
    let yard = &pair.yard;
    drive(yard).await;
    pair.agree("after uploads").await;
    yard.server.app().write_sums().await.unwrap();
    pair.agree("after the sums were stored").await;
    clock.advance(Duration::from_secs(3));
    let robot = Robot::join(yard, "rover-3").await;
    for part in 0..6_u64 {
        let passes = (0..30).map(|number| {
            let seq = part * 30 + number;
            let place = i32::try_from(seq % 3).unwrap() * 19 - 90;
            let second = i64::try_from(seq).unwrap() * 60;
            measured(seq, segment((place, -75), 0.3, second))
        });
        robot.upload(passes.collect()).await.unwrap();
        if part % 2 == 1 {
            yard.server.app().write_sums().await.unwrap();
            clock.advance(Duration::from_secs(1));
        }
        pair.agree("between uploads and stored sums").await;
    }
    let path = "/v1/sites/yard/robots/rover-2/withdrawals";
    let begin = segment((0, 0), 0.2, 0).ended_at;
    let body = json!({"to": begin + jiff::SignedDuration::from_hours(4), "reason": "worn tyres"});
    let (status, said) = yard.post(path, &body).await;
    assert_eq!(status, StatusCode::CREATED, "{said}");
    pair.agree("after a withdrawal").await;
    // Hours become days, and tokens expire.
    clock.advance(Duration::from_hours(200 * 24));
    let again = FirstAdmin {
        name: "later".to_owned(),
        valid_days: 1,
        force: true,
    };
    let again = yard.server.app().create_first_admin(again).await.unwrap();
    pair.client = client(Some(&again.secret));
    let has_times = |path: &str| path.contains("as_of") || path.contains("from");
    pair.paths.retain(|path| !has_times(path));
    let yard = &pair.yard;
    yard.server.app().move_horizons().await.unwrap();
    while yard.server.app().merge_some(7).await.unwrap() {}
    pair.agree("after old hours were merged").await;
    let late = vec![measured(500, segment((3, 3), 0.25, 100_000))];
    robot.upload(late).await.unwrap();
    pair.agree("after a late upload").await;
    let status = pair.client.get(yard.url("/v1/server"));
    assert_eq!(pair.send(status).await.1["database"]["standbys"], 1);

    // It takes over with the map that it has, and stores what it had not to store before.
    let expected = answers_at(&pair.client, &pair.standby, &pair.paths).await;
    let Pair { yard, standby, .. } = pair;
    yard.server.stop().await.unwrap();
    let server = pair.taking_over.join_next().await.unwrap().unwrap();
    let server = server.unwrap();
    // The standby closes its connections.
    pair.client = client(Some(&again.secret));
    let found = answers_at(&pair.client, &standby, &pair.paths).await;
    assert_same(&found, &expected, "after it has taken over");
    server.app().write_sums().await.unwrap();
    let found = answers_at(&pair.client, &standby, &pair.paths).await;
    assert_same(&found, &expected, "after it has stored all sums");
    server.app().load_map().await.unwrap();
    let found = answers_at(&pair.client, &standby, &pair.paths).await;
    assert_same(&found, &expected, "as it reads the map again");
    server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_map_of_a_standby_is_that_of_the_server() {
    Box::pin(maps_agree(MapConfig::default())).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_standby_without_memory_for_its_map_reads_the_same_from_the_database() {
    Box::pin(maps_agree(MapConfig { memory_max_mib: 0 })).await;
}

/// The server counts its standby, which says how old its map is.
async fn both_have_metrics(pair: &Pair) {
    let Pair { yard, .. } = pair;
    let metrics = async |address: SocketAddr| {
        let url = format!("http://{address}/metrics");
        client(None)
            .get(url)
            .send()
            .await
            .unwrap()
            .text()
            .await
            .unwrap()
    };
    let of_server = metrics(yard.server.metrics_address().unwrap()).await;
    assert!(of_server.contains("\ntread_standbys 1\n"), "{of_server}");
    let of_standby = metrics(pair.config.metrics.unwrap()).await;
    assert!(
        of_standby.contains("\ntread_standby_map_age_seconds 0."),
        "{of_standby}"
    );
}

/// The server judges who may do what, and the standby knows it soon.
async fn the_server_judges(pair: &Pair) {
    let Pair { yard, .. } = pair;
    let by_admin = yard.client();
    let at = |path: &str| format!("{}{path}", pair.standby);
    let viewer = yard.token("screen", Role::Viewer).await;
    let as_viewer = client(Some(&viewer.secret));
    let refused = as_viewer
        .post(at("/v1/missions"))
        .json(&circle(&"rover-1".parse().unwrap()));
    assert_eq!(pair.send(refused).await.0, StatusCode::FORBIDDEN);
    let map_path = "/v1/sites/yard/friction/cells";
    assert_eq!(
        pair.send(as_viewer.get(at(map_path))).await.0,
        StatusCode::OK
    );
    let revoked = by_admin.delete(at(&format!("/v1/tokens/{}", viewer.token.id)));
    assert!(pair.send(revoked).await.0.is_success());
    let begun = Instant::now();
    eventually("the token is refused by the standby", async || {
        let (status, _) = pair.send(as_viewer.get(at(map_path))).await;
        (status == StatusCode::UNAUTHORIZED)
            .then_some(())
            .ok_or(status)
    })
    .await;
    assert!(begun.elapsed() <= FOLLOWED_MAX, "{:?}", begun.elapsed());
    let (status, _) = pair.send(client(None).get(at(map_path))).await;
    assert_eq!(status, StatusCode::UNAUTHORIZED);
    let cookie = sign_in(yard, yard.admin()).await;
    let sees = async || {
        let asked = client(None).get(at(map_path));
        pair.send(asked.header(header::COOKIE, &cookie)).await.0
    };
    assert_eq!(sees().await, StatusCode::OK);
    let out = by_cookie(yard, Method::DELETE, "/v1/session", &cookie);
    let out = out.header("sec-fetch-site", "same-origin");
    assert!(out.send().await.unwrap().status().is_success());
    let begun = Instant::now();
    eventually("the session is refused by the standby", async || {
        let status = sees().await;
        (status == StatusCode::UNAUTHORIZED)
            .then_some(())
            .ok_or(status)
    })
    .await;
    assert!(begun.elapsed() <= FOLLOWED_MAX, "{:?}", begun.elapsed());
    let (status, _) = pair.send(by_admin.get(at("/nothing/here"))).await;
    assert_eq!(status, StatusCode::NOT_FOUND);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_standby_that_has_lost_the_database_answers_nothing_by_itself() {
    let Some(admin) = server_of_tests() else {
        return;
    };
    let (_, server) = admin.rsplit_once('@').unwrap();
    let relay = Relay::to(server.split('/').next().unwrap().to_owned()).await;
    let through = |config: &mut Config| {
        let address = address_of(&config.database);
        let (user, rest) = address.rsplit_once('@').unwrap();
        let (_, name) = rest.split_once('/').unwrap();
        let through = format!("{user}@127.0.0.1:{}/{name}", relay.port);
        config.database = Location::Postgres(through);
    };
    let clock = Clock::system();
    let pair = Pair::start_with(&admin, (clock, MapConfig::default()), None, through);
    let pair = Box::pin(pair).await;
    let yard = &pair.yard;
    let viewer = yard.token("screen", Role::Viewer).await;
    let as_viewer = client(Some(&viewer.secret));
    let map = format!("{}/v1/sites/yard/friction/cells", pair.standby);
    assert_eq!(pair.send(as_viewer.get(&map)).await.0, StatusCode::OK);
    relay.is_open.send_replace(false);
    let ready = format!("{}/readyz", pair.standby);
    eventually("the standby is not ready", async || {
        let (status, body) = pair.send(as_viewer.get(&ready)).await;
        (status == StatusCode::SERVICE_UNAVAILABLE)
            .then_some(())
            .ok_or(body)
    })
    .await;
    // The server answers instead, and knows what has happened meanwhile.
    assert_eq!(pair.send(as_viewer.get(&map)).await.0, StatusCode::OK);
    let path = format!("/v1/tokens/{}", viewer.token.id);
    let revoked = yard.client().delete(yard.url(&path));
    assert!(pair.send(revoked).await.0.is_success());
    let (status, _) = pair.send(as_viewer.get(&map)).await;
    assert_eq!(status, StatusCode::UNAUTHORIZED);
    relay.is_open.send_replace(true);
    pair.is_ready().await;
    let begun = Instant::now();
    eventually("the token is refused by the standby", async || {
        let (status, _) = pair.send(as_viewer.get(&map)).await;
        (status == StatusCode::UNAUTHORIZED)
            .then_some(())
            .ok_or(status)
    })
    .await;
    assert!(begun.elapsed() <= FOLLOWED_MAX, "{:?}", begun.elapsed());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_request_that_a_standby_has_forwarded_already_is_not_forwarded_again() {
    let Some(admin) = server_of_tests() else {
        return;
    };
    let clock = Clock::system();
    let pair = Pair::start(&admin, (clock, MapConfig::default()), None).await;
    let asking = pair.client.get(format!("{}/v1/missions", pair.standby));
    let asking = asking.header("via", "1.1 tread-standby, 1.1 proxy.example.org");
    let (status, body) = pair.send(asking).await;
    assert_eq!(status, StatusCode::SERVICE_UNAVAILABLE, "{body}");
    let said = body["detail"].as_str().unwrap();
    assert!(said.contains("so is the server"), "{said}");
    for path in ["/v1/../v1/missions", "/v1/%2e%2e/metrics"] {
        let raw = raw_get(pair.config.http, path).await;
        assert!(raw.starts_with("HTTP/1.1 400 "), "{path}: {raw}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_standby_forwards_while_it_reads_the_map() {
    let Some(admin) = server_of_tests() else {
        return;
    };
    let mut pair = Pair::start(&admin, (Clock::system(), MapConfig::default()), None).await;
    // Another one cannot read sums for a while.
    let mut locking = Command::new("psql")
        .args([&address_of(&pair.config.database), "--quiet"])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let (mut asking, said) = (
        locking.stdin.take().unwrap(),
        locking.stdout.take().unwrap(),
    );
    let lock = "BEGIN; LOCK TABLE cell_sums IN ACCESS EXCLUSIVE MODE;\n\\echo locked\n";
    asking.write_all(lock.as_bytes()).unwrap();
    let mut line = String::new();
    BufReader::new(said).read_line(&mut line).unwrap();
    assert_eq!(line, "locked\n");
    pair.config.http = free_address();
    pair.config.metrics = None;
    pair.standby = format!("http://{}", pair.config.http);
    let (config, clock) = (pair.config.clone(), pair.clock.clone());
    let runtime = Handle::current();
    pair.taking_over
        .spawn_blocking(move || runtime.block_on(Server::start_with_clock(config, clock)));
    let sites = format!("{}/v1/sites", pair.standby);
    eventually("it forwards", async || {
        let answer = pair.yard.client().get(&sites).send().await;
        match answer {
            Ok(answer) if answer.status() == StatusCode::OK => Ok(()),
            other => Err(other.map(|answer| answer.status())),
        }
    })
    .await;
    let ready = pair.client.get(format!("{}/readyz", pair.standby));
    let (status, body) = pair.send(ready).await;
    assert_eq!(status, StatusCode::SERVICE_UNAVAILABLE, "{body}");
    asking.write_all(b"COMMIT;\n").unwrap();
    drop(asking);
    assert!(locking.wait().unwrap().success());
    pair.is_ready().await;
}

/// What a server answers to a path that no client library would send.
async fn raw_get(server: SocketAddr, path: &str) -> String {
    let mut stream = TcpStream::connect(server).await.unwrap();
    let request = format!("GET {path} HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n\r\n");
    stream.write_all(request.as_bytes()).await.unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).await.unwrap();
    answer
}

/// Goes on with the stream of events of a server that has ended, while others create missions: no step of a
/// mission is missing, and none comes twice.
async fn goes_on(
    by_admin: &reqwest::Client,
    standby: &str,
    (robot, read_before): (&RobotId, &str),
    mut created: Vec<MissionId>,
) {
    let create = || {
        let creating = by_admin.post(format!("{standby}/v1/missions"));
        let creating = creating.json(&circle(robot)).send();
        async { creating.await.unwrap().json::<Mission>().await.unwrap() }
    };
    // Others create missions while the client goes on.
    let mut creating: JoinSet<Mission> = (0..CONCURRENT).map(|_| create()).collect();
    let first = creating.join_next().await.unwrap().unwrap();
    created.push(first.id);
    let url = format!("{standby}/v1/events?topics=missions");
    let resumed = by_admin
        .get(url)
        .header("last-event-id", last_id(read_before));
    let mut resumed = resumed.send().await.unwrap();
    created.extend(
        creating
            .join_all()
            .await
            .into_iter()
            .map(|mission| mission.id),
    );
    let another = create().await;
    let mut rest = String::new();
    read_until(&mut resumed, &mut rest, |text| {
        let mut steps = steps_in(text).into_iter();
        steps.any(|step| step.mission == another.id)
    })
    .await;
    let mut steps = steps_in(read_before);
    steps.extend(steps_in(&rest));
    for id in created {
        let detail: MissionDetail = by_admin
            .get(format!("{standby}/v1/missions/{id}"))
            .send()
            .await
            .unwrap()
            .json()
            .await
            .unwrap();
        let read = steps.iter().filter(|step| step.mission == id);
        let read: Vec<_> = read.map(|step| step.step.clone()).collect();
        assert_eq!(read, detail.events, "no gap, and none twice");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_a_standby_cannot_answer_the_server_answers_until_the_standby_takes_over() {
    let Some(admin) = server_of_tests() else {
        return;
    };
    let map = MapConfig::default();
    let mut pair = Pair::start(&admin, (Clock::system(), map), None).await;
    let yard = &pair.yard;
    let by_admin = yard.client();
    let robot = Robot::join(yard, "rover-1").await;
    let other = Robot::join(yard, "rover-2").await;
    let at = |path: &str| format!("{}{path}", pair.standby);

    let mut stream = by_admin
        .get(at("/v1/events?topics=missions"))
        .send()
        .await
        .unwrap();
    assert_eq!(stream.headers()["content-type"], "text/event-stream");
    let created = by_admin.post(at("/v1/missions")).json(&circle(&robot.id));
    let (status, mission) = pair.send(created).await;
    assert_eq!(status, StatusCode::CREATED, "{mission}");
    let id = mission["id"].as_str().unwrap();
    yard.mission_becomes(id.parse().unwrap(), MissionState::Active)
        .await;
    let mut text = String::new();
    read_until(&mut stream, &mut text, |text| {
        text.contains("\"to\":\"active\"")
    })
    .await;
    let (status, found) = pair
        .send(by_admin.get(at(&format!("/v1/missions/{id}"))))
        .await;
    assert_eq!((status, &found["id"]), (StatusCode::OK, &mission["id"]));

    both_have_metrics(&pair).await;

    // Teleoperation and Stop go through it too.
    let mut socket = Socket::open_at(&pair.standby, "rover-2", yard.admin()).await;
    socket.acquire("desk").await;
    socket.drive(0.3).await;
    driven_at(&other, 0.3).await;
    let stop = by_admin
        .post(at("/v1/sites/yard/robots/rover-2/stop"))
        .json(&json!({}));
    let (status, stopped) = pair.send(stop).await;
    assert_eq!(status, StatusCode::OK, "{stopped}");
    drop(socket);

    the_server_judges(&pair).await;

    // What happens from here on, a client reads from the next server.
    let mut created: Vec<MissionId> = vec![id.parse().unwrap()];
    for _ in 0..3 {
        created.push(yard.create_mission(&robot.id).await.id);
    }
    let read_before = text;

    // It takes over at the same address.
    let Pair { yard, standby, .. } = pair;
    let admin = yard.admin().to_owned();
    yard.server.stop().await.unwrap();
    let server = pair
        .taking_over
        .join_next()
        .await
        .unwrap()
        .unwrap()
        .unwrap();
    let by_admin = client(Some(&admin));
    let found = by_admin
        .get(format!("{standby}/v1/missions/{id}"))
        .send()
        .await
        .unwrap();
    assert_eq!(found.status(), StatusCode::OK);
    assert_eq!(format!("http://{}", server.http_address()), standby);
    goes_on(&by_admin, &standby, (&robot.id, &read_before), created).await;
    server.stop().await.unwrap();
}
