//! Sites and the horizons of their maps.

use tread_api::ids::SiteId;
use tread_api::rights::Scope;
use tread_api::site::{GeoOrigin, Grid, Site};
pub use tread_store::sites::SiteRow;

use super::{
    Connection, EngineError, from_json, from_us, parse, scope_text, to_json, to_us, unsigned,
};
use tread_store::friction::Horizons;

struct Raw {
    pk: i64,
    id: String,
    name: String,
    grid_revision: i64,
    cell_m: f64,
    terrain_revision: i64,
    geofence_revision: i64,
    created_at_us: i64,
    merged_before_h: i64,
    months_before_h: i64,
    origin: Option<String>,
}

impl TryFrom<Raw> for SiteRow {
    type Error = EngineError;

    fn try_from(raw: Raw) -> Result<Self, EngineError> {
        let grid = Grid {
            revision: unsigned("grid revision", raw.grid_revision)?,
            cell_m: raw.cell_m,
        };
        let origin = raw.origin.map(|text| from_json("origin", &text));
        let site = Site {
            id: parse("site", &raw.id)?,
            name: raw.name,
            grid,
            terrain_revision: unsigned("terrain revision", raw.terrain_revision)?,
            geofence_revision: unsigned("geofence revision", raw.geofence_revision)?,
            origin: origin.transpose()?,
            created_at: from_us(raw.created_at_us)?,
        };
        Ok(Self {
            pk: raw.pk,
            site,
            horizons: Horizons {
                days_before_h: raw.merged_before_h,
                months_before_h: raw.months_before_h,
            },
        })
    }
}

/// Adds a site; `false` if the identifier is in use.
pub async fn insert(db: &mut Connection, site: &Site) -> Result<bool, EngineError> {
    let (id, created_at_us) = (site.id.as_str(), to_us(site.created_at));
    let grid_revision = i64::from(site.grid.revision);
    let origin = origin_text(site.origin)?;
    let result = sqlx::query!(
        "INSERT INTO sites (id, name, grid_revision, cell_m, created_at_us, origin)
         VALUES ($1, $2, $3, $4, $5, $6) ON CONFLICT (id) DO NOTHING",
        id,
        site.name,
        grid_revision,
        site.grid.cell_m,
        created_at_us,
        origin,
    )
    .execute(db)
    .await?;
    Ok(result.rows_affected() == 1)
}

fn origin_text(origin: Option<GeoOrigin>) -> Result<Option<String>, EngineError> {
    origin.map(|origin| to_json("origin", &origin)).transpose()
}

/// Sets the position of a site's origin on the earth.
pub async fn set_origin(
    db: &mut Connection,
    pk: i64,
    origin: Option<GeoOrigin>,
) -> Result<(), EngineError> {
    let origin = origin_text(origin)?;
    sqlx::query!("UPDATE sites SET origin = $2 WHERE pk = $1", pk, origin)
        .execute(db)
        .await?;
    Ok(())
}

/// Returns a site by its identifier.
pub async fn find(db: &mut Connection, id: &SiteId) -> Result<Option<SiteRow>, EngineError> {
    let id = id.as_str();
    let raw = sqlx::query_as!(
        Raw,
        r#"SELECT pk AS "pk!", id, name, grid_revision, cell_m, terrain_revision, created_at_us,
               merged_before_h, months_before_h, origin,
               COALESCE((SELECT MAX(revision) FROM geofences WHERE site_pk = sites.pk), 0)
                   AS "geofence_revision!: i64"
           FROM sites WHERE id = $1"#,
        id,
    )
    .fetch_optional(db)
    .await?;
    raw.map(SiteRow::try_from).transpose()
}

/// Returns the sites of a scope after an identifier, in alphabetical order.
pub async fn list(
    db: &mut Connection,
    within: &Scope,
    after: &str,
    limit: u32,
) -> Result<Vec<SiteRow>, EngineError> {
    let within = scope_text(within)?;
    let rows = sqlx::query_as!(
        Raw,
        r#"SELECT pk AS "pk!", id, name, grid_revision, cell_m, terrain_revision, created_at_us,
               merged_before_h, months_before_h, origin,
               COALESCE((SELECT MAX(revision) FROM geofences WHERE site_pk = sites.pk), 0)
                   AS "geofence_revision!: i64"
           FROM sites
           WHERE id > $1 AND (CAST($3 AS TEXT) IS NULL OR id IN (
               SELECT substr(value, 1, instr(value || '/', '/') - 1) FROM json_each($3)))
           ORDER BY id LIMIT $2"#,
        after,
        i64::from(limit),
        within,
    )
    .fetch_all(db)
    .await?;
    rows.into_iter().map(SiteRow::try_from).collect()
}

/// Increments the revision of the site's terrains.
pub async fn count_terrain_change(db: &mut Connection, pk: i64) -> Result<(), EngineError> {
    sqlx::query!(
        "UPDATE sites SET terrain_revision = terrain_revision + 1 WHERE pk = $1",
        pk
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Sets the horizons of a site's map; the caller never moves one back.
pub async fn set_horizons(
    db: &mut Connection,
    pk: i64,
    horizons: Horizons,
) -> Result<(), EngineError> {
    sqlx::query!(
        "UPDATE sites SET merged_before_h = $2, months_before_h = $3 WHERE pk = $1",
        pk,
        horizons.days_before_h,
        horizons.months_before_h,
    )
    .execute(db)
    .await?;
    Ok(())
}
