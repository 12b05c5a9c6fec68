//! Columns that name a cell and a terrain. The terrain is `''`, of revision 0, where none is drawn.

use tread_api::site::Cell;
use tread_api::terrain::TerrainRef;

use super::{EngineError, corrupt, parse, unsigned};

/// Returns the columns of a terrain: identifier and revision.
pub(super) fn columns(terrain: Option<&TerrainRef>) -> (&str, u32) {
    terrain.map_or(("", 0), |terrain| (terrain.id.as_str(), terrain.revision))
}

/// Reads the columns of a terrain.
pub(super) fn terrain(id: &str, revision: i64) -> Result<Option<TerrainRef>, EngineError> {
    if id.is_empty() {
        return Ok(None);
    }
    Ok(Some(TerrainRef {
        id: parse("terrain", id)?,
        revision: unsigned("terrain revision", revision)?,
    }))
}

/// Reads the columns of a cell.
pub(super) fn cell(ix: i64, iy: i64) -> Result<Cell, EngineError> {
    let index = |value: i64| i32::try_from(value).map_err(|_range| corrupt("cell", value));
    Ok(Cell {
        ix: index(ix)?,
        iy: index(iy)?,
    })
}
