//! One polygon of a fence, prepared for distance queries in a control tick.
//!
//! Neighbouring sides form groups, each with a bounding box. A group is skipped if its box is
//! farther away than the nearest side found so far and the ray from the point in the direction of x
//! cannot meet it.

use crate::geometry::{BoundingBox, Point};

/// Number of sides in a group.
const GROUP_SIDES: usize = 12;

/// One side of a polygon, with its inverse squared length.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Side {
    from: Point,
    to: Point,
    inverse_length_1_m2: f64,
}

/// Neighbouring sides with their bounding box.
#[derive(Debug, Clone, PartialEq)]
struct Group {
    bounds: BoundingBox,
    sides: Vec<Side>,
}

/// Nearest point of the border found so far, and its squared distance.
#[derive(Debug, Clone, Copy)]
struct Nearest {
    distance_m2: f64,
    point: Point,
}

impl Group {
    fn new(sides: &[Side]) -> Self {
        let ends = sides.iter().flat_map(|side| [side.from, side.to]);
        Self {
            bounds: BoundingBox::around(ends),
            sides: sides.to_vec(),
        }
    }

    /// Replaces `nearest` if a side of this group has a point nearer to `point`.
    fn refine(&self, point: Point, nearest: &mut Nearest) {
        for side in &self.sides {
            let (from, to) = (side.from, side.to);
            let (side_x, side_y) = (to.x_m - from.x_m, to.y_m - from.y_m);
            let (x_m, y_m) = (point.x_m - from.x_m, point.y_m - from.y_m);
            let fraction =
                ((x_m * side_x + y_m * side_y) * side.inverse_length_1_m2).clamp(0.0, 1.0);
            let (away_x, away_y) = (x_m - fraction * side_x, y_m - fraction * side_y);
            let distance_m2 = away_x * away_x + away_y * away_y;
            if distance_m2 < nearest.distance_m2 {
                *nearest = Nearest {
                    distance_m2,
                    point: Point {
                        x_m: from.x_m + fraction * side_x,
                        y_m: from.y_m + fraction * side_y,
                    },
                };
            }
        }
    }

    /// Returns whether the ray from a point in the direction of x crosses an odd number of the
    /// group's sides.
    fn is_crossed(&self, point: Point) -> bool {
        let mut is_crossed = false;
        for side in &self.sides {
            let (from, to) = (side.from, side.to);
            let (side_x, side_y) = (to.x_m - from.x_m, to.y_m - from.y_m);
            let (x_m, y_m) = (point.x_m - from.x_m, point.y_m - from.y_m);
            // Compares cross products, without a division.
            let is_upward = to.y_m > from.y_m;
            let is_beside = (from.y_m > point.y_m) != (to.y_m > point.y_m);
            is_crossed ^= is_beside && ((x_m * side_y < side_x * y_m) == is_upward);
        }
        is_crossed
    }
}

/// Closed polygon in the site frame; its corners may be in either order.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Polygon {
    groups: Vec<Group>,
    bounds: BoundingBox,
}

impl Polygon {
    /// Creates the closed polygon of these corners; one without corners contains no point.
    pub(super) fn new(corners: &[Point]) -> Self {
        let next = corners.iter().cycle().skip(1);
        let side = |(&from, &to): (&Point, &Point)| Side {
            from,
            to,
            inverse_length_1_m2: from.distance_m(to).powi(2).recip(),
        };
        let sides: Vec<Side> = corners.iter().zip(next).map(side).collect();
        Self {
            groups: sides.chunks(GROUP_SIDES).map(Group::new).collect(),
            bounds: BoundingBox::around(corners.iter().copied()),
        }
    }

    /// Returns a lower bound of the distance from a point outside the polygon to it, metres: the
    /// larger of the distances from the bounding box along the axes; 0 within the box.
    pub(super) fn outside_distance_min_m(&self, point: Point) -> f64 {
        let (x_m, y_m) = self.bounds.axis_distances_m(point);
        x_m.max(y_m)
    }

    /// Returns the signed distance to the border, metres: positive inside, negative outside, −∞ for
    /// a polygon without corners.
    pub(super) fn depth_m(&self, point: Point) -> f64 {
        let mut is_inside = false;
        for group in &self.groups {
            if group.bounds.is_met_by_ray(point) {
                is_inside ^= group.is_crossed(point);
            }
        }
        let distance_m = self.nearest(point).distance_m2.sqrt();
        if is_inside { distance_m } else { -distance_m }
    }

    /// Returns the point of the border that is nearest to `point`.
    pub(super) fn nearest_border_point(&self, point: Point) -> Point {
        self.nearest(point).point
    }

    fn nearest(&self, point: Point) -> Nearest {
        let mut nearest = Nearest {
            distance_m2: f64::INFINITY,
            point,
        };
        // Start with the group whose box is nearest, so that most others can be skipped.
        let by_box = |group: &&Group| group.bounds.distance_m2(point);
        let likely = self
            .groups
            .iter()
            .min_by(|one, other| by_box(one).total_cmp(&by_box(other)));
        if let Some(likely) = likely {
            likely.refine(point, &mut nearest);
        }
        for group in &self.groups {
            if group.bounds.distance_m2(point) < nearest.distance_m2 {
                group.refine(point, &mut nearest);
            }
        }
        nearest
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Computes [`Polygon::depth_m`] without groups.
    fn plain(corners: &[Point], point: Point) -> f64 {
        let next = corners.iter().cycle().skip(1);
        let side = |(&from, &to): (&Point, &Point)| Side {
            from,
            to,
            inverse_length_1_m2: from.distance_m(to).powi(2).recip(),
        };
        let all = Group::new(&corners.iter().zip(next).map(side).collect::<Vec<_>>());
        let mut nearest = Nearest {
            distance_m2: f64::INFINITY,
            point,
        };
        all.refine(point, &mut nearest);
        let distance_m = nearest.distance_m2.sqrt();
        if all.is_crossed(point) {
            distance_m
        } else {
            -distance_m
        }
    }

    proptest! {
        #[test]
        fn groups_change_nothing(
            radii in prop::collection::vec(1.0..20.0_f64, 3..120),
            x_m in -25.0..25.0_f64, y_m in -25.0..25.0_f64,
            is_on_a_corner: bool,
        ) {
            let count = f64::from(u32::try_from(radii.len()).unwrap());
            let corners: Vec<Point> = (0_u32..).zip(&radii).map(|(index, radius_m)| {
                let angle_rad = std::f64::consts::TAU * f64::from(index) / count;
                Point { x_m: radius_m * angle_rad.cos(), y_m: radius_m * angle_rad.sin() }
            }).collect();
            let polygon = Polygon::new(&corners);
            // At the height of a corner, where a ray meets two sides at once.
            let y_m = if is_on_a_corner { corners[0].y_m } else { y_m };
            let point = Point { x_m, y_m };
            let depth_m = polygon.depth_m(point);
            prop_assert!((depth_m - plain(&corners, point)).abs() < 1.0e-12);
            let border = polygon.nearest_border_point(point);
            prop_assert!((border.distance_m(point) - depth_m.abs()).abs() < 1.0e-9);
            prop_assert!(polygon.depth_m(border).abs() < 1.0e-9);
            let least_m = polygon.outside_distance_min_m(point);
            prop_assert!(depth_m > 0.0 || least_m <= -depth_m + 1.0e-9);
        }
    }
}
