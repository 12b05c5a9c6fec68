//! Geofences: where the robots of a site may be. A change reaches the robots by the reconciler.

use tread_api::ids::SiteId;
use tread_api::safety::{Geofence, ReplaceGeofence};

use super::{App, AppError, site_row};
use crate::db;

/// Most robots whose place is looked at.
const ROBOTS_MAX: u32 = 10_000;

impl App {
    /// A site's geofence.
    pub async fn geofence(&self, site: &SiteId) -> Result<Geofence, AppError> {
        let mut tx = self.db().read().await?;
        let site_pk = site_row(&mut tx, site).await?.pk;
        Ok(db::geofences::present(&mut tx, site_pk).await?)
    }

    /// Replaces the whole of a site's geofence.
    ///
    /// # Errors
    /// It is too large, a robot that was heard stands outside of it, or it is no longer at the
    /// `expected` revision.
    pub async fn replace_geofence(
        &self,
        site: &SiteId,
        request: ReplaceGeofence,
        expected: Option<u64>,
    ) -> Result<Geofence, AppError> {
        let ReplaceGeofence { keep_in, keep_out } = request;
        let mut tx = self.db().write().await?;
        let site_pk = site_row(&mut tx, site).await?.pk;
        let before = db::geofences::present(&mut tx, site_pk).await?;
        if let Some(expected) = expected.filter(|expected| *expected != before.revision) {
            return Err(AppError::ChangedMeanwhile {
                what: "geofence",
                present: before.revision,
                expected,
            });
        }
        let geofence = Geofence {
            revision: before.revision + 1,
            keep_in,
            keep_out,
        };
        geofence.validate().map_err(|invalid| AppError::Invalid {
            field: "keep_in",
            detail: invalid.to_string(),
        })?;
        for row in db::robots::list(&mut tx, site_pk, "", false, ROBOTS_MAX).await? {
            let presence = self.presences().get(&(site.clone(), row.id.clone()));
            let Some(pose) = presence.state().and_then(|state| state.pose) else {
                continue;
            };
            let point = pose.value.position();
            let holds = |polygon: &tread_api::geometry::Polygon| polygon.contains(point);
            let is_in = geofence.keep_in.is_empty() || geofence.keep_in.iter().any(holds);
            if !is_in || geofence.keep_out.iter().any(holds) {
                let robot = row.id;
                return Err(AppError::OutsideGeofence { robot, point });
            }
        }
        db::geofences::insert(&mut tx, site_pk, &geofence, self.clock().now()).await?;
        tx.commit().await?;
        self.wake();
        Ok(geofence)
    }
}
