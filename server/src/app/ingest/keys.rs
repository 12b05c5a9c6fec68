//! Cache of the database keys that the ingest writer uses.

use std::collections::HashMap;

use tread_api::ids::{BootId, ConfigurationId, RobotId, SiteId};
use tread_api::site::Grid;

use super::Upload;
use crate::app::App;
use crate::app::presence::RobotKey;
use crate::app::robots::RUNS_KEPT_MAX;
use crate::db::{self, DbError, RecordKey, Tx};

/// Number of cached keys above which the cache is emptied.
const KEYS_MAX: usize = 100_000;

/// Maximum number of configurations that one robot may measure with, since their sums are kept for
/// ever.
pub(super) const CONFIGURATIONS_MAX: i64 = 100;

/// Whether a robot may upload measurements of a configuration.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Configured {
    /// Allowed, with the key of the configuration.
    As(i64),
    /// Refused for now: the robot had too many new configurations of late.
    Later,
    /// Refused for ever: the robot has measured with [`CONFIGURATIONS_MAX`] others.
    Never,
}

/// Database keys, which do not change once they are written.
#[derive(Debug, Default)]
pub(super) struct Keys {
    robots: HashMap<(SiteId, RobotId), RobotKeys>,
    boots: HashMap<(i64, BootId), i64>,
    configurations: HashMap<(i64, ConfigurationId), i64>,
    /// A sequence number at or after that of every segment of a run that is or was stored; `None`
    /// without such segments.
    newest_seqs: HashMap<i64, Option<i64>>,
}

#[derive(Debug, Clone, Copy)]
pub(super) struct RobotKeys {
    pub(super) site_pk: i64,
    pub(super) robot_pk: i64,
    pub(super) grid: Grid,
}

impl Keys {
    pub(super) fn clear(&mut self) {
        *self = Self::default();
    }

    pub(super) fn bound(&mut self) {
        let maps = [
            self.robots.len(),
            self.boots.len(),
            self.configurations.len(),
            self.newest_seqs.len(),
        ];
        if maps.into_iter().sum::<usize>() > KEYS_MAX {
            self.clear();
        }
    }

    pub(super) async fn robot(
        &mut self,
        app: &App,
        tx: &mut Tx,
        (site, robot): (&SiteId, &RobotId),
    ) -> Result<Option<RobotKeys>, DbError> {
        let key = (site.clone(), robot.clone());
        if let Some(&found) = self.robots.get(&key) {
            return Ok(Some(found));
        }
        let Some(site_row) = db::sites::find(tx, site).await? else {
            return Ok(None);
        };
        let found = db::robots::find(tx, site_row.pk, robot).await?;
        app.maps().ensure(&site_row);
        let found = found.map(|row| RobotKeys {
            site_pk: site_row.pk,
            robot_pk: row.pk,
            grid: site_row.site.grid,
        });
        if let Some(found) = found {
            self.robots.insert(key, found);
        }
        Ok(found)
    }

    /// Returns the key of a run; `None` while the robot's allowance of new runs is used up.
    pub(super) async fn boot(
        &mut self,
        app: &App,
        tx: &mut Tx,
        upload: &Upload,
        robot_pk: i64,
    ) -> Result<Option<i64>, DbError> {
        let Upload { site, batch, .. } = upload;
        if let Some(&found) = self.boots.get(&(robot_pk, batch.boot)) {
            return Ok(Some(found));
        }
        let found = db::robots::find_boot(tx, robot_pk, batch.boot).await?;
        let named = (site.clone(), batch.robot.clone());
        if found.is_none() && !app.may_begin_run(&named) {
            return Ok(None);
        }
        let key = db::robots::boot_key(tx, robot_pk, batch.boot, RUNS_KEPT_MAX).await?;
        self.boots.insert((robot_pk, batch.boot), key);
        Ok(Some(key))
    }

    /// Returns a sequence number at or after that of every segment of a run that is or was stored;
    /// `None` without such segments.
    pub(super) async fn newest_seq(
        &mut self,
        tx: &mut Tx,
        boot_pk: i64,
    ) -> Result<Option<i64>, DbError> {
        if let Some(&found) = self.newest_seqs.get(&boot_pk) {
            return Ok(found);
        }
        let stored = db::segment_ranges::newest_seq(tx, boot_pk).await?;
        let newest = stored.max(db::removed::newest_seq(tx, boot_pk).await?);
        self.newest_seqs.insert(boot_pk, newest);
        Ok(newest)
    }

    /// Notes that segments of a run up to this one are about to be stored.
    pub(super) fn record_seq(&mut self, last: RecordKey) {
        let newest = self.newest_seqs.entry(last.boot_pk).or_default();
        *newest = (*newest).max(Some(last.seq));
    }

    /// Returns the key of a configuration that a robot measures with, or why it is refused.
    pub(super) async fn configuration(
        &mut self,
        app: &App,
        tx: &mut Tx,
        (named, robot_pk): (&RobotKey, i64),
        id: ConfigurationId,
    ) -> Result<Configured, DbError> {
        if let Some(&found) = self.configurations.get(&(robot_pk, id)) {
            return Ok(Configured::As(found));
        }
        let key = match db::robots::measured_configuration(tx, robot_pk, id).await? {
            Some(found) => found,
            None if db::robots::measured_count(tx, robot_pk).await? >= CONFIGURATIONS_MAX => {
                return Ok(Configured::Never);
            }
            None if !app.may_change_configuration(named) => return Ok(Configured::Later),
            None => db::robots::record_measured(tx, robot_pk, id).await?,
        };
        self.configurations.insert((robot_pk, id), key);
        Ok(Configured::As(key))
    }
}
