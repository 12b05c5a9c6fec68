//! Rectangles of requests.

use tread_api::friction::CellBox;
use tread_api::geometry::{COORDINATE_MAX_M, Point};
use tread_api::site::Grid;

use super::AppError;

/// An axis-aligned rectangle in the site frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Area {
    /// The corner with the lowest coordinates.
    pub min: Point,
    /// The corner with the highest coordinates.
    pub max: Point,
}

/// Bounds of an area, metres; those of the map where there is none.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
#[expect(clippy::struct_field_names, reason = "units stand last in names")]
pub(crate) struct AreaBounds {
    pub(crate) x_min_m: Option<f64>,
    pub(crate) y_min_m: Option<f64>,
    pub(crate) x_max_m: Option<f64>,
    pub(crate) y_max_m: Option<f64>,
}

impl Area {
    /// The whole map.
    pub const WHOLE: Self = Self {
        min: Point {
            x_m: -COORDINATE_MAX_M,
            y_m: -COORDINATE_MAX_M,
        },
        max: Point {
            x_m: COORDINATE_MAX_M,
            y_m: COORDINATE_MAX_M,
        },
    };

    /// Returns the smallest area around some points; the one around none touches no other.
    pub(super) fn around(points: impl IntoIterator<Item = Point>) -> Self {
        let nothing = Self {
            min: Point {
                x_m: f64::INFINITY,
                y_m: f64::INFINITY,
            },
            max: Point {
                x_m: f64::NEG_INFINITY,
                y_m: f64::NEG_INFINITY,
            },
        };
        points.into_iter().fold(nothing, |area, point| Self {
            min: Point {
                x_m: area.min.x_m.min(point.x_m),
                y_m: area.min.y_m.min(point.y_m),
            },
            max: Point {
                x_m: area.max.x_m.max(point.x_m),
                y_m: area.max.y_m.max(point.y_m),
            },
        })
    }

    /// Returns whether the areas have a point in common.
    pub(super) fn touches(&self, other: &Self) -> bool {
        self.min.x_m <= other.max.x_m
            && self.max.x_m >= other.min.x_m
            && self.min.y_m <= other.max.y_m
            && self.max.y_m >= other.min.y_m
    }

    /// Makes an area from bounds.
    ///
    /// # Errors
    /// A bound is not on the map, or a lower bound is above the upper one.
    pub(crate) fn new(bounds: AreaBounds) -> Result<Self, AppError> {
        let Self { min, max } = Self::WHOLE;
        let min = Point {
            x_m: bounds.x_min_m.unwrap_or(min.x_m),
            y_m: bounds.y_min_m.unwrap_or(min.y_m),
        };
        let max = Point {
            x_m: bounds.x_max_m.unwrap_or(max.x_m),
            y_m: bounds.y_max_m.unwrap_or(max.y_m),
        };
        for (parameter, low, high) in [("x_max_m", min.x_m, max.x_m), ("y_max_m", min.y_m, max.y_m)]
        {
            let bounds = -COORDINATE_MAX_M..=COORDINATE_MAX_M;
            if !bounds.contains(&low) || !bounds.contains(&high) {
                return Err(AppError::InvalidQuery {
                    parameter,
                    detail: format!("the box must be within {COORDINATE_MAX_M} m of the origin"),
                });
            }
            if low > high {
                return Err(AppError::InvalidQuery {
                    parameter,
                    detail: format!("the lower bound, {low} m, is above the upper one, {high} m"),
                });
            }
        }
        Ok(Self { min, max })
    }

    /// Returns the cells of the area in a grid with cells of this size.
    pub(super) fn cells(&self, grid: &Grid) -> Result<CellBox, AppError> {
        let cell = |point| {
            grid.cell_at(point).ok_or_else(|| AppError::InvalidQuery {
                parameter: "x_min_m",
                detail: "the box must be on the map".to_owned(),
            })
        };
        Ok(CellBox {
            min: cell(self.min)?,
            max: cell(self.max)?,
        })
    }

    /// Returns the number of squares of side `size_m` in the area; a float, since it may be very
    /// large.
    pub(super) fn count(&self, size_m: f64) -> f64 {
        let count = |low: f64, high: f64| ((high - low) / size_m).floor() + 1.0;
        count(self.min.x_m, self.max.x_m) * count(self.min.y_m, self.max.y_m)
    }
}
