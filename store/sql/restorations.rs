//! Restorations of backups, and the robots that await what follows from one.

pub use tread_store::restorations::{
    Changed, ENROLMENTS_SKIPPED, REVISIONS_SKIPPED, Restoration, RestrictedRobot,
};

use super::{Connection, EngineError, from_us, parse, to_us, unsigned};

/// Makes a database that was restored from a backup fit for robots and people that went on after
/// the backup.
pub async fn begin(db: &mut Connection, restoration: &Restoration) -> Result<Changed, EngineError> {
    let (at_us, taken_at_us) = (to_us(restoration.restored_at), to_us(restoration.taken_at));
    let mut changed = Changed::default();
    sqlx::query!(
        "INSERT INTO restorations
             (restored_at_us, taken_at_us, version, revision_floor, enrolment_floor)
         VALUES ($1, $2, $3,
             (SELECT COALESCE(MAX(revision), 0) FROM terrain_revisions) + $4,
             (SELECT COALESCE(MAX(number), 0) FROM enrolments) + $5)",
        at_us,
        taken_at_us,
        restoration.version,
        REVISIONS_SKIPPED,
        ENROLMENTS_SKIPPED,
    )
    .execute(&mut *db)
    .await?;
    let done = sqlx::query!(
        "UPDATE robots SET awaits_release_since_us = $1, outcomes_wanted = 1",
        at_us
    );
    changed.robots = done.execute(&mut *db).await?.rows_affected();
    // The silence of a robot counts anew: how long it lasted is not known.
    sqlx::query!("UPDATE missions SET silent_since_us = NULL WHERE silent_since_us IS NOT NULL")
        .execute(&mut *db)
        .await?;
    skip_revisions(&mut *db, at_us).await?;
    let done = sqlx::query!("DELETE FROM sessions");
    changed.sessions = done.execute(&mut *db).await?.rows_affected();
    let done = sqlx::query!(
        "UPDATE join_tokens SET revoked_at_us = MAX($1, created_at_us)
         WHERE used_at_us IS NULL AND revoked_at_us IS NULL",
        at_us
    );
    changed.join_tokens = done.execute(&mut *db).await?.rows_affected();
    let done = sqlx::query!(
        "UPDATE webhook_deliveries SET state = 'dropped', ended_at_us = MAX($1, created_at_us),
             detail = 'the server was restored from a backup, so it may have been sent before'
         WHERE state = 'pending'",
        at_us
    );
    changed.deliveries = done.execute(&mut *db).await?.rows_affected();
    changed.certificates = super::enrolments::delete_issued_certificates(db).await?;
    Ok(changed)
}

/// Gives the terrains and geofences of each site revisions that nobody can have had since the
/// backup, so that every robot gets them again, and the next ones are new.
async fn skip_revisions(db: &mut Connection, at_us: i64) -> Result<(), EngineError> {
    sqlx::query!(
        "UPDATE sites SET terrain_revision = terrain_revision + $1",
        REVISIONS_SKIPPED
    )
    .execute(&mut *db)
    .await?;
    sqlx::query!(
        "INSERT INTO geofences (site_pk, revision, keep_in, keep_out, written_at_us)
         SELECT sites.pk, COALESCE(newest.revision, 0) + $1, COALESCE(newest.keep_in, '[]'),
             COALESCE(newest.keep_out, '[]'), CAST($2 AS BIGINT)
         FROM sites LEFT JOIN geofences AS newest ON newest.site_pk = sites.pk
             AND newest.revision = (SELECT MAX(more.revision) FROM geofences AS more
                 WHERE more.site_pk = sites.pk)",
        REVISIONS_SKIPPED,
        at_us
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Returns the newest restoration; `None` if there was none.
pub async fn newest(db: &mut Connection) -> Result<Option<Restoration>, EngineError> {
    let row = sqlx::query!(
        "SELECT restored_at_us, taken_at_us, version FROM restorations ORDER BY pk DESC LIMIT 1"
    )
    .fetch_optional(db)
    .await?;
    row.map(|row| {
        Ok(Restoration {
            restored_at: from_us(row.restored_at_us)?,
            taken_at: from_us(row.taken_at_us)?,
            version: row.version,
        })
    })
    .transpose()
}

/// Returns the largest number of an enrolment that may have been given before the newest
/// restoration; 0 without any.
pub async fn enrolment_floor(db: &mut Connection) -> Result<u32, EngineError> {
    let floor = sqlx::query_scalar!(
        r#"SELECT COALESCE(MAX(enrolment_floor), 0) AS "floor!: i64" FROM restorations"#
    );
    unsigned("number", floor.fetch_one(db).await?)
}

/// Returns all robots that are restricted since a restoration; retired ones too.
pub async fn restricted(db: &mut Connection) -> Result<Vec<RestrictedRobot>, EngineError> {
    let rows = sqlx::query!(
        r#"SELECT robots.pk AS "pk!", sites.id AS site, robots.id AS robot,
               robots.awaits_release_since_us IS NOT NULL AND robots.retired_at_us IS NULL
                   AS "awaits_release!: bool",
               robots.outcomes_wanted = 1 AS "outcomes_wanted!: bool"
           FROM robots JOIN sites ON sites.pk = robots.site_pk
           WHERE robots.awaits_release_since_us IS NOT NULL OR robots.outcomes_wanted = 1"#
    );
    let rows = rows.fetch_all(db).await?;
    let read = rows.into_iter().map(|row| {
        Ok(RestrictedRobot {
            pk: row.pk,
            site: parse("site", &row.site)?,
            robot: parse("robot", &row.robot)?,
            awaits_release: row.awaits_release,
            outcomes_wanted: row.outcomes_wanted,
        })
    });
    read.collect()
}

/// Returns the number of robots that await their release, without retired ones.
pub async fn awaiting_count(db: &mut Connection) -> Result<u64, EngineError> {
    let count = sqlx::query_scalar!(
        r#"SELECT COUNT(*) AS "count!: i64" FROM robots
           WHERE awaits_release_since_us IS NOT NULL AND retired_at_us IS NULL"#
    );
    unsigned("count", count.fetch_one(db).await?)
}

/// Releases a robot; `false` if it does not await that.
pub async fn release(db: &mut Connection, robot_pk: i64) -> Result<bool, EngineError> {
    let done = sqlx::query!(
        "UPDATE robots SET awaits_release_since_us = NULL
         WHERE pk = $1 AND awaits_release_since_us IS NOT NULL",
        robot_pk
    )
    .execute(db)
    .await?;
    Ok(done.rows_affected() == 1)
}

/// Stores that a robot has said how its open missions ended.
pub async fn record_outcomes(db: &mut Connection, robot_pk: i64) -> Result<(), EngineError> {
    sqlx::query!(
        "UPDATE robots SET outcomes_wanted = 0 WHERE pk = $1",
        robot_pk
    )
    .execute(db)
    .await?;
    Ok(())
}
