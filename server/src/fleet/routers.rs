//! The open routers.
//!
//! The access control of a zenoh router is fixed when it opens, so a router cannot accept a robot
//! that joins later. Another router is then opened beside it, whose rules include the new robot
//! ([`super::router_groups`]). A robot connects to the newest router that knows it; existing
//! connections stay undisturbed. The server receives from and sends to all of them.

use std::collections::HashSet;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use tokio::sync::watch;
use zenoh::{Session, Wait as _};

use super::credentials::CredentialDerivation;
use crate::app::presence::RobotKey;

/// One router.
#[derive(Debug)]
pub(super) struct Router {
    /// Number of the router; the newest has the highest.
    pub(super) number: u64,
    /// The server's zenoh session, which is the router.
    pub(super) session: Session,
    /// Address on which it listens.
    pub(super) address: SocketAddr,
    /// Credentials of robots; `None` without a gate.
    pub(super) credentials: Option<Arc<CredentialDerivation>>,
    /// Robots that its rules include.
    pub(super) robots: HashSet<RobotKey>,
}

impl Router {
    /// Returns the fingerprint of the authority from whose key its passwords derive.
    pub(super) fn authority(&self) -> Option<&str> {
        self.credentials
            .as_ref()
            .map(|derivation| derivation.authority())
    }

    /// Returns the number of its sessions. Blocks its thread.
    pub(super) fn session_count(&self) -> usize {
        self.session.info().transports().wait().count()
    }

    /// Returns whether it has a session of this identifier. Blocks its thread.
    pub(super) fn has_session(&self, session_id: u128) -> bool {
        let mut transports = self.session.info().transports().wait();
        transports.any(|one| u128::from_le_bytes(one.zid().to_le_bytes()) == session_id)
    }
}

/// List of the routers, newest last.
#[derive(Debug)]
pub(super) struct Routers {
    open: Mutex<Vec<Arc<Router>>>,
    changes: watch::Sender<u64>,
}

impl Default for Routers {
    fn default() -> Self {
        Self {
            open: Mutex::default(),
            changes: watch::Sender::new(0),
        }
    }
}

impl Routers {
    fn lock(&self) -> MutexGuard<'_, Vec<Arc<Router>>> {
        self.open.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns all routers, newest last.
    pub(super) fn all(&self) -> Vec<Arc<Router>> {
        self.lock().clone()
    }

    /// Returns the newest router whose rules include a robot.
    pub(super) fn of(&self, robot: &RobotKey) -> Option<Arc<Router>> {
        let open = self.lock();
        let knows = |router: &&Arc<Router>| router.robots.contains(robot);
        open.iter().rev().find(knows).cloned()
    }

    /// Returns the routers that a robot may be connected to; without a gate all, newest last.
    pub(super) fn reaching(&self, robot: &RobotKey) -> Vec<Arc<Router>> {
        let open = self.lock();
        let may_have =
            |router: &&Arc<Router>| router.credentials.is_none() || router.robots.contains(robot);
        open.iter().filter(may_have).cloned().collect()
    }

    /// Returns the newest router.
    pub(super) fn newest(&self) -> Option<Arc<Router>> {
        self.lock().last().cloned()
    }

    /// Adds an opened router.
    pub(super) fn add(&self, router: Arc<Router>) {
        self.lock().push(router);
        self.changes.send_modify(|count| *count += 1);
    }

    /// Removes a router from the list; the caller closes it.
    pub(super) fn remove(&self, number: u64) -> Option<Arc<Router>> {
        let mut open = self.lock();
        let index = open.iter().position(|router| router.number == number)?;
        let router = open.remove(index);
        drop(open);
        self.changes.send_modify(|count| *count += 1);
        Some(router)
    }

    /// Returns a receiver of a counter that increases whenever a router is added or removed.
    pub(super) fn changes(&self) -> watch::Receiver<u64> {
        self.changes.subscribe()
    }

    /// Returns the present value of that counter.
    pub(super) fn version(&self) -> u64 {
        *self.changes.borrow()
    }
}
