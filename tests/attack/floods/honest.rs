//! Who works while the floods go on: an operator, an admin, and a robot that introduces itself.
//!
//! Each has a task on a runtime of its own, and notes how long answers took.

use std::net::SocketAddr;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use futures_util::StreamExt as _;
use reqwest::Method;
use serde_json::{Value, json};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;
use tokio::task::JoinSet;
use tokio::time::{Instant, Interval, MissedTickBehavior, interval, timeout};
use tokio_tungstenite::connect_async;
use tokio_tungstenite::tungstenite::ClientRequestBuilder;
use tread_agent::membership::Membership;
use tread_tests::fleet::{Fleet, SITE};
use tread_tests::light_robot::LightRobot;
use tread_tests::rest::Rest;

use super::HONEST_ROBOT;

/// Time between two stops of the operator.
const STOP_EVERY: Duration = Duration::from_millis(200);
/// Time between two looks at the other robot's state.
const POLL_INTERVAL: Duration = Duration::from_millis(100);
/// Time between two introductions of the quiet robot.
const HELLO_EVERY: Duration = Duration::from_millis(500);
/// Time between two pieces of the operator's other work.
const WORK_EVERY: Duration = Duration::from_millis(500);
/// Changes of the admin in the whole run: fewer than the entries that each token has of its own.
const CHANGES_MAX: u64 = 400;
/// Least time between two changes of the admin.
const CHANGE_EVERY: Duration = Duration::from_millis(200);
/// How long a stop may take without being listed.
const SLOW_STOP_MS: f64 = 50.0;
/// Longest wait for any answer.
const ANSWER_MAX: Duration = Duration::from_secs(10);

/// A change that the admin made and the server answered.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(super) struct Change {
    pub(super) method: String,
    pub(super) path: String,
    pub(super) status: u16,
    /// What it names in its body.
    pub(super) name: Option<String>,
}

/// What honest people and robots saw.
#[derive(Debug, Clone, Default)]
pub(super) struct Worked {
    /// How long stops over new connections took, ms.
    pub(super) stops_ms: Vec<f64>,
    /// Those that took long: when they began, seconds, and how long they took, ms.
    pub(super) slow_stops: Vec<(f64, f64)>,
    /// Stops without an answer, or that the robot did not confirm, and why.
    pub(super) failed_stops: Vec<String>,
    /// How old the other robot's state was, ms.
    pub(super) ages_ms: Vec<f64>,
    /// Looks at it that had no answer.
    pub(super) failed_looks: Vec<String>,
    /// How long introductions took, ms.
    pub(super) hellos_ms: Vec<f64>,
    /// Introductions without an answer.
    pub(super) failed_hellos: Vec<String>,
    /// The operator's other work: how long it took, ms.
    pub(super) work_ms: Vec<f64>,
    /// What of it failed.
    pub(super) failed_work: Vec<String>,
    /// The admin's changes.
    pub(super) changes: Vec<Change>,
    /// What of them had no answer.
    pub(super) failed_changes: Vec<String>,
}

type Shared = Arc<Mutex<Worked>>;

fn record(worked: &Shared, act: impl FnOnce(&mut Worked)) {
    act(&mut worked.lock().unwrap_or_else(PoisonError::into_inner));
}

fn ms(begun: Instant) -> f64 {
    1e3 * begun.elapsed().as_secs_f64()
}

/// Everybody honest, at work until [`Self::end`].
pub(super) struct Honest {
    runtime: tokio::runtime::Runtime,
    tasks: JoinSet<()>,
    worked: Shared,
    is_over: Arc<AtomicBool>,
    // Its session must outlive the task that uses it.
    _quiet: Arc<LightRobot>,
}

impl Honest {
    /// Lets all of them begin.
    pub(super) async fn begin(
        fleet: &Fleet,
        operator: &str,
        quiet: &Membership,
        seconds: u64,
    ) -> anyhow::Result<Self> {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()?;
        let quiet = Arc::new(LightRobot::start_secure(&fleet.zenoh_endpoint(), quiet).await?);
        let http = fleet.http_address();
        let worked = Shared::default();
        let is_over = Arc::new(AtomicBool::new(false));
        let mut tasks = JoinSet::new();
        let begin = || (Arc::clone(&worked), Arc::clone(&is_over));
        let at = format!("http://{http}");
        let handle = runtime.handle();
        tasks.spawn_on(stop(http, operator.to_owned(), begin()), handle);
        tasks.spawn_on(look(Rest::new(at.clone(), operator), begin()), handle);
        tasks.spawn_on(work(http, operator.to_owned(), begin()), handle);
        tasks.spawn_on(say_hello(Arc::clone(&quiet), begin()), handle);
        let every = CHANGE_EVERY.max(Duration::from_secs(seconds) / u32::try_from(CHANGES_MAX)?);
        tasks.spawn_on(change(Rest::new(at, fleet.token()), every, begin()), handle);
        Ok(Self {
            runtime,
            tasks,
            worked,
            is_over,
            _quiet: quiet,
        })
    }

    /// Lets them end what they are at, and gives what they saw.
    pub(super) async fn end(mut self) -> anyhow::Result<Worked> {
        self.is_over.store(true, Ordering::Relaxed);
        while self.tasks.join_next().await.is_some() {}
        self.runtime.shutdown_background();
        let worked = self.worked.lock().unwrap_or_else(PoisonError::into_inner);
        Ok(worked.clone())
    }
}

type SharedState = (Shared, Arc<AtomicBool>);

/// When something is to be done again, until it is over.
struct Rounds {
    ticks: Interval,
    is_over: Arc<AtomicBool>,
    number: u64,
}

impl Rounds {
    fn new(every: Duration, is_over: Arc<AtomicBool>) -> Self {
        let mut ticks = interval(every);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        Self {
            ticks,
            is_over,
            number: 0,
        }
    }

    /// Waits for the next one, and gives its number.
    async fn next(&mut self) -> Option<u64> {
        self.ticks.tick().await;
        self.number += 1;
        (!self.is_over.load(Ordering::Relaxed)).then_some(self.number - 1)
    }
}

/// Sends one request over a new connection and gives the answer's status and body.
async fn ask_anew(http: SocketAddr, request: &str) -> anyhow::Result<(u16, Value)> {
    let mut stream = TcpStream::connect(http).await?;
    stream.set_nodelay(true)?;
    stream.write_all(request.as_bytes()).await?;
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).await?;
    let text = String::from_utf8_lossy(&answer);
    let (head, body) = text
        .split_once("\r\n\r\n")
        .ok_or_else(|| anyhow::anyhow!("the connection ended after {} bytes", answer.len()))?;
    let status = head.split_whitespace().nth(1).unwrap_or_default();
    Ok((status.parse()?, serde_json::from_str(body)?))
}

/// The operator stops the honest robot, each time over a new connection.
async fn stop(http: SocketAddr, operator: String, (worked, is_over): SharedState) {
    let request = format!(
        "POST /v1/sites/{SITE}/robots/{HONEST_ROBOT}/stop HTTP/1.1\r\nhost: {http}\r\n\
         authorization: Bearer {operator}\r\nconnection: close\r\ncontent-length: 0\r\n\r\n"
    );
    let started = Instant::now();
    let mut rounds = Rounds::new(STOP_EVERY, is_over);
    while rounds.next().await.is_some() {
        let begun = Instant::now();
        let asked = timeout(ANSWER_MAX, ask_anew(http, &request)).await;
        let took_ms = ms(begun);
        let failure = match asked {
            Err(_) => Some(format!("no answer in {ANSWER_MAX:?}")),
            Ok(Err(error)) => Some(format!("{error:#}")),
            Ok(Ok((200, stop))) if stop["confirmed_at"].is_string() => None,
            Ok(Ok((status, answer))) => Some(format!("{status} after {took_ms:.0} ms: {answer}")),
        };
        record(&worked, |worked| {
            worked.stops_ms.push(took_ms);
            if took_ms > SLOW_STOP_MS {
                worked
                    .slow_stops
                    .push((begun.duration_since(started).as_secs_f64(), took_ms));
            }
            worked.failed_stops.extend(failure);
        });
    }
}

/// The operator looks at the honest robot.
async fn look(rest: Rest, (worked, is_over): SharedState) {
    let path = format!("/v1/sites/{SITE}/robots/{HONEST_ROBOT}");
    let mut rounds = Rounds::new(POLL_INTERVAL, is_over);
    while rounds.next().await.is_some() {
        let asked = timeout(ANSWER_MAX, rest.call(Method::GET, &path, None)).await;
        record(&worked, |worked| match asked {
            Ok(Some((status, robot))) => match robot["live"]["state_age_ms"].as_f64() {
                Some(age_ms) => worked.ages_ms.push(age_ms),
                None => worked.failed_looks.push(format!("{status} {robot}")),
            },
            Ok(None) | Err(_) => worked.failed_looks.push("no answer".to_owned()),
        });
    }
}

/// The operator's other work: missions, lists, a drive socket.
async fn work(http: SocketAddr, operator: String, (worked, is_over): SharedState) {
    let rest = Rest::new(format!("http://{http}"), &operator);
    let mut rounds = Rounds::new(WORK_EVERY, is_over);
    while let Some(number) = rounds.next().await {
        let begun = Instant::now();
        let done = timeout(ANSWER_MAX, do_work(http, &operator, &rest, number)).await;
        let took_ms = ms(begun);
        let failure = match done {
            Err(_) => Some(format!("no answer in {ANSWER_MAX:?}")),
            Ok(done) => done.err().map(|error| format!("{error:#}")),
        };
        record(&worked, |worked| {
            worked.work_ms.push(took_ms);
            worked.failed_work.extend(failure);
        });
    }
}

async fn do_work(http: SocketAddr, operator: &str, rest: &Rest, number: u64) -> anyhow::Result<()> {
    let call = async |method: Method, path: String, body: Option<&Value>| {
        let answer = rest.call(method, &path, body).await;
        let (status, answer) = answer.ok_or_else(|| anyhow::anyhow!("{path}: no answer"))?;
        anyhow::ensure!(status.is_success(), "{path}: {status} {answer}");
        anyhow::Ok(answer)
    };
    match number % 3 {
        0 => {
            let circle = json!({"center": {"x_m": 0, "y_m": 2}, "radius_m": 2, "speed_m_s": 0.3,
                "direction": "clockwise", "turns": 1});
            let mission = json!({"site": SITE, "robot": HONEST_ROBOT,
                "trajectory": {"circle": circle}});
            let mission = call(Method::POST, "/v1/missions".to_owned(), Some(&mission)).await?;
            let id = mission["id"].as_str().unwrap_or_default();
            let cancel = format!("/v1/missions/{id}/cancel");
            call(Method::POST, cancel, Some(&json!({}))).await?;
        }
        1 => {
            for path in ["robots", "terrains", "friction/cells"] {
                call(Method::GET, format!("/v1/sites/{SITE}/{path}"), None).await?;
            }
        }
        _ => {
            let uri = format!("ws://{http}/v1/sites/{SITE}/robots/{HONEST_ROBOT}/drive");
            let request = ClientRequestBuilder::new(uri.parse()?)
                .with_header("authorization", format!("Bearer {operator}"));
            let (mut socket, _) = connect_async(request).await?;
            let first = socket.next().await;
            anyhow::ensure!(matches!(first, Some(Ok(_))), "a drive socket ended");
            let _ = socket.close(None).await;
        }
    }
    Ok(())
}

/// The quiet robot introduces itself.
async fn say_hello(robot: Arc<LightRobot>, (worked, is_over): SharedState) {
    let mut rounds = Rounds::new(HELLO_EVERY, is_over);
    while rounds.next().await.is_some() {
        let begun = Instant::now();
        let answered = robot.hello().await;
        let took_ms = ms(begun);
        record(&worked, |worked| {
            worked.hellos_ms.push(took_ms);
            let failure = answered.err().map(|error| format!("{error:#}"));
            worked.failed_hellos.extend(failure);
        });
    }
}

/// The admin makes tokens and revokes them, each another one.
async fn change(rest: Rest, every: Duration, (worked, is_over): SharedState) {
    let mut rounds = Rounds::new(every, is_over);
    let mut made: Option<String> = None;
    while let Some(number) = rounds.next().await {
        if number >= CHANGES_MAX {
            continue;
        }
        let (method, path, name) = if let Some(token) = made.take() {
            (Method::DELETE, format!("/v1/tokens/{token}"), None)
        } else {
            let name = format!("made by the admin, {number}");
            (Method::POST, "/v1/tokens".to_owned(), Some(name))
        };
        let body = name
            .as_ref()
            .map(|name| json!({"name": name, "role": "viewer"}));
        let asked = rest.call(method.clone(), &path, body.as_ref());
        let Ok(Some((status, answer))) = timeout(ANSWER_MAX, asked).await else {
            let failure = format!("{method} {path}: no answer");
            record(&worked, |worked| worked.failed_changes.push(failure));
            continue;
        };
        made = answer["token"]["id"].as_str().map(str::to_owned);
        record(&worked, |worked| {
            worked.changes.push(Change {
                method: method.to_string(),
                path: path.clone(),
                status: status.as_u16(),
                name,
            });
            if !status.is_success() {
                let failure = format!("{method} {path}: {status} {answer}");
                worked.failed_changes.push(failure);
            }
        });
    }
}
