//! The link to the fleet's server: the only module that calls zenoh.
//!
//! The session is a zenoh client that reconnects without end; a robot that has joined a fleet
//! connects through the [`tunnel`]. Calls of zenoh block their thread, so all but the cheapest run
//! on the blocking pool. Callbacks hand over what arrives and never block. This module is
//! independent of the loop, missions and storage, except that [`uploader`] uses the outbox.

mod command;
mod error;
pub mod rotation;
mod session;
mod subscriptions;
mod tunnel;
pub mod uploader;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use serde::Serialize;
use tokio::sync::{mpsc, oneshot, watch};
use tokio_util::sync::{CancellationToken, DropGuard};
use tracing::{debug, warn};
use tread_api::enrolment::TrustId;
use tread_api::ids::{BootId, OwnerId, RobotId, SiteId};
use tread_api::keys;
use tread_api::wire::encoding::Encoding;
use tread_api::wire::hello::{Hello, Welcome};
use tread_api::wire::ingest::{Batch, Receipt};
use tread_api::wire::state::{FrictionReport, RobotState};
use tread_api::wire::{self, RefusalCode};
use zenoh::Wait;
use zenoh::handlers::FifoChannel;
use zenoh::liveliness::LivelinessToken;
use zenoh::pubsub::Publisher;
use zenoh::qos::{CongestionControl, Priority};
use zenoh::query::{ConsolidationMode, Querier};

pub use self::command::IncomingCommand;
pub(crate) use self::error::zenoh_failed;
pub use self::error::{AskError, LinkError, may_pass_later};
pub use self::rotation::{ParallelAttempt, Rotation, Server};
pub(crate) use self::session::config_of;
pub use self::session::{session_config, start_jitter};
pub use self::tunnel::{DialError, Tunnel};
use crate::membership::Membership;

/// Capacity of the queue of commands to answer; a command that finds it full is dropped, and the
/// server repeats it.
pub const COMMANDS_MAX: usize = 64;
/// Longest wait for the server's answer to the introduction ([`Hello`]).
pub const HELLO_TIMEOUT: Duration = Duration::from_secs(2);
/// Longest wait for the server's receipt of an upload.
pub const UPLOAD_TIMEOUT: Duration = Duration::from_secs(10);
/// Longest wait for a session to close.
pub const CLOSE_MAX: Duration = Duration::from_secs(3);
/// Longest wait for a session with a server that accepted the connection, or that needs no tunnel.
const OPEN_MAX: Duration = Duration::from_secs(6);
/// Capacity for replies to one query; there is one server.
const REPLIES_MAX: usize = 4;

/// Identity with which the agent addresses the server.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Identity {
    /// The site.
    pub site: SiteId,
    /// The robot.
    pub robot: RobotId,
    /// This run of the agent.
    pub boot: BootId,
}

/// An event on the link, for counters and watches.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LinkEvent {
    /// A readable message of the server arrived: its pulse, or a small command.
    ServerMessage,
    /// A command was dropped because the queue was full; the server repeats it.
    CommandLost,
    /// The server is not reachable any more.
    ServerLost,
    /// The server stated which authorities robots shall trust.
    Trust(TrustId),
    /// The server's robot port shows a certificate of an authority that this robot does not trust.
    Distrusted,
}

/// Callback for events on the link; must not block.
pub type LinkEventHandler = Arc<dyn Fn(LinkEvent) + Send + Sync>;

/// A message that must not wait in any queue, with its payload as received.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Urgent<'payload> {
    /// A stop; it is answered later, as a command.
    Stop(&'payload [u8]),
    /// A drive command.
    Drive(&'payload [u8]),
    /// A limit by this owner.
    Limit(&'payload OwnerId, &'payload [u8]),
}

/// Callback for urgent messages; must not block.
pub type HandleUrgent = Arc<dyn Fn(Urgent<'_>) + Send + Sync>;

/// Receivers of what arrives on the link.
#[derive(Clone)]
pub struct Listeners {
    /// Called for each event on the link.
    pub on_event: LinkEventHandler,
    /// Called for each urgent message.
    pub urgent: HandleUrgent,
    /// Receives commands; a command that finds the queue full is dropped, and the server repeats
    /// it.
    pub commands: mpsc::Sender<IncomingCommand>,
}

impl Listeners {
    /// Returns listeners that take nothing but stops after the agent has left the server.
    fn until(&self, left: &CancellationToken) -> Self {
        let (on_event, urgent) = (Arc::clone(&self.on_event), Arc::clone(&self.urgent));
        let (no_note, no_drive) = (left.clone(), left.clone());
        Self {
            on_event: Arc::new(move |event| {
                if !no_note.is_cancelled() {
                    on_event(event);
                }
            }),
            urgent: Arc::new(move |message| match message {
                Urgent::Drive(_) | Urgent::Limit(..) if no_drive.is_cancelled() => {}
                Urgent::Stop(_) | Urgent::Drive(_) | Urgent::Limit(..) => urgent(message),
            }),
            commands: self.commands.clone(),
        }
    }
}

impl std::fmt::Debug for Listeners {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.write_str("Listeners")
    }
}

/// A connected session with everything declared.
#[derive(Debug)]
pub struct FleetLink {
    identity: Identity,
    session: zenoh::Session,
    /// Whether the server that welcomed the robot last reads uploads in CBOR.
    uploads_cbor: AtomicBool,
    state: Publisher<'static>,
    friction: Publisher<'static>,
    hello: Querier<'static>,
    ingest: Querier<'static>,
    _alive: LivelinessToken,
    server_seen: watch::Receiver<u64>,
    /// Cancelled when the agent has turned to another server.
    left: CancellationToken,
    /// Cancels it with the link: also with one that was not the first to reach a server.
    _leaving: DropGuard,
    /// Tunnel of the session; must outlive it.
    tunnel: Option<Tunnel>,
}

/// Queue of commands to answer. It outlives a link: a command that arrived by one link is answered
/// even after another one has been opened.
pub type Commands = mpsc::Receiver<IncomingCommand>;

/// Result of an attempt to connect.
#[derive(Debug)]
pub enum Attempt {
    /// The server was reached.
    Reached(Box<FleetLink>),
    /// It was not.
    Failed {
        /// Since the robot does not trust its authority.
        is_distrusted: bool,
    },
}

/// Opens a session. Blocks its thread.
fn open(config: zenoh::Config, given_up: &CancellationToken) -> Option<zenoh::Session> {
    match zenoh::open(config).wait() {
        Ok(session) if given_up.is_cancelled() => {
            let _ = session.close().wait();
            None
        }
        Ok(session) => Some(session),
        Err(cause) => {
            debug!("the server is not reached: {cause}");
            None
        }
    }
}

/// Opens a session on a thread of its own, which can be abandoned, since opening blocks. `None` if the
/// server is not reached within [`OPEN_MAX`].
async fn open_session(config: zenoh::Config) -> Result<Option<zenoh::Session>, LinkError> {
    let (opened, opening) = oneshot::channel();
    let given_up = CancellationToken::new();
    let _give_up = given_up.clone().drop_guard();
    std::thread::Builder::new()
        .name("fleet-connect".to_owned())
        .spawn(move || {
            let session = open(config, &given_up);
            // Without a receiver the session is closed by being dropped.
            let _ = opened.send(session);
        })
        .map_err(|cause| LinkError::Zenoh {
            action: "start a thread",
            problem: cause.to_string(),
        })?;
    let Ok(session) = tokio::time::timeout(OPEN_MAX, opening).await else {
        return Ok(None);
    };
    session.map_err(|_| LinkError::Zenoh {
        action: "open a session",
        problem: "its thread died".to_owned(),
    })
}

/// Checks that texts are endpoints that the agent can connect to.
///
/// # Errors
/// [`LinkError::Endpoint`] names the first that is none.
pub fn check_endpoints(servers: &[String]) -> Result<(), LinkError> {
    servers.iter().try_for_each(|server| check_endpoint(server))
}

fn check_endpoint(server: &str) -> Result<(), LinkError> {
    if server.starts_with("tls/") {
        tunnel::check_endpoint(server)
    } else {
        session_config(server).map(|_| ())
    }
}

impl FleetLink {
    /// Makes one attempt to connect to a server, and declares all publishers, queriers and subscribers. zenoh
    /// does not repeat the attempt if the agent has other servers. If the future is dropped, its thread ends soon.
    ///
    /// # Errors
    /// [`LinkError`] for an invalid endpoint or certificate, or when zenoh refuses a declaration.
    pub async fn connect(
        server: &mut Server,
        has_others: bool,
        membership: Option<&Membership>,
        identity: Identity,
        listeners: Listeners,
    ) -> Result<Attempt, LinkError> {
        let Server {
            endpoint, logged, ..
        } = server;
        let mut tunnel = None;
        let mut config = match membership {
            None => session_config(endpoint)?,
            Some(membership) => {
                match Tunnel::open_once(endpoint, membership, &listeners.on_event, logged).await? {
                    Ok(opened) => tunnel.insert(opened).session_config()?,
                    Err(cause) => {
                        return Ok(Attempt::Failed {
                            is_distrusted: matches!(cause, DialError::Distrusted(_)),
                        });
                    }
                }
            }
        };
        if has_others {
            session::try_once(&mut config)?;
            // A session that is opened to a closed port waits for seconds.
            if tunnel.is_none() && !session::is_listening(endpoint).await {
                return Ok(Attempt::Failed {
                    is_distrusted: false,
                });
            }
        }
        let session = match &tunnel {
            None => open_session(config).await?,
            Some(tunnel) => tokio::select! {
                session = open_session(config) => session?,
                () = tunnel.stale() => None,
            },
        };
        let Some(session) = session else {
            return Ok(Attempt::Failed {
                is_distrusted: false,
            });
        };
        let declaring = tokio::task::spawn_blocking(move || {
            Self::declare(session, identity, &listeners, tunnel)
        });
        let link = declaring.await.map_err(|_| LinkError::Zenoh {
            action: "declare what the agent sends and receives",
            problem: "its thread died".to_owned(),
        })?;
        Ok(Attempt::Reached(Box::new(link?)))
    }

    fn declare(
        session: zenoh::Session,
        identity: Identity,
        listeners: &Listeners,
        tunnel: Option<Tunnel>,
    ) -> Result<Self, LinkError> {
        let (site, robot) = (&identity.site, &identity.robot);
        let left = CancellationToken::new();
        let listeners = &listeners.until(&left);
        subscriptions::listen_to_commands(&session, &identity, listeners, &left)?;
        subscriptions::listen_urgently(&session, &identity, &listeners.urgent)?;
        subscriptions::listen_to_pulse(&session, site, &listeners.on_event)?;
        // The state has priority over everything else that the robot sends, records have the least.
        let publisher = |key: String, priority: Priority| {
            let publisher = session.declare_publisher(key).priority(priority);
            publisher.congestion_control(CongestionControl::Drop).wait()
        };
        let querier = |key: String, timeout: Duration, priority: Priority| {
            let querier = session.declare_querier(key).priority(priority);
            querier
                .consolidation(ConsolidationMode::None)
                .timeout(timeout)
                .wait()
        };
        let state = publisher(keys::state(site, robot), Priority::DataHigh)
            .map_err(zenoh_failed("declare `state`"))?;
        let friction = publisher(keys::friction(site, robot), Priority::Data)
            .map_err(zenoh_failed("declare `friction`"))?;
        let ingest = querier(keys::ingest(site, robot), UPLOAD_TIMEOUT, Priority::DataLow)
            .map_err(zenoh_failed("declare `ingest`"))?;
        let hello = querier(keys::hello(site, robot), HELLO_TIMEOUT, Priority::DataHigh)
            .map_err(zenoh_failed("declare `hello`"))?;
        let (seen_sender, server_seen) = watch::channel(0_u64);
        let on_event = Arc::clone(&listeners.on_event);
        hello
            .matching_listener()
            .callback(move |status| {
                if status.matching() {
                    seen_sender.send_modify(|count| *count += 1);
                } else {
                    on_event(LinkEvent::ServerLost);
                }
            })
            .background()
            .wait()
            .map_err(zenoh_failed("listen for the server"))?;
        let alive = session
            .liveliness()
            .declare_token(keys::alive(site, robot, identity.boot))
            .wait()
            .map_err(zenoh_failed("declare the liveliness token"))?;
        Ok(Self {
            identity,
            session,
            uploads_cbor: AtomicBool::new(false),
            state,
            friction,
            hello,
            ingest,
            _alive: alive,
            server_seen,
            _leaving: left.clone().drop_guard(),
            left,
            tunnel,
        })
    }

    /// Returns a counter that increases whenever the server becomes reachable.
    pub fn server_seen(&self) -> watch::Receiver<u64> {
        self.server_seen.clone()
    }

    /// Returns the identity of this agent.
    pub fn identity(&self) -> &Identity {
        &self.identity
    }

    /// Publishes the state; it is dropped if the network is congested.
    pub fn publish_state(&self, state: &RobotState) {
        match wire::encode(state) {
            Ok(payload) => log_failed(self.state.put(payload).wait(), "state"),
            Err(cause) => debug!("the state cannot be written: {cause}"),
        }
    }

    /// Publishes both friction estimates; they are dropped if the network is congested.
    pub fn publish_friction(&self, report: &FrictionReport) {
        match wire::encode(report) {
            Ok(payload) => log_failed(self.friction.put(payload).wait(), "friction"),
            Err(cause) => debug!("friction cannot be written: {cause}"),
        }
    }

    /// Sends the robot's hello to the server and returns its welcome.
    ///
    /// # Errors
    /// [`AskError`] if the hello cannot be encoded, or no readable answer arrives.
    pub async fn hello(self: &Arc<Self>, hello: &Hello) -> Result<Welcome, AskError> {
        let answer = self.ask(Encoding::Json, Question::Hello, hello).await?;
        let welcome: Welcome = wire::decode(&answer).map_err(AskError::Unreadable)?;
        self.uploads_cbor.store(
            welcome.upload_encoding() == Encoding::Cbor,
            Ordering::Relaxed,
        );
        Ok(welcome)
    }

    /// Uploads a batch in the encoding that the server's welcome names; the receipt is sent after the
    /// server's commit.
    ///
    /// # Errors
    /// [`AskError`] if there is no readable receipt: the batch may or may not have been stored.
    pub async fn upload(self: &Arc<Self>, batch: &Batch) -> Result<Receipt, AskError> {
        let encoding = self.upload_encoding();
        let mut answer = self.ask(encoding, Question::Ingest, batch).await;
        let is_unread = |answer: &Result<_, AskError>| match answer {
            Err(AskError::Refused(refusal)) => refusal.code == RefusalCode::Malformed,
            _ => false,
        };
        // An older server may have taken the place of the one that welcomed the robot.
        if encoding == Encoding::Cbor && is_unread(&answer) {
            self.uploads_cbor.store(false, Ordering::Relaxed);
            answer = self.ask(Encoding::Json, Question::Ingest, batch).await;
        }
        wire::decode(&answer?).map_err(AskError::Unreadable)
    }

    fn upload_encoding(&self) -> Encoding {
        if self.uploads_cbor.load(Ordering::Relaxed) {
            Encoding::Cbor
        } else {
            Encoding::Json
        }
    }

    async fn ask<T: Serialize>(
        self: &Arc<Self>,
        encoding: Encoding,
        question: Question,
        body: &T,
    ) -> Result<Vec<u8>, AskError> {
        let payload = wire::encode_as(encoding, body).map_err(AskError::Unwritable)?;
        let link = Arc::clone(self);
        // Sending blocks while the network is slow.
        let sending = tokio::task::spawn_blocking(move || {
            let querier = match question {
                Question::Hello => &link.hello,
                Question::Ingest => &link.ingest,
            };
            querier
                .get()
                .payload(payload)
                .encoding(encoding.media_type())
                .with(FifoChannel::new(REPLIES_MAX))
                .wait()
        });
        let replies = sending
            .await
            .map_err(|_| AskError::NoAnswer)?
            .map_err(zenoh_failed("send a query"))?;
        // The channel closes by itself at the query's timeout.
        let Ok(reply) = replies.recv_async().await else {
            return Err(AskError::NoAnswer);
        };
        match reply.into_result() {
            Ok(sample) => Ok(sample.payload().to_bytes().into_owned()),
            Err(error) => Err(AskError::of_reply(&error.payload().to_bytes())),
        }
    }

    /// Waits until the session can no longer reconnect, so that the link must be opened again.
    pub async fn lost_for_good(&self) {
        match &self.tunnel {
            Some(tunnel) => tunnel.stale().await,
            None => std::future::pending().await,
        }
    }

    /// Takes nothing but stops from this server any more, since the agent turns to another one.
    pub fn leave(&self) {
        self.left.cancel();
    }

    /// Closes the session; the server sees the robot's liveliness token disappear.
    pub async fn close(&self) {
        let session = self.session.clone();
        let closing = tokio::task::spawn_blocking(move || session.close().wait());
        match tokio::time::timeout(CLOSE_MAX, closing).await {
            Ok(Ok(Ok(()))) => {}
            Ok(Ok(Err(cause))) => warn!("the session did not close cleanly: {cause}"),
            Ok(Err(_)) | Err(_) => warn!("the session did not close in time"),
        }
    }
}

#[derive(Debug, Clone, Copy)]
enum Question {
    Hello,
    Ingest,
}

fn log_failed(sent: zenoh::Result<()>, what: &str) {
    if let Err(cause) = sent {
        debug!("`{what}` was not published: {cause}");
    }
}
