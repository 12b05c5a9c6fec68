//! The map in memory, beside the database: loaded at the start, changed after each commit.

use std::collections::HashMap;
use std::sync::{PoisonError, RwLock};

use tokio::sync::{Mutex, MutexGuard};
use tread_api::ids::{ConfigurationId, RobotId};

use super::{App, AppError};
use crate::db::sites::SiteRow;
use crate::db::sums::SumKey;
use crate::db::{self, Tx};
use crate::friction::Sums;
use crate::friction::index::{Labelled, SiteMap};

/// The maps of all sites.
#[derive(Debug, Default)]
pub(super) struct Maps {
    sites: RwLock<HashMap<i64, SiteMap>>,
    /// Held from before a transaction that changes sums until memory shows it, so that both see
    /// the same changes in the same order.
    order: Mutex<()>,
}

/// Sums on their way into memory.
#[derive(Debug, Clone)]
pub(super) struct Folded {
    pub(super) key: SumKey,
    pub(super) robot: RobotId,
    pub(super) configuration: ConfigurationId,
    pub(super) sums: Sums,
}

impl Maps {
    /// The turn to change sums, in the database and then here.
    pub(super) async fn turn(&self) -> MutexGuard<'_, ()> {
        self.order.lock().await
    }

    /// Makes room for a site's map.
    pub(super) fn ensure(&self, row: &SiteRow) {
        let mut sites = self.sites.write().unwrap_or_else(PoisonError::into_inner);
        sites
            .entry(row.pk)
            .or_insert_with(|| SiteMap::new(row.site.grid.revision, row.merged_before_h));
    }

    /// Adds what was committed.
    pub(super) fn fold(&self, folded: &[Folded]) {
        if folded.is_empty() {
            return;
        }
        let mut sites = self.sites.write().unwrap_or_else(PoisonError::into_inner);
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

    /// Changes a site's map.
    pub(super) fn change(&self, row: &SiteRow, change: impl FnOnce(&mut SiteMap)) {
        self.ensure(row);
        let mut sites = self.sites.write().unwrap_or_else(PoisonError::into_inner);
        if let Some(map) = sites.get_mut(&row.pk) {
            change(map);
        }
    }

    /// Looks at a site's map.
    pub(super) fn look<T>(&self, row: &SiteRow, look: impl FnOnce(&SiteMap) -> T) -> T {
        let sites = self.sites.read().unwrap_or_else(PoisonError::into_inner);
        match sites.get(&row.pk) {
            Some(map) => look(map),
            None => look(&SiteMap::new(row.site.grid.revision, row.merged_before_h)),
        }
    }
}

impl App {
    /// Reads all sums into memory, and of which runs raw measurements were removed; once, before
    /// anything is taken in.
    ///
    /// # Errors
    /// The database failed.
    pub async fn load_map(&self) -> Result<(), AppError> {
        let _turn = self.maps().turn().await;
        let mut tx = self.db().read().await?;
        self.fill(&mut tx).await
    }

    async fn fill(&self, tx: &mut Tx) -> Result<(), AppError> {
        self.removed().extend(db::removed::boots(tx).await?);
        let mut after = String::new();
        loop {
            let rows = db::sites::list(tx, &after, 100).await?;
            let Some(last) = rows.last() else { break };
            after = last.site.id.to_string();
            for row in &rows {
                self.maps().ensure(row);
            }
        }
        let robots = db::robots::ids_by_key(tx).await?;
        let configurations = db::robots::configurations_by_key(tx).await?;
        let mut chunk = Vec::new();
        db::sums::each(tx, |row| {
            let key = row.key;
            // A sum refers to both, so neither is ever missing.
            if let (Some(robot), Some(&configuration)) = (
                robots.get(&key.robot_pk),
                configurations.get(&key.configuration_pk),
            ) {
                chunk.push(Folded {
                    robot: robot.clone(),
                    configuration,
                    sums: row.sums,
                    key,
                });
            }
            if chunk.len() >= 10_000 {
                self.maps().fold(&chunk);
                chunk.clear();
            }
        })
        .await?;
        self.maps().fold(&chunk);
        Ok(())
    }
}
