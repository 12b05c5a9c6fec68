//! Which connections are open, and who goes when there are too many.
//!
//! ```text
//!  unproven ──whole request head──► busy ──answer given──► idle ──next request──► busy …
//! ```
//!
//! A connection that has not sent a whole request yet is *unproven*: there is room for few of
//! those, and a new one displaces the oldest. So whoever opens thousands and sends nothing only
//! displaces their own, while an honest client is unproven for a moment. When everything is full,
//! the one that has been idle longest goes, then the oldest unproven one; only connections at
//! work are kept, and if all are, the new one is refused.

use std::collections::{BTreeMap, HashMap};
use std::net::IpAddr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use tokio_util::sync::CancellationToken;

/// How many connections there may be.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Bounds {
    /// Of all kinds.
    pub all: usize,
    /// From one address of another machine. (All that comes by a proxy comes from this machine.)
    pub per_address: usize,
    /// Without a whole request so far.
    pub unproven: usize,
    /// The same, from one address of another machine.
    pub unproven_per_address: usize,
}

/// The bounds of the REST API.
pub const BOUNDS: Bounds = Bounds {
    all: 4_096,
    per_address: 512,
    unproven: 512,
    unproven_per_address: 64,
};

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Phase {
    Unproven,
    Busy,
    Idle,
}

#[derive(Debug)]
struct Entry {
    address: IpAddr,
    phase: Phase,
    /// Requests that are being answered.
    requests: usize,
    /// Since when it is in its phase, in the order of changes.
    since: u64,
    cut: CancellationToken,
}

#[derive(Debug, Default)]
struct Table {
    next: u64,
    entries: HashMap<u64, Entry>,
    /// By when they became so, oldest first.
    unproven: BTreeMap<u64, u64>,
    idle: BTreeMap<u64, u64>,
    per_address: HashMap<IpAddr, usize>,
    unproven_per_address: HashMap<IpAddr, usize>,
}

impl Table {
    fn number(&mut self) -> u64 {
        self.next += 1;
        self.next
    }

    fn leave_phase(&mut self, phase: Phase, since: u64, address: IpAddr) {
        match phase {
            Phase::Unproven => {
                self.unproven.remove(&since);
                count_down(&mut self.unproven_per_address, address);
            }
            Phase::Idle => {
                self.idle.remove(&since);
            }
            Phase::Busy => {}
        }
    }

    fn remove(&mut self, id: u64) -> Option<Entry> {
        let entry = self.entries.remove(&id)?;
        self.leave_phase(entry.phase, entry.since, entry.address);
        count_down(&mut self.per_address, entry.address);
        Some(entry)
    }

    fn cut(&mut self, id: u64) {
        if let Some(entry) = self.remove(id) {
            entry.cut.cancel();
        }
    }

    fn set_phase(&mut self, id: u64, phase: Phase) {
        let since = self.number();
        let Some(entry) = self.entries.get_mut(&id) else {
            return;
        };
        let (old, old_since, address) = (entry.phase, entry.since, entry.address);
        (entry.phase, entry.since) = (phase, since);
        self.leave_phase(old, old_since, address);
        if phase == Phase::Idle {
            self.idle.insert(since, id);
        }
    }

    fn oldest(&self, among: &BTreeMap<u64, u64>, address: Option<IpAddr>) -> Option<u64> {
        let is_of = |id: &u64| {
            let of = self.entries.get(id).map(|entry| entry.address);
            address.is_none() || of == address
        };
        among.values().copied().find(is_of)
    }

    fn oldest_idle_or_unproven(&self, address: Option<IpAddr>) -> Option<u64> {
        let idle = self.oldest(&self.idle, address);
        idle.or_else(|| self.oldest(&self.unproven, address))
    }
}

fn count_down(counts: &mut HashMap<IpAddr, usize>, address: IpAddr) {
    if let Some(count) = counts.get_mut(&address) {
        *count -= 1;
        if *count == 0 {
            counts.remove(&address);
        }
    }
}

/// All open connections.
#[derive(Debug)]
pub struct Connections {
    bounds: Bounds,
    table: Mutex<Table>,
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
        Arc::new(Self { bounds, table })
    }

    fn lock(&self) -> MutexGuard<'_, Table> {
        self.table.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes in a new connection; `None` if all are at work. `cut` is cancelled when it has to
    /// go.
    pub fn admit(self: &Arc<Self>, peer: IpAddr, cut: CancellationToken) -> Option<Admitted> {
        let address = peer.to_canonical();
        let Bounds {
            all,
            per_address,
            unproven,
            unproven_per_address,
        } = self.bounds;
        let mut table = self.lock();
        let mut displaced = 0;
        let mut make_room = |table: &mut Table, whom: Option<u64>| {
            let id = whom?;
            table.cut(id);
            displaced += 1;
            Some(())
        };
        if !address.is_loopback() {
            let of_address = Some(address);
            if table
                .per_address
                .get(&address)
                .is_some_and(|&count| count >= per_address)
            {
                let whom = table.oldest_idle_or_unproven(of_address);
                make_room(&mut table, whom)?;
            }
            let count = table.unproven_per_address.get(&address);
            if count.is_some_and(|&count| count >= unproven_per_address) {
                let whom = table.oldest(&table.unproven, of_address);
                make_room(&mut table, whom)?;
            }
        }
        if table.unproven.len() >= unproven {
            let whom = table.oldest(&table.unproven, None);
            make_room(&mut table, whom)?;
        }
        if table.entries.len() >= all {
            let whom = table.oldest_idle_or_unproven(None);
            make_room(&mut table, whom)?;
        }
        let (id, since) = (table.number(), table.number());
        table.entries.insert(
            id,
            Entry {
                address,
                phase: Phase::Unproven,
                requests: 0,
                since,
                cut,
            },
        );
        table.unproven.insert(since, id);
        *table.per_address.entry(address).or_default() += 1;
        *table.unproven_per_address.entry(address).or_default() += 1;
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
    /// A whole request has come; the connection is at work until the result is dropped.
    pub fn work(self: &Arc<Self>) -> AtWork {
        let mut table = self.connections.lock();
        if let Some(entry) = table.entries.get_mut(&self.id) {
            entry.requests += 1;
        }
        table.set_phase(self.id, Phase::Busy);
        AtWork(Arc::clone(self))
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
        if entry.requests == 0 {
            table.set_phase(self.0.id, Phase::Idle);
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const FEW: Bounds = Bounds {
        all: 8,
        per_address: 4,
        unproven: 3,
        unproven_per_address: 2,
    };

    fn address(last: u8) -> IpAddr {
        [192, 0, 2, last].into()
    }

    fn open(connections: &Arc<Connections>, from: u8) -> Option<(Arc<Slot>, CancellationToken)> {
        let cut = CancellationToken::new();
        let admitted = connections.admit(address(from), cut.clone())?;
        Some((admitted.slot, cut))
    }

    #[test]
    fn half_open_connections_displace_their_own_kind_and_nobody_at_work() {
        let connections = Connections::new(FEW);
        let (honest, honest_cut) = open(&connections, 1).unwrap();
        let _at_work = honest.work();
        let silent: Vec<_> = (0..50)
            .map(|number| open(&connections, number).unwrap())
            .collect();
        let alive = silent.iter().filter(|(_, cut)| !cut.is_cancelled()).count();
        assert_eq!(
            (alive, connections.count()),
            (FEW.unproven, FEW.unproven + 1)
        );
        assert!(!honest_cut.is_cancelled());
    }

    #[test]
    fn when_full_the_longest_idle_goes_first_and_none_at_work() {
        let connections = Connections::new(FEW);
        let mut working = Vec::new();
        for from in 0..8 {
            let (slot, cut) = open(&connections, from).unwrap();
            working.push((slot.work(), slot, cut));
        }
        assert!(open(&connections, 9).is_none(), "all are at work");
        let (at_work, _slot, first_cut) = working.remove(3);
        drop(at_work);
        let (at_work, _other_slot, second_cut) = working.remove(0);
        drop(at_work);
        let (_slot, _) = open(&connections, 9).unwrap();
        assert!(first_cut.is_cancelled() && !second_cut.is_cancelled());
        assert!(working.iter().all(|(_, _, cut)| !cut.is_cancelled()));
    }

    #[test]
    fn one_address_has_its_share_and_this_machine_all_of_it() {
        let connections = Connections::new(FEW);
        let busy: Vec<_> = (0..4)
            .map(|_| {
                let (slot, _) = open(&connections, 7).unwrap();
                (slot.work(), slot)
            })
            .collect();
        assert!(open(&connections, 7).is_none());
        assert!(open(&connections, 8).is_some());
        drop(busy);
        let local: Vec<_> = (0..8)
            .map(|_| {
                let here = IpAddr::from([127, 0, 0, 1]);
                let admitted = connections.admit(here, CancellationToken::new()).unwrap();
                (admitted.slot.work(), admitted.slot)
            })
            .collect();
        assert_eq!(connections.count(), local.len());
    }

    proptest! {
        #[test]
        fn whatever_happens_the_bounds_hold_and_the_books_balance(
            steps in prop::collection::vec((0_u8..4, 0_u8..5, 0_usize..12), 1..200),
        ) {
            let connections = Connections::new(FEW);
            let mut slots: Vec<(Arc<Slot>, Vec<AtWork>)> = Vec::new();
            for (what, from, which) in steps {
                let chosen = which % slots.len().max(1);
                match what {
                    0 => slots.extend(open(&connections, from).map(|(slot, _)| (slot, Vec::new()))),
                    1 if !slots.is_empty() => {
                        let at_work = slots[chosen].0.work();
                        slots[chosen].1.push(at_work);
                    }
                    2 if !slots.is_empty() => drop(slots[chosen].1.pop()),
                    3 if !slots.is_empty() => drop(slots.remove(chosen)),
                    _ => {}
                }
                let table = connections.lock();
                prop_assert!(table.entries.len() <= FEW.all);
                prop_assert!(table.unproven.len() <= FEW.unproven);
                prop_assert!(table.per_address.values().all(|&count| count <= FEW.per_address));
                prop_assert_eq!(table.per_address.values().sum::<usize>(), table.entries.len());
                let unproven: usize = table.unproven_per_address.values().sum();
                prop_assert_eq!(unproven, table.unproven.len());
            }
            drop(slots);
            let table = connections.lock();
            prop_assert!(table.entries.is_empty() && table.idle.is_empty());
            prop_assert!(table.unproven.is_empty() && table.per_address.is_empty());
        }
    }
}
