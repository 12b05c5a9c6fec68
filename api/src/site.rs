//! Sites, their grids of cells, and their position in WGS 84.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::geometry::Point;
use crate::ids::SiteId;

/// Minimum side of a cell, metres.
pub const CELL_MIN_M: f64 = 0.1;
/// Maximum side of a cell, metres.
pub const CELL_MAX_M: f64 = 100.0;
/// Maximum length of the name of a site, terrain, robot or base, characters.
pub const NAME_LENGTH_MAX: usize = 200;

/// Revision of a site's first grid.
pub const GRID_REVISION_FIRST: u32 = 1;

/// Grid of square cells in which the friction of a site is stored.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(try_from = "GridFields")]
pub struct Grid {
    /// Number of changes of the grid; a segment names the revision to which its cell refers.
    pub revision: u32,
    /// Side of a cell, metres.
    #[schema(minimum = 0.1, maximum = 100.0, example = 1.0)]
    pub cell_m: f64,
}

impl Grid {
    /// Returns the cell that contains a point; `None` if the point is off the map.
    pub fn cell_at(&self, point: Point) -> Option<Cell> {
        point.is_on_the_map().then(|| {
            #[expect(
                clippy::cast_possible_truncation,
                reason = "within 10^7 cells of the origin"
            )]
            let index = |coordinate_m: f64| (coordinate_m / self.cell_m).floor() as i32;
            Cell {
                ix: index(point.x_m),
                iy: index(point.y_m),
            }
        })
    }

    /// Returns the centre of a cell.
    pub fn center_of(&self, cell: Cell) -> Point {
        let middle = |index: i32| (f64::from(index) + 0.5) * self.cell_m;
        Point {
            x_m: middle(cell.ix),
            y_m: middle(cell.iy),
        }
    }
}

#[derive(Deserialize)]
struct GridFields {
    revision: u32,
    cell_m: f64,
}

/// Error for a cell side that is out of range; contains the side, metres.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[error("cell_m must be {CELL_MIN_M} to {CELL_MAX_M}, not {0}")]
pub struct InvalidGrid(f64);

impl TryFrom<GridFields> for Grid {
    type Error = InvalidGrid;

    fn try_from(GridFields { revision, cell_m }: GridFields) -> Result<Self, InvalidGrid> {
        if (CELL_MIN_M..=CELL_MAX_M).contains(&cell_m) {
            Ok(Self { revision, cell_m })
        } else {
            Err(InvalidGrid(cell_m))
        }
    }
}

/// Cell of a site's grid, by the indices of its column and row from the origin.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, ToSchema,
)]
pub struct Cell {
    /// Column index: the cell spans `ix · cell_m` to `(ix + 1) · cell_m` in x.
    pub ix: i32,
    /// Row index: the cell spans `iy · cell_m` to `(iy + 1) · cell_m` in y.
    pub iy: i32,
}

/// Position of a site's origin in WGS 84, and orientation of the site's frame.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(try_from = "GeoOriginFields")]
pub struct GeoOrigin {
    /// Latitude of the origin in WGS 84, degrees, positive north.
    #[schema(minimum = -90.0, maximum = 90.0)]
    pub latitude_deg: f64,
    /// Longitude of the origin in WGS 84, degrees, positive east.
    #[schema(minimum = -180.0, maximum = 180.0)]
    pub longitude_deg: f64,
    /// Angle from east to the site's x axis, counter-clockwise, degrees; 0 when absent.
    #[schema(minimum = -360.0, maximum = 360.0, default = 0.0)]
    #[serde(default)]
    pub x_axis_deg: f64,
}

#[derive(Deserialize)]
#[expect(clippy::struct_field_names, reason = "units stand last in names")]
struct GeoOriginFields {
    latitude_deg: f64,
    longitude_deg: f64,
    #[serde(default)]
    x_axis_deg: f64,
}

/// Error for a coordinate or angle that is out of range.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[error("{field} must be -{most} to {most}, not {value}")]
pub struct InvalidGeoOrigin {
    field: &'static str,
    most: f64,
    value: f64,
}

impl TryFrom<GeoOriginFields> for GeoOrigin {
    type Error = InvalidGeoOrigin;

    fn try_from(fields: GeoOriginFields) -> Result<Self, InvalidGeoOrigin> {
        let GeoOriginFields {
            latitude_deg,
            longitude_deg,
            x_axis_deg,
        } = fields;
        for (field, value, most) in [
            ("latitude_deg", latitude_deg, 90.0),
            ("longitude_deg", longitude_deg, 180.0),
            ("x_axis_deg", x_axis_deg, 360.0),
        ] {
            if !(-most..=most).contains(&value) {
                return Err(InvalidGeoOrigin { field, most, value });
            }
        }
        Ok(Self {
            latitude_deg,
            longitude_deg,
            x_axis_deg,
        })
    }
}

/// Site as the server stores it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Site {
    /// Identifier of the site, a chunk of every zenoh key.
    pub id: SiteId,
    /// Name, for people.
    pub name: String,
    /// Grid of the friction map.
    pub grid: Grid,
    /// Number of changes of the site's terrains.
    pub terrain_revision: u64,
    /// Number of changes of the site's geofence.
    #[serde(default)]
    pub geofence_revision: u64,
    /// Position in WGS 84; absent if the site is not georeferenced.
    #[serde(default)]
    pub origin: Option<GeoOrigin>,
    /// Time when the site was created.
    pub created_at: Timestamp,
}

/// Body of `POST /v1/sites`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct CreateSite {
    /// Identifier of the new site.
    pub id: SiteId,
    /// Name, for people; equal to the identifier when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    /// Side of a cell, metres; 1 m when absent. It cannot be changed later.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(minimum = 0.1, maximum = 100.0)]
    pub cell_m: Option<f64>,
    /// Position of the site in WGS 84; it can also be set later.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub origin: Option<GeoOrigin>,
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn a_cell_contains_its_centre(ix in -10_000..10_000, iy in -10_000..10_000, cell_m in 0.1..100.0) {
            let grid = Grid { revision: 1, cell_m };
            let cell = Cell { ix, iy };
            prop_assert_eq!(grid.cell_at(grid.center_of(cell)), Some(cell));
        }
    }

    #[test]
    fn a_grid_that_has_no_cells_is_refused_while_parsing() {
        for cell_m in ["0", "-1", "1e-300", "1e9"] {
            let text = format!(r#"{{"revision":1,"cell_m":{cell_m}}}"#);
            let error = serde_json::from_str::<Grid>(&text).unwrap_err();
            assert!(error.to_string().contains("cell_m"), "{error}");
        }
    }

    #[test]
    fn an_origin_beyond_the_earth_is_refused_while_parsing() {
        for (text, named) in [
            (r#"{"latitude_deg":91,"longitude_deg":0}"#, "latitude_deg"),
            (
                r#"{"latitude_deg":0,"longitude_deg":-181}"#,
                "longitude_deg",
            ),
            (
                r#"{"latitude_deg":0,"longitude_deg":0,"x_axis_deg":1e3}"#,
                "x_axis_deg",
            ),
        ] {
            let error = serde_json::from_str::<GeoOrigin>(text).unwrap_err();
            assert!(error.to_string().contains(named), "{error}");
        }
    }

    #[test]
    fn a_point_that_is_no_place_has_no_cell() {
        let grid = Grid {
            revision: 1,
            cell_m: 1.0,
        };
        assert_eq!(
            grid.cell_at(Point {
                x_m: f64::NAN,
                y_m: 0.0
            }),
            None
        );
        assert_eq!(
            grid.cell_at(Point {
                x_m: 0.0,
                y_m: 1.0e9
            }),
            None
        );
    }
}
