//! Geofences of sites; every revision is kept.

use jiff::Timestamp;
use tread_api::safety::Geofence;

use super::{Connection, EngineError, from_json, to_json, to_us, unsigned};

/// Returns a site's present geofence; an empty one of revision 0 if there never was one.
pub async fn present(db: &mut Connection, site_pk: i64) -> Result<Geofence, EngineError> {
    let raw = sqlx::query!(
        "SELECT revision, keep_in, keep_out FROM geofences WHERE site_pk = $1
         ORDER BY revision DESC LIMIT 1",
        site_pk,
    )
    .fetch_optional(db)
    .await?;
    let Some(raw) = raw else {
        return Ok(Geofence::default());
    };
    Ok(Geofence {
        revision: unsigned("geofence revision", raw.revision)?,
        keep_in: from_json("geofence", &raw.keep_in)?,
        keep_out: from_json("geofence", &raw.keep_out)?,
    })
}

/// Adds a revision; `false` if it exists already.
pub async fn insert(
    db: &mut Connection,
    site_pk: i64,
    geofence: &Geofence,
    at: Timestamp,
) -> Result<bool, EngineError> {
    let revision = i64::try_from(geofence.revision);
    let revision = revision.map_err(|_range| EngineError::DoesNotFit("geofence revision"))?;
    let keep_in = to_json("geofence", &geofence.keep_in)?;
    let keep_out = to_json("geofence", &geofence.keep_out)?;
    let at_us = to_us(at);
    let result = sqlx::query!(
        "INSERT INTO geofences (site_pk, revision, keep_in, keep_out, written_at_us)
         VALUES ($1, $2, $3, $4, MAX($5, COALESCE(
             (SELECT MAX(written_at_us) FROM geofences WHERE site_pk = $1), $5)))
         ON CONFLICT DO NOTHING",
        site_pk,
        revision,
        keep_in,
        keep_out,
        at_us,
    )
    .execute(db)
    .await?;
    Ok(result.rows_affected() == 1)
}
