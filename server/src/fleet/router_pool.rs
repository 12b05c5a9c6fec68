//! Keeps routers open whose rules together include every robot of the fleet, and closes unused ones.
//!
//! ```text
//!  robots join, or another authority signs
//!                ─► new routers beside the others (`router_groups`) ─► robots come to it as they
//!                                           reconnect (each at the latest when it renews)
//!  an authority is retired ─► routers whose passwords derive from its key are closed
//!  a superseded router without robots ─► closed
//!  too many superseded ones ─► the one with the fewest robots is closed; they reconnect at once
//! ```

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::{Mutex, watch};
use tokio_util::sync::CancellationToken;
use tracing::{error, info};

use super::client;
use super::inbox::Channels;
use super::opening::Opener;
use super::router_groups::{Group, superseded, to_open};
use super::routers::{Router, Routers};
use crate::app::App;
use crate::app::presence::RobotKey;
use crate::authority::Trusted;

/// Maximum number of superseded routers that still have robots, beyond the number of the others: the
/// authority that signs may change while all of them have robots.
const SUPERSEDED_MAX: usize = 8;
/// Minimum interval between two openings: robots that join at about the same time share a router.
const OPEN_EVERY: Duration = Duration::from_millis(500);
/// Interval of checks for unused routers.
const CHECK_EVERY: Duration = Duration::from_secs(5);

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
    /// Opens a router for these robots, beside those that are open.
    ///
    /// # Errors
    /// [`super::FleetError`].
    pub(super) async fn open(&self, robots: Vec<RobotKey>) -> Result<(), super::FleetError> {
        let router = self.opener.open(robots).await?;
        if let Err(failed) = self.opener.declare(&router, &self.channels).await {
            client::close(router.session.clone()).await;
            return Err(failed);
        }
        self.routers.add(router);
        Ok(())
    }

    /// Opens routers for all robots of the fleet. One that fails after the first is opened by
    /// [`Self::run`] later.
    ///
    /// # Errors
    /// [`super::FleetError`] of the first one.
    pub(super) async fn open_for_all(&self) -> Result<(), super::FleetError> {
        let fleet = self.app.enrolment_registry().robots();
        if self.opener.authorities.is_none() {
            // Without a gate there is one address, and so one router.
            return self.open(fleet).await;
        }
        loop {
            let all = self.routers.all();
            match to_open(&self.groups(&all), &fleet, self.opener.robots_max) {
                Some(robots) => match self.open(robots.into_iter().collect()).await {
                    Ok(()) => {}
                    Err(failed) if all.is_empty() => return Err(failed),
                    Err(failed) => {
                        error!("cannot open another router: {failed}");
                        return Ok(());
                    }
                },
                None => return Ok(()),
            }
        }
    }

    /// Closes a router; its robots reconnect to another.
    pub(super) async fn close(&self, number: u64) {
        if let Some(router) = self.routers.remove(number) {
            client::close(router.session.clone()).await;
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
            let opened = {
                let _turn = self.turn.lock().await;
                let opened = self.open_for_waiting_robots().await;
                self.close_idle().await;
                opened
            };
            if let Some(robot_count) = opened {
                // A full one is not waited for: nobody who joins now would have room in it.
                let pause = if robot_count < self.opener.robots_max {
                    OPEN_EVERY
                } else {
                    Duration::ZERO
                };
                tokio::select! {
                    biased;
                    () = stop.cancelled() => return,
                    () = tokio::time::sleep(pause) => {}
                }
                // One has room for some of the robots alone.
                continue;
            }
            tokio::select! {
                biased;
                () = stop.cancelled() => return,
                _ = joined.changed() => {}
                () = changed(&mut rotated) => {}
                () = tokio::time::sleep(CHECK_EVERY) => {}
            }
        }
    }

    /// Returns the open routers as groups of robots, oldest first.
    fn groups<'all>(&self, all: &'all [Arc<Router>]) -> Vec<Group<'all>> {
        let trusted = self.opener.authorities.as_ref().map(|it| it.present());
        let signing = trusted.as_ref().map(|it| it.signing().fingerprint());
        let group = |router: &'all Arc<Router>| Group {
            robots: &router.robots,
            is_of_signing: router.authority() == signing,
        };
        all.iter().map(group).collect()
    }

    /// Returns the routers that robots connect to: those that are not superseded.
    pub(super) fn current(&self) -> Vec<Arc<Router>> {
        let all = self.routers.all();
        let is_superseded = superseded(&self.groups(&all));
        let with = all.into_iter().zip(is_superseded);
        let current = with.filter(|(_, is_superseded)| !is_superseded);
        current.map(|(router, _)| router).collect()
    }

    /// Opens a router for robots that have none, as far as it has room for them; returns the number of its
    /// robots if it did.
    async fn open_for_waiting_robots(&self) -> Option<usize> {
        let all = self.routers.all();
        let fleet = self.app.enrolment_registry().robots();
        let robots = to_open(&self.groups(&all), &fleet, self.opener.robots_max)?;
        let count = robots.len();
        match self.open(robots.into_iter().collect()).await {
            Ok(()) => {
                self.app.counters().routers_opened.one();
                info!("another zenoh router was opened, for {count} robots");
                Some(count)
            }
            // The next check tries again.
            Err(failed) => {
                error!("cannot open another router: {failed}");
                None
            }
        }
    }

    /// Closes superseded routers that have no robots or are too many.
    pub(super) async fn close_idle(&self) {
        let all = self.routers.all();
        let is_superseded = superseded(&self.groups(&all));
        let mut counted = Vec::new();
        for (router, is_superseded) in all.iter().zip(is_superseded) {
            if is_superseded {
                let counts = !self.is_of_retired(router);
                counted.push((counts, robots_on(router).await, router.number));
            }
        }
        let most = SUPERSEDED_MAX + all.len() - counted.len();
        let mut left = counted.len();
        counted.sort_unstable();
        for (counts, robot_count, number) in counted {
            if counts && robot_count > 0 && left <= most {
                break;
            }
            self.close(number).await;
            left -= 1;
            info!("a superseded zenoh router with {robot_count} robots was closed");
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
