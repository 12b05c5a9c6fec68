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
use std::sync::{Arc, Mutex as StdMutex, PoisonError};
use std::time::Duration;

use tokio::sync::{Mutex, MutexGuard};
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

/// Interval at which the map is brought up to date.
const FOLLOW_EVERY: Duration = Duration::from_millis(250);
/// Interval at which sums leave the unwritten ones that the other server has stored.
const FORGET_EVERY: Duration = Duration::from_secs(2);
/// Maximum time to count the standbys.
const STANDBYS_MAX: Duration = Duration::from_millis(500);
/// Number of segments that are read at a time.
const SEGMENTS_AT_ONCE: u32 = 10_000;

/// What a standby has read of the database.
#[derive(Debug, Default)]
pub(super) struct Follower {
    read: Mutex<Read>,
    seen: StdMutex<Seen>,
}

/// Up to where the database was read.
#[derive(Debug, Default)]
pub(super) struct Read {
    /// Key of the last segment on the map.
    last_pk: i64,
    /// Number of the last withdrawal on the map.
    last_withdrawal: i64,
    /// Generation of sites, terrains and robots; `None` before the first.
    generation: Option<i64>,
    names: Names,
    watermarks: HashMap<i64, i64>,
    /// When watermarks were read, on the monotonic clock.
    watermarks_at: Duration,
    /// Whether the server that this process became has the map now.
    is_over: bool,
}

/// What was seen of the server that has the database, and when the map was up to date.
#[derive(Debug, Default)]
struct Seen {
    leader: Leader,
    at: Option<Duration>,
}

impl Read {
    /// Returns what a map that was just read follows.
    pub(super) fn from(
        last_pk: i64,
        leader: &Leader,
        names: Names,
        watermarks: HashMap<i64, i64>,
    ) -> Self {
        Self {
            last_pk,
            last_withdrawal: names.last_withdrawal(),
            generation: Some(leader.generation),
            names,
            watermarks,
            watermarks_at: Duration::ZERO,
            is_over: false,
        }
    }
}

impl Follower {
    /// Waits for the right to bring the map up to date.
    pub(super) async fn turn(&self) -> MutexGuard<'_, Read> {
        self.read.lock().await
    }

    fn saw(&self, leader: Leader, at: Duration) {
        let mut seen = self.seen.lock().unwrap_or_else(PoisonError::into_inner);
        *seen = Seen {
            leader,
            at: Some(at),
        };
    }
}

impl App {
    /// Brings the map of a standby up to date.
    ///
    /// # Errors
    /// The database failed.
    pub async fn follow(&self) -> Result<(), DbError> {
        let Some(follower) = self.maps().follower() else {
            return Ok(());
        };
        let mut turn = follower.turn().await;
        if turn.is_over {
            return Ok(());
        }
        let mut tx = self.db().read("follow").await?;
        let has_gap = !self.follow_in(&mut tx, &mut turn).await?;
        drop((tx, turn));
        if has_gap {
            tracing::info!(
                "measurements were removed that this standby has not read: it reads the map again"
            );
            self.load_map().await?;
        }
        Ok(())
    }

    /// Brings the map up to what a snapshot contains; `false` if it cannot, since segments were removed that
    /// are not on it, or another has it now.
    pub(super) async fn follow_in(&self, tx: &mut Tx, read: &mut Read) -> Result<bool, DbError> {
        if read.is_over {
            return Ok(false);
        }
        let leader = db::leader::get(tx).await?;
        if read.generation != Some(leader.generation) {
            self.follow_sites(tx, read).await?;
            read.generation = Some(leader.generation);
            self.db().follow(leader.generation);
        }
        if !self.follow_segments(tx, read).await? {
            return Ok(false);
        }
        let now = self.clock().elapsed();
        if now.saturating_sub(read.watermarks_at) >= FORGET_EVERY {
            read.watermarks_at = now;
            self.forget_stored(db::watermarks::all(tx).await?, read);
        }
        if let Some(follower) = self.maps().follower() {
            follower.saw(leader, now);
        }
        Ok(true)
    }

    /// Adds new sites, and removes and merges what was removed and merged.
    async fn follow_sites(&self, tx: &mut Tx, read: &mut Read) -> Result<(), DbError> {
        read.names = Names::read(tx).await?;
        let sites = db::sites::list(tx, &Scope::EVERYWHERE, "", SITES_MAX).await?;
        for site in &sites {
            self.maps().ensure(site);
            let is_merged = self
                .maps()
                .look(site, |map| map.horizons() == site.horizons);
            if !is_merged {
                self.apply(MapChange::MergeBefore(
                    Box::new(site.clone()),
                    site.horizons,
                ));
            }
        }
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
                    hours: (row.from_h, row.to_h),
                })));
            }
            read.last_withdrawal = read.names.last_withdrawal();
        }
        Ok(())
    }

    /// Adds the segments after the last one.
    async fn follow_segments(&self, tx: &mut Tx, read: &mut Read) -> Result<bool, DbError> {
        loop {
            let rows = db::segments::after(tx, read.last_pk, SEGMENTS_AT_ONCE).await?;
            let (Some(first), Some(last)) = (rows.first(), rows.last()) else {
                return Ok(true);
            };
            // Keys have no gaps, and the first are removed first.
            if first.pk != read.last_pk + 1 {
                return Ok(false);
            }
            let is_last = rows.len() < SEGMENTS_AT_ONCE as usize;
            let last_pk = last.pk;
            if !rows.iter().all(|row| read.names.knows(row)) {
                read.names = Names::read(tx).await?;
            }
            self.add_segments(rows, &read.names)?;
            read.last_pk = last_pk;
            if is_last {
                return Ok(true);
            }
        }
    }

    fn add_segments(&self, rows: Vec<KeyedSegment>, names: &Names) -> Result<(), DbError> {
        let mut rows = rows.into_iter().peekable();
        while let Some(first) = rows.next() {
            let range_pk = first.range_pk;
            let mut keys = Added {
                first: range_pk,
                last: first.pk,
            };
            let mut folded = Vec::new();
            folded.extend(names.folded(first)?);
            while let Some(row) = rows.next_if(|row| row.range_pk == range_pk) {
                keys.last = row.pk;
                folded.extend(names.folded(row)?);
            }
            if !folded.is_empty() {
                self.apply(MapChange::Add(folded, keys));
            }
        }
        Ok(())
    }

    /// Removes sums from the unwritten ones that are stored now.
    fn forget_stored(&self, watermarks: HashMap<i64, i64>, read: &mut Read) {
        let step = |(&robot_pk, &to_pk): (&i64, &i64)| {
            let from_pk = read.watermarks.get(&robot_pk).copied().unwrap_or_default();
            (to_pk > from_pk).then_some(WatermarkStep {
                robot_pk,
                from_pk,
                to_pk,
            })
        };
        let steps: Vec<WatermarkStep> = watermarks.iter().filter_map(step).collect();
        self.apply(MapChange::Store(steps));
        read.watermarks = watermarks;
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
    /// it has to be read.
    ///
    /// # Errors
    /// The database failed.
    pub async fn take_map(&self, standby: &Self) -> Result<bool, DbError> {
        let Some(follower) = standby.maps().follower() else {
            return Ok(false);
        };
        let mut order = Arc::clone(&self.maps().order).lock_owned().await;
        let ended = self.db().unknown_outcomes();
        let mut turn = follower.turn().await;
        let mut tx = self.db().read("map").await?;
        if turn.generation.is_none() || !standby.follow_in(&mut tx, &mut turn).await? {
            return Ok(false);
        }
        let watermarks = db::watermarks::all(&mut tx).await?;
        if standby.maps().unwritten().is_divided_by(&watermarks) {
            return Ok(false);
        }
        standby.forget_stored(watermarks, &mut turn);
        self.removed().extend(db::removed::boots(&mut tx).await?);
        drop(tx);
        let (sites, unwritten) = standby.maps().take();
        *turn = Read {
            is_over: true,
            ..Read::default()
        };
        self.maps().memory.continue_clock(&standby.maps().memory);
        self.maps().replace(sites, unwritten);
        *order = ended;
        Ok(true)
    }

    /// Returns the address of the server that has the database, as it says itself; `None` if it says none, or
    /// in that server.
    pub fn leader_url(&self) -> Option<String> {
        let follower = self.maps().follower()?;
        let seen = follower.seen.lock().unwrap_or_else(PoisonError::into_inner);
        seen.leader.advertise_url.clone()
    }

    /// Returns for how long the map of a standby has not been up to date; `None` before it was for the first
    /// time, or in the server that has the database.
    pub fn map_age(&self) -> Option<Duration> {
        let follower = self.maps().follower()?;
        let seen = follower.seen.lock().unwrap_or_else(PoisonError::into_inner);
        Some(self.clock().elapsed().saturating_sub(seen.at?))
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

/// Brings the map of a standby up to date periodically, until the stop.
pub async fn run(app: App, stop: CancellationToken) {
    loop {
        tokio::select! {
            biased;
            () = stop.cancelled() => return,
            () = tokio::time::sleep(FOLLOW_EVERY) => {}
        }
        if let Err(cause) = db::limited(app.follow()).await {
            app.log_failure("follow the database", &cause);
        }
    }
}
