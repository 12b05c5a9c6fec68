//! Table of open connections with their phases, counted by address and by identity.

use std::collections::{BTreeMap, HashMap};
use std::hash::Hash;
use std::net::IpAddr;
use std::time::Duration;

use tokio_util::sync::CancellationToken;

use super::{
    Bounds, ConnectionLimitError, PER_IDENTITY_MAX, Purpose, STOPS_MAX, STOPS_PER_IDENTITY_MAX,
};
use crate::identity::subject::SubjectId;
use crate::rate_limit::{Bucket, RateLimit};

/// Rate limit of one identity with all its sessions, over all its connections. It suffices for a
/// dashboard that serves a thousand people with one token.
const REQUESTS_OF_IDENTITY: RateLimit = RateLimit {
    burst: 2_000,
    interval: Duration::from_millis(1),
};
/// Rate limit of one connection for requests without a known identity, and for Stops.
const REQUESTS_OF_CONNECTION: RateLimit = RateLimit {
    burst: 50,
    interval: Duration::from_millis(20),
};
/// Number of identities with a stored rate from which those with an unused limit are dropped.
const RATES_MAX: usize = 4_096;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Phase {
    Unproven,
    Busy,
    Idle,
    /// Processes a Stop on a reserved connection.
    Stopping,
}

#[derive(Debug)]
pub(super) struct Entry {
    pub(super) address: IpAddr,
    /// Whether many clients share this address: this machine's, or a trusted proxy's.
    pub(super) is_shared: bool,
    /// Identity whose limits count this connection; `None` while unproven.
    pub(super) identity: Option<SubjectId>,
    pub(super) phase: Phase,
    /// Identity that the latest request presented, for the rate limit.
    pub(super) known: Option<SubjectId>,
    /// Rate of the requests without a known identity and of the Stops on this connection.
    pub(super) rate: Bucket,
    /// Number of requests in progress.
    pub(super) requests: usize,
    /// Sequence number of the last change of phase, unique in the table.
    pub(super) since: u64,
    pub(super) cut: CancellationToken,
}

/// Number of connections for each key; absent if zero.
type Counts<K> = HashMap<K, usize>;

#[derive(Debug, Default)]
pub(super) struct Table {
    next: u64,
    pub(super) entries: HashMap<u64, Entry>,
    /// Unproven connections, as `since` → connection, so the oldest is first; `idle` likewise.
    pub(super) unproven: BTreeMap<u64, u64>,
    pub(super) idle: BTreeMap<u64, u64>,
    /// Number of connections that are busy or idle.
    pub(super) proven: usize,
    pub(super) stopping: usize,
    pub(super) proven_per_address: Counts<IpAddr>,
    pub(super) unproven_per_address: Counts<IpAddr>,
    pub(super) proven_per_identity: Counts<SubjectId>,
    pub(super) stopping_per_identity: Counts<SubjectId>,
    rates: HashMap<SubjectId, Bucket>,
}

impl Table {
    pub(super) fn number(&mut self) -> u64 {
        self.next += 1;
        self.next
    }

    /// Returns the delay of the next request on connection `id`, during which the connection is not
    /// read. `now` is the time since the table's creation.
    pub(super) fn delay(&mut self, id: u64, purpose: Purpose, now: Duration) -> Duration {
        let Some(entry) = self.entries.get_mut(&id) else {
            return Duration::ZERO;
        };
        let (Some(identity), Purpose::Other) = (entry.known, purpose) else {
            let limit = REQUESTS_OF_CONNECTION;
            return entry.rate.take_delayed(limit, now);
        };
        if self.rates.len() >= RATES_MAX {
            self.rates.retain(|_, rate| !rate.is_full(now));
        }
        let rate = self.rates.entry(identity).or_default();
        rate.take_delayed(REQUESTS_OF_IDENTITY, now)
    }

    /// Inserts a connection, whose phase must be unproven.
    pub(super) fn insert(&mut self, id: u64, entry: Entry) {
        self.entries.insert(id, entry);
        self.count_in(id);
    }

    /// Removes a connection from all counts; called before its entry changes.
    fn count_out(&mut self, id: u64) {
        let Some(entry) = self.entries.get(&id) else {
            return;
        };
        match entry.phase {
            Phase::Unproven => {
                self.unproven.remove(&entry.since);
                count_down(&mut self.unproven_per_address, Some(&entry.address));
            }
            Phase::Busy | Phase::Idle => {
                self.idle.remove(&entry.since);
                self.proven -= 1;
                count_down(&mut self.proven_per_address, Some(&entry.address));
                count_down(&mut self.proven_per_identity, entry.identity.as_ref());
            }
            Phase::Stopping => {
                self.stopping -= 1;
                count_down(&mut self.stopping_per_identity, entry.identity.as_ref());
            }
        }
    }

    /// Adds a connection to the counts of its phase, address and identity.
    fn count_in(&mut self, id: u64) {
        let Some(entry) = self.entries.get(&id) else {
            return;
        };
        match entry.phase {
            Phase::Unproven => {
                self.unproven.insert(entry.since, id);
                count_up(&mut self.unproven_per_address, Some(entry.address));
            }
            Phase::Busy | Phase::Idle => {
                if entry.phase == Phase::Idle {
                    self.idle.insert(entry.since, id);
                }
                self.proven += 1;
                count_up(&mut self.proven_per_address, Some(entry.address));
                count_up(&mut self.proven_per_identity, entry.identity);
            }
            Phase::Stopping => {
                self.stopping += 1;
                count_up(&mut self.stopping_per_identity, entry.identity);
            }
        }
    }

    pub(super) fn remove(&mut self, id: u64) -> Option<Entry> {
        self.count_out(id);
        self.entries.remove(&id)
    }

    pub(super) fn cut(&mut self, id: u64) {
        if let Some(entry) = self.remove(id) {
            entry.cut.cancel();
        }
    }

    pub(super) fn set_phase(&mut self, id: u64, phase: Phase) {
        let identity = self.entries.get(&id).and_then(|entry| entry.identity);
        self.set(id, phase, identity.filter(|_| phase != Phase::Unproven));
    }

    /// Sets phase and identity of a connection.
    pub(super) fn set(&mut self, id: u64, phase: Phase, identity: Option<SubjectId>) {
        let since = self.number();
        self.count_out(id);
        if let Some(entry) = self.entries.get_mut(&id) {
            (entry.phase, entry.identity, entry.since) = (phase, identity, since);
            // The latest request alone counts, because a proxy sends requests of several clients.
            entry.known = identity;
        }
        self.count_in(id);
    }

    /// Sets the address of a connection to the client address that a trusted proxy reports.
    pub(super) fn set_address(&mut self, id: u64, address: IpAddr) {
        self.count_out(id);
        if let Some(entry) = self.entries.get_mut(&id)
            && entry.address != address
        {
            (entry.address, entry.is_shared) = (address, address.is_loopback());
        }
        self.count_in(id);
    }

    /// Closes the oldest unproven connections beyond the limits per address and in total. Returns
    /// the number of closed connections.
    pub(super) fn close_oldest_unproven(
        &mut self,
        address: IpAddr,
        is_shared: bool,
        bounds: &Bounds,
    ) -> usize {
        let mut displaced = 0;
        let count = |table: &Self| table.unproven_per_address.get(&address).copied();
        while !is_shared && count(self).is_some_and(|count| count > bounds.unproven_per_address) {
            let Some(id) = self.oldest(&self.unproven, Some(address)) else {
                break;
            };
            self.cut(id);
            displaced += 1;
        }
        while self.unproven.len() > bounds.unproven {
            let Some(id) = self.unproven_to_displace() else {
                break;
            };
            self.cut(id);
            displaced += 1;
        }
        displaced
    }

    /// Returns whether the other busy and idle connections of this one's address reach the limit.
    pub(super) fn has_share_of_address(&self, id: u64, bounds: &Bounds) -> bool {
        let Some(entry) = self.entries.get(&id) else {
            return false;
        };
        let counts = matches!(entry.phase, Phase::Busy | Phase::Idle);
        let count = self.proven_per_address.get(&entry.address);
        !entry.is_shared && !counts && count.is_some_and(|&count| count >= bounds.per_address)
    }

    /// Makes room for a busy connection of `identity` by closing idle ones.
    ///
    /// # Errors
    /// [`ConnectionLimitError`] if a limit is reached and no idle connection can be closed.
    pub(super) fn room_for(
        &mut self,
        id: u64,
        identity: SubjectId,
        bounds: &Bounds,
    ) -> Result<(), ConnectionLimitError> {
        let share = self.proven_per_identity.get(&identity);
        if share.is_some_and(|&count| count >= PER_IDENTITY_MAX) {
            let idle = self.oldest_idle(|entry| entry.identity == Some(identity));
            self.cut(idle.ok_or(ConnectionLimitError::Identity)?);
        }
        if self.has_share_of_address(id, bounds) {
            let address = self.entries.get(&id).map(|entry| entry.address);
            let idle = self.oldest_idle(|entry| Some(entry.address) == address);
            self.cut(idle.ok_or(ConnectionLimitError::Address(bounds.per_address))?);
        }
        if self.proven >= bounds.all - bounds.unproven {
            let idle = self.oldest_idle(|_| true);
            self.cut(idle.ok_or(ConnectionLimitError::Server)?);
        }
        Ok(())
    }

    /// Returns whether a reserved Stop connection is free for `identity`.
    pub(super) fn has_room_for_stop(&self, identity: SubjectId) -> bool {
        let own = self.stopping_per_identity.get(&identity).copied();
        self.stopping < STOPS_MAX && own.unwrap_or(0) < STOPS_PER_IDENTITY_MAX
    }

    pub(super) fn oldest(
        &self,
        among: &BTreeMap<u64, u64>,
        address: Option<IpAddr>,
    ) -> Option<u64> {
        let is_of = |id: &u64| {
            let of = self.entries.get(id).map(|entry| entry.address);
            address.is_none() || of == address
        };
        among.values().copied().find(is_of)
    }

    fn oldest_idle(&self, is_wanted: impl Fn(&Entry) -> bool) -> Option<u64> {
        // A connection whose next request is being delayed is not idle.
        let is_idle = |entry: &Entry| entry.requests == 0 && is_wanted(entry);
        let is_wanted = |id: &u64| self.entries.get(id).is_some_and(is_idle);
        self.idle.values().copied().find(is_wanted)
    }

    pub(super) fn oldest_idle_or_unproven(&self) -> Option<u64> {
        let idle = self.oldest_idle(|_| true);
        idle.or_else(|| self.unproven_to_displace())
    }

    /// Returns the oldest unproven connection of the address that has most of them.
    pub(super) fn unproven_to_displace(&self) -> Option<u64> {
        let counts = &self.unproven_per_address;
        let most = counts.values().copied().max()?;
        let is_of_most = |id: &u64| {
            let entry = self.entries.get(id);
            entry.is_some_and(|entry| counts.get(&entry.address) == Some(&most))
        };
        self.unproven.values().copied().find(is_of_most)
    }
}

fn count_up<K: Eq + Hash>(counts: &mut Counts<K>, key: Option<K>) {
    if let Some(key) = key {
        *counts.entry(key).or_default() += 1;
    }
}

fn count_down<K: Eq + Hash>(counts: &mut Counts<K>, key: Option<&K>) {
    if let Some(key) = key
        && let Some(count) = counts.get_mut(key)
    {
        *count -= 1;
        if *count == 0 {
            counts.remove(key);
        }
    }
}
