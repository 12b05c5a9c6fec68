//! What a run has shown, against the truth.

use std::collections::BTreeMap;
use std::time::Duration;

use anyhow::Context as _;
use serde::Serialize;
use tread_agent::geometry::{control_model, control_trajectory, plan_options};
use tread_agent::sim::scenario::Scenario;
use tread_agent::sim::trace::TruthSample;
use tread_api::friction::{CellFriction, FusedFriction};
use tread_api::robot::RobotModel;
use tread_api::trajectory::Trajectory;
use tread_control::geometry::{Point, Pose};
use tread_control::plan::Plan;

use super::yard;

/// Half width of the band around a path, metres.
pub const BAND_M: f64 = 0.3;
/// θ from which ground counts as ice.
const ICE_THETA: f64 = 1.0;
/// Speed below which a robot stands, m/s.
const STANDING_M_S: f64 = 0.01;
/// Distance between two places of a path that are looked at, metres.
const PATH_STEP_M: f64 = 0.02;

/// What the map says of the ground of one kind for one robot model.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct GroundLine {
    /// The terrain, or `-` for what nobody has drawn.
    pub terrain: String,
    /// The robot model.
    pub model: &'static str,
    /// The true θ.
    pub truth: f64,
    /// What the map says of the terrain as a whole.
    pub theta: Option<f64>,
    /// Its 95 % interval.
    pub low_95: Option<f64>,
    /// The same.
    pub high_95: Option<f64>,
    /// Cells of it that were driven.
    pub cells: u32,
    /// Of these, those whose 95 % interval holds the truth.
    pub held: u32,
    /// Median half width of the cells' intervals over the truth.
    pub half_width_ratio: f64,
    /// Root mean square of the cells' errors over the truth.
    pub error_rms_ratio: f64,
}

/// The lines of a map, and what they are together.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct MapFigures {
    /// One line for each ground and robot model.
    pub lines: Vec<GroundLine>,
    /// Cells that were driven, each model's for itself.
    pub cells: u32,
    /// Of these, those whose 95 % interval holds the truth.
    pub held: u32,
    /// Terrains whose 95 % interval as a whole holds the truth, each model's for itself.
    pub terrains_held: u32,
    /// Terrains that have an interval.
    pub terrains: u32,
}

impl MapFigures {
    /// Share of the cells whose interval holds the truth.
    pub fn held_ratio(&self) -> f64 {
        f64::from(self.held) / f64::from(self.cells.max(1))
    }
}

/// Whether an interval holds a value.
pub fn holds(known: &FusedFriction, truth: f64) -> bool {
    (known.theta_low_95..=known.theta_high_95).contains(&truth)
}

/// A terrain's estimate as a whole.
#[derive(Debug, Clone)]
pub struct TerrainEstimate {
    /// The terrain.
    pub terrain: String,
    /// The robot model.
    pub model: &'static str,
    /// What the map says.
    pub friction: FusedFriction,
}

/// Cells and terrains of a map against the truth at a simulated time.
pub fn map_figures(
    scenario: &Scenario,
    at: Duration,
    cells: &[(&'static str, CellFriction)],
    wholes: &[TerrainEstimate],
) -> MapFigures {
    let mut grounds: BTreeMap<(String, &'static str), Vec<&FusedFriction>> = BTreeMap::new();
    for (model, cell) in cells {
        let terrain = cell.terrain.as_ref().map(|drawn| drawn.id.as_str());
        let key = (terrain.unwrap_or("-").to_owned(), *model);
        grounds.entry(key).or_default().push(&cell.friction);
    }
    let mut figures = MapFigures::default();
    for ((terrain, model), known) in grounds {
        let named = Some(terrain.as_str()).filter(|name| *name != "-");
        let truth = yard::truth(scenario, named, at.as_secs_f64());
        let mut line = GroundLine {
            truth,
            theta: None,
            low_95: None,
            high_95: None,
            cells: 0,
            held: 0,
            half_width_ratio: 0.0,
            error_rms_ratio: 0.0,
            model,
            terrain,
        };
        for known in &known {
            line.cells += 1;
            line.held += u32::from(holds(known, truth));
            line.error_rms_ratio += (known.theta / truth - 1.0).powi(2);
        }
        let widths = known.iter();
        let widths = widths.map(|known| 0.5 * (known.theta_high_95 - known.theta_low_95) / truth);
        let mut widths: Vec<f64> = widths.collect();
        widths.sort_by(f64::total_cmp);
        line.half_width_ratio = widths.get(widths.len() / 2).copied().unwrap_or(f64::NAN);
        line.error_rms_ratio = (line.error_rms_ratio / f64::from(line.cells)).sqrt();
        let whole = wholes
            .iter()
            .find(|whole| (&whole.terrain, whole.model) == (&line.terrain, line.model));
        if let Some(TerrainEstimate { friction, .. }) = whole {
            line.theta = Some(friction.theta);
            line.low_95 = Some(friction.theta_low_95);
            line.high_95 = Some(friction.theta_high_95);
            figures.terrains += 1;
            figures.terrains_held += u32::from(holds(friction, truth));
        }
        figures.cells += line.cells;
        figures.held += line.held;
        figures.lines.push(line);
    }
    figures
}

/// How a robot kept to its path on ice.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Tracking {
    /// How often it left the band around its path.
    pub departures: u32,
    /// Farthest that it truly was from its path, metres.
    pub farthest_m: f64,
    /// Root mean square of its distance from the path, metres.
    pub rms_m: f64,
    /// Fastest that it truly went, m/s.
    pub fastest_m_s: f64,
    /// Time that it spent there, seconds.
    pub time_s: f64,
}

/// What a robot truly did on ice, against the path that it was to follow from where it started.
///
/// # Errors
/// There is no such path.
pub fn tracking(
    samples: &[TruthSample],
    start: Pose,
    model: &RobotModel,
    asked: &Trajectory,
) -> anyhow::Result<Tracking> {
    let model = control_model(model)?;
    let plan = Plan::with_options(
        &control_trajectory(asked),
        start,
        &model,
        &plan_options(asked),
    )?;
    let mut path: Vec<Point> = Vec::new();
    let mut arc_m = 0.0;
    while arc_m < plan.length_m() + PATH_STEP_M {
        path.push(plan.path().sample(arc_m).pose.point());
        arc_m += PATH_STEP_M;
    }
    let mut found = Tracking::default();
    let (mut is_out, mut squares_m2, mut count) = (false, 0.0, 0_u32);
    let mut before: Option<Duration> = None;
    for sample in samples {
        let last = before.replace(sample.at).unwrap_or(sample.at);
        let speed_m_s = sample.state.forward_m_s.hypot(sample.state.left_m_s);
        if sample.theta < ICE_THETA {
            is_out = false;
            continue;
        }
        let at = sample.state.pose.point();
        let away_m = path
            .iter()
            .map(|place| place.distance_m(at))
            .fold(f64::INFINITY, f64::min);
        found.departures += u32::from(away_m > BAND_M && !is_out);
        is_out = away_m > BAND_M;
        found.farthest_m = found.farthest_m.max(away_m);
        found.fastest_m_s = found.fastest_m_s.max(speed_m_s);
        if speed_m_s > STANDING_M_S {
            squares_m2 += away_m * away_m;
            count += 1;
            found.time_s += sample.at.saturating_sub(last).as_secs_f64();
        }
    }
    found.rms_m = (squares_m2 / f64::from(count.max(1))).sqrt();
    Ok(found)
}

/// How a robot came to rest after a word to stop.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Stopping {
    /// How fast it went at the command, m/s.
    pub from_m_s: f64,
    /// How far it still went, metres.
    pub distance_m: f64,
    /// How long that took, seconds.
    pub time_s: f64,
}

/// How a robot stopped that was commanded to at a simulated time.
///
/// # Errors
/// It was not seen to come to rest.
pub fn stopping(samples: &[TruthSample], stop_requested_at: Duration) -> anyhow::Result<Stopping> {
    let speed = |sample: &TruthSample| sample.state.forward_m_s.hypot(sample.state.left_m_s);
    let after: Vec<&TruthSample> = samples
        .iter()
        .filter(|sample| sample.at >= stop_requested_at)
        .collect();
    let first = after.first().context("nothing was seen after the stop")?;
    let rest = after.iter().position(|sample| speed(sample) < STANDING_M_S);
    let rest = rest.context("the robot never stood")?;
    let distance_m = after[..=rest]
        .windows(2)
        .map(|pair| {
            let (from, to) = (pair[0].state.pose.point(), pair[1].state.pose.point());
            from.distance_m(to)
        })
        .sum();
    Ok(Stopping {
        from_m_s: speed(first),
        distance_m,
        time_s: after[rest]
            .at
            .saturating_sub(stop_requested_at)
            .as_secs_f64(),
    })
}

#[cfg(test)]
mod tests {
    use tread_agent::geometry::paper_robot;
    use tread_control::measured::WheelSpeeds;
    use tread_control::plant::PlantState;

    use super::*;

    fn sample(at_s: f64, Point { x_m, y_m }: Point, speed_m_s: f64) -> TruthSample {
        TruthSample {
            at: Duration::from_secs_f64(at_s),
            state: PlantState {
                pose: Pose {
                    x_m,
                    y_m,
                    heading_rad: 0.0,
                },
                forward_m_s: speed_m_s,
                ..PlantState::default()
            },
            command: WheelSpeeds::default(),
            theta: if x_m > 1.0 { 2.0 } else { 0.2 },
        }
    }

    #[test]
    fn leaving_the_band_counts_once_each_time_and_only_on_ice() {
        let asked = yard::path(&[(0.0, 0.0), (5.0, 0.0)], 0.5).unwrap();
        let aside = [0.9, 0.0, 0.1, 0.4, 0.5, 0.1, -0.31, -0.29];
        let samples: Vec<TruthSample> = (0_u32..)
            .zip(aside)
            .map(|(step, y_m)| {
                let x_m = 0.6 * f64::from(step);
                sample(f64::from(step), Point { x_m, y_m }, 0.5)
            })
            .collect();
        let start = Pose::default();
        let found = tracking(&samples, start, &paper_robot(), &asked).unwrap();
        assert_eq!(found.departures, 2);
        assert!((found.farthest_m - 0.5).abs() < 0.01, "{found:?}");
        // Past its end it is as far off as it has overrun it.
        let overrun = [
            sample(0.0, Point { x_m: 5.0, y_m: 0.0 }, 0.5),
            sample(1.0, Point { x_m: 5.4, y_m: 0.0 }, 0.1),
        ];
        let found = tracking(&overrun, start, &paper_robot(), &asked).unwrap();
        assert_eq!(found.departures, 1);
        assert!((found.farthest_m - 0.4).abs() < 0.03, "{found:?}");
    }

    #[test]
    fn stopping_is_from_the_word_to_rest() {
        let samples = [
            sample(1.0, Point { x_m: 0.0, y_m: 0.0 }, 1.0),
            sample(2.0, Point { x_m: 1.0, y_m: 0.0 }, 1.0),
            sample(3.0, Point { x_m: 1.6, y_m: 0.0 }, 0.4),
            sample(4.0, Point { x_m: 1.7, y_m: 0.0 }, 0.0),
            sample(5.0, Point { x_m: 1.7, y_m: 0.0 }, 0.0),
        ];
        let found = stopping(&samples, Duration::from_secs(2)).unwrap();
        assert!((found.distance_m - 0.7).abs() < 1.0e-9, "{found:?}");
        assert!((found.from_m_s - 1.0).abs() < 1.0e-9);
        assert!((found.time_s - 2.0).abs() < 1.0e-9);
        assert!(stopping(&samples[..3], Duration::from_secs(1)).is_err());
    }
}
