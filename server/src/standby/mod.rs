//! A standby while it waits for the database: what it says in its log and to the service manager, and the
//! requests that it answers meanwhile ([`serving`]).

pub(crate) mod serving;

use std::time::Duration;

use sd_notify::NotifyState;
use tokio::task::JoinSet;
use tokio::time::Instant;
use tracing::info;

use crate::service_manager::notify;

/// Interval of the log lines of a standby that waits for the same reason.
const LOG_EVERY: Duration = Duration::from_mins(10);

/// Interval at which the watchdog is fed while it takes over.
const FEED_EVERY: Duration = Duration::from_secs(5);

/// A server that waits until it can use the database.
#[derive(Debug, Default)]
pub(crate) struct Standby {
    /// The reason that was logged last, and when.
    logged: Option<(String, Instant)>,
}

impl Standby {
    /// Says why it waits. To be called often: it feeds the watchdog of the service manager too, since a
    /// standby that waits does what it is for.
    pub(crate) fn waits(&mut self, reason: &str) {
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

    /// Says that it takes over, if it has waited, and feeds the watchdog until what it returns is dropped:
    /// migrations and the map may take long.
    pub(crate) fn takes_over(&self) -> JoinSet<()> {
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
