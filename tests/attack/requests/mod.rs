//! Requests from the description of the API: every operation, by everybody, as described and not.

mod body;
mod rights;

use std::fmt::Write as _;
use std::net::SocketAddr;
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context as _;
use clap::Args;
use serde::Serialize;
use serde_json::Value;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;
use tokio::task::JoinSet;
use tokio::time::{Instant, timeout};
use tread_api::ids::RobotId;
use tread_tests::fleet::Fleet;
use tread_tests::process::node;
use tread_tests::random::Random;
use tread_tests::report::{self, Check, figure};

use self::body::Body;
use self::rights::Needs;
use crate::floods::{HONEST_ROBOT, token};

/// The description as it is committed.
const DESCRIPTION: &str = include_str!("../../../server/openapi.json");
/// Longest time that an answer may take: the server ends each request after 15 s.
const ANSWER_MAX: Duration = Duration::from_secs(20);
/// How long the rest of a stream is read.
const STREAM_MAX: Duration = Duration::from_millis(50);
/// Most bytes of an answer that are read.
const ANSWER_BYTES_MAX: usize = 256 * 1024;
/// Who asks at the same time.
const AT_ONCE: u64 = 4;
/// Failures that are reported.
const REPORTED_MAX: usize = 20;
/// What only an answer that makes a secret may contain.
const SECRET_BEGINNINGS: [&str; 5] = ["tread_v_", "tread_o_", "tread_a_", "tread_s_", "tread_j_"];
/// What no answer may contain.
const INTERNALS: [&str; 4] = ["panicked at", "PRIVATE KEY", "/.cargo/", "SELECT "];

/// Requests from the description.
#[derive(Debug, Args)]
pub(crate) struct Arguments {
    /// How long, seconds; each operation is asked for by everybody at least once
    #[arg(long, default_value_t = 60, value_parser = clap::value_parser!(u64).range(1..=3_600))]
    seconds: u64,
    /// Seed of all that is random
    #[arg(long, default_value_t = 1)]
    seed: u64,
}

/// Who asks.
#[derive(Debug, Clone)]
struct Asker {
    name: &'static str,
    shows: Option<String>,
    may: Needs,
}

/// One operation of the description.
#[derive(Debug, Clone)]
struct Operation {
    method: String,
    path: String,
    parameters: Vec<Value>,
    schema: Option<Value>,
    needs: Option<Needs>,
}

/// What is attacked, and what is known of it.
struct Target {
    http: SocketAddr,
    document: Value,
    operations: Vec<Operation>,
    askers: Vec<Asker>,
}

/// What came of it.
#[derive(Debug, Default, Serialize)]
struct Seen {
    requests: u64,
    answered: u64,
    refused_connections: u64,
    longest_ms: f64,
    server_errors: u64,
    unavailable: u64,
    past_the_guard: u64,
    wrongly_refused: u64,
    secrets: u64,
    hangs: u64,
    failures: Vec<String>,
}

impl Seen {
    fn fail(&mut self, what: &str, request: &Request, answer: &str) {
        if self.failures.len() < REPORTED_MAX {
            let answer: String = answer.chars().take(300).collect();
            let head: String = request.head.chars().take(200).collect();
            self.failures
                .push(format!("{what}: {head:?} by {}: {answer}", request.by));
        }
    }

    fn add(&mut self, other: Self) {
        self.requests += other.requests;
        self.answered += other.answered;
        self.refused_connections += other.refused_connections;
        self.longest_ms = self.longest_ms.max(other.longest_ms);
        self.server_errors += other.server_errors;
        self.unavailable += other.unavailable;
        self.past_the_guard += other.past_the_guard;
        self.wrongly_refused += other.wrongly_refused;
        self.secrets += other.secrets;
        self.hangs += other.hangs;
        self.failures.extend(other.failures);
        self.failures.truncate(REPORTED_MAX);
    }
}

/// A request as it goes over the line.
struct Request {
    head: String,
    body: Vec<u8>,
    by: &'static str,
    may: Needs,
    needs: Option<Needs>,
    /// Whether path and head are as described, so that the answer to who may not is known.
    is_plain: bool,
    makes_secrets: bool,
}

fn operations(document: &Value) -> Vec<Operation> {
    let mut operations = Vec::new();
    for (path, of_path) in document["paths"].as_object().into_iter().flatten() {
        for (method, operation) in of_path.as_object().into_iter().flatten() {
            let method = method.to_uppercase();
            if !["GET", "POST", "PUT", "PATCH", "DELETE"].contains(&method.as_str()) {
                continue;
            }
            let schema = operation.pointer("/requestBody/content/application~1json/schema");
            operations.push(Operation {
                needs: rights::needs(&method, path),
                method,
                path: path.clone(),
                parameters: operation["parameters"]
                    .as_array()
                    .cloned()
                    .unwrap_or_default(),
                schema: schema.cloned(),
            });
        }
    }
    operations
}

/// A text as a part of a path or query.
fn escaped(text: &str) -> String {
    let escape = |byte: u8| match byte {
        b'a'..=b'z' | b'A'..=b'Z' | b'0'..=b'9' | b'-' | b'_' | b'.' => {
            char::from(byte).to_string()
        }
        _ => format!("%{byte:02x}"),
    };
    text.bytes().map(escape).collect()
}

fn parameter(name: &str, random: &mut Random, is_odd: bool) -> String {
    if is_odd {
        return escaped(&body::odd_text(random))
            .chars()
            .take(6_000)
            .collect();
    }
    let value = match name {
        "site" => "yard",
        "robot" => HONEST_ROBOT,
        "terrain" => "slab",
        "owner" => "lidar",
        "format" => ["png", "csv", "geojson", "parquet", "nav2"][random.index(5)],
        "limit" => ["1", "0", "1000", "100000"][random.index(4)],
        "as_of" | "from" | "to" => "2026-11-22T13:00:00Z",
        "raised" | "refused" | "retired" | "in_force" => "true",
        name if name.ends_with("_m") || name.ends_with("_s") => {
            ["0", "-3.5", "10", "1e9"][random.index(4)]
        }
        _ => "01a20366-00c7-728b-8be7-56a782511a65",
    };
    escaped(value)
}

impl Target {
    fn request(&self, number: usize, random: &mut Random, is_mutated: bool) -> Request {
        let asker = &self.askers[number % self.askers.len()];
        let operation = &self.operations[(number / self.askers.len()) % self.operations.len()];
        let what = if is_mutated { random.index(4) } else { 9 };
        let (mut path, mut query, mut headers) =
            (operation.path.clone(), Vec::new(), String::new());
        for of in &operation.parameters {
            let name = of["name"].as_str().unwrap_or_default();
            let is_odd = what == 0 && random.chance(0.6);
            match of["in"].as_str() {
                Some("path") => {
                    let value = parameter(name, random, is_odd);
                    path = path.replace(&format!("{{{name}}}"), &value);
                }
                Some("query") if of["required"] == true || random.chance(0.3) => {
                    query.push(format!("{name}={}", parameter(name, random, is_odd)));
                }
                Some("header") if random.chance(0.5) => {
                    let value = ["*", "\"x\"", "99999999999999999999", "a b", "\u{e9}"];
                    let _ = write!(headers, "{name}: {}\r\n", value[random.index(value.len())]);
                }
                _ => {}
            }
        }
        if what == 1 {
            headers += [
                "x-forwarded-for: 127.0.0.1, \u{fffd}\r\n",
                "cookie: tread_session=x; __Host-tread_session=y\r\n",
                "range: bytes=0-99999999999999999999\r\n",
                "accept: \u{7f}/*;q=nan\r\n",
                "x-http-method-override: DELETE\r\n",
                "expect: 100-continue\r\n",
            ][random.index(6)];
        }
        let described = operation.schema.as_ref();
        let described = described.map(|of| body::of_schema(&self.document, of, random));
        let sent = match described {
            Some(value) if what >= 2 && is_mutated => Some(body::mutated(value, random)),
            None if what == 2 => Some(body::mutated(Value::Null, random)),
            Some(value) => Some(Body {
                bytes: value.to_string().into_bytes(),
                media_type: "application/json",
            }),
            None => None,
        };
        if let Some(secret) = &asker.shows {
            let _ = write!(headers, "authorization: Bearer {secret}\r\n");
        }
        let bytes = sent.map_or_else(Vec::new, |body| {
            let _ = write!(headers, "content-type: {}\r\n", body.media_type);
            body.bytes
        });
        let query = if query.is_empty() {
            String::new()
        } else {
            format!("?{}", query.join("&"))
        };
        let head = format!(
            "{} {path}{query} HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n{headers}\
             content-length: {}\r\n\r\n",
            operation.method,
            bytes.len(),
        );
        Request {
            head,
            body: bytes,
            by: asker.name,
            may: asker.may,
            needs: operation.needs,
            is_plain: !is_mutated,
            makes_secrets: operation.method == "POST"
                && ["/v1/tokens", "/v1/join-tokens"].contains(&operation.path.as_str()),
        }
    }
}

/// Sends a request over a connection of its own, and gives what comes within the bounds.
async fn send(http: SocketAddr, request: &Request) -> anyhow::Result<String> {
    let (mut from, mut to) = TcpStream::connect(http).await?.into_split();
    let sending = async {
        // The server may answer before it has read all, and close.
        let _ = to.write_all(request.head.as_bytes()).await;
        let _ = to.write_all(&request.body).await;
        std::future::pending::<()>().await;
    };
    let reading = async {
        let mut answer = Vec::new();
        while answer.len() < ANSWER_BYTES_MAX {
            let has_head = answer.windows(4).any(|four| four == b"\r\n\r\n");
            let within = if has_head { STREAM_MAX } else { ANSWER_MAX };
            match timeout(within, from.read_buf(&mut answer)).await {
                Ok(Ok(1..)) => {}
                Ok(Ok(0) | Err(_)) => break,
                Err(_) if has_head => break,
                Err(_) => anyhow::bail!("no answer in {ANSWER_MAX:?}"),
            }
        }
        anyhow::Ok(String::from_utf8_lossy(&answer).into_owned())
    };
    tokio::select! {
        answer = reading => answer,
        () = sending => unreachable!("it waits for ever"),
    }
}

fn judge(request: &Request, answer: &str, secrets: &[String], seen: &mut Seen) {
    let status = answer.split_whitespace().nth(1).unwrap_or_default();
    let Ok(status) = status.parse::<u16>() else {
        // Hyper ends what is no HTTP without a word; what is plain it must answer.
        if request.is_plain {
            seen.hangs += 1;
            seen.fail("no answer", request, answer);
        }
        return;
    };
    seen.answered += 1;
    let lower = answer.to_ascii_lowercase();
    if status == 503 && lower.contains("\r\nretry-after:") {
        seen.unavailable += 1;
    } else if status >= 500 {
        seen.server_errors += 1;
        seen.fail("a server error", request, answer);
    }
    let is_allowed = request.needs.is_some_and(|needs| request.may >= needs);
    let is_public = request.needs == Some(Needs::Nothing);
    let is_past = !is_allowed && (status < 400 || status == 409 || status == 422);
    let refusals: &[u16] = if request.may == Needs::Nothing {
        &[401, 429]
    } else {
        &[403]
    };
    if is_past || (!is_allowed && request.is_plain && !refusals.contains(&status)) {
        seen.past_the_guard += 1;
        seen.fail("past the guard", request, answer);
    }
    if is_allowed && !is_public && [401, 403].contains(&status) {
        seen.wrongly_refused += 1;
        seen.fail("refused who may", request, answer);
    }
    let tells_known = secrets
        .iter()
        .any(|secret| answer.contains(secret.as_str()));
    let tells_new = SECRET_BEGINNINGS.iter().any(|begin| answer.contains(begin));
    let tells_internals = INTERNALS.iter().any(|text| answer.contains(text));
    if tells_known || (tells_new && !request.makes_secrets) || tells_internals {
        seen.secrets += 1;
        seen.fail("a secret", request, answer);
    }
}

async fn ask_all(target: Arc<Target>, first: u64, seed: u64, until: Instant) -> Seen {
    let mut random = Random::new(seed.wrapping_add(first));
    let secrets: Vec<String> = target
        .askers
        .iter()
        .filter_map(|asker| asker.shows.clone())
        .collect();
    let mut noted = Seen::default();
    let once = target.operations.len() * target.askers.len();
    for number in
        (usize::try_from(first).unwrap_or(0)..).step_by(usize::try_from(AT_ONCE).unwrap_or(1))
    {
        // As described once, whatever time that takes; then in other ways until it is time.
        if number >= once && Instant::now() >= until {
            return noted;
        }
        let chosen = if number < once {
            number
        } else {
            random.index(once)
        };
        let request = target.request(chosen, &mut random, number >= once);
        let begun = Instant::now();
        noted.requests += 1;
        match send(target.http, &request).await {
            Ok(answer) => judge(&request, &answer, &secrets, &mut noted),
            Err(error) => {
                noted.hangs += 1;
                noted.fail("no answer", &request, &format!("{error:#}"));
            }
        }
        noted.longest_ms = noted.longest_ms.max(1e3 * begun.elapsed().as_secs_f64());
    }
    noted
}

pub(crate) async fn run(arguments: &Arguments, json: bool) -> anyhow::Result<ExitCode> {
    let mut fleet = Fleet::start_secure_with(&node()?, 86_400).await;
    let robot: RobotId = HONEST_ROBOT.parse()?;
    fleet.join(&robot).await;
    fleet.start_agent(&robot, 0.0).await;
    let document: Value = serde_json::from_str(DESCRIPTION).context("the description is JSON")?;
    let shows = |name, secret: &str, may| Asker {
        name,
        shows: Some(secret.to_owned()),
        may,
    };
    let askers = vec![
        Asker {
            name: "nobody",
            shows: None,
            may: Needs::Nothing,
        },
        shows("who guesses", "tread_a_00", Needs::Nothing),
        shows(
            "a robot that joins",
            &fleet.join_token(None).await,
            Needs::Nothing,
        ),
        shows("the viewer", &token(&fleet, "viewer").await?, Needs::Viewer),
        shows(
            "the operator",
            &token(&fleet, "operator").await?,
            Needs::Operator,
        ),
        shows("the admin", &token(&fleet, "admin").await?, Needs::Admin),
    ];
    let operations = operations(&document);
    let unknown: Vec<String> = operations
        .iter()
        .filter(|operation| operation.needs.is_none())
        .map(|operation| format!("{} {}", operation.method, operation.path))
        .collect();
    let http = fleet.http_address();
    let target = Arc::new(Target {
        http,
        document,
        operations,
        askers,
    });
    let until = Instant::now() + Duration::from_secs(arguments.seconds);
    let mut asking = JoinSet::new();
    for first in 0..AT_ONCE {
        asking.spawn(ask_all(Arc::clone(&target), first, arguments.seed, until));
    }
    let mut seen = Seen::default();
    while let Some(asked) = asking.join_next().await {
        seen.add(asked?);
    }
    print_report(&fleet, &target, unknown, seen, json).await
}

/// Looks at the server afterwards, and prints all.
async fn print_report(
    fleet: &Fleet,
    target: &Target,
    unknown: Vec<String>,
    mut seen: Seen,
    json: bool,
) -> anyhow::Result<ExitCode> {
    let ready = fleet.rest.call(reqwest::Method::GET, "/readyz", None).await;
    let stop = format!("/v1/sites/yard/robots/{HONEST_ROBOT}/stop");
    let stopped = fleet.rest.call(reqwest::Method::POST, &stop, None).await;
    let log = fleet.log("server");
    let logged = target
        .askers
        .iter()
        .filter_map(|asker| asker.shows.as_ref());
    let logged = logged
        .filter(|secret| log.contains(secret.as_str()))
        .count();
    let is_ok = |answer: Option<(reqwest::StatusCode, Value)>| {
        answer.is_some_and(|(status, _)| status.is_success())
    };
    seen.failures.extend(
        unknown
            .iter()
            .map(|operation| format!("not in the table: {operation}")),
    );
    let checks = [
        Check::of(
            "operations",
            figure(u64::try_from(target.operations.len())?),
        )
        .at_least(60.0),
        Check::of_count(
            "operations of which nobody wrote who may",
            u64::try_from(unknown.len())?,
        )
        .exactly(0),
        Check::of("requests that were answered", figure(seen.answered)).at_least(300.0),
        Check::of_count("server errors", seen.server_errors).exactly(0),
        Check::of_count("answers past the guard", seen.past_the_guard).exactly(0),
        Check::of_count("refusals of who may", seen.wrongly_refused).exactly(0),
        Check::of_count("answers with a secret", seen.secrets).exactly(0),
        Check::of_count("secrets in the log", u64::try_from(logged)?).exactly(0),
        Check::of_count("requests without an answer", seen.hangs).exactly(0),
        Check::shown("503 with Retry-After", figure(seen.unavailable)),
        Check::shown("longest answer, ms", seen.longest_ms),
        Check::so("the server survived", !fleet.has_server_ended()),
        Check::so("the server is ready", is_ok(ready)),
        Check::so("a robot can be stopped", is_ok(stopped)),
    ];
    let words = seen
        .failures
        .iter()
        .map(|failure| format!("  ! {failure}\n"));
    let words = format!("{} requests\n{}", seen.requests, words.collect::<String>());
    report::print_with(json, &seen, words, &checks)
}
