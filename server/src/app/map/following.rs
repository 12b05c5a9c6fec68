//! The map of a standby, which follows a database that another server writes.
//!
//! ```text
//! every 0.25 s ─────────► snapshot ─► new sites, horizons, withdrawals; segments after the last key ─► map
//! block of cells read ──► snapshot ─► the same first, then the block
//! ```
//!
//! As in the server that writes, the sums that follow the stored watermarks are in memory. Each range of the
//! ledger is a generation of its own, since that server moves its watermarks between ranges.

use std::collections::HashMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex as StdMutex, PoisonError};
use std::time::Duration;

use tokio::sync::{Mutex, MutexGuard};
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;
use tread_api::ids::RobotId;
use tread_api::rights::Scope;

use super::names::Names;
use super::{MapChange, Withdrawn};
use crate::app::App;
use crate::app::sites::SITES_MAX;
use crate::db::leader::Leader;
use crate::db::segments::{Added, KeyedSegment};
use crate::db::sites::SiteRow;
use crate::db::watermarks::WatermarkStep;
use crate::db::{self, DbError, Tx};
use crate::friction::index::SiteMap;

/// Interval at which the map is brought up to date.
const FOLLOW_EVERY: Duration = Duration::from_millis(250);
/// Interval at which sums leave the unwritten ones that the other server has stored.
const FORGET_EVERY: Duration = Duration::from_secs(2);
/// Maximum time to count the standbys.
const STANDBYS_MAX: Duration = Duration::from_millis(500);
/// Maximum time that the server that was a standby waits for the map.
const TURN_MAX: Duration = Duration::from_secs(1);
/// Number of segments that are read at a time.
const SEGMENTS_AT_ONCE: u32 = 10_000;

/// What a standby has read of the database.
#[derive(Debug, Default)]
pub(super) struct Follower {
    read: Mutex<ReadPosition>,
    seen: StdMutex<LeaderView>,
    /// Whether the process is the server now; set under the lock of the maps.
    is_over: AtomicBool,
}

/// Position up to which the database was read.
#[derive(Debug, Default)]
pub(super) struct ReadPosition {
    /// Key of the last segment on the map.
    last_pk: i64,
    /// Number of the last withdrawal on the map.
    last_withdrawal: i64,
    /// The server that has the database, and its generation of sites, terrains and robots; `None` before the
    /// map was read.
    leader: Option<Leader>,
    names: Names,
    watermarks: HashMap<i64, i64>,
    /// When watermarks were read, on the monotonic clock.
    watermarks_at: Duration,
}

/// State of the server that has the database, and the time when the map was up to date.
#[derive(Debug, Default)]
struct LeaderView {
    leader: Leader,
    at: Option<Instant>,
}

impl ReadPosition {
    /// Begins after a map that was just read.
    pub(super) fn begin(
        &mut self,
        last_pk: i64,
        leader: Leader,
        (names, watermarks): (Names, HashMap<i64, i64>),
    ) {
        *self = Self {
            last_pk,
            last_withdrawal: names.last_withdrawal(),
            leader: Some(leader),
            names,
            watermarks,
            watermarks_at: Duration::ZERO,
        };
    }
}

impl Follower {
    /// Waits for the right to bring the map up to date.
    pub(super) async fn turn(&self) -> MutexGuard<'_, ReadPosition> {
        self.read.lock().await
    }

    pub(super) fn is_over(&self) -> bool {
        self.is_over.load(Ordering::Acquire)
    }

    pub(super) fn end(&self) {
        self.is_over.store(true, Ordering::Release);
    }

    fn seen(&self) -> std::sync::MutexGuard<'_, LeaderView> {
        self.seen.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl App {
    /// Updates the map of a standby. Returns `false` if the whole map has to be read again: another server has
    /// become active, the database lacks measurements that the map has, or removed some that the map lacks.
    ///
    /// # Errors
    /// The database failed.
    pub async fn follow(&self) -> Result<bool, DbError> {
        let Some(follower) = self.maps().follower() else {
            return Ok(true);
        };
        let mut turn = follower.turn().await;
        let mut tx = self.db().read("follow").await?;
        self.follow_in(&mut tx, &mut turn).await
    }

    /// Brings the map up to what a snapshot contains; `false` if it cannot.
    pub(super) async fn follow_in(
        &self,
        tx: &mut Tx,
        read: &mut ReadPosition,
    ) -> Result<bool, DbError> {
        let (Some(follower), Some(before)) = (self.maps().follower(), read.leader.clone()) else {
            return Ok(false);
        };
        let leader = db::leader::get(tx).await?;
        // Whoever has the database now may have other segments with the same keys, and another schema.
        if leader.epoch != before.epoch || leader.generation < before.generation {
            return Ok(false);
        }
        if leader.generation != before.generation {
            self.follow_sites(tx, read).await?;
            self.db().set_generation(leader.generation);
            read.leader = Some(leader.clone());
        }
        if !self.follow_segments(tx, read).await? {
            return Ok(false);
        }
        let now = self.clock().elapsed();
        if now.saturating_sub(read.watermarks_at) >= FORGET_EVERY {
            read.watermarks_at = now;
            if !self.remove_stored(db::watermarks::all(tx).await?, read) {
                return Ok(false);
            }
        }
        *follower.seen() = LeaderView {
            leader,
            at: Some(Instant::now()),
        };
        Ok(true)
    }

    /// Adds new sites, and removes and merges what was removed and merged.
    async fn follow_sites(&self, tx: &mut Tx, read: &mut ReadPosition) -> Result<(), DbError> {
        read.names = Names::read(tx).await?;
        let sites = db::sites::list(tx, &Scope::EVERYWHERE, "", SITES_MAX).await?;
        for site in &sites {
            self.maps().ensure(site);
        }
        // Before hours are merged into days, of which a withdrawal takes a part no more.
        let after = read.last_withdrawal;
        if read.names.last_withdrawal() > after {
            let places = places(tx, &sites).await?;
            for row in read.names.withdrawals_after(after) {
                let Some((site, robot)) = places.get(&row.robot_pk) else {
                    continue;
                };
                self.apply(MapChange::Withdraw(Box::new(Withdrawn {
                    site: (*site).clone(),
                    robot: robot.clone(),
                    robot_pk: row.robot_pk,
                    hours: row.hours,
                })));
            }
            read.last_withdrawal = read.names.last_withdrawal();
        }
        for site in sites {
            let horizons = site.horizons;
            if self.maps().with_map(&site, SiteMap::horizons) != horizons {
                self.apply(MapChange::MergeBefore(Box::new(site), horizons));
            }
        }
        Ok(())
    }

    /// Adds the segments after the last one.
    async fn follow_segments(&self, tx: &mut Tx, read: &mut ReadPosition) -> Result<bool, DbError> {
        loop {
            let rows = db::segments::after(tx, read.last_pk, SEGMENTS_AT_ONCE).await?;
            let Some(first) = rows.first() else {
                let last = db::segment_ranges::last(tx).await?;
                // The ledger keeps its last range for ever.
                return Ok(last.map_or(0, |(last_pk, _)| last_pk) >= read.last_pk);
            };
            // Keys have no gaps, and the first are removed first.
            if first.pk != read.last_pk + 1 {
                return Ok(false);
            }
            let is_last = rows.len() < SEGMENTS_AT_ONCE as usize;
            if !self.add_segments(rows, read)? {
                return Ok(false);
            }
            if is_last {
                return Ok(true);
            }
        }
    }

    /// Adds segments range by range; `false` if this process is the server now.
    fn add_segments(
        &self,
        rows: Vec<KeyedSegment>,
        read: &mut ReadPosition,
    ) -> Result<bool, DbError> {
        let now = self.clock().elapsed();
        let mut rows = rows.into_iter().peekable();
        while let Some(first) = rows.next() {
            let range_pk = first.range_pk;
            let mut range = Added {
                first: range_pk,
                last: first.pk,
            };
            let mut folded = Vec::new();
            folded.extend(read.names.folded(first)?);
            while let Some(row) = rows.next_if(|row| row.range_pk == range_pk) {
                range.last = row.pk;
                folded.extend(read.names.folded(row)?);
            }
            if !folded.is_empty() && !self.maps().add_followed(&folded, range, now) {
                return Ok(false);
            }
            read.last_pk = range.last;
        }
        Ok(true)
    }

    /// Removes sums from the unwritten ones that are stored now; `false` if this process is the server now.
    fn remove_stored(&self, watermarks: HashMap<i64, i64>, read: &mut ReadPosition) -> bool {
        let step = |(&robot_pk, &to_pk): (&i64, &i64)| {
            let from_pk = read.watermarks.get(&robot_pk).copied().unwrap_or_default();
            (to_pk > from_pk).then_some(WatermarkStep {
                robot_pk,
                from_pk,
                to_pk,
            })
        };
        let steps: Vec<WatermarkStep> = watermarks.iter().filter_map(step).collect();
        read.watermarks = watermarks;
        self.maps().remove_followed(&steps)
    }

    /// Returns the number of standbys that follow the database of this server; `None` for a database that has
    /// one server.
    ///
    /// # Errors
    /// The database failed, or does not answer soon.
    pub async fn standbys(&self) -> Result<Option<u64>, DbError> {
        let looking = async {
            let mut tx = self.db().read("standbys").await?;
            db::leader::standbys(&mut tx).await
        };
        let looked = tokio::time::timeout(STANDBYS_MAX, looking).await;
        looked.unwrap_or_else(|_elapsed| Err(DbError::unanswered()))
    }

    /// Takes the map over from the standby that this process was, after all that the database has. `false` if
    /// it has to be read. Requests to the standby that are under way read the same map.
    ///
    /// # Errors
    /// The database failed.
    pub async fn take_over_map(&self) -> Result<bool, DbError> {
        let maps = self.maps();
        let Some(follower) = maps.follower() else {
            return Ok(false);
        };
        let mut order = Arc::clone(&maps.order).lock_owned().await;
        let ended = self.db().unknown_outcomes();
        // A read may hang on a connection to a machine that is gone.
        let taken = match tokio::time::timeout(TURN_MAX, follower.turn()).await {
            Ok(mut turn) => self.catch_up(&mut turn).await,
            Err(_elapsed) => Ok(false),
        };
        maps.end_following();
        *order = ended;
        taken
    }

    /// Brings the map of a standby up to date as the server that has the database now.
    async fn catch_up(&self, read: &mut ReadPosition) -> Result<bool, DbError> {
        let mut tx = self.db().read("map").await?;
        let Some(leader) = &mut read.leader else {
            return Ok(false);
        };
        // This server has counted the epoch up, and whoever had the database last was the one before.
        leader.epoch += 1;
        if !self.follow_in(&mut tx, read).await? {
            return Ok(false);
        }
        let watermarks = db::watermarks::all(&mut tx).await?;
        if self.maps().unwritten().is_divided_by(&watermarks) {
            return Ok(false);
        }
        if !self.remove_stored(watermarks, read) {
            return Ok(false);
        }
        self.removed().extend(db::removed::boots(&mut tx).await?);
        Ok(true)
    }

    /// Reads which server has the database, to which a standby forwards before it has the map.
    ///
    /// # Errors
    /// The database failed.
    pub async fn load_leader(&self) -> Result<(), DbError> {
        if let Some(follower) = self.maps().follower() {
            let mut tx = self.db().read("follow").await?;
            follower.seen().leader = db::leader::get(&mut tx).await?;
        }
        Ok(())
    }

    /// Returns the address that the active server advertises; `None` if it advertises none, or in the active
    /// server.
    pub fn leader_url(&self) -> Option<String> {
        self.maps().follower()?.seen().leader.advertise_url.clone()
    }

    /// Returns the time since the map of a standby was last up to date; `None` before its first update, or in
    /// the active server.
    pub fn map_age(&self) -> Option<Duration> {
        let at = self.maps().follower()?.seen().at?;
        Some(at.elapsed())
    }

    /// Returns whether another server has the database, and this one follows it.
    pub(in crate::app) fn is_standby(&self) -> bool {
        self.maps().follower().is_some()
    }
}

/// Returns site and name of each robot by its key.
async fn places<'sites>(
    tx: &mut Tx,
    sites: &'sites [SiteRow],
) -> Result<HashMap<i64, (&'sites SiteRow, RobotId)>, DbError> {
    let mut places = HashMap::new();
    for site in sites {
        let robots = db::robots::of_site_by_key(tx, site.pk).await?;
        places.extend(robots.into_iter().map(|(pk, robot)| (pk, (site, robot))));
    }
    Ok(places)
}

/// Brings the map of a standby up to date periodically, until the stop, or until it has to be read as a whole.
pub async fn run(app: App, stop: CancellationToken) {
    loop {
        tokio::select! {
            biased;
            () = stop.cancelled() => return,
            () = tokio::time::sleep(FOLLOW_EVERY) => {}
        }
        let followed = tokio::select! {
            biased;
            () = stop.cancelled() => return,
            followed = db::limited(app.follow()) => followed,
        };
        match followed {
            Ok(true) => {}
            Ok(false) => return,
            Err(cause) => app.log_failure("follow the database", &cause),
        }
    }
}
