//! Converts site coordinates to WGS 84. The site's plane is tangent to the ellipsoid at the origin.
//!
//! A point (x, y) is rotated into east and north, transformed to the earth-centred, earth-fixed
//! frame, and converted to latitude and longitude. Height is ignored: at 10 km from the origin the
//! plane is 8 m above the ellipsoid, which gives a horizontal error of 1 cm.

use tread_api::geometry::Point;
use tread_api::site::GeoOrigin;

/// Semi-major axis of the WGS 84 ellipsoid, metres.
const A_M: f64 = 6_378_137.0;
/// Flattening of the WGS 84 ellipsoid.
const F: f64 = 1.0 / 298.257_223_563;
/// Squared first eccentricity of the WGS 84 ellipsoid.
const E2: f64 = F * (2.0 - F);
/// Number of iterations for the latitude; each gains at least two digits.
const ROUNDS: u32 = 6;

/// `[longitude, latitude]` in degrees, the order of GeoJSON.
pub type LonLat = [f64; 2];

/// Converts `point` in the site frame to WGS 84, given the site's origin.
pub fn to_wgs84(origin: GeoOrigin, point: Point) -> LonLat {
    let (sin_turn, cos_turn) = origin.x_axis_deg.to_radians().sin_cos();
    let east = point.x_m * cos_turn - point.y_m * sin_turn;
    let north = point.x_m * sin_turn + point.y_m * cos_turn;
    let (sin_lat, cos_lat) = origin.latitude_deg.to_radians().sin_cos();
    let (sin_lon, cos_lon) = origin.longitude_deg.to_radians().sin_cos();
    let radius = A_M / (1.0 - E2 * sin_lat * sin_lat).sqrt();
    let x = (radius * cos_lat - north * sin_lat) * cos_lon - east * sin_lon;
    let y = (radius * cos_lat - north * sin_lat) * sin_lon + east * cos_lon;
    let z = radius * (1.0 - E2) * sin_lat + north * cos_lat;
    let axis = x.hypot(y);
    let mut latitude = z.atan2(axis * (1.0 - E2));
    for _ in 0..ROUNDS {
        let sin = latitude.sin();
        let normal = A_M / (1.0 - E2 * sin * sin).sqrt();
        latitude = (z + E2 * normal * sin).atan2(axis);
    }
    [y.atan2(x).to_degrees(), latitude.to_degrees()]
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn origin(latitude_deg: f64, longitude_deg: f64, x_axis_deg: f64) -> GeoOrigin {
        GeoOrigin {
            latitude_deg,
            longitude_deg,
            x_axis_deg,
        }
    }

    #[test]
    fn a_hundred_metres_are_as_many_degrees_as_the_tables_say() {
        // Lengths of a degree at 52° north: 111 267.9 m of latitude, 68 677.7 m of longitude.
        let from = origin(52.0, 4.0, 0.0);
        let [lon, lat] = to_wgs84(
            from,
            Point {
                x_m: 100.0,
                y_m: 0.0,
            },
        );
        assert!(((lon - 4.0) * 68_677.7 - 100.0).abs() < 0.01, "{lon}");
        assert!((lat - 52.0).abs() < 1e-8, "{lat}");
        let [lon, lat] = to_wgs84(
            from,
            Point {
                x_m: 0.0,
                y_m: 100.0,
            },
        );
        assert!(((lat - 52.0) * 111_267.9 - 100.0).abs() < 0.01, "{lat}");
        assert!((lon - 4.0).abs() < 1e-12, "{lon}");
        // A site whose x axis points north.
        let turned = to_wgs84(
            origin(52.0, 4.0, 90.0),
            Point {
                x_m: 100.0,
                y_m: 0.0,
            },
        );
        assert!((turned[1] - lat).abs() < 1e-12, "{turned:?}");
    }

    proptest! {
        #[test]
        fn distances_on_the_earth_are_those_of_the_site(
            latitude in -80.0_f64..80.0, longitude in -179.0_f64..179.0, turn in -180.0_f64..180.0,
            x_m in -2_000.0_f64..2_000.0, y_m in -2_000.0_f64..2_000.0,
        ) {
            let from = origin(latitude, longitude, turn);
            let [lon, lat] = to_wgs84(from, Point { x_m, y_m });
            // Expected values from the radii of curvature at the origin.
            let sin = latitude.to_radians().sin();
            let root = (1.0 - E2 * sin * sin).sqrt();
            let north = (lat - latitude).to_radians() * A_M * (1.0 - E2) / root.powi(3);
            let east = (lon - longitude).to_radians() * A_M / root * lat.to_radians().cos();
            let distance = x_m.hypot(y_m);
            prop_assert!((north.hypot(east) - distance).abs() < 1e-3 * distance + 1e-3);
        }
    }
}
