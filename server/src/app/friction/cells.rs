//! Friction at places: at a point, in the cells of a box, and its change between two times.

use std::collections::BTreeMap;

use jiff::Timestamp;
use tread_api::friction::{CellBox, CellDifference, CellFriction, ModelFriction, PointFriction};
use tread_api::geometry::Point;
use tread_api::ids::{ConfigurationId, SiteId};
use tread_api::page::{DifferencePage, MapPage};
use tread_api::site::{CELL_MAX_M, Cell, Grid};
use tread_api::terrain::{Terrain, TerrainRef};

use super::area::Area;
use super::map_reader::smaller;
use super::present_terrains::{PresentTerrains, is_here};
use super::{App, AppError, MapReader, Reading, ReadingParameters, SiteView, page, terrain_ref};
use crate::friction::Ground;
use crate::friction::index::{Block, Cells, Group};

/// Maximum number of squares that a box with a resolution may have.
pub const CELLS_MAX: f64 = 4_194_304.0;
/// Number of cells along a row that are joined into squares at a time.
const SQUARES_WIDTH_CELLS: i32 = 1_024;
/// Maximum number of cells of one read of the map for a page with fewer entries.
const CELLS_AT_ONCE: usize = 4_096;

/// The cells that a request asks for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CellRequest<'query> {
    /// Where.
    pub area: Area,
    /// Side of the squares into which cells are joined, metres; `None` for the grid's own cells.
    pub resolution_m: Option<f64>,
    /// Last cell of the preceding page.
    pub cursor: Option<&'query str>,
    /// Maximum number of cells.
    pub limit: u32,
}

impl App {
    /// Returns the friction of the cells in an area, row by row. The limit counts cells with entries; a
    /// cell gives one entry per terrain and robot model.
    pub async fn friction_of_cells(
        &self,
        site: &SiteId,
        parameters: &ReadingParameters,
        cells: CellRequest<'_>,
    ) -> Result<MapPage<CellFriction>, AppError> {
        let CellRequest {
            area,
            resolution_m,
            cursor,
            limit,
        } = cells;
        let reading = Reading::new(self, parameters)?;
        let after = cursor.map(read_cursor).transpose()?;
        let row = self.site_view(site).await?.row.clone();
        let grid = row.site.grid;
        let factor = factor(&grid, resolution_m)?;
        check_count(&area, resolution_m)?;
        let size_m = grid.cell_m * f64::from(factor);
        let bounds = area.cells(&Grid {
            cell_m: size_m,
            ..grid
        })?;
        let wanted = usize::try_from(limit)
            .unwrap_or(usize::MAX)
            .saturating_add(1);
        let of_site = row.clone();
        let looking = move |reader: &MapReader<'_>, [reading]: &[Reading; 1]| {
            let (mut found, mut after, mut at_once) = (Vec::new(), after, wanted);
            let mut at_once_max = wanted.max(CELLS_AT_ONCE);
            while found.len() < wanted {
                let tried = at_once;
                let (some, last) = smaller(&mut at_once, |at_once| {
                    reader.cells(&row, |map| {
                        let some = squares(map, factor, bounds, after, at_once);
                        let last = some.last().map(|(square, _)| *square);
                        let some = some.into_iter();
                        let some = some.map(|square: CellGroup| {
                            (square.0, of_square(map, reading, square, size_m))
                        });
                        // Nothing that was asked for was measured in the others: a page of them would
                        // be empty.
                        let some = some.filter(|(_, entries)| !entries.is_empty());
                        (some.collect::<Vec<_>>(), last)
                    })
                })?;
                found.extend(some);
                match last {
                    Some(_) => after = last,
                    None => break,
                }
                if at_once < tried {
                    at_once_max = at_once;
                }
                at_once = at_once.saturating_mul(2).min(at_once_max);
            }
            let cells = page(found, limit, |(cell, _)| format!("{},{}", cell.ix, cell.iy));
            let items = cells.items.into_iter().flat_map(|(_, of_square)| of_square);
            Ok(MapPage {
                items: items.collect(),
                next_cursor: cells.next_cursor,
                as_of: reading.as_of,
            })
        };
        self.read_map(&of_site, [reading], looking).await
    }

    /// Returns the friction at a point, from measurements on the terrain at this point alone.
    pub async fn friction_at(
        &self,
        site: &SiteId,
        parameters: &ReadingParameters,
        point: Point,
    ) -> Result<PointFriction, AppError> {
        let reading = Reading::new(self, parameters)?;
        let view = self.site_view(site).await?;
        let cell = view.cell_at(point)?;
        let row = view.row.clone();
        let looking = move |reader: &MapReader<'_>, [reading]: &[Reading; 1]| {
            known_at_point(reader, &view, reading, (cell, point))
        };
        self.read_map(&row, [reading], looking).await
    }

    /// Returns the differences of friction between two times, for cells that were measured in
    /// between.
    pub async fn friction_difference(
        &self,
        site: &SiteId,
        parameters: &ReadingParameters,
        (from, to): (Timestamp, Option<Timestamp>),
        cells: CellRequest<'_>,
    ) -> Result<DifferencePage<CellDifference>, AppError> {
        let parameters = ReadingParameters {
            as_of: to,
            ..parameters.clone()
        };
        let late = Reading::new(self, &parameters)?;
        if from.as_microsecond() > late.now_us {
            return Err(AppError::InvalidQuery {
                parameter: "to",
                detail: "to lies before from".to_owned(),
            });
        }
        let after = cells.cursor.map(read_cursor).transpose()?;
        let row = self.site_view(site).await?.row.clone();
        let early = late.at(from);
        let area = cells.area.cells(&row.site.grid)?;
        let wanted = usize::try_from(cells.limit).unwrap_or(usize::MAX);
        let limit = cells.limit;
        let of_site = row.clone();
        let looking = move |reader: &MapReader<'_>, [early, late]: &[Reading; 2]| {
            let (mut found, mut after) = (Vec::new(), after);
            let mut at_once = CELLS_AT_ONCE;
            let compared = ReadingPair { early, late };
            while found.len() <= wanted {
                let (some, last) = smaller(&mut at_once, |at_once| {
                    reader.cells(&row, |map| {
                        let cells = map.cells_in(area, after).take(at_once);
                        let cells: Vec<Cell> = cells.collect();
                        let measured = cells.iter().copied().filter(|&cell| {
                            let newest = map.newest_at_us(cell, late.choice());
                            newest.is_some_and(|newest_us| newest_us >= early.now_us)
                        });
                        let some = measured.map(|cell| (cell, compared.differences(map, cell)));
                        (some.collect::<Vec<_>>(), cells.last().copied())
                    })
                })?;
                found.extend(some);
                match last {
                    Some(_) => after = last,
                    None => break,
                }
            }
            let cells = page(found, limit, |(cell, _)| format!("{},{}", cell.ix, cell.iy));
            let items = cells.items.into_iter().flat_map(|(_, of_cell)| of_cell);
            Ok(DifferencePage {
                items: items.collect(),
                next_cursor: cells.next_cursor,
                from: early.as_of,
                as_of: late.as_of,
            })
        };
        self.read_map(&of_site, [early, late], looking).await
    }
}

fn known_at_point(
    reader: &MapReader<'_>,
    view: &SiteView,
    reading: &Reading,
    (cell, point): (Cell, Point),
) -> Result<PointFriction, AppError> {
    let drawn = PresentTerrains::new(&view.terrains);
    let terrain = drawn.at(point);
    let measured = measured_at_point(reader, view, reading, cell, terrain)?;
    // The prior of the terrain's class is needed only where nothing was measured.
    let models = match terrain {
        Some(terrain) if measured.is_empty() => {
            let classes = reader.app().classes(view, reading);
            let models = classes.models(view, reading, terrain).into_iter();
            let expected = models.map(|model| ModelFriction {
                prior: classes.prior(terrain, model.configuration),
                friction: None,
                ..model
            });
            expected.filter(|model| model.prior.is_some()).collect()
        }
        _ => measured,
    };
    Ok(PointFriction {
        as_of: reading.as_of,
        cell,
        terrain: terrain.map(terrain_ref),
        models,
    })
}

/// Returns the friction measured in a cell, on the given terrain alone, per robot model.
pub(super) fn measured_at_point(
    reader: &MapReader<'_>,
    view: &SiteView,
    reading: &Reading,
    cell: Cell,
    terrain: Option<&Terrain>,
) -> Result<Vec<ModelFriction>, AppError> {
    reader.cells(&view.row, |map| {
        let groups = map.cell(cell, reading.choice()).into_iter();
        let here = groups.filter(|group| is_here(view, group.terrain, terrain));
        let models = same_ground(here).into_iter().map(|group| ModelFriction {
            configuration: group.configuration,
            model: view.model(group.configuration),
            friction: reading.fused(group, Ground::Cell),
            prior: None,
            normalisation: reading.normalisation(),
        });
        models.collect()
    })
}

/// Returns the friction of a square, per terrain and configuration.
pub(super) fn of_square(
    map: Cells<'_>,
    reading: &Reading,
    (cell, parts): CellGroup,
    size_m: f64,
) -> Vec<CellFriction> {
    let (groups, ground) = match parts {
        None => (map.cell(cell, reading.choice()), Ground::Cell),
        Some(parts) => (map.area(&parts, reading.choice()), Ground::Area),
    };
    let entry = |group: Group<'_>| {
        let (terrain, configuration) = (group.terrain.cloned(), group.configuration);
        Some(CellFriction {
            cell,
            size_m,
            terrain,
            configuration,
            friction: reading.fused(group, ground)?,
            normalisation: reading.normalisation(),
        })
    };
    groups.into_iter().filter_map(entry).collect()
}

/// Readings of the map as of two times.
#[derive(Clone, Copy)]
struct ReadingPair<'reading> {
    early: &'reading Reading,
    late: &'reading Reading,
}

impl ReadingPair<'_> {
    /// Returns the differences of friction in a cell, per terrain and configuration.
    fn differences(self, map: Cells<'_>, cell: Cell) -> Vec<CellDifference> {
        type Key = (Option<TerrainRef>, ConfigurationId);
        let Self { early, late } = self;
        let key = |group: &Group<'_>| -> Key { (group.terrain.cloned(), group.configuration) };
        let mut before: BTreeMap<Key, _> = map
            .cell(cell, early.choice())
            .into_iter()
            .filter_map(|group| Some((key(&group), early.fused(group, Ground::Cell)?)))
            .collect();
        let after = map.cell(cell, late.choice()).into_iter();
        let both = after.map(|group| {
            let key = key(&group);
            let before = before.remove(&key);
            let after = late.fused(group, Ground::Cell);
            let z_score = before.zip(after).map(|(before, after)| {
                (after.theta - before.theta) / before.std_dev.hypot(after.std_dev)
            });
            CellDifference {
                cell,
                terrain: key.0,
                configuration: key.1,
                before,
                after,
                z_score,
                normalisation: late.normalisation(),
            }
        });
        both.collect()
    }
}

/// Joins groups of the same configuration, measured on several revisions of the same ground.
pub(super) fn same_ground<'map>(groups: impl Iterator<Item = Group<'map>>) -> Vec<Group<'map>> {
    let mut joined: Vec<Group<'map>> = Vec::new();
    for group in groups {
        let same = joined
            .iter_mut()
            .find(|present| present.configuration == group.configuration);
        match same {
            Some(present) => {
                present.seen.extend(group.seen);
                present.uninformative_passes += group.uninformative_passes;
            }
            None => joined.push(group),
        }
    }
    joined
}

/// Returns the number of grid cells along the side of a square of this resolution.
pub(super) fn factor(grid: &Grid, resolution_m: Option<f64>) -> Result<i32, AppError> {
    let Some(resolution_m) = resolution_m else {
        return Ok(1);
    };
    let ratio = resolution_m / grid.cell_m;
    if !(grid.cell_m..=CELL_MAX_M * 100.0).contains(&resolution_m)
        || (ratio - ratio.round()).abs() > 1.0e-9 * ratio
    {
        return Err(AppError::InvalidQuery {
            parameter: "resolution_m",
            detail: format!(
                "resolution_m must be a whole multiple of the grid's {} m up to {} m",
                grid.cell_m,
                CELL_MAX_M * 100.0
            ),
        });
    }
    #[expect(clippy::cast_possible_truncation, reason = "at most 100 000")]
    let factor = ratio.round() as i32;
    Ok(factor)
}

/// Refuses a resolution with which a box would have too many squares.
fn check_count(area: &Area, resolution_m: Option<f64>) -> Result<(), AppError> {
    let count = resolution_m.map_or(0.0, |resolution_m| area.count(resolution_m));
    if count > CELLS_MAX {
        return Err(AppError::InvalidQuery {
            parameter: "resolution_m",
            detail: format!("this would be {count} cells; a box may have {CELLS_MAX}"),
        });
    }
    Ok(())
}

/// A square and those grid cells in it that hold measurements; `None` where the square is one cell.
pub(super) type CellGroup = (Cell, Option<Vec<Cell>>);

/// Returns the squares that hold measurements, row by row.
pub(super) fn squares(
    map: Cells<'_>,
    factor: i32,
    area: CellBox,
    after: Option<Cell>,
    wanted: usize,
) -> Vec<CellGroup> {
    if factor == 1 {
        let cells = map.cells_in(area, after).take(wanted);
        return cells.map(|cell| (cell, None)).collect();
    }
    let CellBox { min, max } = area;
    let first = |square: Cell| Cell {
        ix: square.ix.saturating_mul(factor),
        iy: square.iy.saturating_mul(factor),
    };
    let last = |square: Cell| Cell {
        ix: first(square).ix.saturating_add(factor - 1),
        iy: first(square).iy.saturating_add(factor - 1),
    };
    let wide = i32::try_from(wanted).unwrap_or(i32::MAX);
    let at_once = (SQUARES_WIDTH_CELLS / factor).min(wide).max(1);
    let mut found: Vec<CellGroup> = Vec::new();
    let mut row = after.map_or(min.iy, |after| after.iy.max(min.iy));
    while row <= max.iy && found.len() < wanted {
        // The next grid row with measurements determines the next row of squares.
        let rest = CellBox {
            min: first(Cell {
                ix: min.ix,
                iy: row,
            }),
            max: last(max),
        };
        let Some(next) = map.cells_in(rest, None).next() else {
            break;
        };
        row = next.iy.div_euclid(factor);
        let is_new = |ix: i32| after.is_none_or(|after| (row, ix) > (after.iy, after.ix));
        let of_row = after.filter(|after| after.iy == row);
        let mut from = of_row.map_or(min.ix, |after| after.ix.saturating_add(1).max(min.ix));
        // Some columns at a time, so that no more cells are needed than wanted.
        while from <= max.ix && found.len() < wanted && !map.is_incomplete() {
            let to = from.saturating_add(at_once - 1).min(max.ix);
            let some = CellBox {
                min: first(Cell { ix: from, iy: row }),
                max: last(Cell { ix: to, iy: row }),
            };
            let mut columns: BTreeMap<i32, Vec<Cell>> = BTreeMap::new();
            for cell in map.cells_in(some, None) {
                let column = columns.entry(cell.ix.div_euclid(factor)).or_default();
                column.push(cell);
            }
            let squares = columns.into_iter().filter(|&(ix, _)| is_new(ix));
            found.extend(squares.map(|(ix, cells)| (Cell { ix, iy: row }, Some(cells))));
            // The next block with measurements determines the next column of squares.
            let Some(next) = to.checked_add(1) else { break };
            let low = first(Cell { ix: next, iy: row });
            let high = last(Cell {
                ix: max.ix,
                iy: row,
            });
            match map
                .map()
                .changes()
                .first_column(Block::of(low)..=Block::of(high))
            {
                Some(column) => {
                    let begin = Block { row: 0, column }.first().ix;
                    from = begin.div_euclid(factor).max(next);
                }
                None => break,
            }
        }
        let Some(next) = row.checked_add(1) else {
            break;
        };
        row = next;
    }
    found.truncate(wanted);
    found
}

fn read_cursor(cursor: &str) -> Result<Cell, AppError> {
    let cell = cursor.split_once(',').and_then(|(ix, iy)| {
        Some(Cell {
            ix: ix.parse().ok()?,
            iy: iy.parse().ok()?,
        })
    });
    cell.ok_or_else(|| crate::app::bad_cursor(cursor))
}
