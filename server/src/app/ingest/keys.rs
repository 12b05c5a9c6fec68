//! Keys of the database that the ingest writer remembers.

use std::collections::HashMap;

use tread_api::ids::{BootId, ConfigurationId, RobotId, SiteId};
use tread_api::site::Grid;

use crate::app::App;
use crate::db::{self, DbError, Tx};

/// Keys kept in memory before they are looked up afresh.
const KEYS_MAX: usize = 100_000;

/// Keys of the database that do not change once they are written.
#[derive(Debug, Default)]
pub(super) struct Keys {
    robots: HashMap<(SiteId, RobotId), RobotKeys>,
    boots: HashMap<(i64, BootId), i64>,
    configurations: HashMap<ConfigurationId, i64>,
}

#[derive(Debug, Clone, Copy)]
pub(super) struct RobotKeys {
    pub(super) site_pk: i64,
    pub(super) robot_pk: i64,
    pub(super) grid: Grid,
}

impl Keys {
    pub(super) fn forget(&mut self) {
        *self = Self::default();
    }

    pub(super) fn bound(&mut self) {
        if self.robots.len() + self.boots.len() + self.configurations.len() > KEYS_MAX {
            self.forget();
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

    pub(super) async fn boot(
        &mut self,
        tx: &mut Tx,
        robot_pk: i64,
        boot: BootId,
    ) -> Result<i64, DbError> {
        if let Some(&found) = self.boots.get(&(robot_pk, boot)) {
            return Ok(found);
        }
        let key = db::robots::boot_key(tx, robot_pk, boot).await?;
        self.boots.insert((robot_pk, boot), key);
        Ok(key)
    }

    pub(super) async fn configuration(
        &mut self,
        tx: &mut Tx,
        id: ConfigurationId,
    ) -> Result<i64, DbError> {
        if let Some(&found) = self.configurations.get(&id) {
            return Ok(found);
        }
        let key = db::robots::configuration_key(tx, id).await?;
        self.configurations.insert(id, key);
        Ok(key)
    }
}
