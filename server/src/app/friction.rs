//! What the map says, made from the sums at the time of reading.

use tread_api::friction::{CellFriction, ModelFriction, TerrainFriction};
use tread_api::geometry::Point;
use tread_api::ids::{SiteId, TerrainId};
use tread_api::page::Page;
use tread_api::site::{Cell, Grid};
use tread_api::terrain::{Terrain, TerrainRef};

use super::{App, AppError, page, site_row};
use crate::db::sums::{CellRange, SumRow};
use crate::db::{self, Tx};
use crate::friction::{fuse, grouped};

/// The model's name while only measurements have named the configuration.
const UNKNOWN_MODEL: &str = "not declared";

/// A rectangle of a site.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Area {
    /// The corner with the lowest coordinates.
    pub min: Point,
    /// The corner with the highest coordinates.
    pub max: Point,
}

impl App {
    /// The friction of every terrain of a site, after a cursor.
    pub async fn friction_of_terrains(
        &self,
        site: &SiteId,
        cursor: Option<&str>,
        limit: u32,
    ) -> Result<Page<TerrainFriction>, AppError> {
        let mut tx = self.db().read().await?;
        let site_pk = site_row(&mut tx, site).await?.pk;
        let mut terrains = db::terrains::list(&mut tx, site_pk).await?;
        terrains.retain(|terrain| cursor.is_none_or(|cursor| terrain.id.as_str() > cursor));
        let Page { items, next_cursor } =
            page(terrains, limit, |terrain: &Terrain| terrain.id.to_string());
        let mut frictions = Vec::with_capacity(items.len());
        for terrain in items {
            frictions.push(self.terrain_friction(&mut tx, site_pk, terrain).await?);
        }
        Ok(Page {
            items: frictions,
            next_cursor,
        })
    }

    /// The friction of one terrain.
    pub async fn friction_of_terrain(
        &self,
        site: &SiteId,
        id: &TerrainId,
    ) -> Result<TerrainFriction, AppError> {
        let mut tx = self.db().read().await?;
        let site_pk = site_row(&mut tx, site).await?.pk;
        let terrain = db::terrains::find(&mut tx, site_pk, id).await?;
        let unknown = || AppError::UnknownTerrain(site.clone(), id.clone());
        self.terrain_friction(&mut tx, site_pk, terrain.ok_or_else(unknown)?)
            .await
    }

    async fn terrain_friction(
        &self,
        tx: &mut Tx,
        site_pk: i64,
        terrain: Terrain,
    ) -> Result<TerrainFriction, AppError> {
        let rows = db::sums::of_terrain(tx, site_pk, &terrain.id).await?;
        let now = self.clock().now();
        let models = grouped(rows.into_iter().map(|row| (row.configuration, row)));
        let models = models.into_iter().map(|(configuration, rows)| {
            let model = rows.first().and_then(|row| row.model.clone());
            ModelFriction {
                configuration,
                model: model.unwrap_or_else(|| UNKNOWN_MODEL.to_owned()),
                friction: fuse(parts(rows), self.friction_config(), now),
            }
        });
        Ok(TerrainFriction {
            models: models.collect(),
            terrain: TerrainRef {
                id: terrain.id,
                revision: terrain.revision,
            },
            name: terrain.name,
            class: terrain.class,
        })
    }

    /// The friction of the cells in an area, row by row. `limit` counts cells; a cell gives one
    /// entry per terrain and robot model.
    pub async fn friction_of_cells(
        &self,
        site: &SiteId,
        area: Area,
        cursor: Option<&str>,
        limit: u32,
    ) -> Result<Page<CellFriction>, AppError> {
        let after = cursor.map(read_cursor).transpose()?;
        let mut tx = self.db().read().await?;
        let row = site_row(&mut tx, site).await?;
        let grid = row.site.grid;
        let corner = |point, parameter| cell_of(&grid, point, parameter);
        let range = CellRange {
            grid_revision: grid.revision,
            min: corner(area.min, "x_min_m")?,
            max: corner(area.max, "x_max_m")?,
            after,
        };
        let rows = db::sums::of_cells(&mut tx, row.pk, range, limit + 1).await?;
        let now = self.clock().now();
        let cells = grouped(
            rows.into_iter()
                .map(|row| ((row.cell.iy, row.cell.ix), row)),
        );
        let cells = page(cells.into_iter().collect(), limit, |((iy, ix), _rows)| {
            format!("{ix},{iy}")
        });
        let mut items = Vec::new();
        for (_place, rows) in cells.items {
            let ground = |row: SumRow| ((row.terrain.clone(), row.configuration), row);
            for ((terrain, configuration), rows) in grouped(rows.into_iter().map(ground)) {
                let cell = rows.first().map(|row| row.cell);
                let fused = fuse(parts(rows), self.friction_config(), now);
                if let (Some(cell), Some(friction)) = (cell, fused) {
                    items.push(CellFriction {
                        cell,
                        terrain,
                        configuration,
                        friction,
                    });
                }
            }
        }
        Ok(Page {
            items,
            next_cursor: cells.next_cursor,
        })
    }
}

fn parts(
    rows: Vec<SumRow>,
) -> impl Iterator<Item = (tread_api::ids::RobotId, crate::friction::Sums)> {
    rows.into_iter().map(|row| (row.robot, row.sums))
}

fn cell_of(grid: &Grid, point: Point, parameter: &'static str) -> Result<Cell, AppError> {
    let off_the_map = || AppError::InvalidQuery {
        parameter,
        detail: "the area must be on the map, within 1e6 m of the origin".to_owned(),
    };
    grid.cell_at(point).ok_or_else(off_the_map)
}

fn read_cursor(cursor: &str) -> Result<Cell, AppError> {
    let cell = cursor.split_once(',').and_then(|(ix, iy)| {
        Some(Cell {
            ix: ix.parse().ok()?,
            iy: iy.parse().ok()?,
        })
    });
    cell.ok_or_else(|| super::bad_cursor(cursor))
}
