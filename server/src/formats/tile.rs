//! Encodes the map as a compact binary tile, see [`tread_api::tile`].

use tread_api::tile::{Tile, TileSquare};

use crate::friction::Raster;
use crate::friction::index::CellSummary;

/// Returns the encoded tile.
pub fn encode(raster: &Raster) -> Vec<u8> {
    let square = |square: &CellSummary| {
        square.known().map(|known| TileSquare {
            theta: known.theta,
            std_dev: known.std_dev,
            segments: known.segments,
        })
    };
    let tile = Tile {
        columns: u32::try_from(raster.columns).unwrap_or(u32::MAX),
        rows: u32::try_from(raster.rows).unwrap_or(u32::MAX),
        first: raster.first,
        size_m: raster.size_m,
        as_of_us: raster.as_of_us,
        grid_revision: raster.site.grid.revision,
        configuration: raster.configuration,
        normalisation: raster.normalisation.clone(),
        squares: Vec::new(),
    };
    tile.encode_with(raster.squares.iter().map(square))
}
