//! The site of the scenario on the map: five terrains, a ford that freezes, ten robots of two
//! models.

use anyhow::Context as _;
use serde_json::json;
use tread_agent::geometry::paper_robot;
use tread_agent::sim::scenario::{Scenario, ScenarioRobot, ScenarioTerrain, ScenarioText};
use tread_api::geometry::Point;
use tread_api::ids::{RobotId, SiteId};
use tread_api::robot::{RobotLimits, RobotModel};
use tread_api::trajectory::Trajectory;
use tread_server::config::FrictionConfig;

use super::world::Entry;
use crate::random::Random;

/// When the ford freezes, seconds of simulated time.
pub const ICE_AFTER_S: f64 = 900.0;
/// The terrain that freezes.
pub const FORD: &str = "ford";
/// The true ground. What lies between the terrains is nobody's, and drawn by nobody.
const GROUND: &str = r#"
site = "yard"
cell_m = 1.0
robots = []

[ground]
stiffness = 4.0

[[terrains]]
id = "concrete"
class = "concrete"
polygon = [[0, 0], [16, 0], [16, 12], [0, 12]]
stiffness = 8.0
peak_slip = 0.1

[[terrains]]
id = "asphalt"
class = "asphalt"
polygon = [[16, 0], [32, 0], [32, 12], [16, 12]]
stiffness = 5.0

[[terrains]]
id = "gravel"
class = "gravel"
polygon = [[32, 0], [48, 0], [48, 12], [32, 12]]
stiffness = 2.5

[[terrains]]
id = "grass"
class = "grass"
polygon = [[0, 12], [16, 12], [16, 24], [0, 24]]
stiffness = 1.2
peak_slip = 0.25

[[terrains]]
id = "sand"
class = "sand"
polygon = [[16, 12], [32, 12], [32, 24], [16, 24]]
stiffness = 0.7
peak_slip = 0.3

[[terrains]]
id = "ford"
class = "paving"
polygon = [[34, 12], [48, 12], [48, 24], [34, 24]]
stiffness = 6.0
then = [{ after_s = 900.0, stiffness = 0.35 }]
"#;
/// The terrains that every robot visits some of.
const TERRAINS: [&str; 5] = ["concrete", "asphalt", "gravel", "grass", "sand"];
/// Speed on all paths on which the map is made, m/s.
const SPEED_M_S: f64 = 0.6;
/// Half length and half width of a figure-8, metres: no bend is tighter than 1.5 m.
const EIGHT_M: (f64, f64) = (6.0, 2.0);
/// Points of a figure-8.
const EIGHT_POINTS: u32 = 24;

/// A model of the fleet.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// The paper's robot, 5 kg.
    Small,
    /// One of 14 kg.
    Large,
}

impl Kind {
    /// Both.
    pub const ALL: [Self; 2] = [Self::Small, Self::Large];

    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Small => "small",
            Self::Large => "large",
        }
    }

    /// What it declares.
    pub fn model(self) -> RobotModel {
        match self {
            Self::Small => paper_robot(),
            Self::Large => RobotModel {
                name: "large".to_owned(),
                tyres: "standard".to_owned(),
                mass_kg: 14.0,
                track_width_m: 0.56,
                wheelbase_m: 0.38,
                wheel_radius_m: 0.11,
                yaw_inertia_kg_m2: 1.3,
                limits: RobotLimits {
                    wheel_speed_max_rad_s: 15.0,
                    wheel_acceleration_max_rad_s2: 45.0,
                    ..paper_robot().limits
                },
            },
        }
    }
}

/// The site as it truly is, without robots.
///
/// # Errors
/// Never for the text above; tests parse it.
pub fn ground(site: &SiteId) -> anyhow::Result<Scenario> {
    let mut scenario = Scenario::parse(ScenarioText {
        file: "scenario",
        text: GROUND,
    })?;
    scenario.site = site.clone();
    Ok(scenario)
}

/// The true θ of a terrain, or of what is nobody's, at a simulated time.
pub fn truth(scenario: &Scenario, terrain: Option<&str>, at_s: f64) -> f64 {
    let named = |drawn: &&ScenarioTerrain| Some(drawn.id.as_str()) == terrain;
    let stiffness =
        scenario
            .terrains
            .iter()
            .find(named)
            .map_or(scenario.ground.stiffness, |drawn| {
                let mut newest_first = drawn.then.iter().rev();
                newest_first
                    .find(|change| change.after_s <= at_s)
                    .map_or(drawn.stiffness, |change| change.stiffness)
            });
    stiffness.recip()
}

/// How much θ of each of `count` robots differs from that of all, as a share: equal steps whose
/// standard deviation is the one that the server assumes, dealt out by the seed. So no seed
/// decides whether the fleet is as it is said to be.
fn biases(count: u32, random: &mut Random) -> Vec<f64> {
    let std_dev = FrictionConfig::default().robot_bias_ratio;
    let count_f = f64::from(count.max(2));
    let unit = ((1.0 - count_f.powi(-2)) / 3.0).sqrt();
    let mut steps: Vec<f64> = (0..count)
        .map(|index| std_dev / unit * (f64::from(2 * index + 1) / count_f - 1.0))
        .collect();
    for last in (1..steps.len()).rev() {
        steps.swap(last, random.index(last + 1));
    }
    steps
}

/// Robots of one model, their names numbered, side by side from a place on.
#[derive(Debug, Clone, Copy)]
pub struct Row<'name> {
    /// What their names begin with.
    pub name: &'name str,
    /// What they are.
    pub kind: Kind,
    /// How many.
    pub count: u32,
    /// Where the first stands; each next one is a metre to the right.
    pub first: Point,
    /// Whether they measure wheel torque.
    pub has_torque: bool,
}

/// Puts robots heading north into a scenario.
///
/// # Errors
/// The name is none.
pub fn put(
    scenario: &mut Scenario,
    row: Row<'_>,
    random: &mut Random,
) -> anyhow::Result<Vec<Entry>> {
    let mut entries = Vec::new();
    for (number, bias) in (0..row.count).zip(biases(row.count, random)) {
        let name = format!("{}-{}-{}", row.name, row.kind.name(), number + 1);
        let robot: RobotId = name.parse().context("a name")?;
        scenario.robots.push(ScenarioRobot {
            id: robot.clone(),
            x_m: row.first.x_m + f64::from(number),
            y_m: row.first.y_m,
            heading_rad: std::f64::consts::FRAC_PI_2,
            // Below 2^53, as every number of a file.
            seed: random.next_u64() >> 12,
            stiffness_ratio: (1.0 + bias).recip(),
            wheel_torque: row.has_torque,
            faults: Vec::new(),
        });
        entries.push(Entry {
            robot,
            model: row.kind.model(),
        });
    }
    Ok(entries)
}

/// A path through points.
///
/// # Errors
/// It is none.
pub fn path(points: &[(f64, f64)], speed_m_s: f64) -> anyhow::Result<Trajectory> {
    let points: Vec<_> = points
        .iter()
        .map(|&(x_m, y_m)| json!({"x_m": x_m, "y_m": y_m}))
        .collect();
    let path = json!({"waypoints": {"speed_m_s": speed_m_s, "points": points}});
    serde_json::from_value(path).context("a path")
}

/// A figure-8 around a centre, once through.
fn figure_eight(
    center: (f64, f64),
    half_m: (f64, f64),
    speed_m_s: f64,
) -> anyhow::Result<Trajectory> {
    let points: Vec<(f64, f64)> = (0..=EIGHT_POINTS)
        .map(|step| {
            let angle = std::f64::consts::TAU * f64::from(step) / f64::from(EIGHT_POINTS);
            (
                center.0 + half_m.0 * angle.sin(),
                center.1 + half_m.1 * (2.0 * angle).sin(),
            )
        })
        .collect();
    path(&points, speed_m_s)
}

fn middle(scenario: &Scenario, terrain: &str) -> anyhow::Result<(f64, f64)> {
    let drawn = scenario
        .terrains
        .iter()
        .find(|drawn| drawn.id.as_str() == terrain);
    let drawn = drawn.context("a terrain of the site")?;
    let corners = f64::from(u32::try_from(drawn.polygon.len())?);
    let sum = drawn.polygon.iter().fold((0.0, 0.0), |sum, corner| {
        (sum.0 + corner[0], sum.1 + corner[1])
    });
    Ok((sum.0 / corners, sum.1 / corners))
}

/// The paths on which robot number `robot` of a model makes the map: figure-8s on so many terrains,
/// each a little aside from those of the others, and for the first two of a model one on the ford.
///
/// # Errors
/// One is none.
pub fn paths(
    scenario: &Scenario,
    kind: Kind,
    robot: u32,
    visits: u32,
) -> anyhow::Result<Vec<Trajectory>> {
    let shift = u32::from(kind == Kind::Large);
    let mut paths = Vec::new();
    for visit in 0..visits {
        let terrain = TERRAINS[((robot + 2 * visit + shift) % 5) as usize];
        let (x_m, y_m) = middle(scenario, terrain)?;
        let aside = |step: u32| f64::from(step % 5) - 2.0;
        let center = (
            x_m + 0.45 * aside(7 * robot + 3 * visit + shift),
            y_m + 0.95 * aside(3 * robot + visit + 2 * shift),
        );
        paths.push(figure_eight(center, EIGHT_M, SPEED_M_S)?);
    }
    if robot < 2 {
        paths.push(over_the_ford(scenario)?);
    }
    Ok(paths)
}

/// A figure-8 on the ford.
///
/// # Errors
/// It is none.
pub fn over_the_ford(scenario: &Scenario) -> anyhow::Result<Trajectory> {
    figure_eight(middle(scenario, FORD)?, (5.5, 2.0), SPEED_M_S)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_fleet_differs_as_the_server_is_configured_whatever_the_seed() {
        for (seed, count) in [(1, 5), (2, 5), (3, 2), (4, 9)] {
            let found = biases(count, &mut Random::new(seed));
            let mean = found.iter().sum::<f64>() / f64::from(count);
            let square = found.iter().map(|bias| bias * bias).sum::<f64>() / f64::from(count);
            assert!(mean.abs() < 1.0e-12, "{found:?}");
            assert!((square.sqrt() - 0.08).abs() < 1.0e-9, "{found:?}");
        }
        let of_seed = |seed| biases(5, &mut Random::new(seed));
        assert!((1..20).any(|seed| of_seed(seed) != of_seed(0)));
    }

    #[test]
    fn the_ford_freezes_when_it_is_said_to() {
        let scenario = ground(&"yard".parse().unwrap()).unwrap();
        let theta = |at_s| truth(&scenario, Some(FORD), at_s);
        assert!((theta(ICE_AFTER_S - 1.0) - 1.0 / 6.0).abs() < 1.0e-12);
        assert!((theta(ICE_AFTER_S) - 1.0 / 0.35).abs() < 1.0e-12);
        assert!((truth(&scenario, None, 0.0) - 0.25).abs() < 1.0e-12);
        let terrains = |kind, robot| paths(&scenario, kind, robot, 3).unwrap().len();
        assert_eq!((terrains(Kind::Small, 0), terrains(Kind::Large, 4)), (4, 3));
    }
}
