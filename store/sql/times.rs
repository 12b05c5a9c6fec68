//! The newest times that the database holds.

use jiff::Timestamp;
use uuid::Uuid;

use super::{Connection, EngineError, from_us, parse};

/// Number of rows read from the end of a long table: a robot's report of an earlier time may have
/// been stored last.
const NEWEST_ROWS: i64 = 100;

/// Returns the newest time in the database, by the server's clock.
pub async fn newest(db: &mut Connection) -> Result<Option<Timestamp>, EngineError> {
    let newest_us = sqlx::query_scalar!(
        r#"SELECT MAX(at_us) AS "newest: i64" FROM (
               SELECT MAX(at_us) AS at_us FROM (
                   SELECT at_us FROM mission_events ORDER BY pk DESC LIMIT $1) AS steps
               UNION ALL SELECT MAX(at_us) FROM (
                   SELECT at_us FROM audit ORDER BY id DESC LIMIT $1) AS entries
               UNION ALL SELECT MAX(received_at_us) FROM (
                   SELECT received_at_us FROM segment_ranges ORDER BY first_pk DESC LIMIT $1) AS ranges
               UNION ALL SELECT MAX(MAX(raised_at_us, COALESCE(acknowledged_at_us, 0),
                       COALESCE(cleared_at_us, 0))) FROM alerts
               UNION ALL SELECT MAX(MAX(wanted_at_us, COALESCE(confirmed_at_us, 0),
                       COALESCE(clear_asked_at_us, 0), COALESCE(cleared_at_us, 0))) FROM stops
               UNION ALL SELECT MAX(MAX(created_at_us, COALESCE(revoked_at_us, 0),
                       COALESCE(last_used_at_us, 0))) FROM tokens
               UNION ALL SELECT MAX(created_at_us) FROM sessions
               UNION ALL SELECT MAX(last_hello_at_us) FROM robots) AS times"#,
        NEWEST_ROWS,
    );
    newest_us.fetch_one(db).await?.map(from_us).transpose()
}

/// Returns the newest identifier made by the server; identifiers sort by creation.
pub async fn newest_id(db: &mut Connection) -> Result<Option<Uuid>, EngineError> {
    let newest = sqlx::query_scalar!(
        r#"SELECT MAX(id) AS "newest: String" FROM (
               SELECT MAX(id) AS id FROM missions UNION ALL SELECT MAX(id) FROM alerts
               UNION ALL SELECT MAX(id) FROM webhook_deliveries) AS ids"#
    );
    let newest = newest.fetch_one(db).await?;
    newest.map(|id| parse("identifier", &id)).transpose()
}
