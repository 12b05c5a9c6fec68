//! Points, poses, velocities and simple polygons in the frame of a site.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// Maximum absolute value of a coordinate, metres; larger ones are refused. At this distance `f64`
/// resolves 0.1 µm.
pub const COORDINATE_MAX_M: f64 = 1.0e6;
/// Minimum number of corners of a polygon.
pub const CORNERS_MIN: usize = 3;
/// Maximum number of corners of a polygon; bounds the check for crossing sides, whose cost is
/// quadratic.
pub const CORNERS_MAX: usize = 1_000;
/// Minimum area of a polygon, square metres.
pub const AREA_MIN_M2: f64 = 1.0e-2;

/// Point in the site frame.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Point {
    /// East-like coordinate, metres.
    pub x_m: f64,
    /// North-like coordinate, metres.
    pub y_m: f64,
}

impl std::fmt::Display for Point {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(formatter, "({:.2} m, {:.2} m)", self.x_m, self.y_m)
    }
}

impl Point {
    /// Whether both coordinates are finite and within ±[`COORDINATE_MAX_M`].
    pub fn is_on_the_map(&self) -> bool {
        self.x_m.abs() <= COORDINATE_MAX_M && self.y_m.abs() <= COORDINATE_MAX_M
    }

    /// Returns the distance to another point, metres.
    pub fn distance_m(&self, other: Point) -> f64 {
        (other.x_m - self.x_m).hypot(other.y_m - self.y_m)
    }
}

/// Position and heading in the site frame.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Pose {
    /// East-like coordinate, metres.
    pub x_m: f64,
    /// North-like coordinate, metres.
    pub y_m: f64,
    /// Heading, radians counter-clockwise from x, −π to π.
    pub heading_rad: f64,
}

impl Pose {
    /// Returns the position without the heading.
    pub fn position(&self) -> Point {
        Point {
            x_m: self.x_m,
            y_m: self.y_m,
        }
    }
}

/// Velocity in the robot frame.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, ToSchema)]
pub struct Twist {
    /// Forward velocity, m/s, negative backwards.
    pub linear_m_s: f64,
    /// Yaw rate, rad/s, positive counter-clockwise.
    pub angular_rad_s: f64,
}

/// Reason why corners do not form a simple polygon. Corners are numbered from 0.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum InvalidPolygon {
    /// Fewer than [`CORNERS_MIN`] or more than [`CORNERS_MAX`] corners.
    #[error("a polygon has {CORNERS_MIN} to {CORNERS_MAX} corners, this one has {0}")]
    CornerCount(usize),
    /// A corner is not finite or a coordinate is beyond [`COORDINATE_MAX_M`].
    #[error("corner {0} is not within {COORDINATE_MAX_M} m of the origin")]
    OffTheMap(usize),
    /// Two neighbouring corners coincide.
    #[error("corners {0} and {1} are the same point; leave out the closing corner")]
    DuplicateCorner(usize, usize),
    /// Two sides touch or cross.
    #[error(
        "the side from corner {first} at {from} crosses or touches the side from corner {second} \
         at {onto}"
    )]
    SelfCrossing {
        /// Index of the corner at which the first side begins.
        first: usize,
        /// Position of that corner.
        from: Point,
        /// Index of the corner at which the second side begins.
        second: usize,
        /// Position of that corner.
        onto: Point,
    },
    /// The area is below [`AREA_MIN_M2`].
    #[error("the polygon's area is below {AREA_MIN_M2} m²")]
    TooSmall,
}

/// Simple polygon: its corners in order, clockwise or counter-clockwise. The last corner is
/// connected to the first.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(try_from = "Vec<Point>", into = "Vec<Point>")]
#[schema(value_type = Vec<Point>, min_items = 3, max_items = 1000)]
pub struct Polygon(Vec<Point>);

impl Polygon {
    /// Creates a polygon and checks that it is simple.
    ///
    /// # Errors
    /// [`InvalidPolygon`] if there are too few or too many corners, a corner is off the map or
    /// coincides with the next, sides cross or touch, or the area is below [`AREA_MIN_M2`].
    pub fn new(corners: Vec<Point>) -> Result<Self, InvalidPolygon> {
        let count = corners.len();
        if !(CORNERS_MIN..=CORNERS_MAX).contains(&count) {
            return Err(InvalidPolygon::CornerCount(count));
        }
        if let Some(index) = corners.iter().position(|corner| !corner.is_on_the_map()) {
            return Err(InvalidPolygon::OffTheMap(index));
        }
        let side = |index: usize| Side {
            from: corners[index],
            to: corners[(index + 1) % count],
        };
        let has_no_length = |&index: &usize| side(index).from == side(index).to;
        if let Some(index) = (0..count).find(has_no_length) {
            return Err(InvalidPolygon::DuplicateCorner(index, (index + 1) % count));
        }
        for first in 0..count {
            for second in first + 1..count {
                let neighbours = second == first + 1 || (first == 0 && second == count - 1);
                let crossing = if neighbours {
                    side(first).folds_back(side(second))
                } else {
                    side(first).touches(side(second))
                };
                if crossing {
                    return Err(InvalidPolygon::SelfCrossing {
                        first,
                        from: side(first).from,
                        second,
                        onto: side(second).from,
                    });
                }
            }
        }
        let polygon = Self(corners);
        if polygon.area_m2() < AREA_MIN_M2 {
            Err(InvalidPolygon::TooSmall)
        } else {
            Ok(polygon)
        }
    }

    /// Returns the corners in order.
    pub fn corners(&self) -> &[Point] {
        &self.0
    }

    /// Returns the enclosed area, square metres.
    pub fn area_m2(&self) -> f64 {
        let origin = self.0[0];
        let doubled: f64 = self
            .0
            .windows(2)
            .map(|pair| {
                let side = Side {
                    from: origin,
                    to: pair[0],
                };
                side.cross(pair[1])
            })
            .sum();
        doubled.abs() / 2.0
    }

    /// Whether a point lies inside. For a point on the border the result is unspecified.
    pub fn contains(&self, point: Point) -> bool {
        let mut inside = false;
        let mut from = self.0[self.0.len() - 1];
        for &to in &self.0 {
            if (from.y_m > point.y_m) != (to.y_m > point.y_m) {
                let ratio = (point.y_m - from.y_m) / (to.y_m - from.y_m);
                if point.x_m < from.x_m + ratio * (to.x_m - from.x_m) {
                    inside = !inside;
                }
            }
            from = to;
        }
        inside
    }
}

impl TryFrom<Vec<Point>> for Polygon {
    type Error = InvalidPolygon;

    fn try_from(corners: Vec<Point>) -> Result<Self, InvalidPolygon> {
        Self::new(corners)
    }
}

impl From<Polygon> for Vec<Point> {
    fn from(polygon: Polygon) -> Self {
        polygon.0
    }
}

/// Side of a polygon, or of a triangle.
#[derive(Debug, Clone, Copy)]
struct Side {
    from: Point,
    to: Point,
}

impl Side {
    /// Returns twice the signed area of the triangle with a third point; positive when that lies to
    /// the left.
    fn cross(self, point: Point) -> f64 {
        let Self { from, to } = self;
        (to.x_m - from.x_m) * (point.y_m - from.y_m) - (to.y_m - from.y_m) * (point.x_m - from.x_m)
    }

    /// Whether two sides without a common corner have a point in common.
    fn touches(self, other: Self) -> bool {
        let (from, to) = (self.cross(other.from), self.cross(other.to));
        let (own_from, own_to) = (other.cross(self.from), other.cross(self.to));
        let opposite = |left: f64, right: f64| (left > 0.0) != (right > 0.0);
        if from != 0.0 && to != 0.0 && own_from != 0.0 && own_to != 0.0 {
            return opposite(from, to) && opposite(own_from, own_to);
        }
        (from == 0.0 && self.has_in_box(other.from))
            || (to == 0.0 && self.has_in_box(other.to))
            || (own_from == 0.0 && other.has_in_box(self.from))
            || (own_to == 0.0 && other.has_in_box(self.to))
    }

    /// Whether two neighbouring sides overlap, instead of sharing only their corner.
    fn folds_back(self, other: Self) -> bool {
        let (start, shared, end) = if self.to == other.from {
            (self.from, self.to, other.to)
        } else {
            (self.to, self.from, other.from)
        };
        let along = (start.x_m - shared.x_m) * (end.x_m - shared.x_m)
            + (start.y_m - shared.y_m) * (end.y_m - shared.y_m);
        let side = Self {
            from: start,
            to: shared,
        };
        side.cross(end) == 0.0 && along > 0.0
    }

    /// Whether a point lies in the box around the side.
    fn has_in_box(self, point: Point) -> bool {
        let Self { from, to } = self;
        let between =
            |low: f64, high: f64, value: f64| value >= low.min(high) && value <= low.max(high);
        between(from.x_m, to.x_m, point.x_m) && between(from.y_m, to.y_m, point.y_m)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn polygon(corners: &[(f64, f64)]) -> Result<Polygon, InvalidPolygon> {
        Polygon::new(
            corners
                .iter()
                .map(|&(x_m, y_m)| Point { x_m, y_m })
                .collect(),
        )
    }

    #[test]
    fn a_bow_tie_is_refused_with_the_sides_that_cross() {
        let bow_tie = polygon(&[(0.0, 0.0), (2.0, 2.0), (2.0, 0.0), (0.0, 2.0)]);
        let refused = bow_tie.unwrap_err().to_string();
        for part in [
            "corner 0 at (0.00 m, 0.00 m)",
            "corner 2 at (2.00 m, 0.00 m)",
        ] {
            assert!(refused.contains(part), "{refused}");
        }
    }

    #[test]
    fn sides_that_touch_or_fold_back_are_refused() {
        let touching = polygon(&[(0.0, 0.0), (4.0, 0.0), (4.0, 2.0), (2.0, 0.0), (0.0, 2.0)]);
        assert!(
            matches!(touching, Err(InvalidPolygon::SelfCrossing { .. })),
            "{touching:?}"
        );
        let folded = polygon(&[(0.0, 0.0), (4.0, 0.0), (2.0, 0.0), (2.0, 2.0)]);
        assert!(
            matches!(folded, Err(InvalidPolygon::SelfCrossing { .. })),
            "{folded:?}"
        );
    }

    #[test]
    fn corners_that_make_no_polygon_are_refused() {
        assert_eq!(
            polygon(&[(0.0, 0.0), (1.0, 0.0)]),
            Err(InvalidPolygon::CornerCount(2))
        );
        let closed = polygon(&[(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 0.0)]);
        assert_eq!(closed, Err(InvalidPolygon::DuplicateCorner(3, 0)));
        let nan = polygon(&[(0.0, 0.0), (f64::NAN, 0.0), (1.0, 1.0)]);
        assert_eq!(nan, Err(InvalidPolygon::OffTheMap(1)));
        let tiny = polygon(&[(0.0, 0.0), (0.01, 0.0), (0.0, 0.01)]);
        assert_eq!(tiny, Err(InvalidPolygon::TooSmall));
    }

    proptest! {
        #[test]
        fn a_star_shaped_polygon_is_simple_and_contains_its_centre(
            radii in prop::collection::vec(0.5_f64..20.0, 3..24),
            x_m in -1000.0_f64..1000.0,
            y_m in -1000.0_f64..1000.0,
            clockwise: bool,
        ) {
            let count = radii.len();
            let mut corners: Vec<Point> = radii
                .iter()
                .enumerate()
                .map(|(index, radius)| {
                    #[expect(clippy::cast_precision_loss, reason = "two dozen corners")]
                    let angle = std::f64::consts::TAU * index as f64 / count as f64;
                    Point { x_m: x_m + radius * angle.cos(), y_m: y_m + radius * angle.sin() }
                })
                .collect();
            if clockwise {
                corners.reverse();
            }
            let polygon = Polygon::new(corners).unwrap();
            let centre = Point { x_m, y_m };
            prop_assert!(polygon.contains(centre));
            let outside = Point { x_m: x_m + 21.0, y_m };
            prop_assert!(!polygon.contains(outside));
        }
    }
}
