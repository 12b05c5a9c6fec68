//! Terrains: named polygons with a class.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::geometry::{Point, Polygon};
use crate::ids::TerrainId;

/// Most terrains of one site; each robot carries them all.
pub const TERRAINS_MAX: usize = 1_000;

/// What kind of ground a terrain is.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, ToSchema,
)]
#[serde(rename_all = "snake_case")]
#[expect(missing_docs, reason = "the names say it")]
pub enum TerrainClass {
    Asphalt,
    Concrete,
    Paving,
    Gravel,
    Soil,
    Grass,
    Sand,
    Mud,
    Snow,
    Ice,
    Wood,
    Metal,
    Other,
}

/// A terrain as the server keeps it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Terrain {
    /// The terrain's identifier within its site.
    pub id: TerrainId,
    /// Counts changes of this terrain; a segment names the one it was measured on.
    pub revision: u32,
    /// Name for people.
    pub name: String,
    /// Kind of ground.
    pub class: TerrainClass,
    /// Where it lies.
    pub polygon: Polygon,
    /// Where terrains overlap the higher layer counts; of equal ones the smaller identifier.
    pub layer: i32,
    /// When this revision was written.
    pub updated_at: Timestamp,
}

/// The body of `POST /v1/sites/{site}/terrains`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct CreateTerrain {
    /// The identifier to use, unique within the site.
    pub id: TerrainId,
    /// Name for people; the identifier when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    /// Kind of ground.
    pub class: TerrainClass,
    /// Where it lies: 3 to 1000 corners of a simple polygon.
    pub polygon: Polygon,
    /// Where terrains overlap the higher layer counts; 0 when absent.
    #[serde(default)]
    pub layer: i32,
}

/// The body of `PUT /v1/sites/{site}/terrains/{terrain}`: replaces everything but the identifier.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct ReplaceTerrain {
    /// Name for people; the identifier when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    /// Kind of ground.
    pub class: TerrainClass,
    /// Where it lies: 3 to 1000 corners of a simple polygon.
    pub polygon: Polygon,
    /// Where terrains overlap the higher layer counts; 0 when absent.
    #[serde(default)]
    pub layer: i32,
}

/// Which revision of which terrain a measurement belongs to.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, ToSchema)]
pub struct TerrainRef {
    /// The terrain.
    pub id: TerrainId,
    /// Its revision at the time.
    pub revision: u32,
}

/// The part of a terrain that a robot needs to tell on which one it drives.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct TerrainShape {
    /// The terrain and its revision.
    pub terrain: TerrainRef,
    /// Where it lies.
    pub polygon: Polygon,
    /// Where terrains overlap the higher layer counts; of equal ones the smaller identifier.
    pub layer: i32,
}

/// The terrain under a point: the highest layer, of equal ones the smaller identifier.
pub fn terrain_at(shapes: &[TerrainShape], point: Point) -> Option<&TerrainShape> {
    shapes
        .iter()
        .filter(|shape| shape.polygon.contains(point))
        .min_by(|left, right| {
            let by_layer = right.layer.cmp(&left.layer);
            by_layer.then_with(|| left.terrain.id.cmp(&right.terrain.id))
        })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn square(id: &str, half_m: f64, layer: i32) -> TerrainShape {
        let corner = |x: f64, y: f64| Point {
            x_m: half_m * x,
            y_m: half_m * y,
        };
        let corners = vec![
            corner(-1.0, -1.0),
            corner(1.0, -1.0),
            corner(1.0, 1.0),
            corner(-1.0, 1.0),
        ];
        TerrainShape {
            terrain: TerrainRef {
                id: id.parse().unwrap(),
                revision: 1,
            },
            polygon: Polygon::new(corners).unwrap(),
            layer,
        }
    }

    #[test]
    fn the_higher_layer_counts_where_terrains_overlap() {
        let shapes = [
            square("yard", 10.0, 0),
            square("lawn", 2.0, 1),
            square("zone", 5.0, 0),
        ];
        let at =
            |x_m: f64| terrain_at(&shapes, Point { x_m, y_m: 0.0 }).map(|s| s.terrain.id.as_str());
        assert_eq!(at(0.0), Some("lawn"));
        assert_eq!(
            at(4.0),
            Some("yard"),
            "equal layers: the smaller identifier"
        );
        assert_eq!(at(11.0), None);
    }
}
