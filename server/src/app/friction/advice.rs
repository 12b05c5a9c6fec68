//! Cells whose measurement would improve the map most, and each robot's contribution to the map.

use std::collections::{BTreeMap, HashMap};
use std::sync::{Mutex, MutexGuard, PoisonError};

use jiff::Timestamp;
use tread_api::friction::{CellBox, RobotContribution, VisitSuggestion};
use tread_api::geometry::Point;
use tread_api::ids::{RobotId, SiteId};
use tread_api::page::{MapPage, Page};
use tread_api::rights::Scope;
use tread_api::site::Cell;

use super::area::Area;
use super::present_terrains::PresentTerrains;
use super::{App, AppError, MapReader, Reading, ReadingParameters, SiteView, page, terrain_ref};
use crate::db::sites::SiteRow;
use crate::friction::Ground;
use crate::friction::epochs::HOUR_S;
use crate::friction::index::{Block, Cells, Contribution, SiteMap};

/// Maximum number of cells that one request for visits may cover.
const VISIT_CELLS_MAX: f64 = 262_144.0;
/// Relative standard deviation of θ (σ/θ) of one ordinary visit by one robot, including the robot's
/// own bias.
const VISIT_DEVIATION_RATIO: f64 = 0.13;
/// Relative standard deviation of θ assumed for unmeasured ground: about a factor of three either
/// way.
const UNKNOWN_DEVIATION_RATIO: f64 = 1.1;

impl App {
    /// Returns the cells of a box in which a visit would reduce the standard deviation of θ most,
    /// best first.
    pub async fn visits_worth_most(
        &self,
        site: &SiteId,
        parameters: &ReadingParameters,
        area: Area,
        limit: u32,
    ) -> Result<MapPage<VisitSuggestion>, AppError> {
        let reading = Reading::new(self, parameters)?;
        let view = self.site_view(site).await?;
        let row = view.row.clone();
        let grid = view.row.site.grid;
        let count = area.count(grid.cell_m);
        if count > VISIT_CELLS_MAX {
            return Err(AppError::InvalidQuery {
                parameter: "x_min_m",
                detail: format!("this box has {count} cells; at most {VISIT_CELLS_MAX} here"),
            });
        }
        let CellBox { min, max } = area.cells(&grid)?;
        let looking = move |reader: &MapReader<'_>, [reading]: &[Reading; 1]| {
            let drawn = PresentTerrains::new(&view.terrains);
            let (low, high) = (Block::of(min), Block::of(max));
            let rows = low.row..=high.row;
            let blocks = rows.flat_map(|row| {
                let columns = low.column..=high.column;
                columns.map(move |column| Block { row, column })
            });
            let mut found = Vec::new();
            for block in blocks {
                let (first, last) = (block.first(), block.last());
                let rows = first.iy.max(min.iy)..=last.iy.min(max.iy);
                let columns = first.ix.max(min.ix)..=last.ix.min(max.ix);
                found.extend(reader.cells(&view.row, |map| {
                    let cells = rows.clone().flat_map(|iy| {
                        let columns = columns.clone();
                        columns.map(move |ix| Cell { ix, iy })
                    });
                    let suggestion = |cell: Cell| {
                        let center = grid.center_of(cell);
                        suggested(map, &drawn, reading, cell, center)
                    };
                    cells.filter_map(suggestion).collect::<Vec<_>>()
                })?);
            }
            Ok((found, reading.as_of))
        };
        let (mut found, as_of) = self.read_map(&row, [reading], looking).await?;
        found.sort_by(|left, right| {
            let by_gain = right.gain.total_cmp(&left.gain);
            by_gain.then_with(|| (left.cell.iy, left.cell.ix).cmp(&(right.cell.iy, right.cell.ix)))
        });
        found.truncate(usize::try_from(limit).unwrap_or(usize::MAX));
        Ok(MapPage {
            items: found,
            next_cursor: None,
            as_of,
        })
    }

    /// Returns each robot's contribution to the map of a site, ordered by name.
    pub async fn contributions(
        &self,
        (site, within): (&SiteId, &Scope),
        cursor: Option<&str>,
        limit: u32,
    ) -> Result<Page<RobotContribution>, AppError> {
        let reading = Reading::new(self, &ReadingParameters::default())?;
        let view = self.site_view(site).await?;
        let (after, named) = (cursor.map(str::to_owned), within.limit_of(site));
        let looking = move |reader: &MapReader<'_>| {
            let (biases, contributions) = reader.map(&view.row, |map| {
                (biases(map, &view, &reading), map.contributions())
            });
            let cells = reader.app().inner.cell_counts.of(reader, &view.row)?;
            let is_wanted = |found: &Contribution| {
                let after = after.as_deref();
                let is_named = named
                    .as_ref()
                    .is_none_or(|named| named.contains(&found.robot));
                is_named && after.is_none_or(|after| found.robot.as_str() > after)
            };
            let time = |at: Result<Timestamp, _>| at.unwrap_or(Timestamp::MAX);
            let listed = contributions.into_iter().filter(is_wanted);
            let shown = listed.map(|found| RobotContribution {
                bias_ratio: biases.get(&found.robot).copied(),
                cells: cells.get(&found.robot).copied().unwrap_or_default(),
                robot: found.robot,
                segments: found.segments,
                first_at: time(Timestamp::from_second(found.first_epoch_h * HOUR_S)),
                newest_at: time(Timestamp::from_microsecond(found.newest_at_us)),
            });
            Ok::<Vec<_>, AppError>(shown.collect())
        };
        let found = self.with_map_reader(looking).await?;
        Ok(page(found, limit, |found: &RobotContribution| {
            found.robot.to_string()
        }))
    }
}

/// Number of cells that each robot has measured, of each block of each site. Only blocks that have
/// changed since are counted again.
#[derive(Debug, Default)]
pub(in crate::app) struct CellCounts(Mutex<HashMap<(i64, Block), RobotCells>>);

/// Cells of a block by robot.
#[derive(Debug, Clone)]
struct RobotCells {
    /// Number of the newest change when they were counted.
    change: u64,
    cells: BTreeMap<RobotId, u64>,
}

impl CellCounts {
    fn lock(&self) -> MutexGuard<'_, HashMap<(i64, Block), RobotCells>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns the number of cells of a site that each robot has measured.
    fn of(
        &self,
        reader: &MapReader<'_>,
        row: &SiteRow,
    ) -> Result<BTreeMap<RobotId, u64>, AppError> {
        let blocks: Vec<(Block, u64)> = reader.map(row, |map| map.changes().blocks().collect());
        let mut all = BTreeMap::new();
        for (block, newest) in blocks {
            let key = (row.pk, block);
            let known = self.lock().get(&key).cloned();
            let counted = if let Some(known) = known.filter(|known| known.change >= newest) {
                known
            } else {
                let counted = reader.cells(row, |map| {
                    let mut cells = BTreeMap::new();
                    map.count_cells(block, &mut cells);
                    let change = map.map().changes().newest_of(block);
                    RobotCells { change, cells }
                })?;
                self.lock().insert(key, counted.clone());
                counted
            };
            for (robot, count) in counted.cells {
                *all.entry(robot).or_default() += count;
            }
        }
        Ok(all)
    }
}

fn suggested(
    map: Cells<'_>,
    drawn: &PresentTerrains<'_>,
    reading: &Reading,
    cell: Cell,
    center: Point,
) -> Option<VisitSuggestion> {
    let terrain = drawn.at(center);
    let known = map
        .cell(cell, reading.choice())
        .into_iter()
        .filter(|group| group.terrain.map(|found| &found.id) == terrain.map(|found| &found.id))
        .filter_map(|group| reading.fused(group, Ground::Cell))
        .min_by(|left, right| left.std_dev.total_cmp(&right.std_dev));
    // Unvisited ground outside every terrain is not suggested.
    if terrain.is_none() && known.is_none() {
        return None;
    }
    let relative = known.map(|known| known.std_dev / known.theta);
    let now = relative.unwrap_or(UNKNOWN_DEVIATION_RATIO);
    // Two independent measurements of the same value: 1/σ'² = 1/σ² + 1/σ_v².
    let gain = 0.5 * (now / VISIT_DEVIATION_RATIO).powi(2).ln_1p();
    Some(VisitSuggestion {
        cell,
        center,
        terrain: terrain.map(terrain_ref),
        gain,
        relative_std_dev: relative,
        normalisation: reading.normalisation(),
        disputed: known.is_some_and(|known| known.disputed),
    })
}

/// Returns, for each robot, the median over terrains of its θ divided by the θ of all robots of its
/// model.
fn biases(map: &SiteMap, view: &SiteView, reading: &Reading) -> BTreeMap<RobotId, f64> {
    let mut ratios: BTreeMap<RobotId, Vec<f64>> = BTreeMap::new();
    for terrain in &view.terrains {
        let groups = map.terrain(
            |found| found.id == terrain.id && view.is_present(found),
            reading.choice(),
        );
        for group in groups {
            let robots: Vec<(u32, Option<f64>)> = group
                .seen
                .chunk_by(|left, right| left.robot == right.robot)
                .map(|seen| {
                    let mut alone = group.clone();
                    alone.seen = seen.to_vec();
                    let theta = reading.fused(alone, Ground::Area).map(|known| known.theta);
                    (seen[0].robot, theta)
                })
                .collect();
            if robots.len() < 2 {
                continue;
            }
            let Some(common) = reading.fused(group, Ground::Area) else {
                continue;
            };
            for (rank, theta) in robots {
                if let (Some(robot), Some(theta)) = (map.robot_of_rank(rank), theta) {
                    let of_robot = ratios.entry(robot.clone()).or_default();
                    of_robot.push(theta / common.theta);
                }
            }
        }
    }
    ratios
        .into_iter()
        .filter_map(|(robot, mut ratios)| {
            ratios.sort_unstable_by(f64::total_cmp);
            Some((robot, *ratios.get(ratios.len() / 2)?))
        })
        .collect()
}
