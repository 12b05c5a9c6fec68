//! The terrains as they are drawn: which ground lies under a point, and whether what was measured on
//! a ground counts there.

use tread_api::geometry::Point;
use tread_api::ids::TerrainId;
use tread_api::terrain::{Terrain, TerrainRef, TerrainShape, terrain_at};

use super::{SiteView, terrain_ref};
use crate::friction::index::GROUND_NONE;

/// Whether what was measured on a ground counts where this terrain is drawn now.
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

/// The terrains as they are drawn, to find the one under a point.
pub(super) struct Drawn<'view> {
    pub(super) terrains: &'view [Terrain],
    shapes: Vec<TerrainShape>,
}

impl<'view> Drawn<'view> {
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

    /// The number of a ground that measurements name; `None` where it is drawn no more.
    pub(super) fn ground_of(&self, view: &SiteView, found: Option<&TerrainRef>) -> Option<u16> {
        let Some(found) = found else {
            return Some(GROUND_NONE);
        };
        let place = self.place(&found.id)?;
        view.is_present(found).then_some(place)
    }

    /// The number of a terrain, from 1.
    fn place(&self, id: &TerrainId) -> Option<u16> {
        let place = self.terrains.iter().position(|terrain| terrain.id == *id)?;
        u16::try_from(place + 1).ok()
    }

    /// Terrains whose outlines come near a box.
    pub(super) fn near(&self, low: Point, high: Point) -> Near<'view> {
        let touches = |terrain: &Terrain| {
            let corners = terrain.polygon.corners();
            let span = |of: fn(&Point) -> f64| {
                let values = corners.iter().map(of);
                let least = values.clone().fold(f64::INFINITY, f64::min);
                (least, values.fold(f64::NEG_INFINITY, f64::max))
            };
            let (x, y) = (span(|corner| corner.x_m), span(|corner| corner.y_m));
            x.0 <= high.x_m && x.1 >= low.x_m && y.0 <= high.y_m && y.1 >= low.y_m
        };
        let mut found: Vec<(u16, &'view Terrain)> = (1..)
            .zip(self.terrains)
            .filter(|(_, terrain)| touches(terrain))
            .collect();
        // As `terrain_at` has it: the higher layer counts, of equal ones the smaller identifier.
        found.sort_by(|(_, left), (_, right)| {
            let by_layer = right.layer.cmp(&left.layer);
            by_layer.then_with(|| left.id.cmp(&right.id))
        });
        Near { found }
    }
}

/// Terrains that a box touches, in the order in which they count.
pub(super) struct Near<'view> {
    found: Vec<(u16, &'view Terrain)>,
}

impl Near<'_> {
    /// The number of the ground at a point.
    pub(super) fn ground_at(&self, point: Point) -> u16 {
        let mut here = self.found.iter();
        here.find(|(_, terrain)| terrain.polygon.contains(point))
            .map_or(GROUND_NONE, |&(number, _)| number)
    }
}
