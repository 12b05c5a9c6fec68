//! Raw measurements in the order of their commits: those of the archive, then those of the database.

use tread_api::friction::StoredSegment;
use tread_api::ids::SiteId;
use tread_api::page::Page;

use super::{App, AppError, site_row};
use crate::archive::Selection;
use crate::db;
pub use crate::db::segments::SegmentFilter;

/// Some measurements of a list.
#[derive(Debug, Default)]
pub(super) struct Batch {
    /// The measurements.
    pub(super) segments: Vec<StoredSegment>,
    /// Key after which the list goes on; `None` at its end.
    pub(super) next: Option<i64>,
}

impl App {
    /// Returns a page of the measurements of a site, in the order of their commits. A page may have
    /// fewer than `limit`, or none, before the end of the list.
    pub async fn segments(
        &self,
        site: &SiteId,
        filter: &SegmentFilter,
        limit: u32,
    ) -> Result<Page<StoredSegment>, AppError> {
        let batch = self.some_segments(site, filter, limit).await?;
        Ok(Page {
            items: batch.segments,
            next_cursor: batch.next.map(|next| next.to_string()),
        })
    }

    /// Returns at most `limit` measurements of a site after the filter's cursor.
    pub(super) async fn some_segments(
        &self,
        site: &SiteId,
        filter: &SegmentFilter,
        limit: u32,
    ) -> Result<Batch, AppError> {
        let mut filter = filter.clone();
        // One more, which says whether the list goes on.
        let wanted = usize::try_from(limit)
            .unwrap_or(usize::MAX)
            .saturating_add(1);
        let mut segments = Vec::new();
        loop {
            let mut tx = self.db().read("segments").await?;
            let site_pk = site_row(&mut tx, site).await?.pk;
            let ends = db::segment_ranges::ends(&mut tx).await?;
            let before = ends.map_or(0, |(first, _)| first);
            let archive = self.archive().filter(|_| filter.after < before - 1);
            let left = wanted - segments.len();
            let Some(archive) = archive else {
                let left = u32::try_from(left).unwrap_or(u32::MAX);
                segments.extend(db::segments::list(&mut tx, site_pk, &filter, left).await?);
                return Ok(Batch::new(segments, wanted - 1, None));
            };
            // While files are read, more measurements may move to them: then they are read once more.
            drop(tx);
            let selection = Selection {
                site: Some(site.clone()),
                robot: filter.robot.clone(),
                terrain: filter.terrain.clone(),
                robots: filter.robots.clone(),
                after: filter.after,
                before,
            };
            let found = self.read_archive(archive, selection, left).await?;
            segments.extend(found.segments.into_iter().map(|segment| segment.stored));
            filter.after = found.searched_to;
            if segments.len() >= wanted || found.searched_to < before - 1 {
                return Ok(Batch::new(segments, wanted - 1, Some(found.searched_to)));
            }
        }
    }
}

impl Batch {
    /// Divides what was found into this batch and what follows it.
    fn new(mut segments: Vec<StoredSegment>, limit: usize, searched_to: Option<i64>) -> Self {
        let is_more = segments.len() > limit;
        segments.truncate(limit);
        let last = segments.last().filter(|_| is_more);
        Self {
            next: last.map(|segment| segment.id).or(searched_to),
            segments,
        }
    }
}
