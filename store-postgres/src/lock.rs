//! Lock of a database: allows one server at a time.
//!
//! PostgreSQL serves any number of programs, but a server keeps the map in memory and alone decides what
//! its robots do. The lock belongs to a connection of its own, and PostgreSQL releases it when that ends,
//! as at its restart: it is taken again then, and [`DatabaseLock::lost`] returns only if
//! another server was faster. After a network failure PostgreSQL may still have the old session, which is
//! ended first: a server does not stop because of itself. Programs that only read do not take the lock.
//!
//! A standby waits for the lock ([`DatabaseLock::wait`]). The session that holds it asks something every
//! [`CHECK_INTERVAL`], so a server that is frozen, or cut off, shows as a process whose sessions were all silent
//! for longer: the standby ends all sessions of that server then, also one in the middle of a write. A server
//! that wakes up writes no more, since the new one has claimed the database ([`super::Db::claim`]).

use std::future::pending;
use std::io;
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use sqlx::PgConnection;
use sqlx::postgres::PgConnectOptions;
use tokio::sync::watch;
use tokio::task::JoinHandle;
use tokio::time::{Instant, sleep, timeout};
use tracing::warn;

use super::{OpenError, connections, open};

/// Interval at which a server checks that it still has the lock.
const CHECK_INTERVAL: Duration = Duration::from_millis(100);
/// Interval at which a standby tries to take the lock.
const STANDBY_INTERVAL: Duration = Duration::from_millis(100);
/// Interval at which a standby tries to reach PostgreSQL.
const RETRY_INTERVAL: Duration = Duration::from_millis(250);
/// Maximum time for an answer about it.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(5);
/// Maximum time between two checks of a silent server by a standby: PostgreSQL may have stood still itself.
const CHECK_GAP_MAX: Duration = Duration::from_millis(500);
/// Number of late checks in a row after which it is said that a silent server would not be noticed.
const LATE_CHECKS_MAX: u32 = 20;
/// Maximum time for an attempt to take the lock: that for a connection and an answer.
const ATTEMPT_TIMEOUT: Duration = Duration::from_secs(15);
/// Interval at which the lock is tried while a session ends that holds it.
const ENDING_INTERVAL: Duration = Duration::from_millis(20);
/// Takes the lock, whose number is "treadsrv" in ASCII. PostgreSQL ends the connection of a machine that
/// does not answer any more after 25 s, and with it the lock.
const TAKE: &str = "SELECT pg_try_advisory_lock(8390880524716175990),
    set_config('tcp_keepalives_idle', '10', FALSE), set_config('tcp_keepalives_interval', '5', FALSE),
    set_config('tcp_keepalives_count', '3', FALSE)";
/// Selects something of the session that has the lock, with further conditions.
macro_rules! select_owner {
    ($columns:literal, $further:literal) => {
        concat!(
            "SELECT ",
            $columns,
            " FROM pg_locks JOIN pg_stat_activity USING (pid)
            WHERE locktype = 'advisory' AND granted AND objsubid = 1
                AND database = (SELECT oid FROM pg_database WHERE datname = current_database())
                AND (CAST(classid AS BIGINT) << 32) | CAST(objid AS BIGINT) = 8390880524716175990 ",
            $further
        )
    };
}
/// Ends the session that has the lock, if it is another one of this process.
const END_OWN: &str = select_owner!(
    "pg_terminate_backend(pid)",
    "AND application_name = current_setting('application_name') AND pid <> pg_backend_pid()"
);
/// Returns the session that holds the lock: see [`Session`].
const SESSION: &str = select_owner!(
    "application_name AS process, pid,
        (SELECT CAST(MAX(own.state_change) AS TEXT) FROM pg_stat_activity AS own
            WHERE own.datname = current_database()
                AND own.application_name = pg_stat_activity.application_name) AS asked_at,
        COALESCE(host(client_addr), 'this machine') AS client,
        to_char(backend_start AT TIME ZONE 'UTC', 'YYYY-MM-DD HH24:MI:SS') AS since",
    "LIMIT 1"
);
/// Ends all sessions of a process, if none of them has asked anything since.
const END_PROCESS: &str = "SELECT COUNT(pg_terminate_backend(pid)) FROM pg_stat_activity
    WHERE datname = current_database() AND application_name = $1 AND pid <> pg_backend_pid()
        AND (SELECT CAST(MAX(own.state_change) AS TEXT) FROM pg_stat_activity AS own
            WHERE own.datname = current_database() AND own.application_name = $1) = $2";

/// Reason why a server may not use a database.
#[derive(Debug, thiserror::Error)]
pub enum LockError {
    /// Another server uses it.
    #[error(
        "the database `{address}` is used by another server{holder}: stop that one first, or give \
         this one a database of its own"
    )]
    InUse {
        /// The address, without a password.
        address: String,
        /// ` (at ADDRESS, since TIME)`, or empty if it is not known.
        holder: String,
    },
    /// The database cannot be opened.
    #[error(transparent)]
    Open(OpenError),
}

/// Exclusive use of a database by this process, until it is released or dropped, or another server was
/// faster after the connection was lost.
#[derive(Debug)]
pub struct DatabaseLock {
    keeping: JoinHandle<()>,
    lost: watch::Receiver<Option<String>>,
    epoch: Arc<OnceLock<i64>>,
}

impl DatabaseLock {
    /// Locks the database of an address.
    ///
    /// # Errors
    /// [`LockError::InUse`] says who holds the lock; [`LockError::Open`].
    pub async fn take(url: &str) -> Result<Self, LockError> {
        let (options, address) = open::options_of(url).map_err(LockError::Open)?;
        let locked = bounded(&address, locked(&options, &address)).await?;
        Ok(Self::keeping(locked, options, address))
    }

    /// Waits until the server that has the lock ends, or has not said anything for a time, and takes the
    /// lock then. `waiting` is called with the reason at each attempt. A database that cannot be reached
    /// is tried again.
    ///
    /// # Errors
    /// [`LockError::Open`]: the address cannot be read.
    pub async fn wait(
        url: &str,
        silence_max: Duration,
        mut waiting: impl FnMut(&LockError),
    ) -> Result<Self, LockError> {
        let (options, address) = open::options_of(url).map_err(LockError::Open)?;
        let mut watch = Watch::default();
        loop {
            let attempt = watch.attempt(&options, &address, silence_max);
            let pause = match bounded(&address, attempt).await {
                Ok(Attempt::Taken(locked)) => {
                    return Ok(Self::keeping(locked, options, address));
                }
                // Its lock is free as soon as PostgreSQL has ended its session.
                Ok(Attempt::Ended) => ENDING_INTERVAL,
                Ok(Attempt::InUse(holder)) => {
                    waiting(&in_use(&address, holder));
                    STANDBY_INTERVAL
                }
                Err(reason) => {
                    waiting(&reason);
                    // What was seen before says nothing about the time without answers.
                    watch.disconnect();
                    RETRY_INTERVAL
                }
            };
            sleep(pause).await;
        }
    }

    fn keeping(locked: PgConnection, options: PgConnectOptions, address: String) -> Self {
        let (losing, lost) = watch::channel(None);
        let epoch = Arc::new(OnceLock::new());
        let own_epoch = Arc::clone(&epoch);
        #[expect(
            clippy::disallowed_methods,
            reason = "ends with the lock, which aborts it; the lock outlives all other tasks of a server"
        )]
        let keeping = tokio::spawn(async move {
            let in_use = keep(locked, &options, &address, &own_epoch).await;
            losing.send_replace(Some(in_use.to_string()));
        });
        Self {
            keeping,
            lost,
            epoch,
        }
    }

    /// Notes the epoch of this server: once another one has a newer epoch, this one does not take the lock again
    /// after it lost its connection.
    pub fn claimed(&self, epoch: i64) {
        // A process claims once.
        let _ = self.epoch.set(epoch);
    }

    /// Waits until another server has the lock, and returns why this one must stop.
    pub fn lost(&self) -> impl Future<Output = String> + Send + 'static {
        let mut lost = self.lost.clone();
        async move {
            let reason = lost.wait_for(Option::is_some).await.ok();
            match reason.and_then(|reason| reason.clone()) {
                Some(reason) => reason,
                // The lock was released.
                None => pending().await,
            }
        }
    }

    /// Releases the lock, and waits until its connection is closed here.
    pub async fn release(mut self) {
        self.keeping.abort();
        // It was aborted, or has ended.
        let _ = (&mut self.keeping).await;
    }
}

impl Drop for DatabaseLock {
    fn drop(&mut self) {
        self.keeping.abort();
    }
}

/// Checks that the lock is held, and takes it again when its connection was lost. Returns when
/// another server has it.
async fn keep(
    mut connection: PgConnection,
    options: &PgConnectOptions,
    address: &str,
    epoch: &OnceLock<i64>,
) -> LockError {
    loop {
        sleep(CHECK_INTERVAL).await;
        let checking = sqlx::query("SELECT 1").execute(&mut connection);
        if matches!(timeout(ANSWER_TIMEOUT, checking).await, Ok(Ok(_))) {
            continue;
        }
        warn!("the connection that holds the lock of the database is lost");
        connection = loop {
            let own = epoch.get().copied();
            match bounded(address, locked_again(options, address, own)).await {
                Ok(locked) => break locked,
                Err(in_use @ LockError::InUse { .. }) => return in_use,
                // PostgreSQL is away, as every transaction notices too.
                Err(LockError::Open(_)) => sleep(CHECK_INTERVAL).await,
            }
        };
    }
}

/// Limits the time for an attempt to take the lock.
async fn bounded<T>(
    address: &str,
    attempt: impl Future<Output = Result<T, LockError>>,
) -> Result<T, LockError> {
    let attempt = timeout(ATTEMPT_TIMEOUT, attempt).await;
    attempt.unwrap_or_else(|_elapsed| {
        let cause = io::Error::from(io::ErrorKind::TimedOut).into();
        Err(LockError::Open(open::refused(address, cause)))
    })
}

/// What a standby has seen of the session that holds the lock.
#[derive(Debug, Default)]
struct Watch {
    /// Connection on which it asks, which has the lock once it is free; opened again after a failure.
    connection: Option<PgConnection>,
    /// The session that holds the lock, and since when this standby has seen nothing newer of it, by its own
    /// clock.
    seen: Option<(Session, Instant)>,
    /// Time of its last check: a check that comes late says nothing about the time before.
    checked_at: Option<Instant>,
    /// Number of checks in a row that came late.
    late_checks: u32,
    has_warned: bool,
}

/// Outcome of an attempt of a standby to take the lock.
#[derive(Debug)]
enum Attempt {
    /// This connection holds the lock.
    Taken(PgConnection),
    /// The sessions of a server that was silent are ended.
    Ended,
    /// The server that has the lock has asked something lately, or nobody knows.
    InUse(Option<Session>),
}

/// Session that holds the lock.
#[derive(Debug, Clone, PartialEq, Eq, sqlx::FromRow)]
struct Session {
    /// Name of its process.
    process: String,
    pid: i32,
    /// Time of the last statement of any session of that process by the clock of PostgreSQL; unknown without
    /// the rights to see it.
    asked_at: Option<String>,
    /// Address of its client.
    client: String,
    /// When it was connected; unknown without the rights to see it.
    since: Option<String>,
}

impl Watch {
    /// Tries to take the lock once, and ends the sessions of the server that has it if that one has asked
    /// nothing for longer than permitted.
    ///
    /// # Errors
    /// PostgreSQL cannot be asked.
    async fn attempt(
        &mut self,
        options: &PgConnectOptions,
        address: &str,
        silence_max: Duration,
    ) -> Result<Attempt, LockError> {
        let refused = |cause| LockError::Open(open::refused(address, cause));
        let connection = match self.connection.take() {
            Some(connection) => connection,
            None => connections::connect(options).await.map_err(refused)?,
        };
        let asking = self.ask(connection, silence_max);
        let no_answer = |_elapsed| sqlx::Error::from(io::Error::from(io::ErrorKind::TimedOut));
        let asked = timeout(ANSWER_TIMEOUT, asking).await.map_err(no_answer);
        asked.flatten().map_err(refused)
    }

    async fn ask(
        &mut self,
        mut connection: PgConnection,
        silence_max: Duration,
    ) -> Result<Attempt, sqlx::Error> {
        if try_lock(&mut connection).await? {
            return Ok(Attempt::Taken(connection));
        }
        let session = holder(&mut connection).await?;
        let is_silent = self.is_silent(session.as_ref(), silence_max);
        let is_ended = match &session {
            Some(session) if is_silent => self.end(session, &mut connection).await?,
            Some(_) | None => false,
        };
        self.connection = Some(connection);
        Ok(if is_ended {
            Attempt::Ended
        } else {
            Attempt::InUse(session)
        })
    }

    /// Returns whether the server that has the lock has asked nothing for longer than permitted. A step of any
    /// clock changes nothing: only whether there was a statement counts.
    fn is_silent(&mut self, session: Option<&Session>, silence_max: Duration) -> bool {
        let before = self.checked_at.replace(Instant::now());
        let is_late = before.is_none_or(|before| before.elapsed() > CHECK_GAP_MAX);
        self.late_checks = if is_late { self.late_checks + 1 } else { 0 };
        if self.late_checks > LATE_CHECKS_MAX {
            self.warn_once(&"PostgreSQL answers too slowly");
        }
        match (&self.seen, session) {
            (Some((seen, since)), Some(session)) if seen == session && !is_late => {
                if session.asked_at.is_none() {
                    self.warn_once(&"the user may not see its last statement");
                    return false;
                }
                since.elapsed() >= silence_max
            }
            _ => {
                self.seen = session.map(|session| (session.clone(), Instant::now()));
                false
            }
        }
    }

    /// Ends the sessions of a server that was silent; returns whether it was silent until then.
    async fn end(
        &mut self,
        session: &Session,
        connection: &mut PgConnection,
    ) -> Result<bool, sqlx::Error> {
        let process = &session.process;
        let ended = sqlx::query_as(END_PROCESS)
            .bind(process)
            .bind(&session.asked_at)
            .fetch_one(connection);
        let (ended,): (i64,) = match ended.await {
            Ok(ended) => ended,
            // It may lack the right to end sessions of others.
            Err(sqlx::Error::Database(cause)) => {
                self.warn_once(&cause);
                return Ok(false);
            }
            Err(cause) => return Err(cause),
        };
        let silent = self.seen.take();
        if ended > 0 {
            let silence = silent.map_or(Duration::ZERO, |(_, since)| since.elapsed());
            warn!(
                "`{process}` has the lock of the database and was silent for {:.1} s: its {ended} sessions \
                 are ended",
                silence.as_secs_f64()
            );
        }
        Ok(ended > 0)
    }

    /// Forgets connection and session, after a failure.
    fn disconnect(&mut self) {
        *self = Self {
            has_warned: self.has_warned,
            ..Self::default()
        };
    }

    /// Logs once that the server cannot be watched.
    fn warn_once(&mut self, cause: &dyn std::fmt::Display) {
        if !std::mem::replace(&mut self.has_warned, true) {
            warn!("the server that has the database cannot be watched: {cause}");
        }
    }
}

/// Takes the lock again after this process lost its connection, unless another server has a newer epoch: that
/// one may have lost its connection too. PostgreSQL may not have noticed the loss: a session of this process that
/// still has the lock is ended.
async fn locked_again(
    options: &PgConnectOptions,
    address: &str,
    epoch: Option<i64>,
) -> Result<PgConnection, LockError> {
    let refused = |cause| LockError::Open(open::refused(address, cause));
    let mut connection = connections::connect(options).await.map_err(refused)?;
    if let Some(own) = epoch {
        let newest = sqlx::query_scalar("SELECT epoch FROM server_epoch");
        let newest: i64 = newest.fetch_one(&mut connection).await.map_err(refused)?;
        if newest > own {
            let holder = holder(&mut connection).await.ok().flatten();
            return Err(in_use(address, holder));
        }
    }
    if try_lock(&mut connection).await.map_err(refused)? {
        return Ok(connection);
    }
    let ending: Option<(bool,)> = sqlx::query_as(END_OWN)
        .fetch_optional(&mut connection)
        .await
        .map_err(refused)?;
    let began = Instant::now();
    while ending.is_some() && began.elapsed() < ANSWER_TIMEOUT {
        if try_lock(&mut connection).await.map_err(refused)? {
            return Ok(connection);
        }
        sleep(CHECK_INTERVAL).await;
    }
    let holder = holder(&mut connection).await.ok().flatten();
    Err(in_use(address, holder))
}

/// Opens a connection that holds the lock.
async fn locked(options: &PgConnectOptions, address: &str) -> Result<PgConnection, LockError> {
    let refused = |cause| LockError::Open(open::refused(address, cause));
    let mut connection = connections::connect(options).await.map_err(refused)?;
    if try_lock(&mut connection).await.map_err(refused)? {
        return Ok(connection);
    }
    let holder = holder(&mut connection).await.ok().flatten();
    Err(in_use(address, holder))
}

/// Takes the lock on a connection, if it is free.
async fn try_lock(connection: &mut PgConnection) -> Result<bool, sqlx::Error> {
    let taking = sqlx::query_as(TAKE).fetch_one(connection);
    let (is_taken, ..): (bool, String, String, String) = taking.await?;
    Ok(is_taken)
}

/// Returns the session that holds the lock; `None` if it has become free.
async fn holder(connection: &mut PgConnection) -> Result<Option<Session>, sqlx::Error> {
    sqlx::query_as(SESSION).fetch_optional(connection).await
}

fn in_use(address: &str, holder: Option<Session>) -> LockError {
    let holder = holder.and_then(|holder| {
        let since = holder.since?;
        Some(format!(" (at {}, since {since} UTC)", holder.client))
    });
    LockError::InUse {
        address: address.to_owned(),
        holder: holder.unwrap_or_default(),
    }
}

#[cfg(test)]
mod tests;
