//! A receiver of webhooks that answers as the test decides, and resolvers of its name.

use std::collections::{BTreeMap, HashMap};
use std::net::{IpAddr, SocketAddr};
use std::sync::{Arc, Mutex};

use ring::hmac;
use serde_json::Value;
use tokio::io::{AsyncRead, AsyncReadExt as _, AsyncWrite, AsyncWriteExt as _};
use tokio::net::TcpListener;
use tokio_rustls::TlsAcceptor;
use tread_server::supervisor::Supervisor;
use tread_server::webhooks::{Resolved, Resolver};

use crate::harness::eventually;

/// Bytes that are sent at once of a body without end.
const PIECE: [u8; 1_024] = [b'a'; 1_024];

/// How a receiver answers.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Mood {
    /// It takes everything.
    Good,
    /// It answers with this status and this body.
    Says(u16, &'static str),
    /// It reads the request and never answers.
    Hangs,
    /// It closes the connection before it answers.
    ClosesEarly,
    /// It sends whoever asks to another address.
    Redirects(String),
    /// It answers with an error whose body never ends.
    Endless,
    /// It promises a longer body than it sends, with this status.
    Lies(u16),
}

/// A request that arrived.
#[derive(Debug, Clone)]
pub(super) struct Request {
    pub(super) line: String,
    pub(super) headers: BTreeMap<String, String>,
    pub(super) body: String,
}

impl Request {
    pub(super) fn json(&self) -> Value {
        serde_json::from_str(&self.body).unwrap()
    }

    pub(super) fn delivery(&self) -> &str {
        &self.headers["tread-delivery"]
    }

    pub(super) fn timestamp_s(&self) -> i64 {
        self.headers["tread-timestamp"].parse().unwrap()
    }

    /// Whether it was signed with a secret, as the documentation says it.
    pub(super) fn is_signed_with(&self, secret: &str) -> bool {
        let signature = self.headers["tread-signature"].strip_prefix("v1=").unwrap();
        let pairs = signature.as_bytes().chunks(2);
        let byte =
            |pair: &[u8]| u8::from_str_radix(std::str::from_utf8(pair).unwrap(), 16).unwrap();
        let signature: Vec<u8> = pairs.map(byte).collect();
        let key = hmac::Key::new(hmac::HMAC_SHA256, secret.as_bytes());
        let signed = format!("{}.{}", self.headers["tread-timestamp"], self.body);
        hmac::verify(&key, signed.as_bytes(), &signature).is_ok()
    }
}

#[derive(Debug)]
struct Shared {
    mood: Mood,
    requests: Vec<Request>,
    connections: usize,
}

/// A receiver on an address of this machine.
#[derive(Debug)]
pub(super) struct Receiver {
    pub(super) address: SocketAddr,
    shared: Arc<Mutex<Shared>>,
    supervisor: Supervisor,
}

impl Drop for Receiver {
    fn drop(&mut self) {
        self.supervisor.stop_token().cancel();
    }
}

impl Receiver {
    pub(super) async fn start(mood: Mood) -> Self {
        Self::start_on("127.0.0.1:0", mood, None).await
    }

    pub(super) async fn start_on(address: &str, mood: Mood, tls: Option<TlsAcceptor>) -> Self {
        let listener = TcpListener::bind(address).await.unwrap();
        let address = listener.local_addr().unwrap();
        let shared = Arc::new(Mutex::new(Shared {
            mood,
            requests: Vec::new(),
            connections: 0,
        }));
        let supervisor = Supervisor::new();
        let receiver = Self {
            address,
            shared: Arc::clone(&shared),
            supervisor: supervisor.clone(),
        };
        let stop = supervisor.stop_token();
        let accepting = supervisor.clone();
        supervisor.spawn_passing("receiver", async move {
            loop {
                let stream = tokio::select! {
                    () = stop.cancelled() => return,
                    accepted = listener.accept() => accepted.unwrap().0,
                };
                shared.lock().unwrap().connections += 1;
                let (shared, stop, tls) = (Arc::clone(&shared), stop.clone(), tls.clone());
                accepting.spawn_passing("connection", async move {
                    let serving = async {
                        match tls {
                            None => serve(stream, &shared).await,
                            Some(tls) => match tls.accept(stream).await {
                                Ok(stream) => serve(stream, &shared).await,
                                // The server does not trust the certificate.
                                Err(_refused) => None,
                            },
                        }
                    };
                    tokio::select! {
                        () = stop.cancelled() => {}
                        _ended = serving => {}
                    }
                });
            }
        });
        receiver
    }

    pub(super) fn url(&self) -> String {
        format!("http://{}/alerts?of=yard", self.address)
    }

    pub(super) fn set(&self, mood: Mood) {
        self.shared.lock().unwrap().mood = mood;
    }

    pub(super) fn requests(&self) -> Vec<Request> {
        self.shared.lock().unwrap().requests.clone()
    }

    pub(super) fn connections(&self) -> usize {
        self.shared.lock().unwrap().connections
    }

    /// Waits until that many requests have arrived in all.
    pub(super) async fn has(&self, count: usize) -> Vec<Request> {
        eventually("the receiver has the requests", async || {
            let requests = self.requests();
            if requests.len() >= count {
                Ok(requests)
            } else {
                Err(requests)
            }
        })
        .await
    }
}

/// Reads one request and answers it; `None` if the connection ended.
async fn serve(
    mut stream: impl AsyncRead + AsyncWrite + Unpin,
    shared: &Mutex<Shared>,
) -> Option<()> {
    let mut text = Vec::new();
    let (head, length) = loop {
        let mut piece = [0; 4_096];
        let count = stream
            .read(&mut piece)
            .await
            .ok()
            .filter(|count| *count > 0)?;
        text.extend_from_slice(&piece[..count]);
        let read = String::from_utf8(text.clone()).ok()?;
        if let Some((head, body)) = read.split_once("\r\n\r\n") {
            let length = head.lines().find_map(|line| {
                let (name, value) = line.split_once(':')?;
                let is_length = name.eq_ignore_ascii_case("content-length");
                is_length.then(|| value.trim().parse::<usize>().unwrap())
            });
            if body.len() >= length.unwrap_or(0) {
                break (head.to_owned(), length.unwrap_or(0));
            }
        }
    };
    let body = String::from_utf8(text[head.len() + 4..][..length].to_vec()).ok()?;
    let mut lines = head.lines();
    let line = lines.next()?.to_owned();
    let headers = lines.filter_map(|line| {
        let (name, value) = line.split_once(':')?;
        Some((name.to_ascii_lowercase(), value.trim().to_owned()))
    });
    let request = Request {
        line,
        headers: headers.collect(),
        body,
    };
    let mood = {
        let mut shared = shared.lock().unwrap();
        shared.requests.push(request);
        shared.mood.clone()
    };
    let answer = match mood {
        Mood::Good => "HTTP/1.1 204 No Content\r\n\r\n".to_owned(),
        Mood::Says(status, body) => {
            let length = body.len();
            format!("HTTP/1.1 {status} So\r\ncontent-length: {length}\r\n\r\n{body}")
        }
        Mood::Hangs => std::future::pending().await,
        Mood::ClosesEarly => return None,
        Mood::Redirects(to) => {
            format!("HTTP/1.1 307 There\r\nlocation: {to}\r\ncontent-length: 0\r\n\r\n")
        }
        Mood::Endless => {
            let head = b"HTTP/1.1 500 So\r\n\r\n";
            stream.write_all(head).await.ok()?;
            loop {
                stream.write_all(&PIECE).await.ok()?;
            }
        }
        Mood::Lies(status) => format!("HTTP/1.1 {status} So\r\ncontent-length: 1000\r\n\r\nabc"),
    };
    stream.write_all(answer.as_bytes()).await.ok()?;
    stream.shutdown().await.ok()
}

/// A resolver that knows some names, and counts how often it is asked for each.
#[derive(Debug, Default)]
pub(super) struct Names {
    known: HashMap<&'static str, Vec<Vec<IpAddr>>>,
    asked: Mutex<HashMap<String, usize>>,
}

impl Names {
    /// Each name has the addresses of its first list when it is asked for the first time, and so on;
    /// the last list stays.
    pub(super) fn of(known: &[(&'static str, &[&[&str]])]) -> Arc<Self> {
        let addresses = |list: &&[&str]| list.iter().map(|text| text.parse().unwrap()).collect();
        let known = known
            .iter()
            .map(|(name, lists)| (*name, lists.iter().map(addresses).collect()));
        Arc::new(Self {
            known: known.collect(),
            asked: Mutex::default(),
        })
    }

    pub(super) fn asked(&self, name: &str) -> usize {
        self.asked.lock().unwrap().get(name).copied().unwrap_or(0)
    }
}

impl Resolver for Names {
    fn resolve<'resolver>(&'resolver self, host: &'resolver str) -> Resolved<'resolver> {
        Box::pin(async move {
            let mut asked = self.asked.lock().unwrap();
            let count = asked.entry(host.to_owned()).or_default();
            *count += 1;
            let lists = self.known.get(host);
            let lists = lists.ok_or_else(|| std::io::Error::other("no such name"))?;
            Ok(lists[(*count - 1).min(lists.len() - 1)].clone())
        })
    }
}
