//! Cache of the sites and robots that map requests need from the database, valid until a
//! transaction is committed that may change them ([`db::Db::generation`]). Requests then need no
//! database connection.

use std::collections::HashMap;
use std::hash::Hash;
use std::sync::{Arc, Mutex, PoisonError};

use tread_api::ids::{RobotId, SiteId};

use super::{App, AppError, SiteView};
use crate::db;
use crate::db::robots::RobotRow;

/// Maximum number of cached sites, and of cached robots; beyond it that cache is emptied.
const KEPT_MAX: usize = 1_000;

/// The cache.
#[derive(Debug, Default)]
pub(in crate::app) struct Views {
    sites: GenerationCache<SiteId, SiteView>,
    robots: GenerationCache<(i64, RobotId), RobotRow>,
}

/// Values read at one generation of the database.
#[derive(Debug)]
struct GenerationCache<K, V> {
    of: Mutex<(u64, HashMap<K, Arc<V>>)>,
}

impl<K, V> Default for GenerationCache<K, V> {
    fn default() -> Self {
        Self {
            of: Mutex::default(),
        }
    }
}

impl<K: Eq + Hash, V> GenerationCache<K, V> {
    fn find(&self, generation: u64, key: &K) -> Option<Arc<V>> {
        let of = self.of.lock().unwrap_or_else(PoisonError::into_inner);
        (of.0 == generation).then(|| of.1.get(key).cloned())?
    }

    /// Caches a value read at `generation`, unless values of a later generation are cached.
    fn insert(&self, generation: u64, key: K, value: V) -> Arc<V> {
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
    /// Returns a site with what map requests need.
    pub(in crate::app) async fn site_view(&self, site: &SiteId) -> Result<Arc<SiteView>, AppError> {
        let generation = self.db().generation();
        if let Some(view) = self.views().sites.find(generation, site) {
            return Ok(view);
        }
        let view = SiteView::read(&mut self.db().read("friction").await?, site).await?;
        Ok(self.views().sites.insert(generation, site.clone(), view))
    }

    /// Returns a robot of a site; `None` if there is none.
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
            db::robots::find(&mut self.db().read("friction").await?, site_pk, robot).await?;
        Ok(found.map(|row| self.views().robots.insert(generation, key, row)))
    }
}
