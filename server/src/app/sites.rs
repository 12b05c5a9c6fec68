//! Sites: listing and creation.

use tread_api::ids::SiteId;
use tread_api::page::Page;
use tread_api::rights::Scope;
use tread_api::site::{
    CELL_MAX_M, CELL_MIN_M, CreateSite, GRID_REVISION_FIRST, GeoOrigin, Grid, Site,
};

use super::{App, AppError, name_or, page, site_row};
use crate::db;

/// Maximum number of sites of one server.
pub(super) const SITES_MAX: u32 = 1_000;
/// Default side of a cell, metres.
const CELL_DEFAULT_M: f64 = 1.0;

impl App {
    /// Returns a page of the sites of a scope, after a cursor.
    pub async fn sites(
        &self,
        within: &Scope,
        cursor: Option<&str>,
        limit: u32,
    ) -> Result<Page<Site>, AppError> {
        let mut tx = self.db().read("sites").await?;
        let rows = db::sites::list(&mut tx, within, cursor.unwrap_or_default(), limit + 1).await?;
        let sites = rows.into_iter().map(|row| row.site).collect();
        Ok(page(sites, limit, |site: &Site| site.id.to_string()))
    }

    /// Returns the names of all sites.
    pub(crate) async fn all_sites(&self) -> Result<Vec<SiteId>, AppError> {
        let mut tx = self.db().read("sites").await?;
        let rows = db::sites::list(&mut tx, &Scope::EVERYWHERE, "", SITES_MAX).await?;
        Ok(rows.into_iter().map(|row| row.site.id).collect())
    }

    /// Returns one site.
    pub async fn site(&self, id: &SiteId) -> Result<Site, AppError> {
        let mut tx = self.db().read("sites").await?;
        Ok(site_row(&mut tx, id).await?.site)
    }

    /// Creates a site.
    pub async fn create_site(&self, request: CreateSite) -> Result<Site, AppError> {
        let CreateSite {
            id,
            name,
            cell_m,
            origin,
        } = request;
        let cell_m = cell_m.unwrap_or(CELL_DEFAULT_M);
        if !(CELL_MIN_M..=CELL_MAX_M).contains(&cell_m) {
            let detail = format!("cell_m must be {CELL_MIN_M} to {CELL_MAX_M}, not {cell_m}");
            return Err(AppError::Invalid {
                field: "cell_m",
                detail,
            });
        }
        let site = Site {
            name: name_or(name, id.as_str())?,
            id,
            grid: Grid {
                revision: GRID_REVISION_FIRST,
                cell_m,
            },
            terrain_revision: 0,
            geofence_revision: 0,
            origin,
            created_at: self.clock().now(),
        };
        let mut tx = self.db().write("sites").await?;
        let present = db::sites::list(&mut tx, &Scope::EVERYWHERE, "", SITES_MAX)
            .await?
            .len();
        if u32::try_from(present).is_ok_and(|present| present >= SITES_MAX) {
            return Err(AppError::TooMany {
                what: "sites",
                count: present,
            });
        }
        if !db::sites::insert(&mut tx, &site).await? {
            return Err(AppError::AlreadyExists {
                what: "site",
                id: site.id.to_string(),
            });
        }
        tx.commit().await?;
        Ok(site)
    }

    /// Sets the position of a site's origin on the earth (WGS 84), or removes it.
    pub async fn set_site_origin(
        &self,
        id: &SiteId,
        origin: Option<GeoOrigin>,
    ) -> Result<Site, AppError> {
        let mut tx = self.db().write("sites").await?;
        let row = site_row(&mut tx, id).await?;
        db::sites::set_origin(&mut tx, row.pk, origin).await?;
        tx.commit().await?;
        Ok(Site { origin, ..row.site })
    }

    /// Creates a site unless it exists.
    pub async fn ensure_site(&self, id: &SiteId) -> Result<(), AppError> {
        let request = CreateSite {
            id: id.clone(),
            name: None,
            cell_m: None,
            origin: None,
        };
        match self.create_site(request).await {
            Ok(_) | Err(AppError::AlreadyExists { .. }) => Ok(()),
            Err(error) => Err(error),
        }
    }
}
