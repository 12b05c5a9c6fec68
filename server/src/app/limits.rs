//! External limits over REST: another program stops or slows a robot for a limited time.
//!
//! The server forwards limits and does not store them: the robot enforces and ends them. A program
//! that speaks zenoh publishes its limits itself.

use std::time::Duration;

use tread_api::ids::{OwnerId, RobotId, SiteId};
use tread_api::page::Page;
use tread_api::safety::{LIMIT_AHEAD_MAX_US, LimitStatus, SetLimit};
use tread_api::wire::safety::ExternalLimit;

use super::{App, AppError, site_row};
use crate::app::presence::RobotKey;
use crate::db;

/// Maximum duration of a limit, milliseconds.
const FOR_MAX_MS: u64 = LIMIT_AHEAD_MAX_US / 1_000;

impl App {
    /// Returns the external limits that a robot reports.
    pub async fn limits(
        &self,
        site: &SiteId,
        robot: &RobotId,
    ) -> Result<Page<LimitStatus>, AppError> {
        self.known_robot(site, robot).await?;
        let presence = self.presences().get(&(site.clone(), robot.clone()));
        let limits = presence.state().map(|state| state.safety.limits.clone());
        Ok(Page {
            items: limits.unwrap_or_default(),
            next_cursor: None,
        })
    }

    /// Sets a limit on a robot for a while.
    ///
    /// # Errors
    /// The values are invalid, or the robot does not answer or refuses.
    pub async fn set_limit(
        &self,
        (site, robot): (&SiteId, &RobotId),
        owner: OwnerId,
        limit: SetLimit,
    ) -> Result<(), AppError> {
        if !(1..=FOR_MAX_MS).contains(&limit.for_ms) {
            return Err(AppError::Invalid {
                field: "for_ms",
                detail: format!("for_ms must be 1 to {FOR_MAX_MS}, not {}", limit.for_ms),
            });
        }
        self.send_limit((site, robot), owner, Some(limit)).await
    }

    /// Ends an owner's limit of a robot. If the robot is configured to require limits of this
    /// owner, it stops from then on.
    ///
    /// # Errors
    /// The robot does not answer, or refuses.
    pub async fn end_limit(
        &self,
        (site, robot): (&SiteId, &RobotId),
        owner: OwnerId,
    ) -> Result<(), AppError> {
        self.send_limit((site, robot), owner, None).await
    }

    async fn send_limit(
        &self,
        (site, robot): (&SiteId, &RobotId),
        owner: OwnerId,
        limit: Option<SetLimit>,
    ) -> Result<(), AppError> {
        self.known_robot(site, robot).await?;
        let key: RobotKey = (site.clone(), robot.clone());
        let unreachable = || AppError::RobotUnreachable(robot.clone());
        let now = self.clock().elapsed();
        let clock = self.presences().get(&key).robot_clock_us(now);
        let (boot, clock_us) = clock.ok_or_else(unreachable)?;
        let lasting = limit.map_or(Duration::ZERO, |limit| Duration::from_millis(limit.for_ms));
        let lasting_us = u64::try_from(lasting.as_micros()).unwrap_or(0);
        let command = ExternalLimit {
            owner,
            boot,
            until_us: limit.map_or(0, |_| clock_us.saturating_add(lasting_us)),
            // The wall clock orders the limits of one owner, also after a restart of the server.
            seq: u64::try_from(self.clock().now().as_microsecond()).unwrap_or(0),
            hold: limit.is_some_and(|limit| limit.hold),
            linear_max_m_s: limit.and_then(|limit| limit.linear_max_m_s),
        };
        command.validate().map_err(|detail| AppError::Invalid {
            field: "linear_max_m_s",
            detail,
        })?;
        let answer = self.commands().send(&key, &command).await;
        let answer = answer.map_err(|_undelivered| unreachable())?;
        answer
            .reply
            .into_result()
            .map_err(|refusal| AppError::RobotRefused {
                robot: robot.clone(),
                detail: refusal.detail,
            })
    }

    /// Checks that a robot has said hello once.
    pub(super) async fn known_robot(&self, site: &SiteId, robot: &RobotId) -> Result<(), AppError> {
        if self.presences().is_known(&(site.clone(), robot.clone())) {
            return Ok(());
        }
        let mut tx = self.db().read("limits").await?;
        let site_pk = site_row(&mut tx, site).await?.pk;
        let found = db::robots::find(&mut tx, site_pk, robot).await?;
        let unknown = || AppError::UnknownRobot(site.clone(), robot.clone());
        found.map(|_row| ()).ok_or_else(unknown)
    }
}
