//! The routers that are open now.
//!
//! The access control of a zenoh router is fixed when it opens, so a router cannot let in a robot
//! that joins later. Instead another one is opened beside it, whose rules know the newcomer too;
//! connections that come from then on are the newest router's, and those that there are stay
//! where they are, undisturbed. The server listens to all of them, and speaks to all of them.

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
    /// Its number; the newest has the highest.
    pub(super) number: u64,
    /// The server's own session, which is the router.
    pub(super) session: Session,
    /// Where it listens.
    pub(super) address: SocketAddr,
    /// Behind the gate, what robots have to show.
    pub(super) credentials: Option<Arc<CredentialDerivation>>,
    /// Whom its rules know.
    pub(super) robots: HashSet<RobotKey>,
}

impl Router {
    /// The fingerprint of the authority from whose key its passwords derive.
    pub(super) fn authority(&self) -> Option<&str> {
        self.credentials
            .as_ref()
            .map(|derivation| derivation.authority())
    }

    /// How many sessions it has. Blocks its thread.
    pub(super) fn session_count(&self) -> usize {
        self.session.info().transports().wait().count()
    }

    /// Whether it has a session of this id. Blocks its thread.
    pub(super) fn has_session(&self, session_id: u128) -> bool {
        let mut transports = self.session.info().transports().wait();
        transports.any(|one| u128::from_le_bytes(one.zid().to_le_bytes()) == session_id)
    }
}

/// All routers, the newest last.
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

    /// All of them, the newest last.
    pub(super) fn all(&self) -> Vec<Arc<Router>> {
        self.lock().clone()
    }

    /// The newest.
    pub(super) fn newest(&self) -> Option<Arc<Router>> {
        self.lock().last().cloned()
    }

    /// Adds one that was opened.
    pub(super) fn add(&self, router: Arc<Router>) {
        self.lock().push(router);
        self.changes.send_modify(|count| *count += 1);
    }

    /// Takes one away; whoever does closes it.
    pub(super) fn remove(&self, number: u64) -> Option<Arc<Router>> {
        let mut open = self.lock();
        let index = open.iter().position(|router| router.number == number)?;
        let router = open.remove(index);
        drop(open);
        self.changes.send_modify(|count| *count += 1);
        Some(router)
    }

    /// Changes whenever one is added or taken away.
    pub(super) fn changes(&self) -> watch::Receiver<u64> {
        self.changes.subscribe()
    }

    /// How often that has happened.
    pub(super) fn version(&self) -> u64 {
        *self.changes.borrow()
    }
}
