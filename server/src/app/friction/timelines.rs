//! Raw measurements of single epochs, so that the map can be read as of a time within one.
//!
//! Measurements of an epoch that are not all stored any more, or are too many, give no timeline;
//! the map is then read as of the end of the epoch before. A timeline is complete once it has as
//! many measurements as the sums of its epoch.

use std::sync::{Arc, Mutex, PoisonError};

use jiff::Timestamp;

use super::{App, AppError};
use crate::app::ingest::SKEW_MIN;
use crate::db::segments::SiteSegment;
use crate::db::sites::SiteRow;
use crate::db::withdrawals::WithdrawalRow;
use crate::db::{self, Tx};
use crate::friction::index::{Epoch, Measurement, SiteMap, Timeline};
use crate::friction::{Sums, epoch_h};

/// Maximum number of measurements of a timeline, and of all that are cached; 184 bytes each.
pub(super) const MEASUREMENTS_MAX: usize = 200_000;
/// Maximum number of measurements that are read from the database for one timeline, of all sites
/// and epochs since its begin.
const READ_MAX: usize = 400_000;
/// Number of measurements that are read at a time.
const READ_AT_ONCE: u32 = 4_096;

/// Cache of timelines.
#[derive(Debug, Default)]
pub(in crate::app) struct Timelines {
    /// The least recently used first.
    kept: Mutex<Vec<Kept>>,
    /// Held while measurements are read, so that one request at a time does.
    reading: tokio::sync::Mutex<()>,
}

#[derive(Debug, Clone)]
struct Kept {
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
    withdrawals: u64,
}

impl Timelines {
    fn find(&self, of: Identity) -> Option<Kept> {
        let mut kept = self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        let index = kept.iter().position(|kept| kept.of == of)?;
        let found = kept.remove(index);
        kept.push(found.clone());
        Some(found)
    }

    fn keep(&self, new: Kept) {
        let mut kept = self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        let same = |kept: &Kept| (kept.of.site_pk, kept.of.epoch) == (new.of.site_pk, new.of.epoch);
        kept.retain(|kept| !same(kept));
        kept.push(new);
        let count = |kept: &Vec<Kept>| kept.iter().map(|kept| kept.timeline.count()).sum::<usize>();
        while kept.len() > 1 && count(&kept) > MEASUREMENTS_MAX {
            kept.remove(0);
        }
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
        let looked = |map: &SiteMap| (map.measurements_of(epoch), map.withdrawals());
        // Read before the database, which is never behind the map.
        let (wanted, withdrawals) = self.maps().look(row, looked);
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
            withdrawals,
        };
        let is_whole = |kept: &Kept| kept.timeline.count() >= wanted;
        if let Some(found) = self.timelines().find(of).filter(is_whole) {
            return Ok(Some(found.timeline));
        }
        let _turn = self.timelines().reading.lock().await;
        let kept = self.timelines().find(of);
        if let Some(found) = kept.as_ref().filter(|kept| is_whole(kept)) {
            return Ok(Some(Arc::clone(&found.timeline)));
        }
        let mut tx = self.db().read("friction").await?;
        let begun = match kept {
            Some(kept) => Some(kept),
            None => self.begun(&mut tx, of).await?,
        };
        let Some(begun) = begun else { return Ok(None) };
        let read = read(&mut tx, begun, wanted).await?;
        Ok(is_whole(&read).then(|| {
            self.timelines().keep(read.clone());
            read.timeline
        }))
    }

    /// Returns an empty timeline from before the first measurement of an epoch; `None` if some were
    /// removed.
    async fn begun(&self, tx: &mut Tx, of: Identity) -> Result<Option<Kept>, AppError> {
        let begin = of.epoch.begin();
        let since = begin.checked_sub(SKEW_MIN).unwrap_or(Timestamp::MIN);
        let first = db::segments::first_since(tx, since).await?;
        Ok(first
            .filter(|&(_, is_first)| !is_first || self.removed().is_empty())
            .map(|(first, _)| Kept {
                of,
                read_to: first - 1,
                timeline: Arc::new(Timeline::new(of.epoch)),
            }))
    }
}

/// Reads on until a timeline has as many measurements as wanted, or there are no more.
async fn read(tx: &mut Tx, mut kept: Kept, wanted: usize) -> Result<Kept, AppError> {
    let of = kept.of;
    let withdrawals = db::withdrawals::all(tx).await?;
    let mut found: Vec<Measurement> = Vec::new();
    let mut count = 0;
    while kept.timeline.count() + found.len() < wanted && count < READ_MAX {
        let rows = db::segments::of_site(tx, of.site_pk, kept.read_to, READ_AT_ONCE).await?;
        let Some(&(last, _)) = rows.last() else { break };
        kept.read_to = last;
        count += rows.len();
        let rows = rows.into_iter().filter_map(|(_, segment)| segment);
        found.extend(rows.filter_map(|segment| counted(segment, of, &withdrawals)));
    }
    Arc::make_mut(&mut kept.timeline).extend(found);
    Ok(kept)
}

/// Returns a measurement of the epoch that is on the map.
fn counted(
    SiteSegment {
        robot_pk,
        robot,
        segment,
        ..
    }: SiteSegment,
    of: Identity,
    withdrawals: &[WithdrawalRow],
) -> Option<Measurement> {
    let hour = epoch_h(segment.ended_at);
    let is_on_map = of.epoch.includes_h(hour)
        && segment.grid_revision == of.grid_revision
        && !withdrawals.iter().any(|row| row.includes(robot_pk, hour));
    let sums = is_on_map.then(|| Sums::of(&segment)).flatten()?;
    Some(Measurement {
        ended_at_us: segment.ended_at.as_microsecond(),
        cell: segment.cell,
        terrain: segment.terrain,
        configuration: segment.configuration,
        robot,
        sums,
    })
}
