//! Points, bounding boxes, poses and velocities in the plane.

use std::f64::consts::{PI, TAU};

use serde::{Deserialize, Serialize};

/// Point in the site frame; in [`Pose::body_from_site`] also in the body frame.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Point {
    /// East-like coordinate, metres.
    pub x_m: f64,
    /// North-like coordinate, metres.
    pub y_m: f64,
}

impl Point {
    /// Returns the distance to another point, metres.
    pub fn distance_m(self, other: Self) -> f64 {
        (other.x_m - self.x_m).hypot(other.y_m - self.y_m)
    }

    /// Returns the direction from here to another point, radians counter-clockwise from x, in [−π,
    /// π]; 0 if both are equal.
    pub fn bearing_rad(self, other: Self) -> f64 {
        (other.y_m - self.y_m).atan2(other.x_m - self.x_m)
    }

    /// Returns whether both coordinates are finite.
    pub fn is_finite(self) -> bool {
        self.x_m.is_finite() && self.y_m.is_finite()
    }
}

/// Axis-aligned bounding box of some points.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BoundingBox {
    low: Point,
    high: Point,
}

impl BoundingBox {
    /// Returns the smallest box around some points; the box around none contains no point.
    pub fn around(points: impl IntoIterator<Item = Point>) -> Self {
        let nothing = Self {
            low: Point {
                x_m: f64::INFINITY,
                y_m: f64::INFINITY,
            },
            high: Point {
                x_m: f64::NEG_INFINITY,
                y_m: f64::NEG_INFINITY,
            },
        };
        points.into_iter().fold(nothing, |bounds, point| Self {
            low: Point {
                x_m: bounds.low.x_m.min(point.x_m),
                y_m: bounds.low.y_m.min(point.y_m),
            },
            high: Point {
                x_m: bounds.high.x_m.max(point.x_m),
                y_m: bounds.high.y_m.max(point.y_m),
            },
        })
    }

    /// Returns whether a point is in the box or on its border.
    pub fn contains(&self, point: Point) -> bool {
        (self.low.x_m..=self.high.x_m).contains(&point.x_m) && self.spans_y_of(point)
    }

    /// Returns the distance of a point from the box along each axis, `(x, y)`, metres; 0 within.
    pub(crate) fn axis_distances_m(&self, point: Point) -> (f64, f64) {
        let distance_m = |value: f64, low: f64, high: f64| (low - value).max(value - high).max(0.0);
        (
            distance_m(point.x_m, self.low.x_m, self.high.x_m),
            distance_m(point.y_m, self.low.y_m, self.high.y_m),
        )
    }

    /// Returns the squared distance of a point from the box; 0 within.
    pub(crate) fn distance_m2(&self, point: Point) -> f64 {
        let (x_m, y_m) = self.axis_distances_m(point);
        x_m * x_m + y_m * y_m
    }

    /// Returns whether the ray from a point in the direction of x can meet something in the box.
    pub(crate) fn is_met_by_ray(&self, point: Point) -> bool {
        self.spans_y_of(point) && point.x_m <= self.high.x_m
    }

    fn spans_y_of(&self, point: Point) -> bool {
        (self.low.y_m..=self.high.y_m).contains(&point.y_m)
    }
}

/// Position and heading in the site frame.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Pose {
    /// East-like coordinate, metres.
    pub x_m: f64,
    /// North-like coordinate, metres.
    pub y_m: f64,
    /// Heading counter-clockwise from x, radians; not limited to one turn, see [`wrap_angle_rad`].
    pub heading_rad: f64,
}

impl Pose {
    /// Returns the position alone.
    pub fn point(self) -> Point {
        Point {
            x_m: self.x_m,
            y_m: self.y_m,
        }
    }

    /// Returns whether all three values are finite.
    pub fn is_finite(self) -> bool {
        self.point().is_finite() && self.heading_rad.is_finite()
    }

    /// Transforms a point from the site frame to the body frame of this pose: x forward, y to the
    /// left.
    pub fn body_from_site(self, point: Point) -> Point {
        let (sin, cos) = self.heading_rad.sin_cos();
        let (east_m, north_m) = (point.x_m - self.x_m, point.y_m - self.y_m);
        Point {
            x_m: cos * east_m + sin * north_m,
            y_m: cos * north_m - sin * east_m,
        }
    }
}

/// Forward speed and turn rate of a body.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Twist {
    /// Forward speed, metres per second.
    pub linear_m_s: f64,
    /// Turn rate, radians per second, counter-clockwise positive.
    pub angular_rad_s: f64,
}

impl Twist {
    /// Returns whether both values are finite.
    pub fn is_finite(self) -> bool {
        self.linear_m_s.is_finite() && self.angular_rad_s.is_finite()
    }
}

/// Returns the equivalent angle in (−π, π].
pub fn wrap_angle_rad(angle_rad: f64) -> f64 {
    let wrapped = angle_rad.rem_euclid(TAU);
    if wrapped > PI { wrapped - TAU } else { wrapped }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn a_wrapped_angle_points_the_same_way(angle_rad in -1.0e4..1.0e4_f64) {
            let wrapped = wrap_angle_rad(angle_rad);
            prop_assert!(wrapped > -PI - 1.0e-12 && wrapped <= PI);
            prop_assert!((wrapped.sin() - angle_rad.sin()).abs() < 1.0e-9);
            prop_assert!((wrapped.cos() - angle_rad.cos()).abs() < 1.0e-9);
        }

        #[test]
        fn a_point_ahead_is_seen_ahead(
            x_m in -10.0..10.0_f64, y_m in -10.0..10.0_f64, heading_rad in -4.0..4.0_f64
        ) {
            let pose = Pose { x_m, y_m, heading_rad };
            let (sin, cos) = heading_rad.sin_cos();
            let seen = pose.body_from_site(Point { x_m: x_m + 2.0 * cos, y_m: y_m + 2.0 * sin });
            prop_assert!((seen.x_m - 2.0).abs() < 1.0e-9 && seen.y_m.abs() < 1.0e-9);
        }
    }

    #[test]
    fn a_box_contains_its_points_and_one_around_none_contains_nothing() {
        let point = |x_m, y_m| Point { x_m, y_m };
        let corners = [point(1.0, 5.0), point(-2.0, 3.0)];
        let bounds = BoundingBox::around(corners);
        assert!(corners.into_iter().all(|corner| bounds.contains(corner)));
        assert!(bounds.contains(point(0.0, 4.0)));
        for outside in [point(1.1, 4.0), point(0.0, 2.9), point(0.0, 5.1)] {
            assert!(!bounds.contains(outside), "{outside:?}");
        }
        assert!(!BoundingBox::around([]).contains(Point::default()));
    }
}
