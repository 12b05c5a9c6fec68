//! Limits the open connections of a listener, and chooses which one to close when a limit is
//! reached.
//!
//! ```text
//!  unproven ──valid credential──► busy ──answer given──► idle ──next request──► unproven …
//!     ▲  └────a Stop, all full──► stopping ──┐
//!     └──────────answer given────────────────┘
//! ```
//!
//! A connection is *unproven* until its current request has presented a valid credential. The
//! number of unproven connections is small, and a new one displaces the oldest of the address that
//! has most of them. A client that opens thousands of connections and sends nothing, or sends a
//! body byte by byte, therefore displaces only its own; a regular client is unproven for a moment.
//! The remaining connections are for clients with a valid credential, with a limit for each
//! identity and each address. When a limit is reached, the connection that has been idle longest is
//! closed; busy ones are kept.
//!
//! Stop requests have reserved connections beyond these limits, with a limit for each identity.
//! Busy connections do not use the places of unproven ones, so a Stop can always present its
//! credential.
//!
//! The robots' port uses the same table; there a TLS handshake with a client certificate is the
//! credential.

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

/// Maximum numbers of connections of a listener.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Bounds {
    /// All connections, whatever their phase.
    pub all: usize,
    /// Busy and idle connections of one remote address (of one /64 for IPv6).
    pub per_address: usize,
    /// Unproven connections, those without a valid credential.
    pub unproven: usize,
    /// Unproven connections of one remote address (of one /64 for IPv6).
    pub unproven_per_address: usize,
}

/// Limits of the REST API's listener.
pub const BOUNDS: Bounds = Bounds {
    all: 4_096,
    per_address: 512,
    unproven: 512,
    unproven_per_address: 64,
};
/// Pause of the accept loop after a failed `accept`, for example for lack of file descriptors.
pub const ACCEPT_REST: Duration = Duration::from_millis(100);
/// Maximum number of busy and idle connections of one identity with all its sessions. It allows a
/// dashboard to serve a thousand people with one token, and leaves room for others.
pub const PER_IDENTITY_MAX: usize = 2_048;
/// Number of connections reserved for Stop requests while all others are busy.
pub const STOPS_MAX: usize = 256;
/// Maximum number of reserved Stop connections of one identity.
pub const STOPS_PER_IDENTITY_MAX: usize = 32;

/// Error: a limit of busy connections is reached, and no idle connection can be closed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum ConnectionLimitError {
    /// The identity has [`PER_IDENTITY_MAX`] busy connections.
    #[error("this token has {PER_IDENTITY_MAX} connections at work; end some of them")]
    Identity,
    /// The address has reached [`Bounds::per_address`], the value.
    #[error("{0} connections of this address are at work; end some of them")]
    Address(usize),
    /// All places of connections with a credential are busy.
    #[error("all connections of the server are at work; try again later")]
    Server,
}

/// Class of a request in the limits of connections.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Purpose {
    /// Stops robots; uses the reserved connections if the others are busy.
    Stop,
    /// Any other request.
    Other,
}

/// Open connections of a listener, with their limits.
#[derive(Debug)]
pub struct Connections {
    bounds: Bounds,
    table: Mutex<Table>,
    begun: Instant,
}

/// A new connection that was accepted.
#[derive(Debug)]
pub struct Admitted {
    /// Entry of the connection in the table; dropping the last clone removes the entry.
    pub slot: Arc<Slot>,
    /// Number of connections that were closed to make room.
    pub displaced: usize,
}

impl Connections {
    /// Creates an empty table with these limits.
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

    /// Accepts a new connection; `None` if all others are busy. `cut` is cancelled when the
    /// connection has to be closed.
    pub fn admit(self: &Arc<Self>, peer: IpAddr, cut: CancellationToken) -> Option<Admitted> {
        self.admit_from(peer, peer.to_canonical().is_loopback(), cut)
    }

    /// Accepts a new connection as [`Self::admit`] does. The limits per address do not apply if
    /// `is_shared`: many clients use this address, as with a trusted proxy.
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

    /// Returns the number of open connections.
    pub fn count(&self) -> usize {
        self.lock().entries.len()
    }
}

/// Entry of one connection in the table, removed when the last clone is dropped. A task that takes
/// the connection over, such as a `WebSocket`, keeps a clone so that the connection is still
/// counted.
#[derive(Debug)]
pub struct Slot {
    connections: Arc<Connections>,
    id: u64,
}

impl Slot {
    /// Marks the connection as authenticated and busy until the result is dropped. Closes it if its
    /// address has reached [`Bounds::per_address`].
    pub fn work(self: &Arc<Self>) -> RequestGuard {
        let at_work = self.hold();
        let mut table = self.connections.lock();
        if table.has_share_of_address(self.id, &self.connections.bounds) {
            table.cut(self.id);
        } else {
            table.set_phase(self.id, Phase::Busy);
        }
        at_work
    }

    /// Keeps the connection in its phase until the result is dropped, for example as a `WebSocket`.
    pub fn hold(self: &Arc<Self>) -> RequestGuard {
        let mut table = self.connections.lock();
        if let Some(entry) = table.entries.get_mut(&self.id) {
            entry.requests += 1;
        }
        RequestGuard(Arc::clone(self))
    }

    /// Returns the delay of a request whose head has arrived at `now`. If the last request on this
    /// connection was authenticated, the rate limit is that of its identity over all its connections;
    /// otherwise, and for every Stop, it is that of the connection. Other requests of an
    /// identity therefore do not delay its Stop.
    pub fn delay(&self, purpose: Purpose, now: Instant) -> Duration {
        let now = now.saturating_duration_since(self.connections.begun);
        self.connections.lock().delay(self.id, purpose, now)
    }

    /// Starts a request whose head has arrived; the connection is unproven until [`Self::prove`].
    /// `client` is the client's address if a trusted proxy reports one. Returns the number of
    /// connections that were closed to make room.
    pub fn begin(self: &Arc<Self>, client: Option<IpAddr>) -> (RequestGuard, usize) {
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
        displaced += table.close_oldest_unproven(address, is_shared, &self.connections.bounds);
        drop(table);
        (at_work, displaced)
    }

    /// Records that the request has presented a valid credential of `identity`: the connection is
    /// busy until the request is answered.
    ///
    /// # Errors
    /// [`ConnectionLimitError`] if a limit is reached and no idle connection can be closed; for a
    /// Stop only if [`STOPS_MAX`] reserved connections, or [`STOPS_PER_IDENTITY_MAX`] of this
    /// identity, are in use.
    pub fn prove(&self, identity: SubjectId, purpose: Purpose) -> Result<(), ConnectionLimitError> {
        let mut table = self.connections.lock();
        if !table.entries.contains_key(&self.id) {
            // The connection was closed, so nobody reads the answer.
            return Ok(());
        }
        // The phase and identity of an earlier request no longer apply.
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
                    table.close_oldest_unproven(address, is_shared, &self.connections.bounds);
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

/// Guard of a connection that processes a request; dropping the last one makes a busy connection
/// idle.
#[derive(Debug)]
pub struct RequestGuard(Arc<Slot>);

impl Drop for RequestGuard {
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
                    table.close_oldest_unproven(address, is_shared, &self.0.connections.bounds);
                }
                Phase::Unproven | Phase::Idle => {}
            }
        }
    }
}

#[cfg(test)]
mod tests;
