//! The site definition prepared for the loop: finds cell and terrain of a position without
//! allocating.

use tread_api::geometry::Point;
use tread_api::site::{Cell, Grid};
use tread_api::terrain::TerrainRef;
use tread_api::wire::hello::SiteDefinition;
use tread_control::fence::Fence;
use tread_control::geometry::{BoundingBox, Pose};
use tread_control::robot::RobotModel;

use crate::geometry::{control_point, fence_of};

/// Distance outside its cell up to which a robot keeps it, metres: more than the position noise, so
/// that a path along a border does not split its segments.
const CELL_MARGIN_M: f64 = 0.05;

/// Ground under the wheels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum GroundUnderWheels {
    /// All wheels on one terrain, as its index in the definition; `None` where no terrain is drawn.
    Whole(Option<usize>),
    /// Wheels on different terrains.
    Mixed,
}

/// A site definition prepared for look-ups.
#[derive(Debug)]
pub(crate) struct SiteView {
    definition: SiteDefinition,
    fence: Fence,
    bounds: Vec<BoundingBox>,
    /// Indices of the terrains: highest layer first, then by identifier.
    order: Vec<usize>,
    /// Whether the fence leaves no room anywhere, regardless of the definition.
    is_without_room: bool,
}

impl SiteView {
    pub(crate) fn new(definition: SiteDefinition) -> Self {
        let terrains = &definition.terrains;
        let bounds = terrains
            .iter()
            .map(|shape| {
                let corners = shape.polygon.corners().iter();
                BoundingBox::around(corners.map(|corner| control_point(*corner)))
            })
            .collect();
        let mut order: Vec<usize> = (0..terrains.len()).collect();
        order.sort_by(|&left, &right| {
            let (left, right) = (&terrains[left], &terrains[right]);
            right
                .layer
                .cmp(&left.layer)
                .then_with(|| left.terrain.id.cmp(&right.terrain.id))
        });
        let fence = fence_of(&definition.geofence);
        Self {
            definition,
            fence,
            bounds,
            order,
            is_without_room: false,
        }
    }

    /// Creates a view without room for a robot anywhere, for a geofence that cannot be applied.
    pub(crate) fn without_room(mut definition: SiteDefinition) -> Self {
        let revision = std::mem::take(&mut definition.geofence).revision;
        let mut view = Self::new(definition);
        view.definition.geofence.revision = revision;
        view.fence = Fence::without_allowed_ground();
        view.is_without_room = true;
        view
    }

    /// Whether the view was made by [`SiteView::without_room`].
    pub(crate) fn is_without_room(&self) -> bool {
        self.is_without_room
    }

    pub(crate) fn definition(&self) -> &SiteDefinition {
        &self.definition
    }

    pub(crate) fn grid(&self) -> Grid {
        self.definition.grid
    }

    pub(crate) fn terrain_revision(&self) -> u64 {
        self.definition.terrain_revision
    }

    /// Returns the geofence, the area in which the robot may be.
    pub(crate) fn fence(&self) -> &Fence {
        &self.fence
    }

    pub(crate) fn fence_revision(&self) -> u64 {
        self.definition.geofence.revision
    }

    /// Returns the terrain at an index of the definition.
    pub(crate) fn terrain(&self, place: usize) -> Option<&TerrainRef> {
        self.definition
            .terrains
            .get(place)
            .map(|shape| &shape.terrain)
    }

    fn terrain_at(&self, point: Point) -> Option<usize> {
        let within = control_point(point);
        self.order.iter().copied().find(|&place| {
            self.bounds[place].contains(within)
                && self.definition.terrains[place].polygon.contains(point)
        })
    }

    /// Returns the terrain under the four wheels.
    pub(crate) fn ground_under_wheels(&self, pose: Pose, model: &RobotModel) -> GroundUnderWheels {
        let (sin, cos) = pose.heading_rad.sin_cos();
        let (forward_m, left_m) = (0.5 * model.wheelbase_m(), 0.5 * model.track_width_m());
        let under = |forward_m: f64, left_m: f64| {
            self.terrain_at(Point {
                x_m: pose.x_m + forward_m * cos - left_m * sin,
                y_m: pose.y_m + forward_m * sin + left_m * cos,
            })
        };
        let first = under(forward_m, left_m);
        let others = [
            (forward_m, -left_m),
            (-forward_m, left_m),
            (-forward_m, -left_m),
        ];
        if others
            .into_iter()
            .all(|(forward_m, left_m)| under(forward_m, left_m) == first)
        {
            GroundUnderWheels::Whole(first)
        } else {
            GroundUnderWheels::Mixed
        }
    }

    /// Returns the cell of a position; the former cell within [`CELL_MARGIN_M`] of it.
    pub(crate) fn cell(&self, position: Point, former: Option<Cell>) -> Option<Cell> {
        let grid = self.grid();
        let is_near = |cell: &Cell| {
            let center = grid.center_of(*cell);
            let reach_m = 0.5 * grid.cell_m + CELL_MARGIN_M;
            (position.x_m - center.x_m).abs() <= reach_m
                && (position.y_m - center.y_m).abs() <= reach_m
        };
        former.filter(is_near).or_else(|| grid.cell_at(position))
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use tread_api::geometry::Polygon;
    use tread_api::safety::Geofence;
    use tread_api::terrain::{TerrainShape, terrain_at};

    use super::*;

    fn square(id: &str, x_m: f64, half_m: f64, layer: i32) -> TerrainShape {
        let corner = |dx: f64, dy: f64| Point {
            x_m: x_m + half_m * dx,
            y_m: half_m * dy,
        };
        let corners = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)];
        let corners = corners.into_iter().map(|(dx, dy)| corner(dx, dy)).collect();
        TerrainShape {
            terrain: TerrainRef {
                id: id.parse().unwrap(),
                revision: 1,
            },
            polygon: Polygon::new(corners).unwrap(),
            layer,
        }
    }

    fn site(terrains: Vec<TerrainShape>) -> SiteDefinition {
        let grid = Grid {
            revision: 1,
            cell_m: 1.0,
        };
        SiteDefinition {
            grid,
            terrain_revision: 3,
            terrains,
            geofence: Geofence::default(),
        }
    }

    proptest! {
        #[test]
        fn the_loop_and_the_wire_agree_on_the_terrain(
            squares in prop::collection::vec((-5.0..5.0_f64, 0.5..6.0_f64, 0..3), 0..6),
            x_m in -8.0..8.0_f64,
            y_m in -8.0..8.0_f64,
        ) {
            let shapes: Vec<TerrainShape> = squares
                .into_iter()
                .enumerate()
                .map(|(index, (x_m, half_m, layer))| square(&format!("t{index}"), x_m, half_m, layer))
                .collect();
            let point = Point { x_m, y_m };
            let expected = terrain_at(&shapes, point).map(|shape| shape.terrain.clone());
            let view = SiteView::new(site(shapes));
            let found = view.terrain_at(point).and_then(|place| view.terrain(place)).cloned();
            prop_assert_eq!(found, expected);
        }
    }

    #[test]
    fn wheels_on_two_terrains_have_no_single_footing() {
        let view = SiteView::new(site(vec![square("a", 0.0, 2.0, 0)]));
        let model = RobotModel::yi2007();
        let at = |x_m: f64| {
            view.ground_under_wheels(
                Pose {
                    x_m,
                    y_m: 0.0,
                    heading_rad: 0.3,
                },
                &model,
            )
        };
        assert_eq!(at(0.0), GroundUnderWheels::Whole(Some(0)));
        assert_eq!(at(2.0), GroundUnderWheels::Mixed);
        assert_eq!(at(3.0), GroundUnderWheels::Whole(None));
    }

    #[test]
    fn a_robot_on_the_border_of_a_cell_stays_in_it() {
        let view = SiteView::new(site(Vec::new()));
        let first = view.cell(
            Point {
                x_m: 0.99,
                y_m: 0.5,
            },
            None,
        );
        assert_eq!(first, Some(Cell { ix: 0, iy: 0 }));
        assert_eq!(
            view.cell(
                Point {
                    x_m: 1.03,
                    y_m: 0.5
                },
                first
            ),
            first
        );
        let next = view.cell(
            Point {
                x_m: 1.06,
                y_m: 0.5,
            },
            first,
        );
        assert_eq!(next, Some(Cell { ix: 1, iy: 0 }));
    }
}
