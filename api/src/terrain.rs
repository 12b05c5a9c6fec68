//! Terrains: named polygons of a site, each with a class of ground.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::geometry::{Point, Polygon};
use crate::ids::TerrainId;

/// Maximum number of terrains of one site; every robot stores them all.
pub const TERRAINS_MAX: usize = 1_000;

/// Class of ground of a terrain.
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

/// Terrain as the server stores it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Terrain {
    /// Identifier of the terrain within its site.
    pub id: TerrainId,
    /// Number of changes of this terrain; a segment names the revision on which it was measured.
    pub revision: u32,
    /// Name, for people.
    pub name: String,
    /// Class of the ground.
    pub class: TerrainClass,
    /// Border of the terrain in the site frame.
    pub polygon: Polygon,
    /// Layer. Where terrains overlap, the highest layer applies; at equal layers, the smaller
    /// identifier.
    pub layer: i32,
    /// Time when this revision was written.
    pub updated_at: Timestamp,
}

/// Body of `POST /v1/sites/{site}/terrains`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct CreateTerrain {
    /// Identifier of the new terrain, unique within the site.
    pub id: TerrainId,
    /// Name, for people; equal to the identifier when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    /// Class of the ground.
    pub class: TerrainClass,
    /// Border of the terrain in the site frame: 3 to 1000 corners of a simple polygon.
    pub polygon: Polygon,
    /// Layer; 0 when absent. Where terrains overlap, the highest layer applies.
    #[serde(default)]
    pub layer: i32,
}

/// Body of `PUT /v1/sites/{site}/terrains/{terrain}`, which replaces everything but the identifier.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct ReplaceTerrain {
    /// Name, for people; equal to the identifier when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    /// Class of the ground.
    pub class: TerrainClass,
    /// Border of the terrain in the site frame: 3 to 1000 corners of a simple polygon.
    pub polygon: Polygon,
    /// Layer; 0 when absent. Where terrains overlap, the highest layer applies.
    #[serde(default)]
    pub layer: i32,
}

/// Reference to one revision of a terrain.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, ToSchema)]
pub struct TerrainRef {
    /// Identifier of the terrain.
    pub id: TerrainId,
    /// Revision of the terrain.
    pub revision: u32,
}

/// Shape of a terrain, from which a robot determines the terrain under it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct TerrainShape {
    /// Terrain and its revision.
    pub terrain: TerrainRef,
    /// Border of the terrain in the site frame.
    pub polygon: Polygon,
    /// Layer. Where terrains overlap, the highest layer applies; at equal layers, the smaller
    /// identifier.
    pub layer: i32,
}

/// Returns the terrain under a point: that of the highest layer, at equal layers that of the
/// smaller identifier. `None` where there is no terrain.
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
