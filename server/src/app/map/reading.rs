//! Reads the map into memory: the stored sums, and the segments that follow each robot's watermark.

use std::collections::HashMap;
use std::pin::pin;
use std::sync::{Arc, PoisonError};
use std::time::Duration;

use futures_util::TryStreamExt as _;
use tread_api::ids::{ConfigurationId, RobotId};
use tread_api::rights::Scope;

use super::blocks::BlockMemory;
use super::unwritten::Unwritten;
use super::{Folded, Maps, Sites};
use crate::app::App;
use crate::db::segments::{Added, KeyedSegment};
use crate::db::sums::SumKey;
use crate::db::withdrawals::WithdrawalRow;
use crate::db::{self, DbError, Tx};
use crate::friction::index::SiteMap;
use crate::friction::{Sums, epoch_h};

/// Number of sums after which cells leave memory if all together need too much of it.
const EVICT_EVERY: usize = 10_000;

/// What was read.
struct Read {
    sites: Sites,
    unwritten: Unwritten,
}

/// Database keys of what a segment names.
struct Names {
    robots: HashMap<i64, RobotId>,
    configurations: HashMap<i64, ConfigurationId>,
    withdrawals: Vec<WithdrawalRow>,
}

impl App {
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
    pub(in crate::app) async fn load_map_again(&self, ended: u64) -> Result<(), DbError> {
        let mut order = Arc::clone(&self.maps().order).lock_owned().await;
        let mut tx = self.db().read("map").await?;
        let now = self.clock().elapsed();
        let read = read(&mut tx, now, &self.maps().memory).await?;
        self.removed().extend(db::removed::boots(&mut tx).await?);
        drop(tx);
        self.maps().replace(read);
        *order = ended;
        Ok(())
    }
}

impl Maps {
    /// Replaces the maps by those read from the database.
    fn replace(&self, mut read: Read) {
        let mut sites = self.sites.write().unwrap_or_else(PoisonError::into_inner);
        for (pk, before) in sites.maps.drain() {
            match read.sites.maps.get_mut(&pk) {
                Some(map) => map.follow(&before),
                None => {
                    read.sites.maps.insert(pk, before);
                }
            }
        }
        *sites = read.sites;
        let mut unwritten = self.unwritten();
        read.unwritten.follow(&mut unwritten);
        *unwritten = read.unwritten;
    }
}

/// Reads all sums. Cells stay in memory as far as there is room; a block that has left it once gets
/// no further sums, so it is read again as a whole when it is needed.
async fn read(tx: &mut Tx, now: Duration, memory: &BlockMemory) -> Result<Read, DbError> {
    let mut sites = Sites::default();
    let mut after = String::new();
    loop {
        let rows = db::sites::list(tx, &Scope::EVERYWHERE, &after, 100).await?;
        let Some(last) = rows.last() else { break };
        after = last.site.id.to_string();
        for row in &rows {
            sites.ensure(row);
        }
    }
    let names = Names {
        robots: db::robots::ids_by_key(tx).await?,
        configurations: db::robots::configurations_by_key(tx).await?,
        withdrawals: db::withdrawals::all(tx).await?,
    };
    let mut added = 0_usize;
    db::sums::each(tx, |row| {
        // The foreign keys of a sum guarantee both names.
        if let Some(folded) = names.named(row.key, row.sums) {
            sites.add(std::slice::from_ref(&folded), SiteMap::load_cells);
            added += 1;
            if added.is_multiple_of(EVICT_EVERY) {
                memory.evict(&mut sites);
            }
        }
    })
    .await?;
    let watermarks = db::watermarks::all(tx).await?;
    let mut unwritten = Unwritten::following(watermarks.clone());
    for (robot_pk, last_pk) in db::segment_ranges::last_keys(tx).await? {
        let watermark = watermarks.get(&robot_pk).copied().unwrap_or_default();
        // A damaged table of measurements does not keep a server from starting that needs none.
        if last_pk <= watermark {
            continue;
        }
        let mut following = pin!(db::segments::of_robot(tx, robot_pk, watermark));
        while let Some(row) = following.try_next().await? {
            let keys = Added {
                first: row.pk,
                last: row.pk,
            };
            if let Some(folded) = names.folded(row)? {
                unwritten.add([(&folded.key, &*folded.cells)], keys, now);
                sites.add(std::slice::from_ref(&folded), SiteMap::load_cells);
                added += 1;
                if added.is_multiple_of(EVICT_EVERY) {
                    memory.evict(&mut sites);
                }
            }
        }
    }
    memory.evict(&mut sites);
    Ok(Read { sites, unwritten })
}

impl Names {
    fn named(&self, key: SumKey, sums: Sums) -> Option<Folded> {
        Some(Folded {
            robot: self.robots.get(&key.robot_pk)?.clone(),
            configuration: *self.configurations.get(&key.configuration_pk)?,
            cells: vec![(key.cell, sums)],
            key,
        })
    }

    /// Returns the sum of a stored segment, as it was added before its receipt; `None` if it is
    /// withdrawn.
    fn folded(&self, row: KeyedSegment) -> Result<Option<Folded>, DbError> {
        let KeyedSegment {
            pk,
            robot_pk,
            site_pk,
            configuration_pk,
            segment,
            ..
        } = row;
        // It was checked in the transaction that stored it.
        let sums = Sums::of(&segment).ok_or_else(|| DbError::Corrupt {
            what: "measurement out of range",
            value: pk.to_string(),
        })?;
        let key = SumKey {
            robot_pk,
            epoch_h: epoch_h(segment.ended_at),
            cell: segment.cell,
            terrain: segment.terrain,
            grid_revision: segment.grid_revision,
            site_pk,
            configuration_pk,
        };
        let is_withdrawn = |row: &WithdrawalRow| row.includes(robot_pk, key.epoch_h);
        if self.withdrawals.iter().any(is_withdrawn) {
            return Ok(None);
        }
        Ok(self.named(key, sums))
    }
}
