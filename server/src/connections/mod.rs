//! Which connections are open, and who goes when there are too many.
//!
//! ```text
//!  unproven ──valid credential──► busy ──answer given──► idle ──next request──► unproven …
//!     ▲  └────a Stop, all full──► stopping ──┐
//!     └──────────answer given────────────────┘
//! ```
//!
//! A connection whose request has shown no valid credential yet is *unproven*, whatever else it has
//! sent: there is room for few of those, and a new one displaces the oldest of the address that has
//! most. So whoever opens thousands and sends nothing, or sends the body of a sign-in byte by byte, only displaces their
//! own, while an honest client is unproven for a moment. The rest of the room is for those who
//! have shown a credential, for each of them and for each address a share. When all of it is taken, the
//! one that has been idle longest goes; connections at work are kept.
//!
//! A Stop has room beyond all of that, of which each credential has a share. Nobody keeps it from getting
//! so far as to show its credential: what is at work has no part in the room of the unproven.
//!
//! The robots' port uses the same table: there a TLS handshake with a certificate is the proof.

mod table;

use std::net::IpAddr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

use self::table::{Entry, Phase, Table};
use crate::identity::address::network_of;
use crate::identity::subject::SubjectId;
use crate::rate_limit::Bucket;

/// How many connections there may be.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Bounds {
    /// Of all kinds.
    pub all: usize,
    /// At work or idle, from one address of another machine, or one /64 of IPv6.
    pub per_address: usize,
    /// Without a valid credential so far.
    pub unproven: usize,
    /// The same, from one address of another machine, or one /64 of IPv6.
    pub unproven_per_address: usize,
}

/// The bounds of the REST API.
pub const BOUNDS: Bounds = Bounds {
    all: 4_096,
    per_address: 512,
    unproven: 512,
    unproven_per_address: 64,
};
/// Rest after the machine refused a connection, such as for want of file handles.
pub const ACCEPT_REST: Duration = Duration::from_millis(100);
/// Most connections of one token, with its sessions, that are at work or idle: a dashboard may serve
/// a thousand people by one token, and others find room beside it.
pub const PER_IDENTITY_MAX: usize = 2_048;
/// Connections on which a Stop is answered though all others are at work.
pub const STOPS_MAX: usize = 256;
/// Most of them of one token: others find room beside whoever fills his own.
pub const STOPS_PER_IDENTITY_MAX: usize = 32;

/// There is no room for another connection at work.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum Full {
    /// This token has its share.
    #[error("this token has {PER_IDENTITY_MAX} connections at work; end some of them")]
    Identity,
    /// This address has its share.
    #[error("{0} connections of this address are at work; end some of them")]
    Address(usize),
    /// All of the server's room is taken.
    #[error("all connections of the server are at work; try again later")]
    Server,
}

/// What a request is for, as far as room is concerned.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Purpose {
    /// It stops robots, and has room of its own.
    Stop,
    /// Anything else.
    Other,
}

/// All open connections.
#[derive(Debug)]
pub struct Connections {
    bounds: Bounds,
    table: Mutex<Table>,
    begun: Instant,
}

/// What became of a new connection.
#[derive(Debug)]
pub struct Admitted {
    /// Its place, kept as long as this or a clone of it is.
    pub slot: Arc<Slot>,
    /// How many others it displaced.
    pub displaced: usize,
}

impl Connections {
    /// No connections yet.
    pub fn new(bounds: Bounds) -> Arc<Self> {
        let table = Mutex::default();
        let begun = Instant::now();
        Arc::new(Self {
            bounds,
            table,
            begun,
        })
    }

    fn lock(&self) -> MutexGuard<'_, Table> {
        self.table.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes in a new connection; `None` if all are at work. `cut` is cancelled when it has to
    /// go.
    pub fn admit(self: &Arc<Self>, peer: IpAddr, cut: CancellationToken) -> Option<Admitted> {
        self.admit_from(peer, peer.to_canonical().is_loopback(), cut)
    }

    /// The same, from an address that many clients may come from.
    pub fn admit_from(
        self: &Arc<Self>,
        peer: IpAddr,
        is_shared: bool,
        cut: CancellationToken,
    ) -> Option<Admitted> {
        let address = network_of(peer);
        let Bounds {
            all,
            unproven,
            unproven_per_address,
            ..
        } = self.bounds;
        let mut table = self.lock();
        let mut displaced = 0;
        let mut make_room = |table: &mut Table, whom: Option<u64>| {
            let id = whom?;
            table.cut(id);
            displaced += 1;
            Some(())
        };
        let count = table.unproven_per_address.get(&address);
        if !is_shared && count.is_some_and(|&count| count >= unproven_per_address) {
            let whom = table.oldest(&table.unproven, Some(address));
            make_room(&mut table, whom)?;
        }
        if table.unproven.len() >= unproven {
            let whom = table.unproven_to_displace();
            make_room(&mut table, whom)?;
        }
        if table.entries.len() >= all {
            let whom = table.oldest_idle_or_unproven();
            make_room(&mut table, whom)?;
        }
        let (id, since) = (table.number(), table.number());
        table.insert(
            id,
            Entry {
                address,
                is_shared,
                identity: None,
                known: None,
                rate: Bucket::default(),
                phase: Phase::Unproven,
                requests: 0,
                since,
                cut,
            },
        );
        drop(table);
        let connections = Arc::clone(self);
        Some(Admitted {
            slot: Arc::new(Slot { connections, id }),
            displaced,
        })
    }

    /// How many are open.
    pub fn count(&self) -> usize {
        self.lock().entries.len()
    }
}

/// The place of one connection; whoever takes the connection over, as a `WebSocket` does, keeps a
/// clone, so that it goes on being counted.
#[derive(Debug)]
pub struct Slot {
    connections: Arc<Connections>,
    id: u64,
}

impl Slot {
    /// The connection has shown who it is; it is at work until the result is dropped. It is cut if
    /// its address has its share.
    pub fn work(self: &Arc<Self>) -> AtWork {
        let at_work = self.hold();
        let mut table = self.connections.lock();
        if table.has_share_of_address(self.id, &self.connections.bounds) {
            table.cut(self.id);
        } else {
            table.set_phase(self.id, Phase::Busy);
        }
        at_work
    }

    /// The connection stays what it is until the result is dropped, as one does that becomes a
    /// `WebSocket`.
    pub fn hold(self: &Arc<Self>) -> AtWork {
        let mut table = self.connections.lock();
        if let Some(entry) = table.entries.get_mut(&self.id) {
            entry.requests += 1;
        }
        AtWork(Arc::clone(self))
    }

    /// By how long the next request is delayed, whose head has come: whoever was known on this
    /// connection before has a rate for all of its connections, everybody else one for this
    /// connection. A Stop is delayed by no other request.
    pub fn delay(&self, purpose: Purpose, now: Instant) -> Duration {
        let now = now.saturating_duration_since(self.connections.begun);
        self.connections.lock().delay(self.id, purpose, now)
    }

    /// The head of a request has come, of a client that a trusted proxy names if it came by one.
    /// The connection is unproven until [`Self::prove`]. Gives how many others it displaced.
    pub fn begin(self: &Arc<Self>, client: Option<IpAddr>) -> (AtWork, usize) {
        let at_work = self.hold();
        let mut table = self.connections.lock();
        let mut displaced = 0;
        if let Some(client) = client {
            table.set_address(self.id, network_of(client));
        }
        let Some(entry) = table.entries.get(&self.id) else {
            return (at_work, displaced);
        };
        let (address, is_shared, phase) = (entry.address, entry.is_shared, entry.phase);
        if phase != Phase::Unproven {
            table.set_phase(self.id, Phase::Unproven);
        }
        displaced += table.shed_unproven(address, is_shared, &self.connections.bounds);
        drop(table);
        (at_work, displaced)
    }

    /// The request on this connection has shown a valid credential: it is at work until it is
    /// answered.
    ///
    /// # Errors
    /// [`Full`], which a Stop meets only when [`STOPS_MAX`] others are being answered beyond it, or
    /// [`STOPS_PER_IDENTITY_MAX`] of the same token.
    pub fn prove(&self, identity: SubjectId, purpose: Purpose) -> Result<(), Full> {
        let mut table = self.connections.lock();
        if !table.entries.contains_key(&self.id) {
            // It was cut; what is answered nobody reads.
            return Ok(());
        }
        // What it was before counts no more, whatever it shows now.
        table.set(self.id, Phase::Unproven, None);
        let phase = match table.room_for(self.id, identity, &self.connections.bounds) {
            Ok(()) => Phase::Busy,
            Err(_full) if purpose == Purpose::Stop && table.has_room_for_stop(identity) => {
                Phase::Stopping
            }
            Err(full) => {
                let entry = table.entries.get(&self.id);
                if let Some((address, is_shared)) =
                    entry.map(|entry| (entry.address, entry.is_shared))
                {
                    table.shed_unproven(address, is_shared, &self.connections.bounds);
                }
                return Err(full);
            }
        };
        table.set(self.id, phase, Some(identity));
        Ok(())
    }
}

impl Drop for Slot {
    fn drop(&mut self) {
        self.connections.lock().remove(self.id);
    }
}

/// A connection at work on a request.
#[derive(Debug)]
pub struct AtWork(Arc<Slot>);

impl Drop for AtWork {
    fn drop(&mut self) {
        let mut table = self.0.connections.lock();
        let Some(entry) = table.entries.get_mut(&self.0.id) else {
            return;
        };
        entry.requests -= 1;
        let (phase, address, is_shared) = (entry.phase, entry.address, entry.is_shared);
        if entry.requests == 0 {
            match phase {
                Phase::Busy => table.set_phase(self.0.id, Phase::Idle),
                Phase::Stopping => {
                    table.set_phase(self.0.id, Phase::Unproven);
                    table.shed_unproven(address, is_shared, &self.0.connections.bounds);
                }
                Phase::Unproven | Phase::Idle => {}
            }
        }
    }
}

#[cfg(test)]
mod tests;
