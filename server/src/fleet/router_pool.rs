//! Keeps a router open whose rules include every robot of the fleet, and closes unused ones.
//!
//! ```text
//!  a robot joins, or another authority signs
//!                ─► a new router beside the others ─► robots come to it as they reconnect
//!                                                      (each at the latest when it renews)
//!  an authority is retired ─► routers whose passwords derive from its key are closed
//!  an older router without robots ─► closed
//!  too many routers ─► the older one with the fewest robots is closed; they reconnect at once
//! ```

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::{Mutex, watch};
use tokio_util::sync::CancellationToken;
use tracing::{error, info};

use super::inbox::Channels;
use super::opening::{self, Opener};
use super::routers::{Router, Routers};
use crate::app::App;
use crate::app::presence::RobotKey;
use crate::authority::Trusted;

/// Maximum number of routers.
const ROUTERS_MAX: usize = 4;
/// Interval of checks for unused routers.
const LOOK_EVERY: Duration = Duration::from_secs(5);

/// State for opening, replacing and closing routers.
#[derive(Debug)]
pub(super) struct RouterPool {
    pub(super) app: App,
    pub(super) routers: Arc<Routers>,
    pub(super) opener: Opener,
    pub(super) channels: Channels,
    /// Locked during a change.
    pub(super) turn: Mutex<()>,
}

impl RouterPool {
    /// Opens a router for all robots of the fleet, beside those that are open.
    ///
    /// # Errors
    /// [`super::FleetError`].
    pub(super) async fn open(&self) -> Result<(), super::FleetError> {
        let robots = self.app.enrolment_registry().robots();
        let router = self.opener.open(robots).await?;
        if let Err(failed) = self.opener.declare(&router, &self.channels).await {
            opening::close(router.session.clone()).await;
            return Err(failed);
        }
        self.routers.add(router);
        Ok(())
    }

    /// Closes a router; its robots reconnect to another.
    pub(super) async fn close(&self, number: u64) {
        if let Some(router) = self.routers.remove(number) {
            opening::close(router.session.clone()).await;
            self.channels.router_closed(number);
        }
    }

    /// Opens and closes routers as needed until the stop.
    pub(super) async fn run(self: Arc<Self>, stop: CancellationToken) {
        let mut joined = self.app.enrolment_registry().changes();
        let mut rotated = self.opener.authorities.as_ref().map(|it| it.changes());
        loop {
            joined.mark_unchanged();
            if let Some(rotated) = &mut rotated {
                rotated.mark_unchanged();
            }
            {
                let _turn = self.turn.lock().await;
                self.let_everybody_in().await;
                self.close_idle().await;
            }
            tokio::select! {
                biased;
                () = stop.cancelled() => return,
                _ = joined.changed() => {}
                () = changed(&mut rotated) => {}
                () = tokio::time::sleep(LOOK_EVERY) => {}
            }
        }
    }

    async fn let_everybody_in(&self) {
        let newest = self.routers.newest();
        let knows = |robot: &RobotKey| {
            let newest = newest.as_ref();
            newest.is_some_and(|newest| newest.robots.contains(robot))
        };
        let trusted = self.opener.authorities.as_ref().map(|it| it.present());
        let is_of_signing = newest.as_ref().is_some_and(|newest| {
            let signing = trusted.as_ref().map(|it| it.signing().fingerprint());
            newest.authority() == signing
        });
        if is_of_signing && self.app.enrolment_registry().robots().iter().all(knows) {
            return;
        }
        match self.open().await {
            Ok(()) => {
                self.app.counters().routers_opened.one();
                info!("another zenoh router was opened");
            }
            // The next check tries again.
            Err(failed) => error!("cannot open another router: {failed}"),
        }
    }

    async fn close_idle(&self) {
        let all = self.routers.all();
        let Some((_newest, older)) = all.split_last() else {
            return;
        };
        let mut left = all.len();
        let mut counted = Vec::new();
        for router in older {
            let counts = !self.is_of_retired(router);
            counted.push((counts, robots_on(router).await, router.number));
        }
        counted.sort_unstable();
        for (counts, robot_count, number) in counted {
            if counts && robot_count > 0 && left <= ROUTERS_MAX {
                break;
            }
            self.close(number).await;
            left -= 1;
            info!("an older zenoh router with {robot_count} robots was closed");
        }
    }
}

impl RouterPool {
    /// Returns whether a router's passwords derive from the key of a retired authority.
    fn is_of_retired(&self, router: &Router) -> bool {
        let trusted = self.opener.authorities.as_ref().map(|it| it.present());
        trusted.is_some_and(|trusted| {
            let authority = router.authority();
            !authority.is_some_and(|authority| trusted.is_trusted(authority))
        })
    }
}

/// Waits for the next start or end of a rotation.
async fn changed(rotated: &mut Option<watch::Receiver<Arc<Trusted>>>) {
    if let Some(rotated) = rotated
        && rotated.changed().await.is_ok()
    {
        return;
    }
    std::future::pending::<()>().await;
}

/// Returns the number of a router's sessions.
pub(super) async fn robots_on(router: &Arc<Router>) -> usize {
    let router = Arc::clone(router);
    let counting = tokio::task::spawn_blocking(move || router.session_count());
    counting.await.unwrap_or(0)
}
