//! What every answer about the map needs from the database, kept until something but a measurement
//! is written: a question about the map then waits for no connection.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};

use tread_api::ids::{RobotId, SiteId};

use super::{App, AppError, SiteView};
use crate::db;
use crate::db::robots::RobotRow;

/// Robots that are kept; beyond, all are read again.
const ROBOTS_MAX: usize = 1_000;
/// Sites that are kept; beyond, all are read again.
const SITES_MAX: usize = 100;

/// What is kept.
#[derive(Debug, Default)]
pub(in crate::app) struct Views {
    inner: Mutex<Kept>,
}

#[derive(Debug, Default)]
struct Kept {
    /// The generation of the database that all of it is of.
    generation: u64,
    sites: HashMap<SiteId, Arc<SiteView>>,
    robots: HashMap<(i64, RobotId), Arc<RobotRow>>,
}

impl Views {
    /// Looks at what is kept of this generation, or keeps something of it.
    fn of<T>(&self, generation: u64, look: impl FnOnce(&mut Kept) -> T) -> Option<T> {
        let mut kept = self.inner.lock().unwrap_or_else(PoisonError::into_inner);
        if kept.generation > generation {
            return None;
        }
        if kept.generation < generation {
            *kept = Kept {
                generation,
                ..Kept::default()
            };
        }
        Some(look(&mut kept))
    }
}

impl App {
    /// A site as answers about its map need it.
    pub(in crate::app) async fn site_view(&self, site: &SiteId) -> Result<Arc<SiteView>, AppError> {
        let generation = self.db().generation();
        let found = self
            .views()
            .of(generation, |kept| kept.sites.get(site).cloned());
        if let Some(view) = found.flatten() {
            return Ok(view);
        }
        let view = SiteView::read(&mut self.db().read().await?, site).await?;
        let view = Arc::new(view);
        self.views().of(generation, |kept| {
            if kept.sites.len() >= SITES_MAX {
                kept.sites.clear();
            }
            kept.sites.insert(site.clone(), Arc::clone(&view));
        });
        Ok(view)
    }

    /// A robot of a site, if there is one.
    pub(in crate::app) async fn robot_of(
        &self,
        site_pk: i64,
        robot: &RobotId,
    ) -> Result<Option<Arc<RobotRow>>, AppError> {
        let generation = self.db().generation();
        let key = (site_pk, robot.clone());
        let found = self
            .views()
            .of(generation, |kept| kept.robots.get(&key).cloned());
        if let Some(row) = found.flatten() {
            return Ok(Some(row));
        }
        let mut tx = self.db().read().await?;
        let Some(row) = db::robots::find(&mut tx, site_pk, robot).await? else {
            return Ok(None);
        };
        let row = Arc::new(row);
        self.views().of(generation, |kept| {
            if kept.robots.len() >= ROBOTS_MAX {
                kept.robots.clear();
            }
            kept.robots.insert(key, Arc::clone(&row));
        });
        Ok(Some(row))
    }
}
