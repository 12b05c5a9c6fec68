//! The terrains in their present shape: finds the terrain at a point, and whether a measurement
//! applies to it.

use tread_api::geometry::Point;
use tread_api::ids::TerrainId;
use tread_api::terrain::{Terrain, TerrainRef, TerrainShape, terrain_at};

use super::area::Area;
use super::{SiteView, terrain_ref};
use crate::friction::index::GROUND_NONE;

/// Returns whether a measurement on a ground applies where this terrain is drawn now.
pub(super) fn is_here(
    view: &SiteView,
    measured_on: Option<&TerrainRef>,
    drawn: Option<&Terrain>,
) -> bool {
    match (measured_on, drawn) {
        (None, None) => true,
        (Some(found), Some(terrain)) => found.id == terrain.id && view.is_present(found),
        (None, Some(_)) | (Some(_), None) => false,
    }
}

/// The terrains in their present shape, for finding the one at a point.
pub(super) struct PresentTerrains<'view> {
    pub(super) terrains: &'view [Terrain],
    shapes: Vec<TerrainShape>,
}

impl<'view> PresentTerrains<'view> {
    pub(super) fn new(terrains: &'view [Terrain]) -> Self {
        let shape = |terrain: &Terrain| TerrainShape {
            terrain: terrain_ref(terrain),
            polygon: terrain.polygon.clone(),
            layer: terrain.layer,
        };
        Self {
            terrains,
            shapes: terrains.iter().map(shape).collect(),
        }
    }

    pub(super) fn at(&self, point: Point) -> Option<&'view Terrain> {
        let shape = terrain_at(&self.shapes, point)?;
        self.terrains
            .iter()
            .find(|terrain| terrain.id == shape.terrain.id)
    }

    /// Returns the number of the ground on which a measurement was made; `None` if that ground is
    /// no longer on the map.
    pub(super) fn ground_of(&self, view: &SiteView, found: Option<&TerrainRef>) -> Option<u16> {
        let Some(found) = found else {
            return Some(GROUND_NONE);
        };
        let place = self.place(&found.id)?;
        view.is_present(found).then_some(place)
    }

    /// Returns the number of a terrain, from 1, in the order of the list.
    fn place(&self, id: &TerrainId) -> Option<u16> {
        let place = self.terrains.iter().position(|terrain| terrain.id == *id)?;
        u16::try_from(place + 1).ok()
    }

    /// Returns the terrains whose bounding boxes touch an area.
    pub(super) fn near(&self, area: Area) -> NearbyTerrains<'view> {
        let touches = |terrain: &Terrain| {
            Area::around(terrain.polygon.corners().iter().copied()).touches(&area)
        };
        let mut found: Vec<(u16, &'view Terrain)> = (1..)
            .zip(self.terrains)
            .filter(|(_, terrain)| touches(terrain))
            .collect();
        // Same order as in `terrain_at`: highest layer first, then smallest identifier.
        found.sort_by(|(_, left), (_, right)| {
            let by_layer = right.layer.cmp(&left.layer);
            by_layer.then_with(|| left.id.cmp(&right.id))
        });
        NearbyTerrains { found }
    }
}

/// Terrains whose bounding boxes touch an area, in order of precedence.
pub(super) struct NearbyTerrains<'view> {
    found: Vec<(u16, &'view Terrain)>,
}

impl NearbyTerrains<'_> {
    /// Returns the number of the ground at a point.
    pub(super) fn ground_at(&self, point: Point) -> u16 {
        let mut here = self.found.iter();
        here.find(|(_, terrain)| terrain.polygon.contains(point))
            .map_or(GROUND_NONE, |&(number, _)| number)
    }
}
