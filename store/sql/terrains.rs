//! Present terrains, and all their revisions.

use std::collections::HashMap;

use tread_api::ids::TerrainId;
use tread_api::terrain::{Terrain, TerrainClass};

use super::{
    Connection, EngineError, corrupt, from_json, from_us, parse, to_json, to_us, unsigned,
};

struct Raw {
    id: String,
    revision: i64,
    name: String,
    class: String,
    polygon: String,
    layer: i64,
    updated_at_us: i64,
}

impl TryFrom<Raw> for Terrain {
    type Error = EngineError;

    fn try_from(raw: Raw) -> Result<Self, EngineError> {
        Ok(Self {
            id: parse("terrain", &raw.id)?,
            revision: unsigned("terrain revision", raw.revision)?,
            name: raw.name,
            class: from_json("terrain class", &raw.class)?,
            polygon: from_json("polygon", &raw.polygon)?,
            layer: i32::try_from(raw.layer).map_err(|_range| corrupt("layer", raw.layer))?,
            updated_at: from_us(raw.updated_at_us)?,
        })
    }
}

/// Returns all terrains of a site, in alphabetical order; at most
/// [`tread_api::terrain::TERRAINS_MAX`].
pub async fn list(db: &mut Connection, site_pk: i64) -> Result<Vec<Terrain>, EngineError> {
    let rows = sqlx::query_as!(
        Raw,
        "SELECT id, revision, name, class, polygon, layer, updated_at_us
         FROM terrains WHERE site_pk = $1 ORDER BY id",
        site_pk,
    )
    .fetch_all(db)
    .await?;
    rows.into_iter().map(Terrain::try_from).collect()
}

/// Returns a terrain by its identifier.
pub async fn find(
    db: &mut Connection,
    site_pk: i64,
    id: &TerrainId,
) -> Result<Option<Terrain>, EngineError> {
    let id = id.as_str();
    let raw = sqlx::query_as!(
        Raw,
        "SELECT id, revision, name, class, polygon, layer, updated_at_us
         FROM terrains WHERE site_pk = $1 AND id = $2",
        site_pk,
        id,
    )
    .fetch_optional(db)
    .await?;
    raw.map(Terrain::try_from).transpose()
}

/// Returns the number of a site's terrains.
pub async fn count(db: &mut Connection, site_pk: i64) -> Result<usize, EngineError> {
    let count = sqlx::query_scalar!(
        r#"SELECT COUNT(*) AS "count!: i64" FROM terrains WHERE site_pk = $1"#,
        site_pk
    )
    .fetch_one(db)
    .await?;
    unsigned("count", count)
}

/// Returns the newest revision of an identifier, also of a deleted terrain; 0 for none. After a
/// restoration it is at least the newest one that may have been given before it.
pub async fn last_revision(
    db: &mut Connection,
    site_pk: i64,
    id: &TerrainId,
) -> Result<u32, EngineError> {
    let id = id.as_str();
    let revision = sqlx::query_scalar!(
        r#"SELECT MAX(COALESCE(MAX(revision), 0),
               COALESCE((SELECT MAX(revision_floor) FROM restorations), 0)) AS "revision!: i64"
           FROM terrain_revisions WHERE site_pk = $1 AND id = $2"#,
        site_pk,
        id,
    )
    .fetch_one(db)
    .await?;
    unsigned("terrain revision", revision)
}

/// Returns, for each terrain of a site, the revisions with the same polygon and class as the
/// present one. A new display name does not change the ground.
pub async fn same_ground(
    db: &mut Connection,
    site_pk: i64,
) -> Result<HashMap<TerrainId, Vec<u32>>, EngineError> {
    let rows = sqlx::query!(
        r#"SELECT t.id, r.revision FROM terrains t
           JOIN terrain_revisions r ON r.site_pk = t.site_pk AND r.id = t.id
               AND r.polygon = t.polygon AND r.class = t.class
           WHERE t.site_pk = $1 ORDER BY t.id, r.revision"#,
        site_pk,
    )
    .fetch_all(db)
    .await?;
    let mut revisions: HashMap<TerrainId, Vec<u32>> = HashMap::new();
    for row in rows {
        let of_terrain = revisions.entry(parse("terrain", &row.id)?).or_default();
        of_terrain.push(unsigned("terrain revision", row.revision)?);
    }
    Ok(revisions)
}

/// Stores a terrain's present revision, also in the history.
pub async fn put(db: &mut Connection, site_pk: i64, terrain: &Terrain) -> Result<(), EngineError> {
    let (id, revision) = (terrain.id.as_str(), i64::from(terrain.revision));
    let class = class_text(terrain.class)?;
    let polygon = to_json("polygon", &terrain.polygon)?;
    let (layer, at_us) = (i64::from(terrain.layer), to_us(terrain.updated_at));
    sqlx::query!(
        "INSERT INTO terrains (site_pk, id, revision, name, class, polygon, layer, updated_at_us)
         VALUES ($1, $2, $3, $4, $5, $6, $7, $8)
         ON CONFLICT (site_pk, id) DO UPDATE SET revision = $3, name = $4, class = $5,
             polygon = $6, layer = $7,
             updated_at_us = MAX($8, terrains.updated_at_us)",
        site_pk,
        id,
        revision,
        terrain.name,
        class,
        polygon,
        layer,
        at_us,
    )
    .execute(&mut *db)
    .await?;
    sqlx::query!(
        "INSERT INTO terrain_revisions
             (site_pk, id, revision, class, polygon, layer, written_at_us)
         VALUES ($1, $2, $3, $4, $5, $6, MAX($7, COALESCE(
             (SELECT MAX(written_at_us) FROM terrain_revisions WHERE site_pk = $1 AND id = $2),
             $7)))",
        site_pk,
        id,
        revision,
        class,
        polygon,
        layer,
        at_us,
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Deletes a terrain; its history stays. `false` if there was none.
pub async fn delete(
    db: &mut Connection,
    site_pk: i64,
    id: &TerrainId,
) -> Result<bool, EngineError> {
    let id = id.as_str();
    let result = sqlx::query!(
        "DELETE FROM terrains WHERE site_pk = $1 AND id = $2",
        site_pk,
        id
    )
    .execute(db)
    .await?;
    Ok(result.rows_affected() == 1)
}

fn class_text(class: TerrainClass) -> Result<String, EngineError> {
    to_json("terrain class", &class)
}
