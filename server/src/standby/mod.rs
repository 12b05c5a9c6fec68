//! A standby that waits for the lock of the database: its log lines, its messages to the service manager, and
//! the requests that it answers while it waits ([`serving`]).

pub(crate) mod serving;

use std::time::Duration;

use sd_notify::NotifyState;
use tokio::task::JoinSet;
use tokio::time::Instant;
use tracing::{info, warn};

use self::serving::StandbyServing;
use crate::app::App;
use crate::clock::Clock;
use crate::config::Config;
use crate::db::lock::{DatabaseLock, LockError};
use crate::service_manager::notify;

/// Silence of the active server after which a standby takes over: ten times the interval at which the active
/// server queries the database.
const SILENCE_MAX: Duration = Duration::from_secs(1);

/// Interval of the log lines of a standby that waits for the same reason.
const LOG_EVERY: Duration = Duration::from_mins(10);

/// Interval at which the watchdog is fed while it takes over.
const FEED_EVERY: Duration = Duration::from_secs(5);

/// The lock of the database and, if a standby took it, the state that the standby has read.
#[derive(Debug)]
pub(crate) struct AcquiredLock {
    /// The lock.
    pub(crate) lock: DatabaseLock,
    /// The app with the map, if this process was a standby that had read the map.
    pub(crate) standby: Option<App>,
    /// Feeds the watchdog until it is dropped, if this process was a standby.
    _feeding: JoinSet<()>,
}

/// Locks the database. A standby waits for the lock and answers requests while it waits. Returns `None` if a
/// stop is requested before the lock is taken.
///
/// # Errors
/// Another server has the lock and this one is no standby, or the database cannot be locked.
pub(crate) async fn acquire_lock(
    stop_requested: impl Future<Output = ()>,
    config: &Config,
    clock: &Clock,
) -> Result<Option<AcquiredLock>, LockError> {
    if !config.standby {
        let lock = tokio::select! {
            lock = DatabaseLock::take(&config.database) => lock?,
            () = stop_requested => return Ok(None),
        };
        return Ok(Some(AcquiredLock {
            lock,
            standby: None,
            _feeding: JoinSet::new(),
        }));
    }
    let mut serving = None;
    let mut standby = Standby::default();
    let waiting = |reason: &str, is_in_use: bool| {
        standby.waits(reason);
        // Whoever takes over at once has nothing to serve before.
        if is_in_use && serving.is_none() {
            serving = Some(StandbyServing::start(config.clone(), clock.clone()));
        }
    };
    let lock = tokio::select! {
        lock = DatabaseLock::wait(&config.database, SILENCE_MAX, waiting) => Some(lock?),
        () = stop_requested => None,
    };
    let Some(lock) = lock else {
        notify(&[NotifyState::Stopping]);
        if let Some(serving) = serving
            && let Err(error) = serving.stop().await
        {
            warn!("standby: {error}");
        }
        return Ok(None);
    };
    let feeding = standby.takes_over();
    let served = match serving {
        Some(serving) => serving.end().await,
        None => None,
    };
    Ok(Some(AcquiredLock {
        lock,
        standby: served,
        _feeding: feeding,
    }))
}

/// A server that waits until it can use the database.
#[derive(Debug, Default)]
struct Standby {
    /// The reason that was logged last, and when.
    logged: Option<(String, Instant)>,
}

impl Standby {
    /// Logs the reason of the wait if it has changed, and feeds the watchdog of the service manager. Call it
    /// more often than the watchdog's timeout: waiting is normal operation of a standby.
    fn waits(&mut self, reason: &str) {
        let is_new =
            |(logged, at): &(String, Instant)| logged != reason || at.elapsed() >= LOG_EVERY;
        if self.logged.as_ref().is_none_or(is_new) {
            let is_first = self.logged.is_none();
            self.logged = Some((reason.to_owned(), Instant::now()));
            info!("standby: {reason}");
            let status = format!("standby: {reason}");
            notify(&[NotifyState::Status(&status)]);
            if is_first {
                notify(&[NotifyState::Ready]);
            }
        }
        notify(&[NotifyState::Watchdog]);
    }

    /// Logs the takeover if it has waited, and feeds the watchdog until the returned set is dropped, because
    /// migrations and loading the map may take longer than the watchdog's timeout.
    fn takes_over(&self) -> JoinSet<()> {
        let mut feeding = JoinSet::new();
        if self.logged.is_some() {
            info!("standby: takes over the database");
            notify(&[NotifyState::Status("standby: takes over")]);
            feeding.spawn(async {
                loop {
                    notify(&[NotifyState::Watchdog]);
                    tokio::time::sleep(FEED_EVERY).await;
                }
            });
        }
        feeding
    }
}
