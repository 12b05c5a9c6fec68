//! The friction map's answers, computed from the stored sums at the time of the request.

mod advice;
mod area;
mod cells;
mod export;
mod history;
pub mod live;
mod map_reader;
mod path;
mod path_prior;
mod pictures;
mod present_terrains;
mod prior;
mod raster;
mod reading;
mod timelines;
mod views;

use std::collections::HashMap;
use std::sync::Arc;

use jiff::Timestamp;
use tread_api::friction::{ModelFriction, TerrainFriction};
use tread_api::geometry::{COORDINATE_MAX_M, Point};
use tread_api::ids::{ConfigurationId, SiteId, TerrainId};
use tread_api::page::Page;
use tread_api::site::Cell;
use tread_api::terrain::{Terrain, TerrainRef};

pub(super) use self::advice::CellCounts;
pub use self::area::Area;
pub(crate) use self::area::AreaBounds;
pub use self::cells::{CELLS_MAX, CellRequest};
pub use self::export::{CellExport, SegmentExport};
pub use self::history::Times;
pub(super) use self::live::MapUpdates;
use self::map_reader::MapReader;
pub(super) use self::map_reader::ReaderSlots;
pub use self::pictures::Picture;
pub(super) use self::pictures::Pictures;
use self::prior::Classes;
pub use self::raster::{PictureRequest, SQUARES_MAX};
pub(super) use self::reading::Reading;
pub use self::reading::ReadingParameters;
pub(super) use self::timelines::Timelines;
pub(super) use self::views::Views;
use super::{App, AppError, page, site_row};
use crate::db::sites::SiteRow;
use crate::db::{self, Tx};
use crate::friction::Ground;
use crate::friction::index::SiteMap;

/// Model name shown for a configuration that no robot has declared.
const UNKNOWN_MODEL: &str = "not declared";
/// Maximum number of times that a map is read for one answer about the past.
const READS_MAX: usize = 3;
/// Why an answer about the past is given up.
const MOVED: &str = "hours of the map were merged or withdrawn while it was read";

/// A site with its terrains and model names, as read from the database for the map's answers.
#[derive(Debug)]
pub(in crate::app) struct SiteView {
    pub(super) row: SiteRow,
    pub(super) terrains: Vec<Terrain>,
    /// For each terrain, the revisions whose ground is the same as the present one.
    revisions: HashMap<TerrainId, Vec<u32>>,
    models: HashMap<ConfigurationId, String>,
}

impl SiteView {
    pub(super) async fn read(tx: &mut Tx, site: &SiteId) -> Result<Self, AppError> {
        let row = site_row(tx, site).await?;
        let terrains = db::terrains::list(tx, row.pk).await?;
        let revisions = db::terrains::same_ground(tx, row.pk).await?;
        let models = db::robots::model_names(tx).await?;
        Ok(Self {
            row,
            terrains,
            revisions,
            models,
        })
    }

    /// Returns whether a measurement on this revision applies to the terrain in its present shape.
    pub(super) fn is_present(&self, found: &TerrainRef) -> bool {
        let revisions = self.revisions.get(&found.id);
        revisions.is_some_and(|revisions| revisions.contains(&found.revision))
    }

    fn find(&self, site: &SiteId, id: &TerrainId) -> Result<&Terrain, AppError> {
        let unknown = || AppError::UnknownTerrain(site.clone(), id.clone());
        let mut terrains = self.terrains.iter();
        terrains
            .find(|terrain| terrain.id == *id)
            .ok_or_else(unknown)
    }

    /// Returns the cell that contains a point.
    fn cell_at(&self, point: Point) -> Result<Cell, AppError> {
        let off_the_map = || AppError::InvalidQuery {
            parameter: "x_m",
            detail: format!("a point lies on the map, within {COORDINATE_MAX_M} m of the origin"),
        };
        self.row.site.grid.cell_at(point).ok_or_else(off_the_map)
    }

    pub(super) fn model(&self, configuration: ConfigurationId) -> String {
        let name = self.models.get(&configuration);
        name.cloned().unwrap_or_else(|| UNKNOWN_MODEL.to_owned())
    }
}

impl App {
    /// Reads a site's map for an answer, on a blocking thread. Times of the readings are rounded
    /// first; if meanwhile measurements of the map have moved to other epochs, all is done again.
    ///
    /// # Errors
    /// The database failed, or those of `work`.
    async fn read_map<T: Send + 'static, const N: usize>(
        &self,
        row: &SiteRow,
        readings: [Reading; N],
        work: impl Fn(&MapReader<'_>, &[Reading; N]) -> Result<T, AppError> + Send + Sync + 'static,
    ) -> Result<T, AppError> {
        let is_past = readings.iter().any(|reading| reading.as_of.is_some());
        let work = Arc::new(work);
        for _ in 0..READS_MAX {
            let stamp = self.maps().with_map(row, SiteMap::stamp);
            let mut readings = readings.clone();
            for reading in &mut readings {
                reading.of_site(self, row).await?;
            }
            let work = Arc::clone(&work);
            let looking = move |reader: &MapReader<'_>| {
                for reading in &mut readings {
                    reading.sum(reader.app());
                }
                work(reader, &readings)
            };
            let answer = self.with_map_reader(looking).await?;
            if !is_past || self.maps().with_map(row, SiteMap::stamp) == stamp {
                return Ok(answer);
            }
        }
        Err(AppError::Unwritable(MOVED.to_owned()))
    }

    /// Returns the friction of each terrain of a site, after a cursor.
    pub async fn friction_of_terrains(
        &self,
        site: &SiteId,
        parameters: &ReadingParameters,
        cursor: Option<&str>,
        limit: u32,
    ) -> Result<Page<TerrainFriction>, AppError> {
        let reading = Reading::new(self, parameters)?;
        let view = self.site_view(site).await?;
        let row = view.row.clone();
        let cursor = cursor.map(str::to_owned);
        let listing = move |reader: &MapReader<'_>, [reading]: &[Reading; 1]| {
            let classes = reader.app().classes(&view, reading);
            let wanted = |terrain: &&Terrain| {
                cursor
                    .as_deref()
                    .is_none_or(|after| terrain.id.as_str() > after)
            };
            let listed: Vec<&Terrain> = view.terrains.iter().filter(wanted).collect();
            let Page { items, next_cursor } = page(listed, limit, |terrain| terrain.id.to_string());
            let items = items.into_iter().map(|terrain| {
                let models = classes.models(&view, reading, terrain);
                terrain_friction(terrain, models, reading.as_of)
            });
            Ok(Page {
                items: items.collect(),
                next_cursor,
            })
        };
        self.read_map(&row, [reading], listing).await
    }

    /// Returns the friction of one terrain.
    pub async fn friction_of_terrain(
        &self,
        site: &SiteId,
        id: &TerrainId,
        parameters: &ReadingParameters,
    ) -> Result<TerrainFriction, AppError> {
        let reading = Reading::new(self, parameters)?;
        let view = self.site_view(site).await?;
        let terrain = view.find(site, id)?.clone();
        let row = view.row.clone();
        let looking = move |reader: &MapReader<'_>, [reading]: &[Reading; 1]| {
            let classes = reader.app().classes(&view, reading);
            let models = classes.models(&view, reading, &terrain);
            Ok(terrain_friction(&terrain, models, reading.as_of))
        };
        self.read_map(&row, [reading], looking).await
    }

    /// Returns the measured friction of a terrain, per robot model.
    fn measured_models(
        &self,
        view: &SiteView,
        reading: &Reading,
        terrain: &Terrain,
    ) -> Vec<ModelFriction> {
        let is_wanted = |found: &TerrainRef| found.id == terrain.id && view.is_present(found);
        self.maps().with_map(&view.row, |map| {
            let groups = map.terrain(is_wanted, reading.choice());
            let models = groups.into_iter().map(|group| ModelFriction {
                configuration: group.configuration,
                model: view.model(group.configuration),
                friction: reading.fused(group, Ground::Area),
                prior: None,
                normalisation: reading.normalisation(),
            });
            models.collect()
        })
    }

    fn classes(&self, view: &SiteView, reading: &Reading) -> Classes {
        let measured = view.terrains.iter().map(|terrain| {
            let models = self.measured_models(view, reading, terrain);
            (terrain.id.clone(), terrain.class, models)
        });
        Classes::new(measured.collect())
    }
}

/// Friction of a terrain for one robot model, as values of gauges.
#[derive(Debug, Clone, PartialEq)]
pub struct KnownGround {
    /// The site.
    pub site: SiteId,
    /// The terrain.
    pub terrain: TerrainId,
    /// The robot model and tyres.
    pub configuration: ConfigurationId,
    /// θ.
    pub theta: f64,
    /// Standard deviation of θ.
    pub std_dev: f64,
    /// Age of the newest measurement, seconds.
    pub age_s: f64,
}

impl App {
    /// Returns the measured friction of at most `limit` terrains and models, and the number of
    /// those left out.
    ///
    /// # Errors
    /// The database failed.
    pub async fn known_of_terrains(
        &self,
        limit: usize,
    ) -> Result<(Vec<KnownGround>, usize), AppError> {
        let reading = Reading::new(self, &ReadingParameters::default())?;
        let (mut found, mut left_out) = (Vec::new(), 0);
        for site in self.all_sites().await? {
            let view = self.site_view(&site).await?;
            let reading = reading.clone();
            let looking = move |reader: &MapReader<'_>| {
                let mut known = Vec::new();
                for terrain in &view.terrains {
                    let models = reader.app().measured_models(&view, &reading, terrain);
                    let models = models.into_iter();
                    known.extend(models.filter_map(|model| {
                        let friction = model.friction?;
                        Some(KnownGround {
                            site: site.clone(),
                            terrain: terrain.id.clone(),
                            configuration: model.configuration,
                            theta: friction.theta,
                            std_dev: friction.std_dev,
                            age_s: friction.age_s,
                        })
                    }));
                }
                known
            };
            let known = self.with_map_reader(looking).await;
            let room = limit - found.len();
            left_out += known.len().saturating_sub(room);
            found.extend(known.into_iter().take(room));
        }
        Ok((found, left_out))
    }
}

fn terrain_ref(terrain: &Terrain) -> TerrainRef {
    TerrainRef {
        id: terrain.id.clone(),
        revision: terrain.revision,
    }
}

fn terrain_friction(
    terrain: &Terrain,
    models: Vec<ModelFriction>,
    as_of: Option<Timestamp>,
) -> TerrainFriction {
    TerrainFriction {
        as_of,
        models,
        terrain: terrain_ref(terrain),
        name: terrain.name.clone(),
        class: terrain.class,
    }
}
