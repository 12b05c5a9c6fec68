//! Raw measurements of single epochs, so that the map can be read as of a time within one.
//!
//! Measurements of an epoch that are not all stored any more, or are too many, give no timeline;
//! the map is then read as of the end of the epoch before. A timeline is complete once it has as
//! many measurements as the sums of its epoch.

use std::sync::{Arc, Mutex, PoisonError};

use jiff::Timestamp;

use super::{App, AppError};
use crate::app::ingest::SKEW_MIN;
use crate::db::segments::{KeyedSegment, SiteCursor};
use crate::db::sites::SiteRow;
use crate::db::withdrawals::WithdrawalRow;
use crate::db::{self, Tx};
use crate::friction::index::{Measurement, PartialEpoch, SiteMap, Stamp, Timeline};
use crate::friction::{Epoch, Sums, epoch_h};

/// Maximum number of measurements of a timeline, and of all that are cached; 184 bytes each.
pub(super) const MEASUREMENTS_MAX: usize = 200_000;
/// Maximum number of cached timelines.
const KEPT_MAX: usize = 64;
/// Maximum number of cached partial epochs.
const PARTIALS_MAX: usize = 2;
/// Number of measurements that are read at a time, of all epochs since a timeline begins.
const READ_AT_ONCE: u32 = 4_096;
/// Maximum number of times that one request reads for one timeline; the next request reads on.
const READ_MAX: usize = 100;
/// Number of times after which what was read is cached, in case that the request ends.
const CACHED_EVERY: usize = 16;

/// Cache of timelines.
#[derive(Debug, Default)]
pub(in crate::app) struct Timelines {
    /// The least recently used first.
    kept: Mutex<Vec<CachedTimeline>>,
    /// The newest partial epochs, the oldest first: pages and frames of one map share theirs.
    partials: Mutex<Vec<(i64, Arc<PartialEpoch>)>>,
    /// Held while measurements are read, so that one request at a time does.
    reading: tokio::sync::Mutex<()>,
}

#[derive(Debug, Clone)]
struct CachedTimeline {
    of: Identity,
    /// Key of the last measurement that was read.
    read_to: i64,
    timeline: Arc<Timeline>,
}

/// What a timeline belongs to. Of the same one, measurements are only ever added.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Identity {
    site_pk: i64,
    epoch: Epoch,
    grid_revision: u32,
    stamp: Stamp,
}

impl Timelines {
    fn find(&self, of: Identity) -> Option<CachedTimeline> {
        let mut kept = self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        let index = kept.iter().position(|kept| kept.of == of)?;
        let found = kept.remove(index);
        kept.push(found.clone());
        Some(found)
    }

    fn insert(&self, new: CachedTimeline) {
        let mut kept = self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        let same = |kept: &CachedTimeline| {
            (kept.of.site_pk, kept.of.epoch) == (new.of.site_pk, new.of.epoch)
        };
        kept.retain(|kept| !same(kept));
        kept.push(new);
        let count = |kept: &Vec<CachedTimeline>| {
            kept.iter().map(|kept| kept.timeline.count()).sum::<usize>()
        };
        while kept.len() > KEPT_MAX || (kept.len() > 1 && count(&kept) > MEASUREMENTS_MAX) {
            kept.remove(0);
        }
    }

    /// Returns the sums of the measurements of a timeline that ended before a time.
    pub(super) fn before(&self, timeline: &Arc<Timeline>, at_us: i64) -> Arc<PartialEpoch> {
        let partials = || self.partials.lock().unwrap_or_else(PoisonError::into_inner);
        let is_same = |(found_us, partial): &&(i64, Arc<PartialEpoch>)| {
            *found_us == at_us && Arc::ptr_eq(partial.timeline(), timeline)
        };
        if let Some((_, found)) = partials().iter().find(is_same) {
            return Arc::clone(found);
        }
        let partial = Arc::new(PartialEpoch::before(Arc::clone(timeline), at_us));
        let mut partials = partials();
        if partials.len() >= PARTIALS_MAX {
            partials.remove(0);
        }
        partials.push((at_us, Arc::clone(&partial)));
        partial
    }
}

impl App {
    /// Returns all measurements of an epoch that are on a site's map; `None` if some of them are no
    /// longer stored, or if they are too many.
    ///
    /// # Errors
    /// The database failed.
    pub(super) async fn timeline(
        &self,
        row: &SiteRow,
        epoch: Epoch,
    ) -> Result<Option<Arc<Timeline>>, AppError> {
        let looked = |map: &SiteMap| (map.measurements_of(epoch), map.stamp());
        // Read before the database, which is never behind the map.
        let (wanted, stamp) = self.maps().with_map(row, looked);
        let wanted = usize::try_from(wanted).unwrap_or(usize::MAX);
        if wanted == 0 {
            return Ok(Some(Arc::new(Timeline::new(epoch))));
        }
        if wanted > MEASUREMENTS_MAX {
            return Ok(None);
        }
        let of = Identity {
            site_pk: row.pk,
            epoch,
            grid_revision: row.site.grid.revision,
            stamp,
        };
        let is_whole = |kept: &CachedTimeline| kept.timeline.count() >= wanted;
        if let Some(found) = self.timelines().find(of).filter(is_whole) {
            return Ok(Some(found.timeline));
        }
        let _turn = self.timelines().reading.lock().await;
        let mut tx = self.db().read("friction").await?;
        let mut kept = match self.timelines().find(of) {
            Some(kept) => kept,
            None => match begun(&mut tx, of).await? {
                Some(begun) => begun,
                None => return Ok(None),
            },
        };
        let withdrawals: Arc<[WithdrawalRow]> = db::withdrawals::all(&mut tx).await?.into();
        for batch in 1..=READ_MAX {
            if is_whole(&kept) {
                break;
            }
            let cursor = SiteCursor {
                site_pk: of.site_pk,
                after: kept.read_to,
            };
            let rows = db::segments::of_site(&mut tx, cursor, READ_AT_ONCE);
            let rows = rows.await?;
            if rows.is_empty() {
                break;
            }
            let withdrawals = Arc::clone(&withdrawals);
            let adding = move || kept.with(&rows, &withdrawals);
            kept = self.compute(adding).await;
            if batch % CACHED_EVERY == 0 {
                self.timelines().insert(kept.clone());
            }
        }
        drop(tx);
        self.timelines().insert(kept.clone());
        Ok(is_whole(&kept).then_some(kept.timeline))
    }
}

/// Returns an empty timeline from before the first measurement of an epoch; `None` if some were
/// removed.
async fn begun(tx: &mut Tx, of: Identity) -> Result<Option<CachedTimeline>, AppError> {
    let begin = of.epoch.begin();
    let since = begin.checked_sub(SKEW_MIN).unwrap_or(Timestamp::MIN);
    let first = db::segments::first_since(tx, since).await?;
    Ok(first.map(|first| CachedTimeline {
        of,
        read_to: first - 1,
        timeline: Arc::new(Timeline::new(of.epoch)),
    }))
}

impl CachedTimeline {
    /// Adds those of the given measurements that are of this epoch and on the map.
    fn with(mut self, rows: &[KeyedSegment], withdrawals: &[WithdrawalRow]) -> Self {
        let found = rows
            .iter()
            .filter_map(|row| counted(row, self.of, withdrawals));
        let found: Vec<Measurement> = found.collect();
        if !found.is_empty() {
            Arc::make_mut(&mut self.timeline).extend(found);
        }
        self.read_to = rows.last().map_or(self.read_to, |row| row.pk);
        self
    }
}

/// Returns a measurement if it is of the epoch and on the map.
fn counted(row: &KeyedSegment, of: Identity, withdrawals: &[WithdrawalRow]) -> Option<Measurement> {
    let segment = &row.segment;
    let hour = epoch_h(segment.ended_at);
    let is_on_map = of.epoch.includes_h(hour)
        && segment.grid_revision == of.grid_revision
        && !withdrawals
            .iter()
            .any(|found| found.robot_pk == row.robot_pk && found.hours.contains(hour));
    let sums = is_on_map.then(|| Sums::of(segment)).flatten();
    sums.map(|sums| Measurement {
        ended_at_us: segment.ended_at.as_microsecond(),
        cell: segment.cell,
        terrain: segment.terrain.clone(),
        configuration: segment.configuration,
        robot: row.robot.clone(),
        sums,
    })
}
