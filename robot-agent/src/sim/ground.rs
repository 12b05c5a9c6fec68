//! The true ground under a simulated robot: each side stands on the terrain under it.

use tread_api::geometry::{Point, Polygon};
use tread_control::friction::FrictionCurve;
use tread_control::geometry::Pose;
use tread_control::plant::Ground;

use super::scenario::{Scenario, ScenarioError};

#[derive(Debug, Clone)]
struct Patch {
    outline: Polygon,
    curve: FrictionCurve,
}

/// The friction everywhere on a site.
#[derive(Debug, Clone)]
pub struct GroundMap {
    /// Highest layer first, of equal ones the smaller identifier: the first hit counts.
    patches: Vec<Patch>,
    elsewhere: FrictionCurve,
}

impl GroundMap {
    /// The true ground of a scenario.
    ///
    /// # Errors
    /// [`ScenarioError`] for figures that a parsed scenario cannot have.
    pub fn new(scenario: &Scenario) -> Result<Self, ScenarioError> {
        let malformed = |problem: String| ScenarioError::Malformed {
            file: scenario.site.to_string(),
            problem,
        };
        let mut terrains: Vec<_> = scenario.terrains.iter().collect();
        terrains.sort_by(|left, right| {
            right
                .layer
                .cmp(&left.layer)
                .then_with(|| left.id.cmp(&right.id))
        });
        let mut patches = Vec::with_capacity(terrains.len());
        for terrain in terrains {
            let outline = terrain.outline().map_err(malformed)?;
            let curve = terrain.ground().curve().map_err(malformed)?;
            patches.push(Patch { outline, curve });
        }
        let elsewhere = scenario.ground.curve().map_err(malformed)?;
        Ok(Self { patches, elsewhere })
    }

    fn at(&self, x_m: f64, y_m: f64) -> FrictionCurve {
        let point = Point { x_m, y_m };
        let hit = self
            .patches
            .iter()
            .find(|patch| patch.outline.contains(point));
        hit.map_or(self.elsewhere, |patch| patch.curve)
    }

    /// The ground under both sides of a robot, taken half a track width left and right of it.
    pub fn under(&self, pose: Pose, track_width_m: f64) -> Ground {
        let (sin, cos) = pose.heading_rad.sin_cos();
        let half_m = 0.5 * track_width_m;
        Ground {
            left: self.at(pose.x_m - half_m * sin, pose.y_m + half_m * cos),
            right: self.at(pose.x_m + half_m * sin, pose.y_m - half_m * cos),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_robot_on_a_border_stands_on_two_grounds() {
        let text = r#"
site = "s"
cell_m = 1.0
robots = []
[ground]
stiffness = 2.0
[[terrains]]
id = "a"
class = "sand"
polygon = [[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0]]
stiffness = 1.0
[[terrains]]
id = "b"
class = "ice"
polygon = [[4.0, 4.0], [6.0, 4.0], [6.0, 6.0], [4.0, 6.0]]
layer = 1
stiffness = 0.5
"#;
        let map = GroundMap::new(&Scenario::parse("t", text).unwrap()).unwrap();
        let stiffness = |x_m: f64, y_m: f64| {
            let ground = map.under(
                Pose {
                    x_m,
                    y_m,
                    heading_rad: 0.0,
                },
                0.4,
            );
            (ground.left.stiffness(), ground.right.stiffness())
        };
        assert_eq!(stiffness(5.0, 5.0), (0.5, 0.5));
        assert_eq!(stiffness(2.0, 2.0), (1.0, 1.0));
        assert_eq!(stiffness(2.0, 0.1), (1.0, 2.0));
        assert_eq!(stiffness(-1.0, -1.0), (2.0, 2.0));
    }
}
