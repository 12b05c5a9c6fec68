//! Rasters of the map, row by row, for one robot model, from which pictures are made.
//!
//! Blocks of cells are fused once and cached. Cells that changed are fused again one by one; all
//! are fused again when the minute to which ages are rounded is over. The map's lock is held for
//! one block at a time, so that uploads never wait long.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};

use tread_api::friction::CellBox;
use tread_api::ids::ConfigurationId;
use tread_api::site::{Cell, Grid};

use super::area::Area;
use super::cells::factor;
use super::map_reader::in_parts;
use super::present_terrains::PresentTerrains;
use super::{AppError, MapReader, Reading, ReadingParameters, SiteView};
use crate::friction::Raster;
use crate::friction::index::{
    Block, CELLS_PER_BLOCK, CellSummary, Cells, CompiledFilter, FusionBuffers,
};

/// Maximum number of squares in one picture.
pub const SQUARES_MAX: u64 = 1 << 20;
/// Maximum number of cached blocks, of all sites and models; 72 KiB each.
const BLOCKS_MAX: usize = 1_024;
/// Number of cells along a row of squares of several cells for which the map's lock is held at a time.
const CELLS_PER_READ: i32 = 2_048;

/// The content of a requested picture.
#[derive(Debug, Clone, Default)]
pub struct PictureRequest {
    /// Configuration, normalisation and time of the reading.
    pub parameters: ReadingParameters,
    /// The area; `None` for everything that was driven on.
    pub area: Option<Area>,
    /// Side of the squares, metres; `None` for the grid's own cells.
    pub resolution_m: Option<f64>,
}

/// Key of a cached block: everything that determines its squares except the time.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct BlockKey {
    site_pk: i64,
    block: Block,
    configuration: ConfigurationId,
    normalisation: Option<String>,
}

/// A cached block.
#[derive(Debug, Clone)]
struct CachedBlock {
    change: u64,
    terrain_revision: u64,
    now_us: i64,
    grounds: Arc<[u16]>,
    squares: Arc<Vec<CellSummary>>,
    used: u64,
}

/// Cache of fused blocks.
#[derive(Debug, Default)]
pub(in crate::app) struct Blocks {
    inner: Mutex<(u64, HashMap<BlockKey, CachedBlock>)>,
}

impl Blocks {
    fn find(&self, key: &BlockKey) -> Option<CachedBlock> {
        let mut inner = self.inner.lock().unwrap_or_else(PoisonError::into_inner);
        inner.0 += 1;
        let now = inner.0;
        let found = inner.1.get_mut(key)?;
        found.used = now;
        Some(found.clone())
    }

    fn insert(&self, key: BlockKey, kept: CachedBlock) {
        let mut inner = self.inner.lock().unwrap_or_else(PoisonError::into_inner);
        let (_, blocks) = &mut *inner;
        if blocks.len() >= BLOCKS_MAX && !blocks.contains_key(&key) {
            // The least recently used half is removed at once, so that this is rare.
            let mut used: Vec<u64> = blocks.values().map(|kept| kept.used).collect();
            let middle = used.len() / 2;
            let (_, &mut bound, _) = used.select_nth_unstable(middle);
            blocks.retain(|_, kept| kept.used > bound);
        }
        blocks.insert(key, kept);
    }
}

/// What the squares of one picture have in common.
pub(super) struct Frame<'view> {
    view: &'view SiteView,
    reading: &'view Reading,
    drawn: PresentTerrains<'view>,
    configuration: ConfigurationId,
}

impl Frame<'_> {
    fn filter(&self, map: Cells<'_>) -> CompiledFilter<'_> {
        let choice = crate::friction::index::Choice {
            configuration: Some(self.configuration),
            ..self.reading.choice()
        };
        map.map()
            .filter(choice, |found| self.drawn.ground_of(self.view, found))
    }

    fn grounds(&self, block: Block) -> Arc<[u16]> {
        let grid = self.view.row.site.grid;
        let near = self.drawn.near(Area {
            min: grid.center_of(block.first()),
            max: grid.center_of(block.last()),
        });
        let places = 0..u16::try_from(CELLS_PER_BLOCK).unwrap_or(u16::MAX);
        places
            .map(|place| near.ground_at(grid.center_of(block.cell(place))))
            .collect()
    }

    fn block(
        &self,
        reader: &MapReader<'_>,
        block: Block,
    ) -> Result<Arc<Vec<CellSummary>>, AppError> {
        let (app, row, reading) = (reader.app(), &self.view.row, self.reading);
        // Blocks as of a past time are not cached.
        let key = reading.as_of.is_none().then(|| BlockKey {
            site_pk: row.pk,
            block,
            configuration: self.configuration,
            normalisation: reading.normalisation(),
        });
        let found = key.as_ref().and_then(|key| app.pictures().blocks.find(key));
        let terrain_revision = row.site.terrain_revision;
        let found = found.filter(|kept| kept.terrain_revision == terrain_revision);
        let grounds = match &found {
            Some(kept) => Arc::clone(&kept.grounds),
            None => self.grounds(block),
        };
        let of_now = found.filter(|kept| kept.now_us == reading.now_us);
        let (change, squares) = reader.cells(row, |map| {
            let newest = map.map().changes().newest_of(block);
            let (mut squares, places) = match &of_now {
                Some(kept) if kept.change == newest => return (newest, Arc::clone(&kept.squares)),
                Some(kept) => {
                    let places = map.map().changes().since(block, kept.change);
                    (Arc::clone(&kept.squares), places)
                }
                None => (
                    Arc::new(vec![CellSummary::default(); CELLS_PER_BLOCK]),
                    None,
                ),
            };
            if newest > 0 {
                let filter = self.filter(map);
                let kept = Arc::make_mut(&mut squares);
                let which = (block, places.as_deref());
                map.fuse_block(which, &grounds, &filter, reading.fused_at(), kept);
            }
            (newest, squares)
        })?;
        if let Some(key) = key {
            let kept = CachedBlock {
                change,
                terrain_revision,
                now_us: reading.now_us,
                grounds,
                squares: Arc::clone(&squares),
                used: 0,
            };
            app.pictures().blocks.insert(key, kept);
        }
        Ok(squares)
    }

    /// Returns the squares of a box of single cells, row by row.
    fn cells(
        &self,
        reader: &MapReader<'_>,
        CellBox { min, max }: CellBox,
    ) -> Result<Vec<CellSummary>, AppError> {
        let columns = usize::try_from(max.ix - min.ix + 1).unwrap_or_default();
        let rows = usize::try_from(max.iy - min.iy + 1).unwrap_or_default();
        let mut squares = vec![CellSummary::default(); columns * rows];
        let (low, high) = (Block::of(min), Block::of(max));
        for row in low.row..=high.row {
            for column in low.column..=high.column {
                let block = Block { row, column };
                let kept = self.block(reader, block)?;
                let (first, last) = (block.first(), block.last());
                let (from_ix, to_ix) = (first.ix.max(min.ix), last.ix.min(max.ix));
                for iy in first.iy.max(min.iy)..=last.iy.min(max.iy) {
                    let from = usize::from(Block::place(Cell { ix: from_ix, iy }));
                    let to = usize::from(Block::place(Cell { ix: to_ix, iy }));
                    let place = usize::try_from(iy - min.iy).unwrap_or_default() * columns
                        + usize::try_from(from_ix - min.ix).unwrap_or_default();
                    squares[place..=place + to - from].copy_from_slice(&kept[from..=to]);
                }
            }
        }
        Ok(squares)
    }

    /// Returns the squares of a box, each of `factor` × `factor` cells, row by row; these are not
    /// cached.
    fn merged(
        &self,
        reader: &MapReader<'_>,
        CellBox { min, max }: CellBox,
        factor: i32,
    ) -> Result<Vec<CellSummary>, AppError> {
        let grid = self.view.row.site.grid;
        let coarse = Grid {
            cell_m: grid.cell_m * f64::from(factor),
            ..grid
        };
        let near = self.drawn.near(Area {
            min: coarse.center_of(min),
            max: coarse.center_of(max),
        });
        let mut squares = Vec::new();
        let columns: Vec<i32> = (min.ix..=max.ix).collect();
        let at_once = usize::try_from(CELLS_PER_READ / factor)
            .unwrap_or_default()
            .max(1);
        for iy in min.iy..=max.iy {
            squares.extend(in_parts(&columns, at_once, |some| {
                reader.cells(&self.view.row, |map| {
                    let filter = self.filter(map);
                    let mut room = FusionBuffers::default();
                    let square = |&ix: &i32| {
                        let ground = near.ground_at(coarse.center_of(Cell { ix, iy }));
                        let min = Cell {
                            ix: ix.saturating_mul(factor),
                            iy: iy.saturating_mul(factor),
                        };
                        let max = Cell {
                            ix: min.ix.saturating_add(factor - 1),
                            iy: min.iy.saturating_add(factor - 1),
                        };
                        let cells = CellBox { min, max };
                        let at = self.reading.fused_at();
                        map.fuse_square(cells, (ground, &filter), at, &mut room)
                    };
                    some.iter().map(square).collect()
                })
            })?);
        }
        Ok(squares)
    }
}

/// Returns the map of a site as squares.
pub(super) fn raster(
    reader: &MapReader<'_>,
    view: &SiteView,
    reading: &Reading,
    picture: &PictureRequest,
) -> Result<Raster, AppError> {
    let grid = view.row.site.grid;
    let reference = reading.reference();
    let (extent, configuration) = reader.map(&view.row, |map| {
        let first = || map.configurations().first().copied();
        (map.extent(), reference.or_else(first))
    });
    let factor = factor(&grid, picture.resolution_m)?;
    let size_m = grid.cell_m * f64::from(factor);
    let bounds = match (picture.area, extent) {
        (Some(area), _) => Some(area.cells(&Grid {
            cell_m: size_m,
            ..grid
        })?),
        (None, Some((min, max))) => {
            let whole = Area::WHOLE.cells(&grid)?;
            let square = |ix: i32, iy: i32| Cell {
                ix: ix.div_euclid(factor),
                iy: iy.div_euclid(factor),
            };
            Some(CellBox {
                min: square(min.ix.max(whole.min.ix), min.iy.max(whole.min.iy)),
                max: square(max.ix.min(whole.max.ix), max.iy.min(whole.max.iy)),
            })
        }
        (None, None) => None,
    };
    let mut raster = Raster {
        site: view.row.site.clone(),
        configuration,
        model: configuration.map_or_else(String::new, |found| view.model(found)),
        normalisation: reading.normalisation(),
        as_of_us: reading.now_us,
        first: Cell { ix: 0, iy: 0 },
        columns: 0,
        rows: 0,
        size_m,
        squares: Vec::new(),
    };
    let Some(bounds) = bounds else {
        return Ok(raster);
    };
    let CellBox { min, max } = bounds;
    let length = |low: i32, high: i32| (i64::from(high) - i64::from(low) + 1).unsigned_abs();
    let (columns, rows) = (length(min.ix, max.ix), length(min.iy, max.iy));
    let count = columns.saturating_mul(rows);
    if count > SQUARES_MAX {
        return Err(AppError::InvalidQuery {
            parameter: "resolution_m",
            detail: format!(
                "this would be {count} squares; a picture may have {SQUARES_MAX}: take a \
                 smaller box or a larger `resolution_m`"
            ),
        });
    }
    raster.first = min;
    raster.columns = usize::try_from(columns).unwrap_or_default();
    raster.rows = usize::try_from(rows).unwrap_or_default();
    raster.squares = match configuration {
        None => vec![CellSummary::default(); raster.columns * raster.rows],
        Some(configuration) => {
            let frame = Frame {
                view,
                reading,
                drawn: PresentTerrains::new(&view.terrains),
                configuration,
            };
            if factor == 1 {
                frame.cells(reader, bounds)?
            } else {
                frame.merged(reader, bounds, factor)?
            }
        }
    };
    Ok(if picture.area.is_none() {
        raster.trimmed()
    } else {
        raster
    })
}
