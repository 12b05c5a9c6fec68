//! Enrolments of robots, and the certificates that count for a renewal.

use std::collections::BTreeSet;

use jiff::Timestamp;
use tread_api::enrolment::Enrolment;
use tread_api::ids::{RobotId, SiteId};
pub use tread_store::enrolments::{AcceptedCertificates, Renewal};

use super::{Connection, EngineError, from_json, from_us, parse, robots_text, to_json, to_us};
use tread_store::Issued;

struct Raw {
    site: String,
    robot: String,
    number: i64,
    enrolled_at_us: i64,
    join_token: String,
    renewed_at_us: i64,
    expires_at_us: i64,
    revoked_at_us: Option<i64>,
    revoked_by: Option<String>,
    authority: Option<String>,
}

impl TryFrom<Raw> for Enrolment {
    type Error = EngineError;

    fn try_from(raw: Raw) -> Result<Self, EngineError> {
        Ok(Self {
            site: parse("site", &raw.site)?,
            robot: parse("robot", &raw.robot)?,
            number: u32::try_from(raw.number).map_err(|_| EngineError::DoesNotFit("number"))?,
            enrolled_at: from_us(raw.enrolled_at_us)?,
            join_token: parse("join token", &raw.join_token)?,
            renewed_at: from_us(raw.renewed_at_us)?,
            expires_at: from_us(raw.expires_at_us)?,
            revoked_at: raw.revoked_at_us.map(from_us).transpose()?,
            revoked_by: raw.revoked_by,
            authority: raw.authority,
        })
    }
}

macro_rules! enrolments {
    ($condition:tt $(, $argument:expr)* $(,)?) => {
        sqlx::query_as!(
            Raw,
            r#"SELECT site, robot, number, enrolled_at_us, join_token, renewed_at_us,
                   expires_at_us, revoked_at_us, revoked_by, authority
               FROM enrolments "# + $condition
            $(, $argument)*
        )
    };
}

/// Returns the newest enrolment of every robot of all sites.
pub async fn all_newest(db: &mut Connection) -> Result<Vec<Enrolment>, EngineError> {
    let raw = enrolments!(
        "AS present WHERE number = (SELECT MAX(number) FROM enrolments AS other
             WHERE other.site = present.site AND other.robot = present.robot)
         ORDER BY site, robot"
    )
    .fetch_all(db)
    .await?;
    raw.into_iter().map(Enrolment::try_from).collect()
}

/// Returns the newest enrolments of a site's robots after a name, ordered by name; with a list of
/// robots only theirs.
pub async fn list(
    db: &mut Connection,
    (site, named): (&SiteId, Option<&BTreeSet<RobotId>>),
    after: &str,
    limit: u32,
) -> Result<Vec<Enrolment>, EngineError> {
    let named = robots_text(named)?;
    let site = site.as_str();
    let raw = enrolments!(
        "AS present WHERE site = $1 AND robot > $2
             AND number = (SELECT MAX(number) FROM enrolments AS other
                 WHERE other.site = present.site AND other.robot = present.robot)
             AND (CAST($4 AS TEXT) IS NULL OR robot IN (SELECT value FROM json_each($4)))
         ORDER BY robot LIMIT $3",
        site,
        after,
        i64::from(limit),
        named
    )
    .fetch_all(db)
    .await?;
    raw.into_iter().map(Enrolment::try_from).collect()
}

/// Returns a robot's newest enrolment.
pub async fn newest(
    db: &mut Connection,
    site: &SiteId,
    robot: &RobotId,
) -> Result<Option<Enrolment>, EngineError> {
    let (site, robot) = (site.as_str(), robot.as_str());
    let raw = enrolments!(
        "WHERE site = $1 AND robot = $2 ORDER BY number DESC LIMIT 1",
        site,
        robot
    )
    .fetch_optional(db)
    .await?;
    raw.map(Enrolment::try_from).transpose()
}

/// Returns the number of robots that have ever joined.
pub async fn robot_count(db: &mut Connection) -> Result<i64, EngineError> {
    let row = sqlx::query!(
        r#"SELECT COUNT(*) AS "count!: i64" FROM (SELECT DISTINCT site, robot FROM enrolments) AS joined"#
    )
    .fetch_one(db)
    .await?;
    Ok(row.count)
}

/// Stores an enrolment, with the certificate that the robot gets.
pub async fn insert(
    db: &mut Connection,
    enrolment: &Enrolment,
    issued: &Issued,
) -> Result<(), EngineError> {
    let certificates = to_json("certificates", issued)?;
    let (site, robot) = (enrolment.site.as_str(), enrolment.robot.as_str());
    let join_token = enrolment.join_token.to_string();
    let enrolled_at_us = to_us(enrolment.enrolled_at);
    let renewed_at_us = to_us(enrolment.renewed_at);
    let expires_at_us = to_us(enrolment.expires_at);
    sqlx::query!(
        "INSERT INTO enrolments (site, robot, number, enrolled_at_us, join_token, renewed_at_us,
             expires_at_us, authority, certificates)
         VALUES ($1, $2, $3, $4, $5, $6, $7, $8, $9)",
        site,
        robot,
        i64::from(enrolment.number),
        enrolled_at_us,
        join_token,
        renewed_at_us,
        expires_at_us,
        enrolment.authority,
        certificates,
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Returns which certificates of an enrolment are accepted for a renewal.
pub async fn accepted_certificates(
    db: &mut Connection,
    (site, robot, number): (&SiteId, &RobotId, u32),
) -> Result<AcceptedCertificates, EngineError> {
    let (site, robot) = (site.as_str(), robot.as_str());
    let row = sqlx::query!(
        "SELECT certificates FROM enrolments
         WHERE site = $1 AND robot = $2 AND number = $3 AND revoked_at_us IS NULL",
        site,
        robot,
        i64::from(number),
    )
    .fetch_optional(db)
    .await?;
    Ok(match row.map(|row| row.certificates) {
        None => AcceptedCertificates::None,
        Some(None) => AcceptedCertificates::Any,
        Some(Some(text)) => AcceptedCertificates::These(from_json("certificates", &text)?),
    })
}

/// Deletes the record of the certificates that are accepted for a renewal: the next one of each
/// robot is accepted if a trusted authority has signed it. Returns the number of enrolments
/// changed.
pub async fn delete_issued_certificates(db: &mut Connection) -> Result<u64, EngineError> {
    let done = sqlx::query!(
        "UPDATE enrolments SET certificates = NULL
         WHERE certificates IS NOT NULL AND revoked_at_us IS NULL"
    )
    .execute(db)
    .await?;
    Ok(done.rows_affected())
}

/// Stores a renewal of an enrolment that is in force; false if it no longer is.
pub async fn renew(
    db: &mut Connection,
    (site, robot, number): (&SiteId, &RobotId, u32),
    renewal: Renewal<'_>,
) -> Result<bool, EngineError> {
    let (site, robot) = (site.as_str(), robot.as_str());
    let (at_us, expires_at_us) = (to_us(renewal.at), to_us(renewal.expires_at));
    let certificates = to_json("certificates", renewal.issued)?;
    let done = sqlx::query!(
        "UPDATE enrolments SET renewed_at_us = MAX($1, renewed_at_us), expires_at_us = $2,
             authority = $3, certificates = $4
         WHERE site = $5 AND robot = $6 AND number = $7 AND revoked_at_us IS NULL",
        at_us,
        expires_at_us,
        renewal.authority,
        certificates,
        site,
        robot,
        i64::from(number),
    )
    .execute(db)
    .await?;
    Ok(done.rows_affected() == 1)
}

/// Stores the authority of the certificate that a robot has shown, if its enrolment is in force.
pub async fn record_authority(
    db: &mut Connection,
    (site, robot, number): (&SiteId, &RobotId, u32),
    authority: &str,
) -> Result<(), EngineError> {
    let (site, robot) = (site.as_str(), robot.as_str());
    sqlx::query!(
        "UPDATE enrolments SET authority = $1
         WHERE site = $2 AND robot = $3 AND number = $4 AND revoked_at_us IS NULL",
        authority,
        site,
        robot,
        i64::from(number),
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Revokes the robot's enrolment that is in force, if there is one.
pub async fn revoke(
    db: &mut Connection,
    (site, robot): (&SiteId, &RobotId),
    by: &str,
    at: Timestamp,
) -> Result<(), EngineError> {
    let (site, robot, at_us) = (site.as_str(), robot.as_str(), to_us(at));
    sqlx::query!(
        "UPDATE enrolments SET revoked_at_us = MAX($1, renewed_at_us, enrolled_at_us), revoked_by = $2
         WHERE site = $3 AND robot = $4 AND revoked_at_us IS NULL",
        at_us,
        by,
        site,
        robot
    )
    .execute(db)
    .await?;
    Ok(())
}
