//! Terrains: creation, listing, replacement and deletion. The reconciler sends every change to the
//! robots.

use tread_api::ids::{SiteId, TerrainId};
use tread_api::page::Page;
use tread_api::terrain::{
    CreateTerrain, ReplaceTerrain, TERRAINS_MAX, Terrain, TerrainRef, TerrainShape,
};
use tread_api::wire::hello::SiteDefinition;

use super::precondition::Precondition;
use super::{App, AppError, name_or, page, site_row};
use crate::db::{self, DbError, Tx};

impl App {
    /// Returns a page of the terrains of a site, after a cursor.
    pub async fn terrains(
        &self,
        site: &SiteId,
        cursor: Option<&str>,
        limit: u32,
    ) -> Result<Page<Terrain>, AppError> {
        let mut tx = self.db().read("terrains").await?;
        let site_pk = site_row(&mut tx, site).await?.pk;
        let mut terrains = db::terrains::list(&mut tx, site_pk).await?;
        terrains.retain(|terrain| cursor.is_none_or(|cursor| terrain.id.as_str() > cursor));
        Ok(page(terrains, limit, |terrain| terrain.id.to_string()))
    }

    /// Returns one terrain.
    pub async fn terrain(&self, site: &SiteId, id: &TerrainId) -> Result<Terrain, AppError> {
        let mut tx = self.db().read("terrains").await?;
        let site_pk = site_row(&mut tx, site).await?.pk;
        let terrain = db::terrains::find(&mut tx, site_pk, id).await?;
        terrain.ok_or_else(|| AppError::UnknownTerrain(site.clone(), id.clone()))
    }

    /// Creates a terrain.
    pub async fn create_terrain(
        &self,
        site: &SiteId,
        request: CreateTerrain,
    ) -> Result<Terrain, AppError> {
        let CreateTerrain {
            id,
            name,
            class,
            polygon,
            layer,
        } = request;
        let name = name_or(name, id.as_str())?;
        let mut tx = self.db().write("terrains").await?;
        let site_pk = site_row(&mut tx, site).await?.pk;
        if db::terrains::find(&mut tx, site_pk, &id).await?.is_some() {
            return Err(AppError::AlreadyExists {
                what: "terrain",
                id: id.to_string(),
            });
        }
        if db::terrains::count(&mut tx, site_pk).await? >= TERRAINS_MAX {
            return Err(AppError::TooMany {
                what: "terrains in this site",
                count: TERRAINS_MAX,
            });
        }
        let revision = db::terrains::last_revision(&mut tx, site_pk, &id).await? + 1;
        let updated_at = self.clock().now();
        let terrain = Terrain {
            id,
            revision,
            name,
            class,
            polygon,
            layer,
            updated_at,
        };
        self.put_terrain(tx, site_pk, terrain).await
    }

    /// Replaces all of a terrain except its identifier. A request that changes nothing makes no new
    /// revision: measurements on the same ground belong together.
    ///
    /// # Errors
    /// [`AppError::PreconditionFailed`] if its revision is none of `expected`.
    pub async fn replace_terrain(
        &self,
        site: &SiteId,
        id: &TerrainId,
        request: ReplaceTerrain,
        expected: &Precondition,
    ) -> Result<Terrain, AppError> {
        let ReplaceTerrain {
            name,
            class,
            polygon,
            layer,
        } = request;
        let name = name_or(name, id.as_str())?;
        let mut tx = self.db().write("terrains").await?;
        let site_pk = site_row(&mut tx, site).await?.pk;
        let Some(present) = db::terrains::find(&mut tx, site_pk, id).await? else {
            return Err(AppError::UnknownTerrain(site.clone(), id.clone()));
        };
        expected.check("terrain", present.revision.into())?;
        let is_same = (
            &present.name,
            present.class,
            &present.polygon,
            present.layer,
        ) == (&name, class, &polygon, layer);
        if is_same {
            return Ok(present);
        }
        let revision = db::terrains::last_revision(&mut tx, site_pk, id).await? + 1;
        let (id, updated_at) = (id.clone(), self.clock().now());
        let terrain = Terrain {
            id,
            revision,
            name,
            class,
            polygon,
            layer,
            updated_at,
        };
        self.put_terrain(tx, site_pk, terrain).await
    }

    async fn put_terrain(
        &self,
        mut tx: Tx,
        site_pk: i64,
        terrain: Terrain,
    ) -> Result<Terrain, AppError> {
        db::terrains::put(&mut tx, site_pk, &terrain).await?;
        db::sites::count_terrain_change(&mut tx, site_pk).await?;
        tx.commit().await?;
        self.wake();
        Ok(terrain)
    }

    /// Deletes a terrain; measurements made on it are kept.
    ///
    /// # Errors
    /// [`AppError::PreconditionFailed`] if its revision is none of `expected`.
    pub async fn delete_terrain(
        &self,
        site: &SiteId,
        id: &TerrainId,
        expected: &Precondition,
    ) -> Result<(), AppError> {
        let mut tx = self.db().write("terrains").await?;
        let site_pk = site_row(&mut tx, site).await?.pk;
        let Some(present) = db::terrains::find(&mut tx, site_pk, id).await? else {
            return Err(AppError::UnknownTerrain(site.clone(), id.clone()));
        };
        expected.check("terrain", present.revision.into())?;
        db::terrains::delete(&mut tx, site_pk, id).await?;
        db::sites::count_terrain_change(&mut tx, site_pk).await?;
        tx.commit().await?;
        self.wake();
        Ok(())
    }
}

/// Returns the definition of a site for its robots; `None` if there is no such site.
pub(super) async fn site_definition(
    tx: &mut Tx,
    site: &SiteId,
) -> Result<Option<SiteDefinition>, DbError> {
    let Some(row) = db::sites::find(tx, site).await? else {
        return Ok(None);
    };
    let terrains = db::terrains::list(tx, row.pk).await?;
    let geofence = db::geofences::present(tx, row.pk).await?;
    let shape = |terrain: Terrain| TerrainShape {
        terrain: TerrainRef {
            id: terrain.id,
            revision: terrain.revision,
        },
        polygon: terrain.polygon,
        layer: terrain.layer,
    };
    Ok(Some(SiteDefinition {
        grid: row.site.grid,
        terrain_revision: row.site.terrain_revision,
        terrains: terrains.into_iter().map(shape).collect(),
        geofence,
    }))
}
