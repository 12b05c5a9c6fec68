//! Raw measurements in the order of their commits.

use tread_api::friction::StoredSegment;
use tread_api::ids::SiteId;
use tread_api::page::Page;

use super::{App, AppError, page, site_row};
use crate::db;
pub use crate::db::segments::SegmentFilter;

impl App {
    /// Returns a page of the measurements of a site, in the order of their commits.
    pub async fn segments(
        &self,
        site: &SiteId,
        filter: &SegmentFilter,
        limit: u32,
    ) -> Result<Page<StoredSegment>, AppError> {
        let mut tx = self.db().read("segments").await?;
        let site_pk = site_row(&mut tx, site).await?.pk;
        let segments = db::segments::list(&mut tx, site_pk, filter, limit + 1).await?;
        Ok(page(segments, limit, |segment| segment.id.to_string()))
    }
}
