//! Floods over HTTP: by a viewer who may read and stop, and by strangers who may nothing.

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use futures_util::future::BoxFuture;
use futures_util::{SinkExt as _, StreamExt as _};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;
use tokio::task::JoinSet;
use tokio::time::{Instant, timeout_at};
use tokio_tungstenite::connect_async;
use tokio_tungstenite::tungstenite::{ClientRequestBuilder, Message};
use tread_api::identity::Role;
use tread_server::identity::secret::{Kind, SECRET_RANDOM_BYTES, Secret};

use super::attackers::{Outcome, Plan};
use crate::pace::Pace;

/// Changes that a viewer asks for without waiting for the answers, each second.
const PIPELINED_HZ: f64 = 20_000.0;
/// Connections that they go by.
const PIPELINED_CONNECTIONS: u32 = 4;
/// Connections that send a sign-in byte by byte.
const SLOW_SIGN_INS: u32 = 4_250;
/// Time between two of their bytes.
const SLOW_BYTE_EVERY: Duration = Duration::from_secs(1);
/// Rest before one that was ended is opened again.
const REOPEN_REST: Duration = Duration::from_secs(5);
/// Wrong tokens from one address each second.
const WRONG_TOKENS_HZ: f64 = 10.0;
/// Stops of all robots by a viewer each second: 105 in a minute.
const STOPS_HZ: f64 = 1.75;
/// Connections that are opened and closed again each second.
const OPENED_HZ: f64 = 1_000.0;
/// Drive sockets that a viewer opens.
const SOCKETS: u32 = 600;

/// What the floods are called.
const CHANGES: &str = "changes by a viewer, pipelined";
const SIGN_INS: &str = "sign-ins byte by byte, by strangers";
const TOKENS: &str = "wrong tokens from one address";
const STOPS: &str = "stops of 200 absent robots by a viewer";
const OPENED: &str = "connections opened and closed";
const DRIVES: &str = "drive sockets by a viewer";

/// Starts all floods over HTTP.
pub(super) fn spawn(floods: &mut JoinSet<Outcome>, plan: &Plan, until: Instant) {
    let Plan { http, viewer, .. } = plan;
    let floods_by_name: [(&str, BoxFuture<'static, Outcome>); _] = [
        (
            CHANGES,
            Box::pin(pipelined_changes(*http, viewer.clone(), until)),
        ),
        (SIGN_INS, Box::pin(slow_sign_ins(*http, until))),
        (TOKENS, Box::pin(wrong_tokens(*http, until))),
        (STOPS, Box::pin(stops(*http, viewer.clone(), until))),
        (OPENED, Box::pin(opened_and_closed(*http, until))),
        (DRIVES, Box::pin(drive_sockets(plan.clone(), until))),
    ];
    for (name, flood) in floods_by_name {
        if plan.has(name) {
            floods.spawn(flood);
        }
    }
}

/// Counts the answers on a connection until it ends: all, and those of a 5xx.
async fn count_answers(
    mut from: impl tokio::io::AsyncRead + Unpin,
    answers: Arc<AtomicU64>,
    errors: Arc<AtomicU64>,
) {
    let mut room = vec![0; 64 * 1024];
    while let Ok(read @ 1..) = from.read(&mut room).await {
        let text = String::from_utf8_lossy(&room[..read]);
        let count = |what: &str| u64::try_from(text.matches(what).count()).unwrap_or(0);
        answers.fetch_add(count("HTTP/1.1 "), Ordering::Relaxed);
        errors.fetch_add(count("HTTP/1.1 5"), Ordering::Relaxed);
    }
}

/// A viewer who signs out again and again and asks for what he may not, without waiting for answers:
/// each was an entry of the audit log.
async fn pipelined_changes(http: SocketAddr, viewer: String, until: Instant) -> Outcome {
    let (answers, errors) = (Arc::new(AtomicU64::new(0)), Arc::new(AtomicU64::new(0)));
    let mut connections = JoinSet::new();
    for connection in 0..PIPELINED_CONNECTIONS {
        let (viewer, answers, errors) = (viewer.clone(), Arc::clone(&answers), Arc::clone(&errors));
        connections.spawn(async move {
            let hz = PIPELINED_HZ / f64::from(PIPELINED_CONNECTIONS);
            let mut pace = Pace::new(hz, until);
            let mut count = 0_u64;
            while Instant::now() < until {
                let Ok(stream) = TcpStream::connect(http).await else {
                    tokio::time::sleep(Duration::from_millis(100)).await;
                    continue;
                };
                let (from, mut to) = stream.into_split();
                let mut reading = JoinSet::new();
                reading.spawn(count_answers(
                    from,
                    Arc::clone(&answers),
                    Arc::clone(&errors),
                ));
                while let Some(due) = pace.due().await {
                    let mut requests = String::new();
                    for _ in 0..due {
                        count += 1;
                        let path = if count.is_multiple_of(4) {
                            format!("/v1/sites/yard/terrains/t-{connection}-{count}")
                        } else {
                            "/v1/session".to_owned()
                        };
                        requests.push_str("DELETE ");
                        requests.push_str(&path);
                        requests.push_str(" HTTP/1.1\r\nhost: localhost\r\nauthorization: Bearer ");
                        requests.push_str(&viewer);
                        requests.push_str("\r\n\r\n");
                    }
                    let wrote = timeout_at(until, to.write_all(requests.as_bytes())).await;
                    if !matches!(wrote, Ok(Ok(()))) {
                        break;
                    }
                }
            }
        });
    }
    while connections.join_next().await.is_some() {}
    Outcome {
        flood: CHANGES,
        of: "answered",
        count: answers.load(Ordering::Relaxed),
        wanted_per_s: Some(PIPELINED_HZ),
        notes: format!("{} answered 5xx", errors.load(Ordering::Relaxed)),
    }
}

/// Strangers who send the body of a sign-in byte by byte.
async fn slow_sign_ins(http: SocketAddr, until: Instant) -> Outcome {
    let (opened, bytes) = (Arc::new(AtomicU64::new(0)), Arc::new(AtomicU64::new(0)));
    let mut connections = JoinSet::new();
    for number in 0..SLOW_SIGN_INS {
        let (opened, bytes) = (Arc::clone(&opened), Arc::clone(&bytes));
        let attacking = async move {
            // Over two seconds, not all in one moment.
            tokio::time::sleep(Duration::from_secs(2) * number / SLOW_SIGN_INS).await;
            loop {
                if let Ok(mut stream) = TcpStream::connect(http).await {
                    opened.fetch_add(1, Ordering::Relaxed);
                    let head = "POST /v1/session HTTP/1.1\r\nhost: localhost\r\n\
                                content-type: application/json\r\ncontent-length: 90\r\n\r\n";
                    let mut sent = stream.write_all(head.as_bytes()).await;
                    let mut answer = [0; 512];
                    while sent.is_ok() {
                        bytes.fetch_add(1, Ordering::Relaxed);
                        sent = stream.write_all(b"{").await;
                        // Whatever comes ends this one.
                        let read = tokio::time::timeout(SLOW_BYTE_EVERY, stream.read(&mut answer));
                        if read.await.is_ok() {
                            break;
                        }
                    }
                }
                tokio::time::sleep(REOPEN_REST).await;
            }
        };
        connections.spawn(async move {
            let _ = timeout_at(until, attacking).await;
        });
    }
    while connections.join_next().await.is_some() {}
    Outcome {
        flood: SIGN_INS,
        of: "opened",
        count: opened.load(Ordering::Relaxed),
        wanted_per_s: None,
        notes: format!(
            "{SLOW_SIGN_INS} at once, {} bytes of bodies",
            bytes.load(Ordering::Relaxed)
        ),
    }
}

/// One request on a connection that is kept; its status.
async fn ask(stream: &mut TcpStream, request: &str) -> anyhow::Result<u16> {
    stream.write_all(request.as_bytes()).await?;
    let mut answer = Vec::new();
    loop {
        anyhow::ensure!(stream.read_buf(&mut answer).await? > 0, "it ended");
        let text = String::from_utf8_lossy(&answer);
        let Some((head, body)) = text.split_once("\r\n\r\n") else {
            continue;
        };
        let head = head.to_ascii_lowercase();
        let length = head
            .lines()
            .find_map(|line| line.strip_prefix("content-length: "));
        let length: usize = length.map_or(Ok(0), str::parse)?;
        if body.len() >= length {
            let status = head.split_whitespace().nth(1);
            return Ok(status.unwrap_or_default().parse()?);
        }
    }
}

/// Wrong tokens, all from one address.
async fn wrong_tokens(http: SocketAddr, until: Instant) -> Outcome {
    let mut pace = Pace::new(WRONG_TOKENS_HZ, until);
    let (mut count, mut refused, mut locked) = (0_u64, 0_u64, 0_u64);
    while pace.due().await.is_some() {
        let random: [u8; SECRET_RANDOM_BYTES] =
            std::array::from_fn(|_| uuid::Uuid::new_v4().as_bytes()[0]);
        let secret = Secret::from_random(Kind::Token(Some(Role::Admin)), &random);
        let request = format!(
            "GET /v1/sites HTTP/1.1\r\nhost: localhost\r\nauthorization: Bearer {}\r\n\r\n",
            secret.reveal()
        );
        let asking = async {
            let mut stream = TcpStream::connect(http).await?;
            ask(&mut stream, &request).await
        };
        count += 1;
        match timeout_at(until, asking).await {
            Ok(Ok(429)) => locked += 1,
            Ok(Ok(401)) => refused += 1,
            Ok(_) | Err(_) => {}
        }
    }
    Outcome {
        flood: TOKENS,
        of: "asked",
        count,
        wanted_per_s: Some(WRONG_TOKENS_HZ),
        notes: format!("{refused} answered 401, {locked} answered 429"),
    }
}

/// A viewer who stops every robot again and again.
async fn stops(http: SocketAddr, viewer: String, until: Instant) -> Outcome {
    let answered = Arc::new(AtomicU64::new(0));
    let request = format!(
        "POST /v1/stop HTTP/1.1\r\nhost: localhost\r\nauthorization: Bearer {viewer}\r\n\
         content-length: 0\r\n\r\n"
    );
    let request = Arc::new(request);
    let mut pace = Pace::new(STOPS_HZ, until);
    let mut asking = JoinSet::new();
    while let Some(due) = pace.due().await {
        for _ in 0..due {
            let (request, answered) = (Arc::clone(&request), Arc::clone(&answered));
            asking.spawn(async move {
                let ask = async {
                    let mut stream = TcpStream::connect(http).await?;
                    ask(&mut stream, &request).await
                };
                if let Ok(Ok(200)) = timeout_at(until, ask).await {
                    answered.fetch_add(1, Ordering::Relaxed);
                }
            });
        }
        while asking.try_join_next().is_some() {}
    }
    while asking.join_next().await.is_some() {}
    Outcome {
        flood: STOPS,
        of: "asked",
        count: pace.done(),
        wanted_per_s: Some(STOPS_HZ),
        notes: format!("{} answered 200", answered.load(Ordering::Relaxed)),
    }
}

/// Connections that are opened and closed without a word.
async fn opened_and_closed(http: SocketAddr, until: Instant) -> Outcome {
    let mut pace = Pace::new(OPENED_HZ, until);
    let mut opened = 0;
    while let Some(due) = pace.due().await {
        for _ in 0..due {
            if let Ok(Ok(stream)) = timeout_at(until, TcpStream::connect(http)).await {
                // Reset, so that no port waits for a minute afterwards.
                let _ = stream.set_zero_linger();
                opened += 1;
            }
        }
    }
    Outcome {
        flood: OPENED,
        of: "opened",
        count: opened,
        wanted_per_s: Some(OPENED_HZ),
        notes: String::new(),
    }
}

/// A viewer who opens all drive sockets and keeps them.
async fn drive_sockets(plan: Plan, until: Instant) -> Outcome {
    let (opened, refused) = (Arc::new(AtomicU64::new(0)), Arc::new(AtomicU64::new(0)));
    let uri: Option<tokio_tungstenite::tungstenite::http::Uri> = format!(
        "ws://{}/v1/sites/yard/robots/{}/drive",
        plan.http, plan.watched
    )
    .parse()
    .ok();
    let mut sockets = JoinSet::new();
    for number in 0..SOCKETS {
        let Some(uri) = uri.clone() else { break };
        let (opened, refused) = (Arc::clone(&opened), Arc::clone(&refused));
        let viewer = plan.viewer.clone();
        let keeping = async move {
            tokio::time::sleep(Duration::from_secs(4) * number / SOCKETS).await;
            loop {
                let request = ClientRequestBuilder::new(uri.clone())
                    .with_header("authorization", format!("Bearer {viewer}"));
                match connect_async(request).await {
                    Ok((mut socket, _)) => {
                        opened.fetch_add(1, Ordering::Relaxed);
                        // Pings are answered by reading.
                        while let Some(Ok(frame)) = socket.next().await {
                            if let Message::Ping(_) = frame {
                                let _ = socket.flush().await;
                            }
                        }
                    }
                    Err(_) => {
                        refused.fetch_add(1, Ordering::Relaxed);
                    }
                }
                tokio::time::sleep(REOPEN_REST).await;
            }
        };
        sockets.spawn(async move {
            let _ = timeout_at(until, keeping).await;
        });
    }
    while sockets.join_next().await.is_some() {}
    Outcome {
        flood: DRIVES,
        of: "asked for",
        count: opened.load(Ordering::Relaxed) + refused.load(Ordering::Relaxed),
        wanted_per_s: None,
        notes: format!("{} opened", opened.load(Ordering::Relaxed)),
    }
}
