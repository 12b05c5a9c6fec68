//! Withdrawal of a robot's measurements: the map is then as if they had never arrived.
//!
//! The sums of the withdrawn hours are removed, stored or not, and later uploads of these hours are
//! not added, nor are their segments when the server starts. Raw segments are kept. Hours that are
//! merged into days or months can only be withdrawn by whole ones.

use jiff::Timestamp;
use tread_api::friction::{CreateWithdrawal, Withdrawal};
use tread_api::ids::{RobotId, SiteId};
use tread_api::mission::REASON_LENGTH_MAX;
use tread_api::page::Page;
use tread_api::rights::Scope;

use super::map::{MapChange, Withdrawn};
use super::{App, AppError, PeopleField, page, people_line, site_row};
use crate::db;
use crate::db::withdrawals::{Hours, WithdrawalRow};
use crate::friction::epochs::HOUR_S;
use crate::friction::{Horizons, epoch_h};

/// Maximum number of withdrawals of one server; each new segment is compared with all of them.
const WITHDRAWALS_MAX: usize = 1_000;

impl App {
    /// Withdraws what a robot measured in whole hours, on its site's map.
    ///
    /// # Errors
    /// Site or robot is not known, the hours are invalid, or they cut through a merged day or month.
    pub async fn withdraw(
        &self,
        (site, robot): (&SiteId, &RobotId),
        request: CreateWithdrawal,
        by: &str,
    ) -> Result<Withdrawal, AppError> {
        let CreateWithdrawal { from, to, reason } = request;
        let reason = people_line(PeopleField::Reason, &reason, REASON_LENGTH_MAX)?;
        let now = self.clock().now();
        let turn = self.lock_map_for_write().await?;
        let mut tx = self.db().write("withdrawals").await?;
        let site_row = site_row(&mut tx, site).await?;
        let unknown = || AppError::UnknownRobot(site.clone(), robot.clone());
        let found = db::robots::find(&mut tx, site_row.pk, robot).await?;
        let robot_pk = found.ok_or_else(unknown)?.pk;
        let hours = Hours {
            from_h: from.map_or(0, epoch_h).max(0),
            to_h: to.map_or(epoch_h(now), epoch_h),
        };
        check_hours(hours, site_row.horizons)?;
        let count = db::withdrawals::count(&mut tx).await?;
        if count >= WITHDRAWALS_MAX {
            return Err(AppError::TooMany {
                what: "withdrawals",
                count,
            });
        }
        let mut row = WithdrawalRow {
            pk: 0,
            robot_pk,
            hours,
            reason,
            by: by.to_owned(),
            at: now,
        };
        row.pk = db::withdrawals::insert(&mut tx, &row).await?;
        let removed = db::sums::remove_hours(&mut tx, robot_pk, hours).await?;
        let change = MapChange::Withdraw(Box::new(Withdrawn {
            site: site_row,
            robot: robot.clone(),
            robot_pk,
            hours,
        }));
        turn.commit(tx, change, Vec::new()).await?;
        tracing::info!(robot.id = %robot, "{removed} sums of robot `{robot}` were withdrawn");
        Ok(to_api(row, robot.clone()))
    }

    /// Returns the withdrawals of a site's robots in a scope, oldest first, after a cursor.
    pub async fn withdrawals(
        &self,
        (site, within): (&SiteId, &Scope),
        cursor: Option<i64>,
        limit: u32,
    ) -> Result<Page<Withdrawal>, AppError> {
        let mut tx = self.db().read("withdrawals").await?;
        let site_row = site_row(&mut tx, site).await?;
        let robots = db::robots::of_site_by_key(&mut tx, site_row.pk).await?;
        let rows = db::withdrawals::all(&mut tx).await?;
        let found = rows.into_iter().filter_map(|row| {
            let robot = robots.get(&row.robot_pk)?.clone();
            let is_wanted = within.includes_robot(site, &robot);
            (is_wanted && row.pk > cursor.unwrap_or(0)).then(|| to_api(row, robot))
        });
        Ok(page(found.collect(), limit, |found| found.id.to_string()))
    }
}

fn check_hours(Hours { from_h, to_h }: Hours, horizons: Horizons) -> Result<(), AppError> {
    let time = |hour: i64| Timestamp::from_second(hour * HOUR_S).unwrap_or(Timestamp::MAX);
    if to_h < from_h {
        return Err(AppError::Invalid {
            field: "to",
            detail: "to lies before from".to_owned(),
        });
    }
    let (first, last) = (horizons.epoch_of(from_h), horizons.epoch_of(to_h));
    let cuts_begin = first.first_h != from_h;
    if cuts_begin || last.end_h != to_h + 1 {
        let cut = if cuts_begin { first } else { last };
        return Err(AppError::Invalid {
            field: if cuts_begin { "from" } else { "to" },
            detail: format!(
                "hours before {} are merged into days, and days before {} into months (UTC): give \
                 whole ones; this one is from {} to {}",
                time(horizons.days_before_h),
                time(horizons.months_before_h),
                time(cut.first_h),
                time(cut.end_h),
            ),
        });
    }
    Ok(())
}

fn to_api(row: WithdrawalRow, robot: RobotId) -> Withdrawal {
    let time = |hour: i64| Timestamp::from_second(hour * HOUR_S).unwrap_or(Timestamp::MAX);
    Withdrawal {
        id: row.pk,
        robot,
        from: time(row.hours.from_h),
        before: time(row.hours.to_h + 1),
        reason: row.reason,
        by: row.by,
        at: row.at,
    }
}
