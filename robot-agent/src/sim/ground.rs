//! The true ground under a simulated robot: the terrain under each side, as a function of time.

use std::time::Duration;

use tread_api::geometry::{Point, Polygon};
use tread_control::friction::FrictionCurve;
use tread_control::geometry::Pose;
use tread_control::plant::Ground;

use super::scenario::{GroundSpec, Scenario, ScenarioError};

#[derive(Debug, Clone)]
struct Patch {
    outline: Polygon,
    curve: FrictionCurve,
    /// Later friction curves with the time of each change, in order of time.
    changes: Vec<(Duration, FrictionCurve)>,
}

impl Patch {
    fn curve(&self, at: Duration) -> FrictionCurve {
        let begun = self.changes.partition_point(|(from, _)| *from <= at);
        let last = begun.checked_sub(1).and_then(|last| self.changes.get(last));
        last.map_or(self.curve, |(_, curve)| *curve)
    }
}

/// The friction everywhere on a site.
#[derive(Debug, Clone)]
pub struct GroundMap {
    /// Highest layer first, then by identifier; the first patch that contains a point applies.
    patches: Vec<Patch>,
    elsewhere: FrictionCurve,
}

impl GroundMap {
    /// Creates the true ground of a scenario for a robot whose tyres multiply the friction
    /// stiffness by `stiffness_ratio`.
    ///
    /// # Errors
    /// [`ScenarioError`] for values that a parsed scenario cannot have.
    pub fn new(scenario: &Scenario, stiffness_ratio: f64) -> Result<Self, ScenarioError> {
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
            let curve = |ground: GroundSpec| {
                let for_robot = GroundSpec {
                    stiffness: ground.stiffness * stiffness_ratio,
                    ..ground
                };
                for_robot.curve().map_err(malformed)
            };
            let mut changes = Vec::with_capacity(terrain.then.len());
            for change in &terrain.then {
                changes.push((
                    Duration::from_secs_f64(change.after_s),
                    curve(change.ground())?,
                ));
            }
            patches.push(Patch {
                outline,
                curve: curve(terrain.ground())?,
                changes,
            });
        }
        let elsewhere = GroundSpec {
            stiffness: scenario.ground.stiffness * stiffness_ratio,
            ..scenario.ground
        };
        let elsewhere = elsewhere.curve().map_err(malformed)?;
        Ok(Self { patches, elsewhere })
    }

    fn curve(&self, point: Point, at: Duration) -> FrictionCurve {
        let patch = self
            .patches
            .iter()
            .find(|patch| patch.outline.contains(point));
        patch.map_or(self.elsewhere, |patch| patch.curve(at))
    }

    /// Returns the ground under both sides of a robot at a time of its clock, half a track width to
    /// the left and to the right of the centre.
    pub fn under(&self, pose: Pose, track_width_m: f64, at: Duration) -> Ground {
        let (sin, cos) = pose.heading_rad.sin_cos();
        let half_m = 0.5 * track_width_m;
        let curve = |left_m: f64| {
            let point = Point {
                x_m: pose.x_m - left_m * sin,
                y_m: pose.y_m + left_m * cos,
            };
            self.curve(point, at)
        };
        Ground {
            left: curve(half_m),
            right: curve(-half_m),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sim::scenario::ScenarioText;

    #[test]
    fn each_side_stands_on_its_own_ground_as_it_is_then() {
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
then = [{ after_s = 10.0, stiffness = 0.1 }, { after_s = 20.0, stiffness = 3.0 }]
"#;
        let scenario = Scenario::parse(ScenarioText { file: "t", text }).unwrap();
        let map = GroundMap::new(&scenario, 1.0).unwrap();
        let stiffness_at = |x_m: f64, y_m: f64, at_s: u64| {
            let ground = map.under(
                Pose {
                    x_m,
                    y_m,
                    heading_rad: 0.0,
                },
                0.4,
                Duration::from_secs(at_s),
            );
            (ground.left.stiffness(), ground.right.stiffness())
        };
        let stiffness = |x_m, y_m| stiffness_at(x_m, y_m, 0);
        assert_eq!(stiffness(5.0, 5.0), (0.5, 0.5));
        assert_eq!(stiffness(2.0, 2.0), (1.0, 1.0));
        assert_eq!(stiffness(2.0, 0.1), (1.0, 2.0));
        assert_eq!(stiffness(-1.0, -1.0), (2.0, 2.0));
        for (at_s, then) in [(9, 0.5), (10, 0.1), (19, 0.1), (20, 3.0), (999, 3.0)] {
            assert_eq!(stiffness_at(5.0, 5.0, at_s), (then, then), "{at_s} s");
        }
        let map = GroundMap::new(&scenario, 2.0).unwrap();
        let ground = map.under(Pose::default(), 0.0, Duration::ZERO);
        assert!(
            (ground.left.stiffness() - 2.0).abs() < 1.0e-12,
            "{ground:?}"
        );
    }
}
