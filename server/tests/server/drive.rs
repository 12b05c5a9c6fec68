//! Teleoperation over the WebSocket: one driver, observers, and a robot that stands whenever
//! anything about its driver is wrong.

use std::time::Duration;

use futures_util::{SinkExt as _, StreamExt as _};
use serde_json::{Value, json};
use sqlx::{Connection as _, SqliteConnection};
use tokio::net::TcpStream;
use tokio_tungstenite::tungstenite::{ClientRequestBuilder, Message};
use tokio_tungstenite::{MaybeTlsStream, WebSocketStream, connect_async};
use tread_api::drive::{DriveRefusal, DriveUpdate, DriveView, ReleaseCause};
use tread_api::geometry::Twist;
use tread_api::identity::Role;
use tread_api::mission::MissionState;
use tread_api::rights::Right;
use tread_api::safety::Lease;
use tread_api::wire::safety::LeaseCommand;
use tread_server::app::teleop::SESSIONS_PER_IDENTITY_MAX;

use crate::harness::{PATIENCE, Yard, database, eventually, time};
use crate::robot::Robot;

fn request(yard: &Yard, robot: &str, token: &str) -> ClientRequestBuilder {
    request_at(&yard.url(""), robot, token)
}

fn request_at(server: &str, robot: &str, token: &str) -> ClientRequestBuilder {
    let url = format!("{server}/v1/sites/yard/robots/{robot}/drive");
    let url = url.replace("http://", "ws://").parse().unwrap();
    ClientRequestBuilder::new(url).with_header("authorization", format!("Bearer {token}"))
}

/// A client of the drive socket.
pub(crate) struct Socket(WebSocketStream<MaybeTlsStream<TcpStream>>);

impl Socket {
    pub(crate) async fn open(yard: &Yard, robot: &str) -> Self {
        Self::open_as(yard, robot, yard.admin()).await
    }

    async fn open_as(yard: &Yard, robot: &str, token: &str) -> Self {
        Self::open_at(&yard.url(""), robot, token).await
    }

    /// The same at the URL of a server.
    pub(crate) async fn open_at(server: &str, robot: &str, token: &str) -> Self {
        let (socket, _) = connect_async(request_at(server, robot, token))
            .await
            .unwrap();
        let mut socket = Self(socket);
        let first = socket.update().await;
        assert!(matches!(first, DriveUpdate::Welcome { .. }), "{first:?}");
        socket
    }

    async fn send(&mut self, request: &Value) {
        self.put(Message::text(request.to_string())).await;
    }

    async fn put(&mut self, message: Message) {
        self.0.send(message).await.unwrap();
    }

    /// The next frame that is no view and no ping.
    async fn update(&mut self) -> DriveUpdate {
        let reading = async {
            loop {
                if let Message::Text(text) = self.0.next().await.unwrap().unwrap() {
                    let update = serde_json::from_str(&text).unwrap();
                    if !matches!(update, DriveUpdate::View(_)) {
                        return update;
                    }
                }
            }
        };
        tokio::time::timeout(PATIENCE, reading).await.unwrap()
    }

    async fn view(&mut self, is: impl Fn(&DriveView) -> bool) -> DriveView {
        let reading = async {
            loop {
                if let Some(Ok(Message::Text(text))) = self.0.next().await
                    && let DriveUpdate::View(view) = serde_json::from_str(&text).unwrap()
                    && is(&view)
                {
                    return *view;
                }
            }
        };
        tokio::time::timeout(PATIENCE, reading).await.unwrap()
    }

    /// Reads all that comes until the socket ends.
    pub(crate) async fn stay(mut self) {
        while let Some(Ok(_)) = self.0.next().await {}
    }

    /// Waits for the server's close, and gives its code.
    async fn closed(&mut self) -> u16 {
        let reading = async {
            loop {
                match self.0.next().await {
                    Some(Ok(Message::Close(Some(frame)))) => return u16::from(frame.code),
                    Some(Ok(_)) => {}
                    other => panic!("ended without a code: {other:?}"),
                }
            }
        };
        tokio::time::timeout(PATIENCE, reading).await.unwrap()
    }

    pub(crate) async fn acquire(&mut self, name: &str) -> Lease {
        // End times are in the robot's time, which its states carry.
        self.view(|view| view.state_age_ms.is_some()).await;
        self.send(&json!({"acquire": {"name": name}})).await;
        let update = self.update().await;
        let DriveUpdate::Leased(lease) = update else {
            panic!("{update:?}");
        };
        lease
    }

    pub(crate) async fn drive(&mut self, linear_m_s: f64) {
        let drive = json!({"linear_m_s": linear_m_s, "angular_rad_s": 0.1, "for_ms": 300});
        self.send(&json!({"drive": drive})).await;
    }
}

pub(crate) async fn driven_at(robot: &Robot, linear_m_s: f64) {
    let what = format!("the robot is commanded {linear_m_s} m/s");
    eventually(&what, async || {
        let is = is_driven_at(robot, linear_m_s);
        let last = robot.drives().last().map(|command| command.twist);
        if is { Ok(()) } else { Err(last) }
    })
    .await;
}

fn is_driven_at(robot: &Robot, linear_m_s: f64) -> bool {
    let drives = robot.drives();
    let last = drives.last().map(|command| command.twist.linear_m_s);
    last.is_some_and(|last| (last - linear_m_s).abs() < 1e-9)
}

/// Waits until the robot's newest command is to stand and its lease is given back.
async fn stands(robot: &Robot) {
    driven_at(robot, 0.0).await;
    eventually("the lease is given back", async || {
        match robot.leases().pop() {
            Some(LeaseCommand::Release(_)) => Ok(()),
            other => Err(other),
        }
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_driver_drives_in_robot_time_and_losing_the_driver_lets_the_robot_stand() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let mission = yard.create_mission(&robot.id).await;
    yard.mission_becomes(mission.id, MissionState::Active).await;
    let mut observer = Socket::open(&yard, "rover-1").await;
    let mut driver = Socket::open(&yard, "rover-1").await;
    driver.view(|view| view.state_age_ms.is_some()).await;
    let lease = driver.acquire("Ann").await;
    assert_eq!((lease.epoch, lease.driver.name.as_str()), (1, "tests: Ann"));
    driver.drive(0.4).await;
    driven_at(&robot, 0.4).await;
    let state = robot.state();
    let command = robot.drives()[0];
    assert_eq!(
        (command.boot, command.epoch, command.seq),
        (robot.boot, 1, 1)
    );
    assert_eq!(command.until_us - command.sent_us, 300_000);
    let now_us = state.monotonic_us.unwrap();
    assert!(
        command.sent_us <= now_us + 100_000,
        "{command:?} at {now_us}"
    );
    assert!(command.twist.angular_rad_s > 0.0);
    driver.drive(0.5).await;
    driven_at(&robot, 0.5).await;
    assert!(robot.drives().last().unwrap().seq > command.seq);
    // The active mission is held.
    let held = yard.mission_becomes(mission.id, MissionState::Paused).await;
    assert!(held.mission.pause_requested);
    let resume = format!("/v1/missions/{}/resume", mission.id);
    let (status, body) = yard.post(&resume, &Value::Null).await;
    assert_eq!(status, 409, "{body}");
    assert!(body["detail"].as_str().unwrap().contains("Ann"), "{body}");

    // The other one sees it, may not drive, and its end changes nothing.
    let seen = observer.view(|view| view.safety.lease.is_some()).await;
    assert_eq!(seen.safety.lease.unwrap().driver.name, "tests: Ann");
    observer.drive(1.0).await;
    let refused = observer.update().await;
    assert!(matches!(
        refused,
        DriveUpdate::Refused {
            cause: DriveRefusal::NoLease,
            ..
        }
    ));
    observer.send(&json!({"acquire": {"name": "Bob"}})).await;
    let update = observer.update().await;
    let DriveUpdate::Refused { cause, detail } = update else {
        panic!("{update:?}");
    };
    assert_eq!(cause, DriveRefusal::Leased);
    assert!(detail.contains("Ann"), "{detail}");

    drop(observer);
    driver.drive(0.3).await;
    driven_at(&robot, 0.3).await;
    assert!(
        robot
            .leases()
            .iter()
            .all(|lease| matches!(lease, LeaseCommand::Acquire(acquire) if !acquire.take))
    );

    // Without a word: the connection breaks.
    drop(driver);
    stands(&robot).await;
    assert_eq!(robot.drives().last().unwrap().twist, Twist::default());
    assert_eq!(yard.counters().await.drivers_lost, 1);
    // The mission goes on only by request.
    assert_eq!(
        yard.mission(mission.id).await.mission.state,
        MissionState::Paused
    );
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_frame_that_makes_no_sense_closes_the_socket_with_a_code_and_the_robot_stands() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let long = format!("{{\"acquire\": {{\"name\": \"{}\"}}}}", "x".repeat(5_000));
    let nan = r#"{"drive": {"linear_m_s": NaN, "angular_rad_s": 0}}"#;
    let infinite = r#"{"drive": {"linear_m_s": 1e999, "angular_rad_s": 0}}"#;
    let null = r#"{"drive": {"linear_m_s": null, "angular_rad_s": 0}}"#;
    let extra = r#"{"drive": {"linear_m_s": 1, "angular_rad_s": 0, "faster": true}}"#;
    for (frame, code) in [
        (Message::text("{\"drive\":"), 1007),
        (Message::text(nan), 1007),
        (Message::text(infinite), 1008),
        (Message::text(null), 1008),
        (Message::text(extra), 1008),
        (Message::text("{\"fly\": {}}"), 1008),
        (Message::text("[]"), 1008),
        (Message::binary(vec![1, 2, 3]), 1003),
        (Message::text(long), 1009),
    ] {
        let mut driver = Socket::open(&yard, "rover-1").await;
        driver.acquire("Ann").await;
        driver.drive(0.5).await;
        driven_at(&robot, 0.5).await;
        let what = format!("{frame:?}").chars().take(60).collect::<String>();
        driver.put(frame).await;
        assert_eq!(driver.closed().await, code, "{what}");
        stands(&robot).await;
    }
    assert!(yard.counters().await.drive_frames_refused >= 9);
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_lease_is_taken_by_force_given_back_and_lost_with_the_robots_run() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let mut ann = Socket::open(&yard, "rover-1").await;
    let mut bob = Socket::open(&yard, "rover-1").await;
    ann.acquire("Ann").await;
    bob.send(&json!({"take": {"name": "Bob"}})).await;
    let DriveUpdate::Leased(lease) = bob.update().await else {
        panic!("not leased");
    };
    assert_eq!(lease.epoch, 2);
    let update = ann.update().await;
    let DriveUpdate::Released { cause, detail } = update else {
        panic!("{update:?}");
    };
    assert_eq!(cause, ReleaseCause::Taken);
    assert!(detail.contains("Bob"), "{detail}");

    ann.drive(0.9).await;
    assert!(matches!(
        ann.update().await,
        DriveUpdate::Refused {
            cause: DriveRefusal::NoLease,
            ..
        }
    ));
    bob.drive(0.2).await;
    driven_at(&robot, 0.2).await;
    bob.send(&json!({"release": {}})).await;
    let released = bob.update().await;
    assert!(matches!(
        released,
        DriveUpdate::Released {
            cause: ReleaseCause::Released,
            ..
        }
    ));
    stands(&robot).await;
    assert_eq!(yard.counters().await.drivers_lost, 0);

    ann.acquire("Ann").await;
    let robot = robot.reboot(&yard).await;
    let lost = ann.update().await;
    assert!(
        matches!(
            lost,
            DriveUpdate::Released {
                cause: ReleaseCause::Lost,
                ..
            }
        ),
        "{lost:?}"
    );
    drop(robot);
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn anybody_on_the_socket_may_stop_and_a_server_that_stops_lets_the_robot_stand() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let mut observer = Socket::open(&yard, "rover-1").await;
    observer
        .send(&json!({"stop": {"by": "Bob", "reason": "smoke"}}))
        .await;
    let update = observer.update().await;
    let DriveUpdate::Stopped(stop) = update else {
        panic!("{update:?}");
    };
    assert!(stop.confirmed_at.is_some(), "{stop:?}");
    assert_eq!(robot.stops()[0].reason, "smoke");
    // A lease is given, and nothing is driven: the driver hears why.
    let mut driver = Socket::open(&yard, "rover-1").await;
    driver.view(|view| view.safety.stop.is_some()).await;
    driver.acquire("Ann").await;
    driver.drive(0.5).await;
    let refused = driver.update().await;
    assert!(matches!(
        refused,
        DriveUpdate::Refused {
            cause: DriveRefusal::Stopped,
            ..
        }
    ));
    yard.server.stop().await.unwrap();
    assert_eq!(driver.closed().await, 1001);
    stands(&robot).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn of_a_flood_of_commands_the_newest_counts_and_a_plain_request_is_refused_with_the_reason() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let mut driver = Socket::open(&yard, "rover-1").await;
    driver.acquire("Ann").await;
    let drive = |number: u32| {
        let linear_m_s = f64::from(number) * 1e-4;
        let drive = json!({"linear_m_s": linear_m_s, "angular_rad_s": 0.0});
        Message::text(json!({"drive": drive}).to_string())
    };
    for number in 0..2_000 {
        driver.0.feed(drive(number)).await.unwrap();
    }
    driver.0.flush().await.unwrap();
    // Like every client it goes on: a link that is full drops commands rather than queue them.
    let mut fed = 2_000;
    eventually("the robot gets the newest command", async || {
        if is_driven_at(&robot, 0.1999) {
            return Ok(());
        }
        driver.put(drive(1_999)).await;
        fed += 1;
        Err(robot.drives().last().map(|command| command.seq))
    })
    .await;
    let seqs: Vec<u64> = robot.drives().iter().map(|command| command.seq).collect();
    assert!(seqs.is_sorted());
    let replaced = eventually("every command is counted once", async || {
        let counters = yard.counters().await;
        let counted = counters.drive_commands_sent + counters.drive_commands_replaced;
        if counted == fed {
            Ok(counters.drive_commands_replaced)
        } else {
            Err(counted)
        }
    })
    .await;
    assert!(replaced > 0);
    let (status, body) = yard.get_value("/v1/sites/yard/robots/rover-1/drive").await;
    assert_eq!(
        (status.as_u16(), body["type"].as_str()),
        (400, Some("/problems/invalid-header"))
    );
    let nobody = request(&yard, "nobody", yard.admin());
    assert!(
        connect_async(nobody).await.is_err(),
        "a robot that is not known was driven"
    );
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_viewer_watches_and_stops_but_does_not_drive_and_a_revoked_token_ends_the_socket() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let viewer = yard.token("eyes", Role::Viewer).await;
    let mut socket = Socket::open_as(&yard, robot.id.as_str(), &viewer.secret).await;
    socket.send(&json!({"acquire": {"name": "Eve"}})).await;
    let refused = socket.update().await;
    assert!(
        matches!(
            refused,
            DriveUpdate::Refused {
                cause: DriveRefusal::Forbidden,
                ..
            }
        ),
        "{refused:?}"
    );
    let rights = [Right::Dispatch, Right::ClearStop];
    let dispatcher = yard.limited("desk", &rights, &[]).await;
    let mut desk = Socket::open_as(&yard, "rover-1", &dispatcher).await;
    desk.send(&json!({"take": {"name": "Dan"}})).await;
    let refused = desk.update().await;
    assert!(
        matches!(refused, DriveUpdate::Refused { .. }),
        "{refused:?}"
    );
    let driver = yard
        .limited("hands", &[Right::Drive], &["yard/rover-1"])
        .await;
    let mut hands = Socket::open_as(&yard, "rover-1", &driver).await;
    hands.acquire("Ann").await;
    hands.send(&json!({"release": {}})).await;
    socket.send(&json!({"stop": {}})).await;
    let DriveUpdate::Stopped(stop) = socket.update().await else {
        panic!("a viewer could not stop");
    };
    assert_eq!(stop.by, "eyes", "the token's name says who");
    let revoke = yard
        .client()
        .delete(yard.url(&format!("/v1/tokens/{}", viewer.token.id)));
    assert!(yard.send(revoke).await.0.is_success());
    assert_eq!(socket.closed().await, 1008);
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_lease_holds_missions_from_its_grant_not_from_the_first_state_that_shows_it() {
    let yard = Yard::start_at(time("2026-11-01T00:00:00Z")).await;
    let robot = Robot::join(&yard, "rover-1").await;
    let first = yard.create_mission(&robot.id).await;
    yard.mission_becomes(first.id, MissionState::Active).await;
    robot.show_no_lease();
    let mut driver = Socket::open(&yard, "rover-1").await;
    driver.acquire("Ann").await;
    eventually("the mission is held", async || {
        let held = yard.mission(first.id).await.mission;
        if held.pause_requested {
            Ok(())
        } else {
            Err(held)
        }
    })
    .await;
    let resume = format!("/v1/missions/{}/resume", first.id);
    let (status, body) = yard.post(&resume, &Value::Null).await;
    assert_eq!(status, 409, "{body}");
    assert!(body["detail"].as_str().unwrap().contains("Ann"), "{body}");
    let second = yard.create_mission(&robot.id).await;
    assert!(second.pause_requested);
    assert_eq!(second.state, MissionState::Queued);

    // With the lease ends what it prevented.
    driver.send(&json!({"release": {}})).await;
    stands(&robot).await;
    eventually("the mission may be resumed", async || {
        let (status, body) = yard.post(&resume, &Value::Null).await;
        if status == 202 {
            Ok(())
        } else {
            Err((status, body))
        }
    })
    .await;
    assert!(!yard.mission(first.id).await.mission.pause_requested);
    assert!(yard.mission(second.id).await.mission.pause_requested);
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn missions_are_held_for_a_driver_also_if_that_cannot_be_written_down_at_first() {
    /// Longer than the server waits to write.
    const LOCKED_FOR: Duration = Duration::from_secs(12);
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let mission = yard.create_mission(&robot.id).await;
    yard.mission_becomes(mission.id, MissionState::Active).await;
    let mut socket = Socket::open(&yard, "rover-1").await;
    let path = format!("sqlite:{}", database(yard.folder.path()).display());
    let mut other = SqliteConnection::connect(&path).await.unwrap();
    sqlx::query("BEGIN IMMEDIATE")
        .execute(&mut other)
        .await
        .unwrap();
    socket.acquire("desk").await;
    tokio::time::sleep(LOCKED_FOR).await;
    assert!(!yard.mission(mission.id).await.mission.pause_requested);
    sqlx::query("ROLLBACK").execute(&mut other).await.unwrap();
    eventually("the mission is held", async || {
        let detail = yard.mission(mission.id).await;
        if detail.mission.pause_requested {
            Ok(())
        } else {
            Err(detail)
        }
    })
    .await;
    drop(socket);
    drop(robot);
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_viewer_holds_its_share_of_the_sockets_and_no_more() {
    let yard = Yard::start().await;
    let _robot = Robot::join(&yard, "rover-1").await;
    let viewer = yard.token("screen", Role::Viewer).await.secret;
    let mut held = Vec::new();
    for _ in 0..SESSIONS_PER_IDENTITY_MAX {
        held.push(Socket::open_as(&yard, "rover-1", &viewer).await);
    }
    let refused = connect_async(request(&yard, "rover-1", &viewer)).await;
    let said = refused.map(|_| ()).unwrap_err().to_string();
    assert!(said.contains("409"), "{said}");
    // Whoever drives is not concerned.
    let _driver = Socket::open(&yard, "rover-1").await;
    drop(held.pop());
    eventually("the place is free again", async || {
        let again = connect_async(request(&yard, "rover-1", &viewer)).await;
        again.map(|_| ()).map_err(|error| error.to_string())
    })
    .await;
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_list_is_no_command_and_a_stop_is_one_whatever_is_wrong_with_it() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    for frame in [
        json!({"drive": [1.0, 2.0, 250]}),
        json!({"acquire": ["Ann"]}),
        json!({"take": ["Ann"]}),
        json!({"release": []}),
        json!({"drive": {"linear_m_s": [1.0], "angular_rad_s": 0.0}}),
        json!([{"release": {}}]),
    ] {
        let mut socket = Socket::open(&yard, "rover-1").await;
        socket.send(&frame).await;
        let update = socket.update().await;
        assert!(
            matches!(update, DriveUpdate::Ended { .. }),
            "{frame}: {update:?}"
        );
    }
    assert!(robot.leases().is_empty() && robot.drives().is_empty());
    for (count, frame) in [
        json!({"stop": [1, 2]}),
        json!({"stop": {"reason": 5, "loud": true}}),
        json!({"stop": {}, "drive": {}}),
    ]
    .into_iter()
    .enumerate()
    {
        let mut socket = Socket::open(&yard, "rover-1").await;
        socket.send(&frame).await;
        let update = socket.update().await;
        assert!(
            matches!(update, DriveUpdate::Stopped(_)),
            "{frame}: {update:?}"
        );
        assert_eq!(robot.stops().len(), count + 1, "{frame}");
    }
    yard.server.stop().await.unwrap();
}
