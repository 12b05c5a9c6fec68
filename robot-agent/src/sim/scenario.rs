//! Scenario files: the true ground of a simulated site, its robots, and missions to show.
//!
//! TOML. The simulated base takes the true friction from here; no other part of the agent reads it,
//! but has to measure. `tread demo` also takes terrains' shapes and missions from it.

use std::collections::BTreeSet;
use std::path::Path;
use std::str::Lines;

use serde::{Deserialize, Serialize};
use tread_api::geometry::{Point, Polygon};
use tread_api::ids::{RobotId, SiteId, TerrainId};
use tread_api::terrain::{TERRAINS_MAX, TerrainClass};
use tread_api::trajectory::Trajectory;
use tread_control::friction::{FrictionCurve, FrictionSpec};

use super::faults::{FAULTS_MAX, Fault};

/// The scenario that comes with the agent.
pub const BUILT_IN: &str = include_str!("../../scenarios/yard.toml");
/// Name of [`BUILT_IN`] in error messages and on the command line.
pub const BUILT_IN_NAME: &str = "yard";
/// Permitted ratio of a robot's friction stiffness to that of the scenario.
pub const STIFFNESS_RATIO_RANGE: std::ops::RangeInclusive<f64> = 0.2..=5.0;
/// Latest change of the ground, seconds.
const CHANGE_AFTER_MAX_S: f64 = 1.0e6;
/// Largest scenario file, bytes.
pub const SCENARIO_BYTES_MAX: u64 = 4 * 1024 * 1024;

/// Why a scenario was refused.
#[derive(Debug, thiserror::Error)]
pub enum ScenarioError {
    /// The file could not be read.
    #[error("the scenario `{file}` cannot be read")]
    Unreadable {
        /// The file.
        file: String,
        /// What the operating system said.
        #[source]
        source: std::io::Error,
    },
    /// The file is larger than [`SCENARIO_BYTES_MAX`].
    #[error("the scenario `{file}` is larger than {SCENARIO_BYTES_MAX} bytes")]
    TooLarge {
        /// The file.
        file: String,
    },
    /// The text does not parse, or a key is not known.
    #[error("in the scenario `{file}`: {problem}")]
    Malformed {
        /// The file.
        file: String,
        /// Line, column, key and what is wrong with it.
        problem: String,
    },
}

/// Text of a scenario, and its source.
#[derive(Debug, Clone, Copy)]
pub struct ScenarioText<'text> {
    /// The file's name in errors.
    pub file: &'text str,
    /// The text.
    pub text: &'text str,
}

/// True description of a site.
#[derive(Debug, Clone, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct Scenario {
    /// The site.
    pub site: SiteId,
    /// Side of the site's cells, metres.
    pub cell_m: f64,
    /// The ground outside all terrains.
    #[serde(default)]
    pub ground: GroundSpec,
    /// Ground within polygons.
    pub terrains: Vec<ScenarioTerrain>,
    /// Robots, with their start poses and individual properties.
    pub robots: Vec<ScenarioRobot>,
    /// Missions to show, in the order in which each robot drives its own.
    #[serde(default)]
    pub missions: Vec<ScenarioMission>,
}

/// True friction of some ground.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct GroundSpec {
    /// Friction stiffness K = 1/θ.
    pub stiffness: f64,
    /// Slip at the peak of friction, `λ_m`, within 0 to 1.
    #[serde(default = "default_peak_slip")]
    pub peak_slip: f64,
    /// Fraction of the peak friction that is left at full sliding, α, within 0 to 1.
    #[serde(default = "default_sliding_ratio")]
    pub sliding_ratio: f64,
}

fn default_peak_slip() -> f64 {
    0.2
}

fn default_sliding_ratio() -> f64 {
    0.8
}

impl Default for GroundSpec {
    fn default() -> Self {
        Self {
            stiffness: 5.0,
            peak_slip: default_peak_slip(),
            sliding_ratio: default_sliding_ratio(),
        }
    }
}

impl GroundSpec {
    /// Checks the values and returns the friction curve.
    ///
    /// # Errors
    /// A sentence that names the value.
    pub fn curve(&self) -> Result<FrictionCurve, String> {
        let spec = FrictionSpec {
            stiffness: self.stiffness,
            peak_slip: self.peak_slip,
            sliding_ratio: self.sliding_ratio,
        };
        FrictionCurve::try_from(spec).map_err(|refused| refused.to_string())
    }
}

/// Ground within a polygon.
#[derive(Debug, Clone, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct ScenarioTerrain {
    /// The terrain.
    pub id: TerrainId,
    /// Name for people; the identifier when absent.
    pub name: Option<String>,
    /// Kind of ground.
    pub class: TerrainClass,
    /// Corners `[x, y]` in metres.
    pub polygon: Vec<[f64; 2]>,
    /// Layer; where terrains overlap, the highest applies.
    #[serde(default)]
    pub layer: i32,
    /// Friction stiffness K = 1/θ.
    pub stiffness: f64,
    /// Slip at the peak of friction, `λ_m`.
    #[serde(default = "default_peak_slip")]
    pub peak_slip: f64,
    /// Fraction of the peak friction that is left at full sliding, α.
    #[serde(default = "default_sliding_ratio")]
    pub sliding_ratio: f64,
    /// Later changes, in order of time.
    #[serde(default)]
    pub then: Vec<GroundChange>,
}

/// A change of the ground at a time.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct GroundChange {
    /// Time of the change, seconds of the robot's clock since its agent's start.
    pub after_s: f64,
    /// Friction stiffness K = 1/θ from then on.
    pub stiffness: f64,
    /// Slip at the peak of friction, `λ_m`.
    #[serde(default = "default_peak_slip")]
    pub peak_slip: f64,
    /// Fraction of the peak friction that is left at full sliding, α.
    #[serde(default = "default_sliding_ratio")]
    pub sliding_ratio: f64,
}

impl GroundChange {
    /// Returns the friction after the change, unchecked.
    pub fn ground(&self) -> GroundSpec {
        GroundSpec {
            stiffness: self.stiffness,
            peak_slip: self.peak_slip,
            sliding_ratio: self.sliding_ratio,
        }
    }
}

impl ScenarioTerrain {
    /// Checks the corners and returns the terrain's outline.
    ///
    /// # Errors
    /// A sentence that names the corner.
    pub fn outline(&self) -> Result<Polygon, String> {
        let corners = self
            .polygon
            .iter()
            .map(|&[x_m, y_m]| Point { x_m, y_m })
            .collect();
        Polygon::new(corners).map_err(|refused| refused.to_string())
    }

    /// Returns the terrain's friction, unchecked.
    pub fn ground(&self) -> GroundSpec {
        GroundSpec {
            stiffness: self.stiffness,
            peak_slip: self.peak_slip,
            sliding_ratio: self.sliding_ratio,
        }
    }
}

/// A robot of the scenario.
#[derive(Debug, Clone, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct ScenarioRobot {
    /// The robot.
    pub id: RobotId,
    /// Start position, x in the site frame, metres.
    pub x_m: f64,
    /// Start position, y in the site frame, metres.
    pub y_m: f64,
    /// Start heading, radians, counter-clockwise from x.
    pub heading_rad: f64,
    /// Seed of its sensor noise, offsets and rolling radii.
    pub seed: u64,
    /// Ratio of the friction stiffness on its tyres to that of the scenario, within
    /// [`STIFFNESS_RATIO_RANGE`].
    #[serde(default = "default_stiffness_ratio", alias = "grip_ratio")]
    pub stiffness_ratio: f64,
    /// Whether its base measures wheel torque.
    #[serde(default = "default_wheel_torque")]
    pub wheel_torque: bool,
    /// Its faults, at most [`FAULTS_MAX`].
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub faults: Vec<Fault>,
}

fn default_stiffness_ratio() -> f64 {
    1.0
}

fn default_wheel_torque() -> bool {
    true
}

/// A mission of the scenario.
#[derive(Debug, Clone, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct ScenarioMission {
    /// Robot of the mission.
    pub robot: RobotId,
    /// Trajectory of the mission.
    pub trajectory: Trajectory,
}

impl Scenario {
    /// The scenario that comes with the agent.
    ///
    /// # Errors
    /// Never for the file in this repository; a test holds it to that.
    pub fn built_in() -> Result<Self, ScenarioError> {
        Self::parse(ScenarioText {
            file: BUILT_IN_NAME,
            text: BUILT_IN,
        })
    }

    /// Reads a scenario file.
    ///
    /// # Errors
    /// [`ScenarioError`] names file, line and key.
    pub fn load(path: &Path) -> Result<Self, ScenarioError> {
        let file = path.display().to_string();
        let unreadable = |source| ScenarioError::Unreadable {
            file: file.clone(),
            source,
        };
        if std::fs::metadata(path).map_err(unreadable)?.len() > SCENARIO_BYTES_MAX {
            return Err(ScenarioError::TooLarge { file });
        }
        let text = std::fs::read_to_string(path).map_err(unreadable)?;
        Self::parse(ScenarioText {
            file: &file,
            text: &text,
        })
    }

    /// Reads a scenario.
    ///
    /// # Errors
    /// [`ScenarioError::Malformed`] names line and key.
    pub fn parse(ScenarioText { file, text }: ScenarioText<'_>) -> Result<Self, ScenarioError> {
        let malformed = |problem: String| ScenarioError::Malformed {
            file: file.to_owned(),
            problem,
        };
        let scenario: Self =
            toml::from_str(text).map_err(|refused| malformed(refused.to_string()))?;
        scenario.check(text).map_err(malformed)?;
        Ok(scenario)
    }

    /// Returns the robot with this identifier.
    pub fn robot(&self, id: &RobotId) -> Option<&ScenarioRobot> {
        self.robots.iter().find(|robot| robot.id == *id)
    }

    /// Checks what the types do not. `text` is only searched for line numbers.
    fn check(&self, text: &str) -> Result<(), String> {
        let at = |table: &str, index: usize, problem: String| {
            format!(
                "line {}: {table}[{index}]: {problem}",
                line_of(text.lines(), table, index)
            )
        };
        if !(tread_api::site::CELL_MIN_M..=tread_api::site::CELL_MAX_M).contains(&self.cell_m) {
            return Err(format!(
                "cell_m: {} is no possible side of a cell",
                self.cell_m
            ));
        }
        self.ground
            .curve()
            .map_err(|problem| format!("ground: {problem}"))?;
        if self.terrains.len() > TERRAINS_MAX {
            return Err(format!("terrains: there are more than {TERRAINS_MAX}"));
        }
        let mut terrains = BTreeSet::new();
        for (index, terrain) in self.terrains.iter().enumerate() {
            let refused = |problem| at("terrains", index, problem);
            terrain
                .outline()
                .map_err(|problem| refused(format!("polygon: {problem}")))?;
            terrain.ground().curve().map_err(refused)?;
            let mut last_s = 0.0;
            for change in &terrain.then {
                change.ground().curve().map_err(refused)?;
                if !(last_s..=CHANGE_AFTER_MAX_S).contains(&change.after_s) {
                    let problem = format!(
                        "then: after_s must be {last_s} to {CHANGE_AFTER_MAX_S}, not {}",
                        change.after_s
                    );
                    return Err(refused(problem));
                }
                last_s = change.after_s;
            }
            if !terrains.insert(&terrain.id) {
                return Err(refused(format!("id: `{}` is there twice", terrain.id)));
            }
        }
        let mut robots = BTreeSet::new();
        for (index, robot) in self.robots.iter().enumerate() {
            let refused = |problem| at("robots", index, problem);
            let start = Point {
                x_m: robot.x_m,
                y_m: robot.y_m,
            };
            if !(start.is_on_the_map() && robot.heading_rad.is_finite()) {
                return Err(refused("x_m, y_m or heading_rad is no place".to_owned()));
            }
            if !STIFFNESS_RATIO_RANGE.contains(&robot.stiffness_ratio) {
                return Err(refused(format!(
                    "stiffness_ratio must be {} to {}, not {}",
                    STIFFNESS_RATIO_RANGE.start(),
                    STIFFNESS_RATIO_RANGE.end(),
                    robot.stiffness_ratio
                )));
            }
            if robot.faults.len() > FAULTS_MAX {
                return Err(refused(format!("faults: there are more than {FAULTS_MAX}")));
            }
            for fault in &robot.faults {
                fault.check().map_err(refused)?;
            }
            if !robots.insert(&robot.id) {
                return Err(refused(format!("id: `{}` is there twice", robot.id)));
            }
        }
        for (index, mission) in self.missions.iter().enumerate() {
            if !robots.contains(&mission.robot) {
                let problem = format!("robot: `{}` is not among the robots", mission.robot);
                return Err(at("missions", index, problem));
            }
        }
        Ok(())
    }
}

/// Returns the line of the `index`-th `[[table]]`; 1 for inline tables.
fn line_of(lines: Lines<'_>, table: &str, index: usize) -> usize {
    let header = format!("[[{table}]]");
    let mut headers = lines
        .enumerate()
        .filter(|(_, line)| line.trim_start().starts_with(&header));
    headers.nth(index).map_or(1, |(line, _)| line + 1)
}

#[cfg(test)]
mod tests;
