//! The friction map in memory: the stored sums, and those that are stored behind the receipts
//! ([`unwritten`]). It is loaded at the start and changed with each commit.
//!
//! To change sums, a task takes the [`MapTurn`], writes, and commits with [`MapTurn::commit`]:
//! commit and change in memory are one task, which cancellation of the caller does not interrupt.
//! After a commit of unknown outcome no turn is given until memory was read again (see
//! [`super::memory`]).

mod reading;
mod unwritten;
pub mod writing;

use std::collections::{HashMap, HashSet};
use std::sync::{Arc, Mutex as StdMutex, MutexGuard, PoisonError, RwLock};

use tokio::sync::{Mutex, OwnedMutexGuard};
use tread_api::ids::{ConfigurationId, RobotId};
use tread_api::robot::Alert;
use tread_api::site::Cell;

use self::unwritten::Unwritten;
pub use self::unwritten::UnwrittenCounts;
use super::App;
use crate::db::segments::Added;
use crate::db::sites::SiteRow;
use crate::db::sums::SumKey;
use crate::db::watermarks::WatermarkStep;
use crate::db::{DbError, Outcome, Tx};
use crate::friction::index::{Labelled, SiteMap};
use crate::friction::{Horizons, Sums};

/// The maps of all sites.
#[derive(Debug, Default)]
pub(super) struct Maps {
    sites: RwLock<HashMap<i64, SiteMap>>,
    /// Changes only while `order` is held.
    unwritten: StdMutex<Unwritten>,
    /// Held from before a transaction that changes sums until memory shows the change, so that
    /// database and memory change in the same order. Its value is the number of commits of unknown
    /// outcome at the last reading of memory.
    order: Arc<Mutex<u64>>,
}

/// Exclusive right to change sums, in the database and then in memory.
#[derive(Debug)]
pub(super) struct MapTurn {
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
    /// First and last hour.
    pub(super) hours: (i64, i64),
}

impl MapTurn {
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
    /// Creates a site's map if it does not exist.
    pub(super) fn ensure(&self, row: &SiteRow) {
        let mut sites = self.sites.write().unwrap_or_else(PoisonError::into_inner);
        ensure(&mut sites, row);
    }

    /// Changes a site's map.
    fn change(&self, row: &SiteRow, change: impl FnOnce(&mut SiteMap)) {
        let mut sites = self.sites.write().unwrap_or_else(PoisonError::into_inner);
        change(ensure(&mut sites, row));
    }

    /// Reads a site's map; an empty one if it does not exist.
    pub(super) fn look<T>(&self, row: &SiteRow, look: impl FnOnce(&SiteMap) -> T) -> T {
        let sites = self.sites.read().unwrap_or_else(PoisonError::into_inner);
        match sites.get(&row.pk) {
            Some(map) => look(map),
            None => look(&SiteMap::new(row.site.grid.revision, row.horizons)),
        }
    }

    fn unwritten(&self) -> MutexGuard<'_, Unwritten> {
        self.unwritten
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
    }
}

fn ensure<'maps>(sites: &'maps mut HashMap<i64, SiteMap>, row: &SiteRow) -> &'maps mut SiteMap {
    sites
        .entry(row.pk)
        .or_insert_with(|| SiteMap::new(row.site.grid.revision, row.horizons))
}

/// Adds sums to their maps.
fn add(sites: &mut HashMap<i64, SiteMap>, folded: &[Folded]) {
    for Folded {
        key,
        robot,
        configuration,
        cells,
    } in folded
    {
        if let Some(map) = sites.get_mut(&key.site_pk) {
            let labelled = Labelled {
                cell: key.cell,
                grid_revision: key.grid_revision,
                terrain: &key.terrain,
                configuration: *configuration,
                robot,
                epoch_h: key.epoch_h,
            };
            map.add_cells(labelled, cells);
        }
    }
}

impl App {
    /// Waits for the exclusive right to change sums.
    ///
    /// # Errors
    /// [`DbError::Unsettled`] after a commit of unknown outcome, until memory was read again.
    pub(super) async fn map_turn_to_change(&self) -> Result<MapTurn, DbError> {
        let order = Arc::clone(&self.maps().order).lock_owned().await;
        if *order != self.db().unknown_outcomes() {
            return Err(DbError::Unsettled);
        }
        let app = self.clone();
        Ok(MapTurn { app, order })
    }

    fn apply(&self, change: MapChange) {
        match change {
            MapChange::Nothing => {}
            MapChange::Add(folded, added) => {
                if !folded.is_empty() {
                    let sums = folded.iter().map(|part| (&part.key, &*part.cells));
                    let now = self.clock().elapsed();
                    self.maps().unwritten().add(sums, added, now);
                    let sites = self.maps().sites.write();
                    add(&mut sites.unwrap_or_else(PoisonError::into_inner), &folded);
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
