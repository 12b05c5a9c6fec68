//! Geofences: the areas in which the robots of a site may drive. The reconciler sends changes to
//! the robots.

use tread_api::geometry::Point;
use tread_api::ids::SiteId;
use tread_api::safety::{Geofence, ReplaceGeofence};
use tread_control::fence::{Fence, FencePolygon, disc_radius_m};
use tread_control::geometry as control;

use super::check::{control_fence, control_model};
use super::enrolment::FLEET_ROBOTS_MAX;
use super::precondition::Precondition;
use super::{App, AppError, site_row};
use crate::db;
use crate::db::robots::RobotRow;

impl App {
    /// Returns a site's geofence.
    pub async fn geofence(&self, site: &SiteId) -> Result<Geofence, AppError> {
        let mut tx = self.db().read("geofence").await?;
        let site_pk = site_row(&mut tx, site).await?.pk;
        Ok(db::geofences::present(&mut tx, site_pk).await?)
    }

    /// Replaces the whole of a site's geofence.
    ///
    /// # Errors
    /// The geofence is invalid, a robot with a known pose would be outside of it, or its present
    /// revision is not one of `expected`.
    pub async fn replace_geofence(
        &self,
        site: &SiteId,
        request: ReplaceGeofence,
        expected: &Precondition,
    ) -> Result<Geofence, AppError> {
        let ReplaceGeofence { keep_in, keep_out } = request;
        let mut tx = self.db().write("geofence").await?;
        let site_pk = site_row(&mut tx, site).await?.pk;
        let before = db::geofences::present(&mut tx, site_pk).await?;
        expected.check("geofence", before.revision)?;
        let geofence = Geofence {
            revision: before.revision + 1,
            keep_in,
            keep_out,
        };
        geofence.validate().map_err(|invalid| AppError::Invalid {
            field: "keep_in",
            detail: invalid.to_string(),
        })?;
        let fence = control_fence(&geofence);
        for row in db::robots::list(&mut tx, (site_pk, None), "", false, FLEET_ROBOTS_MAX).await? {
            let presence = self.presences().get(&(site.clone(), row.id.clone()));
            let Some(pose) = presence.state().and_then(|state| state.pose) else {
                continue;
            };
            refuse_outside(&fence, row, pose.value.position())?;
        }
        db::geofences::insert(&mut tx, site_pk, &geofence, self.clock().now()).await?;
        tx.commit().await?;
        self.wake();
        Ok(geofence)
    }
}

/// Checks that the whole robot is inside the geofence, without the additional margin for driving
/// robots.
fn refuse_outside(fence: &Fence, row: RobotRow, point: Point) -> Result<(), AppError> {
    // A robot with an invalid model is checked by its centre alone.
    let reach_m = control_model(&row.model).map_or(0.0, |model| disc_radius_m(&model));
    let center = control::Point {
        x_m: point.x_m,
        y_m: point.y_m,
    };
    let Some(overlap) = fence.overlap(center, reach_m) else {
        return Ok(());
    };
    Err(AppError::OutsideGeofence {
        robot: row.id,
        point,
        reach_m,
        polygon: match overlap.polygon {
            FencePolygon::KeepIn(index) => format!("keep_in[{index}]"),
            FencePolygon::KeepOut(index) => format!("keep_out[{index}]"),
        },
        border: Point {
            x_m: overlap.border.x_m,
            y_m: overlap.border.y_m,
        },
        depth_m: overlap.depth_m,
    })
}
