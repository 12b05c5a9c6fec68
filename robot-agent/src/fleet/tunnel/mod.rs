//! The TLS tunnel to the server's robot port. TLS is outside, zenoh inside.
//!
//! ```text
//!  zenoh session ──TCP on the loopback──► tunnel ──TLS, the robot's certificate──► robot port
//! ```
//!
//! zenoh's own TLS link reads and writes one rustls stream from two tasks at once, which is
//! undefined behaviour. So zenoh uses plain TCP to a port of this process, and each of its
//! connections is joined to a TLS connection of its own. Other programs on the robot can reach the
//! local port too: no connection to the server is made for one that does not begin with the session
//! id, whose lower half is random and known to this process alone, and the router requires a
//! password. Connections that have not sent the id count against a limit of their own.

mod dial;
#[cfg(test)]
mod tests;

use std::collections::VecDeque;
use std::io;
use std::net::{Ipv4Addr, SocketAddr};
use std::sync::{Arc, PoisonError};
use std::time::Duration;

use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::{TcpListener, TcpSocket, TcpStream};
use tokio::sync::{Mutex, Semaphore};
use tokio::task::JoinSet;
use tokio_util::sync::CancellationToken;
use tracing::{debug, warn};
use tread_api::tunnel::{RouterCredentials, splice};

pub use self::dial::DialError;
use self::dial::{Connection, Dialer};
use super::rotation::Logged;
use super::session::{self, SessionUser};
use super::{LinkError, LinkEvent, LinkEventHandler};
use crate::membership::Membership;

/// Timeout of the first message on a local connection; zenoh sends it at once.
const FIRST_MESSAGE_TIMEOUT: Duration = Duration::from_millis(500);
/// Largest size of the first message, bytes.
const FIRST_MESSAGE_BYTES_MAX: u16 = 1_024;
/// Size of the length prefix of zenoh's messages on a stream, bytes.
const MESSAGE_LENGTH_BYTES: usize = 2;
/// Largest number of simultaneous connections of the session, which needs one, briefly two.
const CONNECTIONS_MAX: usize = 16;
/// Largest number of simultaneous local connections that have not sent the session id; the oldest
/// is closed. They are counted apart, so that other programs cannot use up the session's
/// connections.
const UNKNOWN_CLIENTS_MAX: usize = 16;
/// Interval of the log lines that count other programs at the local port.
const UNKNOWN_CLIENTS_LOG_EVERY: Duration = Duration::from_mins(1);
/// Connections that the kernel queues until they are accepted.
const BACKLOG: u32 = 16;
/// Receive buffer of the local port, and buffer of the tunnel per direction, bytes; data in them
/// are sent regardless of priority.
const RECEIVE_BUFFER_BYTES: u32 = 4 * 1024;
const COPY_BUFFER_BYTES: usize = 4 * 1024;
/// First and longest pause after a failed attempt to connect.
const RETRY_FIRST: Duration = Duration::from_millis(100);
const RETRY_MAX: Duration = Duration::from_millis(300);
/// Longest pause while the robot does not trust the server's authority. The server counts each
/// attempt as a failure of its address, which other robots may share.
const DISTRUSTED_RETRY_MAX: Duration = Duration::from_secs(10);
/// Pause after the machine failed to accept a connection.
const ACCEPT_REST: Duration = Duration::from_millis(100);

/// An open tunnel; dropping it closes it.
#[derive(Debug)]
pub struct Tunnel {
    local: SocketAddr,
    user: SessionUser,
    stale: CancellationToken,
    _tasks: JoinSet<()>,
}

/// State shared by the connections of one tunnel.
struct Shared {
    dialer: Dialer,
    credentials: RouterCredentials,
    /// Session id in the byte order of the session's first message.
    session_id: [u8; 16],
    /// Connection by which the credentials were received; the session's first connection uses it.
    ready: Mutex<Option<Connection>>,
    /// Permits for the session's connections.
    places: Semaphore,
    unknown_clients: UnknownClientLog,
    stale: CancellationToken,
}

/// Counts other programs at the local port, and logs the number at intervals.
#[derive(Default)]
struct UnknownClientLog(std::sync::Mutex<UnknownClientCount>);

#[derive(Default)]
struct UnknownClientCount {
    count: u64,
    logged_at: Option<tokio::time::Instant>,
}

impl UnknownClientLog {
    /// Counts one more; returns the number since the last log line if one is due.
    fn count_client(&self, now: tokio::time::Instant) -> Option<u64> {
        let mut counted = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        counted.count += 1;
        let is_due = counted
            .logged_at
            .is_none_or(|logged_at| now.duration_since(logged_at) >= UNKNOWN_CLIENTS_LOG_EVERY);
        if !is_due {
            return None;
        }
        counted.logged_at = Some(now);
        Some(std::mem::take(&mut counted.count))
    }

    fn record(&self) {
        if let Some(count) = self.count_client(tokio::time::Instant::now()) {
            warn!(
                count,
                "other programs connected to the tunnel's local port; they were closed"
            );
        }
    }
}

/// Checks that a text is an endpoint of the robots' port.
///
/// # Errors
/// [`LinkError::Endpoint`].
pub(super) fn check_endpoint(endpoint: &str) -> Result<(), LinkError> {
    dial::check_endpoint(endpoint)
}

impl Tunnel {
    /// Opens a tunnel to the server: retries until the server accepts the connection, however long
    /// that takes. If the future is dropped, the attempt ends and leaves nothing behind.
    ///
    /// # Errors
    /// [`LinkError`] at once, without a retry: the endpoint is invalid, the certificate cannot be
    /// used, or no local port can be opened.
    pub async fn open(endpoint: &str, membership: &Membership) -> Result<Self, LinkError> {
        let nobody: LinkEventHandler = Arc::new(|_event| {});
        let mut pause = RETRY_FIRST;
        let mut logged = Logged::default();
        loop {
            match Self::open_once(endpoint, membership, &nobody, &mut logged).await? {
                Ok(tunnel) => return Ok(tunnel),
                Err(cause) => {
                    tokio::time::sleep(pause).await;
                    pause = next_pause(pause, &cause);
                }
            }
        }
    }

    /// Makes one attempt to open a tunnel. If an authority that the robot does not trust issued the
    /// server's certificate, logs it and reports [`LinkEvent::Distrusted`], unless that was logged
    /// before.
    ///
    /// # Errors
    /// As [`Tunnel::open`]; the inner error if the server could not be reached.
    pub(super) async fn open_once(
        endpoint: &str,
        membership: &Membership,
        on_event: &LinkEventHandler,
        logged: &mut Logged,
    ) -> Result<Result<Self, DialError>, LinkError> {
        let dialer = Dialer::new(endpoint, membership)?;
        match dialer.dial(&[]).await {
            Ok(dialled) => Self::through(dialer, dialled).map(Ok),
            Err(cause) => {
                debug!(
                    error = &cause as &dyn std::error::Error,
                    "no tunnel yet: {cause}"
                );
                if matches!(cause, DialError::Distrusted(_)) && !logged.distrusted {
                    logged.distrusted = true;
                    warn!(
                        "the server at {endpoint} shows a certificate of another authority than \
                         this robot trusts; it is tried again"
                    );
                    on_event(LinkEvent::Distrusted);
                }
                if cause.is_about_validity() && !logged.invalid {
                    logged.invalid = true;
                    warn!(
                        error = &cause as &dyn std::error::Error,
                        "no link to {endpoint}: {cause}; it is tried again"
                    );
                }
                Ok(Err(cause))
            }
        }
    }

    /// Opens the local port of a tunnel.
    fn through(
        dialer: Dialer,
        (connection, credentials): (Connection, RouterCredentials),
    ) -> Result<Self, LinkError> {
        let (_, lower) = uuid::Uuid::new_v4().as_u64_pair();
        let user = SessionUser {
            session_id: credentials.session_prefix.session_id(lower),
            user: credentials.user.clone(),
            password: credentials.password.clone(),
        };
        let number = u128::from_str_radix(&user.session_id, 16).unwrap_or_default();
        let listener = listen().map_err(LinkError::LocalPort)?;
        let local = listener.local_addr().map_err(LinkError::LocalPort)?;
        let stale = CancellationToken::new();
        let shared = Arc::new(Shared {
            dialer,
            credentials,
            session_id: number.to_le_bytes(),
            ready: Mutex::new(Some(connection)),
            places: Semaphore::new(CONNECTIONS_MAX),
            unknown_clients: UnknownClientLog::default(),
            stale: stale.clone(),
        });
        let mut tasks = JoinSet::new();
        tasks.spawn(serve(listener, shared));
        Ok(Self {
            local,
            user,
            stale,
            _tasks: tasks,
        })
    }

    /// Creates the configuration of a session through this tunnel.
    ///
    /// # Errors
    /// [`LinkError`] if zenoh refuses a setting.
    pub fn session_config(&self) -> Result<zenoh::Config, LinkError> {
        session::tunnel_config(self.local, &self.user)
    }

    /// Waits until a session through this tunnel can no longer connect: the server has other
    /// credentials for this robot, or a certificate that the robot does not trust. A new tunnel
    /// must then be opened.
    pub async fn stale(&self) {
        self.stale.cancelled().await;
    }
}

/// Returns the pause after another failed attempt.
fn next_pause(pause: Duration, cause: &DialError) -> Duration {
    let longest = match cause {
        DialError::Distrusted(_) => DISTRUSTED_RETRY_MAX,
        DialError::Unreachable(_)
        | DialError::Expired(_)
        | DialError::ClockWrong(_)
        | DialError::TooSlow
        | DialError::NotUnderstood => RETRY_MAX,
    };
    (2 * pause).min(longest)
}

/// Listens on the loopback with a small receive buffer.
fn listen() -> io::Result<TcpListener> {
    let socket = TcpSocket::new_v4()?;
    socket.set_recv_buffer_size(RECEIVE_BUFFER_BYTES)?;
    socket.bind(SocketAddr::from((Ipv4Addr::LOCALHOST, 0)))?;
    socket.listen(BACKLOG)
}

async fn serve(listener: TcpListener, shared: Arc<Shared>) {
    // However this task ends, the owner opens another tunnel.
    let _stale = shared.stale.clone().drop_guard();
    let mut connections = JoinSet::new();
    // Connections that have not sent the session id, oldest first.
    let mut unknown_clients: VecDeque<CancellationToken> = VecDeque::new();
    while !shared.stale.is_cancelled() {
        let accepted = tokio::select! {
            accepted = listener.accept() => accepted,
            () = shared.stale.cancelled() => return,
        };
        while connections.try_join_next().is_some() {}
        unknown_clients.retain(|known| !known.is_cancelled());
        match accepted {
            Ok((local, _peer)) => {
                if unknown_clients.len() >= UNKNOWN_CLIENTS_MAX
                    && let Some(oldest) = unknown_clients.pop_front()
                {
                    oldest.cancel();
                }
                let known = CancellationToken::new();
                unknown_clients.push_back(known.clone());
                connections.spawn(take(local, Arc::clone(&shared), known));
            }
            Err(cause) => {
                warn!("the tunnel's local port cannot accept: {cause}");
                tokio::time::sleep(ACCEPT_REST).await;
            }
        }
    }
}

/// Reads the first message of a local connection; joins one with the session id to the server,
/// closes any other. `known` is cancelled when the connection has sent its first message, or is
/// closed for a newer one.
async fn take(mut local: TcpStream, shared: Arc<Shared>, known: CancellationToken) {
    if let Err(cause) = local.set_nodelay(true) {
        debug!("cannot send at once: {cause}");
    }
    let reading = tokio::time::timeout(FIRST_MESSAGE_TIMEOUT, read_message(&mut local));
    let read = tokio::select! {
        read = reading => read,
        () = known.cancelled() => return shared.unknown_clients.record(),
    };
    known.cancel();
    let has_id = |bytes: &[u8]| *bytes == shared.session_id;
    let first = match read {
        Ok(Ok(first)) if first.windows(shared.session_id.len()).any(has_id) => first,
        Ok(_) | Err(_) => return shared.unknown_clients.record(),
    };
    let Ok(_place) = shared.places.try_acquire() else {
        return warn!("the session has too many connections");
    };
    join(local, &shared, first).await;
}

/// Joins one connection of the session to one to the server, until either ends.
async fn join(local: TcpStream, shared: &Shared, first: Vec<u8>) {
    let ready = shared.ready.lock().await.take();
    let connected = match ready {
        Some(mut connection) => connection
            .write_all(&first)
            .await
            .map(|()| connection)
            .map_err(DialError::from),
        None => reconnect(shared, &first).await,
    };
    let remote = match connected {
        Ok(remote) => remote,
        Err(cause) => {
            return debug!(
                error = &cause as &dyn std::error::Error,
                "the server is not reached: {cause}"
            );
        }
    };
    if let Err(cause) = splice(local, remote, COPY_BUFFER_BYTES).await {
        debug!("the tunnel's connection broke: {cause}");
    }
}

/// Connects again; the first message is sent along, since the credentials are most likely
/// unchanged.
async fn reconnect(shared: &Shared, first: &[u8]) -> Result<Connection, DialError> {
    let dialled = shared.dialer.dial(first).await;
    let is_lasting =
        |cause: &DialError| matches!(cause, DialError::Distrusted(_)) || cause.is_about_validity();
    if dialled.as_ref().err().is_some_and(is_lasting) {
        // The session cannot reconnect with the authorities that this tunnel trusts. Opening
        // another tunnel notes it, so that the robot requests a certificate of the present
        // authority.
        shared.stale.cancel();
    }
    let (connection, credentials) = dialled?;
    if credentials != shared.credentials {
        shared.stale.cancel();
        return Err(DialError::NotUnderstood);
    }
    Ok(connection)
}

/// Reads the first message, including its length prefix.
async fn read_message(local: &mut TcpStream) -> io::Result<Vec<u8>> {
    let length = local.read_u16_le().await?;
    if length > FIRST_MESSAGE_BYTES_MAX {
        return Err(io::ErrorKind::InvalidData.into());
    }
    let mut message = vec![0; MESSAGE_LENGTH_BYTES + usize::from(length)];
    message[..MESSAGE_LENGTH_BYTES].copy_from_slice(&length.to_le_bytes());
    local
        .read_exact(&mut message[MESSAGE_LENGTH_BYTES..])
        .await?;
    Ok(message)
}
