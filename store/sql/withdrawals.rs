//! Withdrawals: hours of robots whose measurements are not on the map.

pub use tread_store::withdrawals::{Hours, WithdrawalRow};

use super::{Connection, EngineError, from_us, to_us, unsigned};

/// Returns all withdrawals, oldest first.
pub async fn all(db: &mut Connection) -> Result<Vec<WithdrawalRow>, EngineError> {
    let rows = sqlx::query!(
        r#"SELECT pk AS "pk!", robot_pk, from_h, to_h, reason, withdrawn_by, withdrawn_at_us
           FROM withdrawals ORDER BY pk"#
    );
    let rows = rows.fetch_all(db).await?;
    rows.into_iter()
        .map(|row| {
            Ok(WithdrawalRow {
                pk: row.pk,
                robot_pk: row.robot_pk,
                hours: Hours {
                    from_h: row.from_h,
                    to_h: row.to_h,
                },
                reason: row.reason,
                by: row.withdrawn_by,
                at: from_us(row.withdrawn_at_us)?,
            })
        })
        .collect()
}

/// Returns the number of withdrawals.
pub async fn count(db: &mut Connection) -> Result<usize, EngineError> {
    let count = sqlx::query_scalar!(r#"SELECT COUNT(*) AS "count!: i64" FROM withdrawals"#);
    unsigned("count", count.fetch_one(db).await?)
}

/// Adds a withdrawal; returns its number.
pub async fn insert(db: &mut Connection, row: &WithdrawalRow) -> Result<i64, EngineError> {
    let at_us = to_us(row.at);
    let pk = sqlx::query_scalar!(
        r#"INSERT INTO withdrawals (robot_pk, from_h, to_h, reason, withdrawn_by, withdrawn_at_us)
         VALUES ($1, $2, $3, $4, $5, MAX($6, COALESCE(
             (SELECT withdrawn_at_us FROM withdrawals ORDER BY pk DESC LIMIT 1), $6)))
         RETURNING pk AS "pk!""#,
        row.robot_pk,
        row.hours.from_h,
        row.hours.to_h,
        row.reason,
        row.by,
        at_us,
    )
    .fetch_one(db)
    .await?;
    Ok(pk)
}
