//! The table of connections: who is in which phase, counted by address and by identity.

use std::collections::{BTreeMap, HashMap};
use std::hash::Hash;
use std::net::IpAddr;
use std::time::Duration;

use tokio_util::sync::CancellationToken;

use super::{Bounds, Full, PER_IDENTITY_MAX, Purpose, STOPS_MAX, STOPS_PER_IDENTITY_MAX};
use crate::identity::subject::SubjectId;
use crate::rate_limit::{Bucket, RateLimit};

/// Requests of one token, with its sessions, on all of its connections: a dashboard serves a thousand
/// people.
const REQUESTS_OF_IDENTITY: RateLimit = RateLimit {
    burst: 2_000,
    interval: Duration::from_millis(1),
};
/// Requests on one connection that has shown nothing valid, and Stops on any one.
const REQUESTS_OF_CONNECTION: RateLimit = RateLimit {
    burst: 50,
    interval: Duration::from_millis(20),
};
/// Longest delay of one request: the connection's next one is not read meanwhile.
const REQUEST_DELAY_MAX: Duration = Duration::from_secs(1);
/// Tokens whose rates are remembered before those that are at rest are forgotten.
const RATES_MAX: usize = 4_096;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Phase {
    Unproven,
    Busy,
    Idle,
    /// A Stop beyond the room of the others.
    Stopping,
}

#[derive(Debug)]
pub(super) struct Entry {
    pub(super) address: IpAddr,
    /// Whether many clients come from there: this machine, or a trusted proxy.
    pub(super) is_shared: bool,
    /// Whose share it is of, while it is not unproven.
    pub(super) identity: Option<SubjectId>,
    pub(super) phase: Phase,
    /// Who showed a credential on it last.
    pub(super) known: Option<SubjectId>,
    /// The rate of requests on it that are of nobody known, or stop robots.
    pub(super) rate: Bucket,
    /// Requests that are being answered.
    pub(super) requests: usize,
    /// Since when it is in its phase, in the order of changes.
    pub(super) since: u64,
    pub(super) cut: CancellationToken,
}

/// How many there are of each.
type Counts<K> = HashMap<K, usize>;

#[derive(Debug, Default)]
pub(super) struct Table {
    next: u64,
    pub(super) entries: HashMap<u64, Entry>,
    /// By when they became so, oldest first.
    pub(super) unproven: BTreeMap<u64, u64>,
    pub(super) idle: BTreeMap<u64, u64>,
    /// Those that are busy or idle.
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

    /// By how long the next request on a connection is delayed, at a time since the server's start.
    pub(super) fn delay(&mut self, id: u64, purpose: Purpose, now: Duration) -> Duration {
        let Some(entry) = self.entries.get_mut(&id) else {
            return Duration::ZERO;
        };
        let (Some(identity), Purpose::Other) = (entry.known, purpose) else {
            let limit = REQUESTS_OF_CONNECTION;
            return entry.rate.take_delayed(limit, now, REQUEST_DELAY_MAX);
        };
        if self.rates.len() >= RATES_MAX {
            self.rates.retain(|_, rate| !rate.is_full(now));
        }
        let rate = self.rates.entry(identity).or_default();
        rate.take_delayed(REQUESTS_OF_IDENTITY, now, REQUEST_DELAY_MAX)
    }

    /// Puts a connection in, whose phase is unproven.
    pub(super) fn insert(&mut self, id: u64, entry: Entry) {
        self.entries.insert(id, entry);
        self.count_in(id);
    }

    /// Leaves the counts without a connection, before something of it changes.
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

    /// Counts a connection as what it is.
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

    /// Gives a connection its phase, as of that identity.
    pub(super) fn set(&mut self, id: u64, phase: Phase, identity: Option<SubjectId>) {
        let since = self.number();
        self.count_out(id);
        if let Some(entry) = self.entries.get_mut(&id) {
            (entry.phase, entry.identity, entry.since) = (phase, identity, since);
            // Of the last request alone: a proxy's connection carries others' as well.
            entry.known = identity;
        }
        self.count_in(id);
    }

    /// Counts a connection as of another address: the one that a trusted proxy names.
    pub(super) fn set_address(&mut self, id: u64, address: IpAddr) {
        self.count_out(id);
        if let Some(entry) = self.entries.get_mut(&id)
            && entry.address != address
        {
            (entry.address, entry.is_shared) = (address, address.is_loopback());
        }
        self.count_in(id);
    }

    /// Ends the oldest unproven connections of an address, and of all, that are too many.
    pub(super) fn shed_unproven(
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

    /// Whether the address of a connection has all others at work or idle that it may have.
    pub(super) fn has_share_of_address(&self, id: u64, bounds: &Bounds) -> bool {
        let Some(entry) = self.entries.get(&id) else {
            return false;
        };
        let counts = matches!(entry.phase, Phase::Busy | Phase::Idle);
        let count = self.proven_per_address.get(&entry.address);
        !entry.is_shared && !counts && count.is_some_and(|&count| count >= bounds.per_address)
    }

    /// Makes room for a connection of an identity at work.
    pub(super) fn room_for(
        &mut self,
        id: u64,
        identity: SubjectId,
        bounds: &Bounds,
    ) -> Result<(), Full> {
        let share = self.proven_per_identity.get(&identity);
        if share.is_some_and(|&count| count >= PER_IDENTITY_MAX) {
            let idle = self.oldest_idle(|entry| entry.identity == Some(identity));
            self.cut(idle.ok_or(Full::Identity)?);
        }
        if self.has_share_of_address(id, bounds) {
            let address = self.entries.get(&id).map(|entry| entry.address);
            let idle = self.oldest_idle(|entry| Some(entry.address) == address);
            self.cut(idle.ok_or(Full::Address(bounds.per_address))?);
        }
        if self.proven >= bounds.all - bounds.unproven {
            let idle = self.oldest_idle(|_| true);
            self.cut(idle.ok_or(Full::Server)?);
        }
        Ok(())
    }

    /// Whether a Stop of an identity has a turn beyond the room of all others.
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
        // One whose next request is delayed is not idle.
        let is_idle = |entry: &Entry| entry.requests == 0 && is_wanted(entry);
        let is_wanted = |id: &u64| self.entries.get(id).is_some_and(is_idle);
        self.idle.values().copied().find(is_wanted)
    }

    pub(super) fn oldest_idle_or_unproven(&self) -> Option<u64> {
        let idle = self.oldest_idle(|_| true);
        idle.or_else(|| self.unproven_to_displace())
    }

    /// The oldest unproven connection of the address that has most of them.
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
