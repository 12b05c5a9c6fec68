//! The friction map in memory: the stored sums, and those that are stored behind the receipts
//! ([`unwritten`]). It is loaded at the start and changed with each commit. The cells of some blocks
//! are in memory, as far as `[map] memory_max_mib` allows ([`blocks`]).
//!
//! To change sums, a task takes the [`MapWriteGuard`], writes, and commits with
//! [`MapWriteGuard::commit`]: commit and change in memory are one task, which cancellation of the
//! caller does not interrupt. After a commit of unknown outcome no task gets the guard until memory
//! was read again (see [`super::memory`]).

mod block_memory;
pub mod blocks;
pub mod following;
mod names;
mod reading;
mod unwritten;
pub mod writing;

use std::collections::{HashMap, HashSet};
use std::sync::{Arc, Mutex as StdMutex, MutexGuard, PoisonError, RwLock};
use std::time::Duration;

use tokio::sync::{Mutex, OwnedMutexGuard};
use tread_api::ids::{ConfigurationId, RobotId};
use tread_api::robot::Alert;
use tread_api::site::Cell;

use self::block_memory::BlockMemory;
pub use self::blocks::BlockCounts;
pub(super) use self::blocks::Pins;
use self::following::Follower;
use self::names::KeyNames;
use self::unwritten::Unwritten;
pub use self::unwritten::UnwrittenCounts;
use super::App;
use crate::db::segments::Added;
use crate::db::sites::SiteRow;
use crate::db::sums::SumKey;
use crate::db::watermarks::WatermarkStep;
use crate::db::withdrawals::Hours;
use crate::db::{DbError, Outcome, Tx};
use crate::friction::index::{LabelledSum, SiteMap};
use crate::friction::{Horizons, Sums};

/// The maps of all sites.
#[derive(Debug)]
pub(super) struct Maps {
    sites: RwLock<Sites>,
    /// Changes only while `order` is held. Locked after `sites`.
    unwritten: StdMutex<Unwritten>,
    /// Held from before a transaction that changes sums until memory shows the change, so that
    /// database and memory change in the same order. Its value is the number of commits of unknown
    /// outcome at the last reading of memory.
    order: Arc<Mutex<u64>>,
    memory: BlockMemory,
    /// In a standby: what it has read of the database that another server writes.
    follower: Option<Follower>,
}

/// The map of each site by its key.
#[derive(Debug, Default)]
struct Sites {
    maps: HashMap<i64, SiteMap>,
    names: KeyNames,
}

/// Guard of the exclusive right to change sums, in the database and then in memory.
#[derive(Debug)]
pub(super) struct MapWriteGuard {
    app: App,
    order: OwnedMutexGuard<u64>,
}

/// What a transaction changes in memory once it is committed.
#[derive(Debug)]
pub(super) enum MapChange {
    /// No change: the same sums in another form.
    Nothing,
    /// Sums of segments that were stored with these keys are added.
    Add(Vec<Folded>, Added),
    /// The unwritten sums of robots are stored up to these watermarks.
    Store(Vec<WatermarkStep>),
    /// Sums of a robot's measurements are removed.
    Withdraw(Box<Withdrawn>),
    /// Epochs before these horizons are merged.
    MergeBefore(Box<SiteRow>, Horizons),
    /// Raw measurements of these runs were removed.
    Remove(HashSet<i64>),
}

/// Sums to be added to the map, which agree in all but their cells.
#[derive(Debug, Clone)]
pub(super) struct Folded {
    /// Key of the first cell.
    pub(super) key: SumKey,
    pub(super) robot: RobotId,
    pub(super) configuration: ConfigurationId,
    pub(super) cells: Vec<(Cell, Sums)>,
}

/// A robot's hours whose sums are removed.
#[derive(Debug)]
pub(super) struct Withdrawn {
    pub(super) site: SiteRow,
    pub(super) robot: RobotId,
    pub(super) robot_pk: i64,
    pub(super) hours: Hours,
}

impl MapWriteGuard {
    /// Commits, and then changes memory and publishes the alerts that were written. After an
    /// outcome that is unknown, memory is read again.
    ///
    /// # Errors
    /// As [`Tx::commit`].
    pub(super) async fn commit(
        self,
        tx: Tx,
        change: MapChange,
        alerts: Vec<Alert>,
    ) -> Result<(), DbError> {
        let Self { app, order } = self;
        tx.commit_then(move |outcome| {
            if outcome == Outcome::Written {
                app.apply(change);
                app.show_alerts(&alerts);
            }
            drop(order);
        })
        .await
    }
}

impl Maps {
    /// Creates maps whose blocks of cells take at most about `memory_max_mib` MiB of memory. Those of a
    /// standby follow a database that another server writes.
    pub(super) fn new(memory_max_mib: u64, is_standby: bool) -> Self {
        Self {
            sites: RwLock::default(),
            unwritten: StdMutex::default(),
            order: Arc::default(),
            memory: BlockMemory::new(memory_max_mib),
            follower: is_standby.then(Follower::default),
        }
    }

    /// Returns what a standby has read; `None` in the server that has the database, also if it was a standby.
    fn follower(&self) -> Option<&Follower> {
        let follower = self.follower.as_ref();
        follower.filter(|follower| !follower.is_over())
    }

    /// Makes the map of a standby that of the server that it becomes: from now on nothing follows the
    /// database.
    fn end_following(&self) {
        let _sites = self.sites.write().unwrap_or_else(PoisonError::into_inner);
        if let Some(follower) = &self.follower {
            follower.end();
            self.unwritten().may_be_stored();
        }
    }

    /// Removes sums from the unwritten ones that another server has stored; `false` if this is the server now.
    fn remove_followed(&self, steps: &[WatermarkStep]) -> bool {
        let _sites = self.sites.write().unwrap_or_else(PoisonError::into_inner);
        if self.follower().is_none() {
            return false;
        }
        self.unwritten().written(steps);
        true
    }

    /// Adds the sums of a range of the ledger that a standby has read; `false` if it is the server now.
    fn add_followed(&self, folded: &[Folded], range: Added, now: Duration) -> bool {
        let mut sites = self.sites.write().unwrap_or_else(PoisonError::into_inner);
        if self.follower().is_none() {
            return false;
        }
        self.add_to(&mut sites, folded, range, now);
        true
    }

    /// Creates a site's map if it does not exist.
    pub(super) fn ensure(&self, row: &SiteRow) {
        let mut sites = self.sites.write().unwrap_or_else(PoisonError::into_inner);
        sites.ensure(row);
    }

    /// Changes a site's map.
    fn change(&self, row: &SiteRow, change: impl FnOnce(&mut SiteMap)) {
        let mut sites = self.sites.write().unwrap_or_else(PoisonError::into_inner);
        change(sites.ensure(row));
    }

    /// Reads a site's map; an empty one if it does not exist.
    pub(super) fn with_map<T>(&self, row: &SiteRow, read: impl FnOnce(&SiteMap) -> T) -> T {
        let sites = self.sites.read().unwrap_or_else(PoisonError::into_inner);
        match sites.maps.get(&row.pk) {
            Some(map) => read(map),
            None => read(&SiteMap::new(row.site.grid.revision, row.horizons)),
        }
    }

    fn unwritten(&self) -> MutexGuard<'_, Unwritten> {
        self.unwritten
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
    }

    /// Adds sums to the unwritten ones and to their maps. Both at once, so that a block that is read
    /// meanwhile has them once.
    fn add(&self, folded: &[Folded], added: Added, now: Duration) {
        let mut sites = self.sites.write().unwrap_or_else(PoisonError::into_inner);
        self.add_to(&mut sites, folded, added, now);
    }

    fn add_to(&self, sites: &mut Sites, folded: &[Folded], added: Added, now: Duration) {
        let sums = folded.iter().map(|part| (&part.key, &*part.cells));
        self.unwritten().add(sums, added, now);
        for map in sites.maps.values_mut() {
            map.set_lru_time(self.memory.lru_time());
        }
        sites.add(folded, SiteMap::add_cells);
        self.memory.wake_if_full(sites);
    }
}

impl Sites {
    fn ensure(&mut self, row: &SiteRow) -> &mut SiteMap {
        self.maps
            .entry(row.pk)
            .or_insert_with(|| SiteMap::new(row.site.grid.revision, row.horizons))
    }

    /// Returns about how many bytes the cells of all maps take.
    fn bytes(&self) -> usize {
        self.maps.values().map(|map| map.size().1).sum()
    }

    /// Adds sums to their maps.
    fn add(
        &mut self,
        folded: &[Folded],
        add: impl Fn(&mut SiteMap, LabelledSum<'_>, &[(Cell, Sums)]),
    ) {
        for part in folded {
            let Folded {
                key,
                robot,
                configuration,
                cells,
            } = part;
            self.names.record(part);
            if let Some(map) = self.maps.get_mut(&key.site_pk) {
                add(map, labelled(key, robot, *configuration), cells);
            }
        }
    }
}

/// Returns the labels of a sum.
fn labelled<'names>(
    key: &'names SumKey,
    robot: &'names RobotId,
    configuration: ConfigurationId,
) -> LabelledSum<'names> {
    LabelledSum {
        cell: key.cell,
        grid_revision: key.grid_revision,
        terrain: &key.terrain,
        configuration,
        robot,
        epoch_h: key.epoch_h,
    }
}

impl App {
    /// Waits for the exclusive right to change sums.
    ///
    /// # Errors
    /// [`DbError::Unsettled`] after a commit of unknown outcome, until memory was read again.
    pub(super) async fn lock_map_for_write(&self) -> Result<MapWriteGuard, DbError> {
        let order = Arc::clone(&self.maps().order).lock_owned().await;
        if *order != self.db().unknown_outcomes() {
            return Err(DbError::Unsettled);
        }
        let app = self.clone();
        Ok(MapWriteGuard { app, order })
    }

    fn apply(&self, change: MapChange) {
        match change {
            MapChange::Nothing => {}
            MapChange::Add(folded, added) => {
                if !folded.is_empty() {
                    self.maps().add(&folded, added, self.clock().elapsed());
                }
            }
            MapChange::Store(steps) => self.maps().unwritten().written(&steps),
            MapChange::Withdraw(withdrawn) => {
                let Withdrawn {
                    site,
                    robot,
                    robot_pk,
                    hours,
                } = *withdrawn;
                self.maps().unwritten().withdraw(robot_pk, hours);
                self.maps().change(&site, |map| map.withdraw(&robot, hours));
            }
            MapChange::MergeBefore(row, horizons) => {
                self.maps().change(&row, |map| map.merge_before(horizons));
            }
            MapChange::Remove(boots) => self.removed().extend(boots),
        }
    }
}
