//! What the scenario on the map has shown, and what of it must hold.

use serde::Serialize;
use tread_api::ids::RobotId;
use tread_api::mission::{MissionState, PriorGain};

use super::judge::{BAND_M, MapFigures, Stopping, Tracking};
use super::yard::FORD;
use crate::report::Check;

/// How large a run is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Size {
    /// What differs between robots and runs is drawn from this.
    pub seed: u64,
    /// Robots of each of the two models.
    pub robots_per_model: u32,
    /// Terrains that each of them visits.
    pub visits: u32,
    /// Robots of each model that arrive.
    pub arrivals_per_model: u32,
}

/// How the ice came onto the map.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct IcePass {
    /// The robot model.
    pub model: &'static str,
    /// Cells of the ford that this pass and all before it, since the ice, have measured.
    pub cells: u32,
    /// Of these, those that the map shows as ice: their whole 95 % interval lies above the former
    /// θ, and their θ is nearer to the new one than to it, by ratio.
    pub shown: u32,
    /// Of these, those that the map calls disputed.
    pub disputed: u32,
    /// Whether the robot that passed has raised an alert by then.
    pub alert: bool,
}

/// What one fleet has made of the site.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FleetMap {
    /// Whether its robots measure wheel torque.
    pub torque: bool,
    /// The map before the ice.
    pub before: MapFigures,
    /// Simulated time that this took, seconds.
    pub driven_s: f64,
    /// Missions in which robots could hold the map's word against their own.
    pub gains: Vec<PriorGain>,
    /// Alerts that the ground has changed, though it has not.
    pub false_alarms: Vec<String>,
    /// What the map knew of the ford after the first and second pass over the ice, by model.
    pub ice: Vec<[IcePass; 2]>,
    /// Cells of the ford driven since the ice, against the ice.
    pub frozen: MapFigures,
}

/// A robot that came, with the map and without.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Arrival {
    /// The robot.
    pub robot: RobotId,
    /// How the bend and the end on the ice went.
    pub course: Option<[Tracking; 2]>,
    /// Friction coefficient that the map gave it to plan with where it was lowest.
    pub traction_limit_mu: Option<f64>,
    /// How the missions ended.
    pub ends: Vec<MissionState>,
    /// How it stopped on the ice.
    pub stop: Option<[Stopping; 2]>,
}

/// All that a run has shown; of pairs, the first is with the map.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Report {
    /// How large it was.
    pub size: Size,
    /// With wheel torque, and without.
    pub learned: Vec<FleetMap>,
    /// Robots that arrived.
    pub arrivals: Vec<Arrival>,
}

/// Least share of the cells of a frozen patch, driven twice since, by which it is visible.
const SHOWN_RATIO_MIN: f64 = 0.9;
/// Least share of the driven cells whose 95 % interval holds the truth.
const HELD_RATIO_MIN: f64 = 0.93;

impl Report {
    /// What must hold of the run, each with its figure.
    pub fn checks(&self) -> Vec<Check> {
        let mut checks = Vec::new();
        for learned in &self.learned {
            checks.extend(learned.checks());
        }
        checks.extend(self.arrival_checks());
        checks
    }

    fn arrival_checks(&self) -> Vec<Check> {
        let courses: Vec<&[Tracking; 2]> = self
            .arrivals
            .iter()
            .filter_map(|arrival| arrival.course.as_ref())
            .collect();
        if courses.is_empty() {
            return Vec::new();
        }
        let sum = |place: usize| -> u32 { courses.iter().map(|pair| pair[place].departures).sum() };
        let farthest = |place: usize| {
            let farthest = courses.iter().map(|pair| pair[place].farthest_m);
            farthest.fold(0.0, f64::max)
        };
        let mut checks = vec![
            Check::of(
                "on ice with the map: departures > 0.3 m from the path",
                f64::from(sum(0)),
            )
            .at_most(0.0),
            Check::of(
                "on ice with the map: farthest from the path, m",
                farthest(0),
            )
            .at_most(BAND_M),
            Check::shown(
                "on ice without the map: departures > 0.3 m",
                f64::from(sum(1)),
            ),
            Check::shown(
                "on ice without the map: farthest from the path, m",
                farthest(1),
            ),
        ];
        let stops: Vec<&[Stopping; 2]> = self
            .arrivals
            .iter()
            .filter_map(|arrival| arrival.stop.as_ref())
            .collect();
        if !stops.is_empty() {
            let longest = |place: usize| {
                let all = stops.iter().map(|pair| pair[place].distance_m);
                all.fold(0.0, f64::max)
            };
            let (with_m, without_m) = (longest(0), longest(1));
            checks.push(Check::shown(
                "longest distance to a stop on ice with the map, m",
                with_m,
            ));
            checks.push(Check::shown(
                "longest distance to a stop on ice without the map, m",
                without_m,
            ));
        }
        checks
    }
}

impl FleetMap {
    /// What must hold of one fleet's map.
    pub fn checks(&self) -> Vec<Check> {
        let (cells, alarms) = if self.torque {
            (
                "with torque: share of driven cells whose 95 % holds the truth",
                "with torque: alerts that unchanged ground has changed",
            )
        } else {
            (
                "without torque: share of driven cells whose 95 % holds the truth",
                "without torque: alerts that unchanged ground has changed",
            )
        };
        let mut checks = vec![
            Check::of(cells, self.before.held_ratio()).at_least(HELD_RATIO_MIN),
            Check::of_count(alarms, self.false_alarms.len() as u64).exactly(0),
        ];
        if self.frozen.cells > 0 {
            // What was known of the ford before it froze is of another ground.
            let elsewhere = self.before.lines.iter();
            let elsewhere = elsewhere.filter(|line| line.terrain != FORD);
            let (cells, held) = elsewhere.fold(
                (self.frozen.cells, self.frozen.held),
                |(cells, held), line| (cells + line.cells, held + line.held),
            );
            checks.push(
                Check::of(
                    "with torque: the same with the ford's cells driven since it froze",
                    f64::from(held) / f64::from(cells),
                )
                .at_least(HELD_RATIO_MIN),
            );
            checks.push(Check::shown(
                "with torque: the same of the frozen ford's cells alone",
                self.frozen.held_ratio(),
            ));
        }
        for [first, second] in &self.ice {
            let share = |pass: &IcePass| f64::from(pass.shown) / f64::from(pass.cells.max(1));
            let shown = Check::shown(
                "share of the cells that show the ice after one pass",
                share(first),
            );
            checks.push(shown);
            checks.push(
                Check::of(
                    "share of the cells that show the ice after two passes",
                    share(second),
                )
                .at_least(SHOWN_RATIO_MIN),
            );
        }
        checks
    }
}
