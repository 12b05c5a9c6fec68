//! The friction map in memory, a copy of the sums in the database: loaded at the start and changed
//! with each commit.
//!
//! To change sums, a task takes the [`MapTurn`], writes, and commits with [`MapTurn::commit`]:
//! commit and change in memory are one task, which cancellation of the caller does not interrupt.
//! After a commit of unknown outcome no turn is given until memory was read again (see
//! [`super::memory`]).

use std::collections::HashMap;
use std::sync::{Arc, PoisonError, RwLock};

use tokio::sync::{Mutex, OwnedMutexGuard};
use tread_api::ids::{ConfigurationId, RobotId};
use tread_api::rights::Scope;
use tread_api::robot::Alert;

use super::App;
use crate::db::sites::SiteRow;
use crate::db::sums::SumKey;
use crate::db::{self, DbError, Outcome, Tx};
use crate::friction::Sums;
use crate::friction::index::{Labelled, SiteMap};

/// The maps of all sites.
#[derive(Debug, Default)]
pub(super) struct Maps {
    sites: RwLock<HashMap<i64, SiteMap>>,
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
    /// Sums are added.
    Add(Vec<Folded>),
    /// Sums of a robot's measurements between two hours, both included, are removed.
    Withdraw(Box<SiteRow>, RobotId, (i64, i64)),
    /// Hours before this one are merged into days.
    MergeBefore(Box<SiteRow>, i64),
    /// Raw measurements of these runs were removed.
    Remove(Vec<i64>),
}

/// Sums to be added to the map.
#[derive(Debug, Clone)]
pub(super) struct Folded {
    pub(super) key: SumKey,
    pub(super) robot: RobotId,
    pub(super) configuration: ConfigurationId,
    pub(super) sums: Sums,
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
        let committed = tx.commit_then(move |outcome| {
            if outcome == Outcome::Written {
                app.apply(change);
                app.show_alerts(&alerts);
            }
            drop(order);
        });
        Ok(committed.await?)
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
            None => look(&SiteMap::new(row.site.grid.revision, row.merged_before_h)),
        }
    }

    /// Replaces the maps by those read from the database.
    fn replace(&self, mut read: HashMap<i64, SiteMap>) {
        let mut sites = self.sites.write().unwrap_or_else(PoisonError::into_inner);
        for (pk, before) in sites.drain() {
            match read.get_mut(&pk) {
                Some(map) => map.follow(&before),
                None => {
                    read.insert(pk, before);
                }
            }
        }
        *sites = read;
    }
}

fn ensure<'maps>(sites: &'maps mut HashMap<i64, SiteMap>, row: &SiteRow) -> &'maps mut SiteMap {
    sites
        .entry(row.pk)
        .or_insert_with(|| SiteMap::new(row.site.grid.revision, row.merged_before_h))
}

/// Adds sums to their maps.
fn add(sites: &mut HashMap<i64, SiteMap>, folded: &[Folded]) {
    for Folded {
        key,
        robot,
        configuration,
        sums,
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
            map.add(labelled, sums);
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
            MapChange::Add(folded) => {
                if !folded.is_empty() {
                    let sites = self.maps().sites.write();
                    add(&mut sites.unwrap_or_else(PoisonError::into_inner), &folded);
                }
            }
            MapChange::Withdraw(row, robot, hours) => {
                self.maps().change(&row, |map| map.withdraw(&robot, hours));
            }
            MapChange::MergeBefore(row, hour) => {
                self.maps().change(&row, |map| map.merge_before(hour));
            }
            MapChange::Remove(boots) => self.removed().extend(boots),
        }
    }

    /// Reads all sums into memory, and the runs of which raw measurements were removed.
    ///
    /// # Errors
    /// The database failed.
    pub async fn load_map(&self) -> Result<(), DbError> {
        self.load_map_again(self.db().unknown_outcomes()).await
    }

    /// Reads everything again when `ended` commits of unknown outcome have ended. No sums change
    /// meanwhile.
    ///
    /// # Errors
    /// The database failed; memory is unchanged.
    pub(super) async fn load_map_again(&self, ended: u64) -> Result<(), DbError> {
        let mut order = Arc::clone(&self.maps().order).lock_owned().await;
        let mut tx = self.db().read("map").await?;
        let read = read_maps(&mut tx).await?;
        self.removed().extend(db::removed::boots(&mut tx).await?);
        drop(tx);
        self.maps().replace(read);
        *order = ended;
        Ok(())
    }
}

async fn read_maps(tx: &mut Tx) -> Result<HashMap<i64, SiteMap>, DbError> {
    let mut sites = HashMap::new();
    let mut after = String::new();
    loop {
        let rows = db::sites::list(tx, &Scope::EVERYWHERE, &after, 100).await?;
        let Some(last) = rows.last() else { break };
        after = last.site.id.to_string();
        for row in &rows {
            ensure(&mut sites, row);
        }
    }
    let robots = db::robots::ids_by_key(tx).await?;
    let configurations = db::robots::configurations_by_key(tx).await?;
    db::sums::each(tx, |row| {
        let key = row.key;
        // The foreign keys of a sum guarantee both.
        if let (Some(robot), Some(&configuration)) = (
            robots.get(&key.robot_pk),
            configurations.get(&key.configuration_pk),
        ) {
            let folded = Folded {
                robot: robot.clone(),
                configuration,
                sums: row.sums,
                key,
            };
            add(&mut sites, std::slice::from_ref(&folded));
        }
    })
    .await?;
    Ok(sites)
}
