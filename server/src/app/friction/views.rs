//! What every answer about the map needs from the database, kept until something but an upload is
//! written: a question about the map then waits for no connection.

use std::collections::HashMap;
use std::hash::Hash;
use std::sync::{Arc, Mutex, PoisonError};

use tread_api::ids::{RobotId, SiteId};

use super::{App, AppError, SiteView};
use crate::db;
use crate::db::robots::RobotRow;

/// Sites, and robots, that are kept; beyond, all are read again.
const KEPT_MAX: usize = 1_000;

/// What is kept.
#[derive(Debug, Default)]
pub(in crate::app) struct Views {
    sites: Kept<SiteId, SiteView>,
    robots: Kept<(i64, RobotId), RobotRow>,
}

/// Things that were read at one generation of the database.
#[derive(Debug)]
struct Kept<K, V> {
    of: Mutex<(u64, HashMap<K, Arc<V>>)>,
}

impl<K, V> Default for Kept<K, V> {
    fn default() -> Self {
        Self {
            of: Mutex::default(),
        }
    }
}

impl<K: Eq + Hash, V> Kept<K, V> {
    fn find(&self, generation: u64, key: &K) -> Option<Arc<V>> {
        let of = self.of.lock().unwrap_or_else(PoisonError::into_inner);
        (of.0 == generation).then(|| of.1.get(key).cloned())?
    }

    /// Keeps what was read when the generation was this or a later one.
    fn keep(&self, generation: u64, key: K, value: V) -> Arc<V> {
        let value = Arc::new(value);
        let mut of = self.of.lock().unwrap_or_else(PoisonError::into_inner);
        if of.0 < generation || of.1.len() >= KEPT_MAX {
            of.1.clear();
            of.0 = of.0.max(generation);
        }
        if of.0 == generation {
            of.1.insert(key, Arc::clone(&value));
        }
        value
    }
}

impl App {
    /// A site as answers about its map need it.
    pub(in crate::app) async fn site_view(&self, site: &SiteId) -> Result<Arc<SiteView>, AppError> {
        let generation = self.db().generation();
        if let Some(view) = self.views().sites.find(generation, site) {
            return Ok(view);
        }
        let view = SiteView::read(&mut self.db().read("friction").await?, site).await?;
        Ok(self.views().sites.keep(generation, site.clone(), view))
    }

    /// A robot of a site, if there is one.
    pub(in crate::app) async fn robot_of(
        &self,
        site_pk: i64,
        robot: &RobotId,
    ) -> Result<Option<Arc<RobotRow>>, AppError> {
        let generation = self.db().generation();
        let key = (site_pk, robot.clone());
        if let Some(row) = self.views().robots.find(generation, &key) {
            return Ok(Some(row));
        }
        let found =
            db::robots::find(&mut *self.db().read("friction").await?, site_pk, robot).await?;
        Ok(found.map(|row| self.views().robots.keep(generation, key, row)))
    }
}
