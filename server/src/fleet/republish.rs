//! Republishes the robots' states and friction, and changes of maps, on another zenoh router of this machine.
//!
//! Only robots may connect to the server's own routers. Subscribers of a site, such as a dashboard or a bridge,
//! connect to the other router and receive the messages under the same keys. The server reads nothing from that
//! router, so nothing that is published there reaches a robot.

use std::collections::HashMap;
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::time::Duration;

use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;
use tracing::{debug, info, warn};
use zenoh::pubsub::Publisher;
use zenoh::qos::CongestionControl;
use zenoh::{Session, Wait as _};

use super::client::{client_config, close};
use crate::app::App;
use crate::app::enrolment::FLEET_ROBOTS_MAX;
use crate::supervisor::Supervisor;

/// Maximum number of messages that wait: one second of a thousand robots at 10 Hz.
const WAITING_MAX: usize = 10_000;
/// Maximum size of the messages that wait, bytes.
const WAITING_BYTES_MAX: usize = 32 * 1024 * 1024;
/// Maximum number of messages that are published before others have their turn.
const AT_ONCE_MAX: usize = 1_000;
/// Maximum number of declared publishers: states and friction of all robots, and room for maps.
const PUBLISHERS_MAX: usize = 3 * FLEET_ROBOTS_MAX as usize;
/// Maximum time of one attempt to reach the router, and the pause before the next.
const OPEN_TIMEOUT: Duration = Duration::from_secs(3);
const RETRY: Duration = Duration::from_secs(2);
/// Interval of log lines about messages that were dropped.
const LOG_EVERY: Duration = Duration::from_mins(1);

/// Handle to publish messages at the router; clones share its queue.
#[derive(Debug, Clone)]
pub(super) struct Republisher {
    messages: mpsc::Sender<Message>,
    queue: Arc<Queue>,
}

/// State of the queue.
#[derive(Debug, Default)]
struct Queue {
    /// Whether the router was reached; before, nothing waits.
    is_open: AtomicBool,
    /// Size of the payloads that wait.
    bytes: AtomicUsize,
    dropped: AtomicU64,
}

#[derive(Debug)]
struct Message {
    key: String,
    payload: Vec<u8>,
}

impl Republisher {
    /// Starts the task that publishes at a router, which is tried again until it is reached.
    pub(super) fn start(router: SocketAddr, app: &App, supervisor: &Supervisor) -> Self {
        let (messages, messages_in) = mpsc::channel(WAITING_MAX);
        app.metrics().queues().show("republished", &messages);
        let queue = Arc::default();
        let publishing = run(
            (router, supervisor.clone()),
            messages_in,
            Arc::clone(&queue),
            supervisor.stop_token(),
        );
        supervisor.spawn_vital("republisher", publishing);
        Self { messages, queue }
    }

    /// Hands a message over. One that finds no room is dropped and counted: the next one follows soon.
    pub(super) fn publish(&self, key: String, payload: Vec<u8>) {
        let queue = &self.queue;
        if !queue.is_open.load(Ordering::Acquire) {
            return;
        }
        let size = payload.len();
        let waiting = queue.bytes.fetch_add(size, Ordering::Relaxed) + size;
        let message = Message { key, payload };
        if waiting > WAITING_BYTES_MAX || self.messages.try_send(message).is_err() {
            queue.bytes.fetch_sub(size, Ordering::Relaxed);
            queue.dropped.fetch_add(1, Ordering::Relaxed);
        }
    }
}

async fn run(
    (router, supervisor): (SocketAddr, Supervisor),
    mut messages: mpsc::Receiver<Message>,
    queue: Arc<Queue>,
    stop: CancellationToken,
) {
    let mut is_logged = false;
    let session = loop {
        let opening = supervisor.blocking(move || open(router));
        let opened = tokio::select! {
            biased;
            () = stop.cancelled() => return,
            opened = opening => opened,
        };
        let reason = match opened {
            Some(Ok(session)) => break session,
            Some(Err(error)) => error.to_string(),
            None => "it panicked".to_owned(),
        };
        if !std::mem::replace(&mut is_logged, true) {
            warn!("cannot republish at the zenoh router {router}, which is tried again: {reason}");
        }
        tokio::select! {
            biased;
            () = stop.cancelled() => return,
            () = tokio::time::sleep(RETRY) => {}
        }
    };
    queue.is_open.store(true, Ordering::Release);
    info!("states, friction and map changes are republished at the zenoh router {router}");
    let mut publishers = HashMap::new();
    let mut waiting = Vec::new();
    let mut log = tokio::time::interval(LOG_EVERY);
    loop {
        tokio::select! {
            biased;
            () = stop.cancelled() => break,
            _ = log.tick() => {
                let dropped = queue.dropped.swap(0, Ordering::Relaxed);
                if dropped > 0 {
                    warn!("{dropped} messages were not republished at {router}: its queue was full");
                }
            }
            count = messages.recv_many(&mut waiting, AT_ONCE_MAX) => {
                if count == 0 {
                    stop.cancelled().await;
                    break;
                }
                for message in waiting.drain(..) {
                    queue.bytes.fetch_sub(message.payload.len(), Ordering::Relaxed);
                    if let Err(error) = publish(&session, &mut publishers, message) {
                        debug!("a message was not republished at {router}: {error}");
                    }
                }
                tokio::task::yield_now().await;
            }
        }
    }
    drop(publishers);
    close(session).await;
}

/// Opens a session, which reconnects automatically after the router was unavailable. Blocks its thread.
fn open(router: SocketAddr) -> zenoh::Result<Session> {
    zenoh::open(client_config(router, None, OPEN_TIMEOUT.as_millis())?).wait()
}

/// Publishes a message by a declared publisher: an undeclared key costs the router more.
fn publish(
    session: &Session,
    publishers: &mut HashMap<String, Publisher<'static>>,
    message: Message,
) -> zenoh::Result<()> {
    let Message { key, payload } = message;
    if let Some(publisher) = publishers.get(&key) {
        return publisher.put(payload).wait();
    }
    if publishers.len() >= PUBLISHERS_MAX {
        // Robots that left long ago are among them; the others are declared again.
        publishers.clear();
    }
    let declaring = session
        .declare_publisher(key.clone())
        .congestion_control(CongestionControl::Drop);
    let publisher = declaring.wait()?;
    publisher.put(payload).wait()?;
    publishers.insert(key, publisher);
    Ok(())
}
