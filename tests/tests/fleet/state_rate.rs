//! Robots that somebody watches publish their state more often; the others cost nothing more.

use std::collections::HashMap;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use futures_util::StreamExt as _;
use tokio::task::JoinSet;
use tokio::time::Instant;
use tokio_tungstenite::connect_async;
use tokio_tungstenite::tungstenite::ClientRequestBuilder;
use tread_api::ids::RobotId;
use tread_api::keys::{self, Key};
use tread_api::robot::Alert;
use tread_server::app::watched::REQUEST_DURATION;
use tread_tests::fleet::{Fleet, SITE};
use tread_tests::wait::{SHORT, eventually};
use zenoh::Wait as _;

use crate::fleet;

/// Rate of states that a watched robot reaches, Hz.
const WATCHED_MIN_HZ: f64 = 8.0;
/// Rate of states that no unwatched robot exceeds, Hz: five, and what a busy machine delays.
const UNWATCHED_MAX_HZ: f64 = 6.0;
/// Time within which a robot that is watched publishes more often.
const RAISED_WITHIN: Duration = Duration::from_secs(2);
/// Span over which a rate is measured.
const SPAN: Duration = Duration::from_secs(1);
/// Longest time after the last request after which the rate is measured as the robot's own.
const BACK_WITHIN: Duration = REQUEST_DURATION.saturating_add(Duration::from_secs(3));

/// Arrivals of states at the server's router, by robot.
#[derive(Debug, Clone, Default)]
struct Arrivals(Arc<Mutex<HashMap<RobotId, Vec<Instant>>>>);

impl Arrivals {
    fn count(&self, robot: &RobotId, from: Instant, to: Instant) -> usize {
        let arrivals = self.0.lock().unwrap();
        let all = arrivals.get(robot).map_or(&[][..], Vec::as_slice);
        all.iter().filter(|at| (from..to).contains(*at)).count()
    }

    /// The rate over the last [`SPAN`], Hz.
    fn rate_hz(&self, robot: &RobotId) -> f64 {
        let now = Instant::now();
        let count = self.count(robot, now - SPAN, now);
        f64::from(u32::try_from(count).unwrap()) / SPAN.as_secs_f64()
    }

    /// Waits until a robot's rate is as wanted, and returns how long that took.
    async fn until(
        &self,
        what: &str,
        bound: Duration,
        robot: &RobotId,
        holds: impl Fn(f64) -> bool,
    ) -> Duration {
        let begin = Instant::now();
        let look = || async { self.rate_hz(robot) };
        eventually(what, bound, look, |&rate_hz| holds(rate_hz)).await;
        begin.elapsed()
    }
}

/// Listens at the server's router, until the session is dropped.
async fn listen(fleet: &Fleet) -> (zenoh::Session, Arrivals) {
    let mut config = zenoh::Config::default();
    let endpoint = format!("[\"{}\"]", fleet.zenoh_endpoint());
    for (key, value) in [
        ("mode", "\"client\""),
        ("connect/endpoints", endpoint.as_str()),
        (
            "connect/retry",
            "{ period_init_ms: 50, period_max_ms: 200, period_increase_factor: 1.5 }",
        ),
        ("scouting/multicast/enabled", "false"),
        ("scouting/gossip/enabled", "false"),
    ] {
        config.insert_json5(key, value).unwrap();
    }
    let arrivals = Arrivals::default();
    let to = arrivals.clone();
    let opening = tokio::task::spawn_blocking(move || {
        let session = zenoh::open(config).wait().unwrap();
        session
            .declare_subscriber(format!("{}/{SITE}/robots/*/state", keys::ROOT))
            .callback(move |sample| {
                if let Some(Key::State(_, robot)) = Key::parse(sample.key_expr().as_str()) {
                    let mut arrivals = to.0.lock().unwrap();
                    arrivals.entry(robot).or_default().push(Instant::now());
                }
            })
            .background()
            .wait()
            .unwrap();
        session
    });
    (opening.await.unwrap(), arrivals)
}

/// Watches a robot by a drive socket, until the result is dropped.
async fn watch(fleet: &Fleet, robot: &RobotId) -> JoinSet<()> {
    let address = fleet.http_address();
    let url = format!("ws://{address}/v1/sites/{SITE}/robots/{robot}/drive");
    let request = ClientRequestBuilder::new(url.parse().unwrap())
        .with_header("authorization", format!("Bearer {}", fleet.token()));
    let (mut socket, _) = connect_async(request).await.unwrap();
    let mut reading = JoinSet::new();
    reading.spawn(async move { while let Some(Ok(_)) = socket.next().await {} });
    reading
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_watched_robot_publishes_at_ten_hertz_and_no_other_does() {
    let mut fleet = fleet().await;
    let [watched, other]: [RobotId; 2] = ["rover-1", "rover-2"].map(|id| id.parse().unwrap());
    fleet.start_agent(&watched, 0.0).await;
    fleet.start_agent(&other, 5.0).await;
    let (session, arrivals) = listen(&fleet).await;
    let is_raised = |rate_hz: f64| rate_hz >= WATCHED_MIN_HZ;
    let is_own = |rate_hz: f64| (3.0..=UNWATCHED_MAX_HZ).contains(&rate_hz);
    arrivals
        .until("its own rate", SHORT, &watched, is_own)
        .await;
    let begin = Instant::now();

    let first = watch(&fleet, &watched).await;
    let took = arrivals
        .until("a higher rate", SHORT, &watched, is_raised)
        .await;
    assert!(took <= RAISED_WITHIN, "{took:?}");
    let second = watch(&fleet, &watched).await;
    drop(first);
    // The second one keeps it, longer than any single request lasts.
    let (raised, end) = (Instant::now(), Instant::now() + BACK_WITHIN);
    tokio::time::sleep_until(end).await;
    let count = arrivals.count(&watched, raised, end);
    let least = WATCHED_MIN_HZ * BACK_WITHIN.as_secs_f64();
    assert!(f64::from(u32::try_from(count).unwrap()) >= least, "{count}");
    drop(second);
    arrivals
        .until("its own rate again", BACK_WITHIN, &watched, is_own)
        .await;

    // Nobody watched the other one, and it did not publish more often.
    let end = Instant::now();
    let count = arrivals.count(&other, begin, end);
    let most = UNWATCHED_MAX_HZ * (end - begin).as_secs_f64();
    assert!(f64::from(u32::try_from(count).unwrap()) <= most, "{count}");
    assert_eq!(fleet.counter("rate_limited").await, 0);
    let alerts: Vec<Alert> = fleet.rest.all(&format!("/v1/alerts?site={SITE}")).await;
    assert!(alerts.is_empty(), "{alerts:?}");
    session.close().wait().unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_that_restarts_asks_again_when_somebody_watches_again() {
    let mut fleet = fleet().await;
    let robot: RobotId = "rover-1".parse().unwrap();
    fleet.start_agent(&robot, 0.0).await;
    let (session, arrivals) = listen(&fleet).await;
    let is_raised = |rate_hz: f64| rate_hz >= WATCHED_MIN_HZ;
    let is_own = |rate_hz: f64| (3.0..=UNWATCHED_MAX_HZ).contains(&rate_hz);
    let socket = watch(&fleet, &robot).await;
    arrivals
        .until("a higher rate", SHORT, &robot, is_raised)
        .await;
    fleet.kill_server();
    drop(socket);
    fleet.start_server().await;
    fleet.robot_is_online(&robot).await;
    // The connection was lost, and nobody watches.
    arrivals
        .until("its own rate", BACK_WITHIN, &robot, is_own)
        .await;
    let _socket = watch(&fleet, &robot).await;
    let took = arrivals
        .until("a higher rate again", SHORT, &robot, is_raised)
        .await;
    assert!(took <= RAISED_WITHIN, "{took:?}");
    session.close().wait().unwrap();
}
