//! Report of a demo: results of its missions, and measured against true θ of each terrain.

use std::collections::BTreeMap;
use std::time::Duration;

use serde::Serialize;
use tread_agent::sim::scenario::Scenario;
use tread_api::friction::{FusedFriction, TerrainFriction};
use tread_api::ids::TerrainId;
use tread_api::mission::{Mission, MissionState};

use crate::output::{or_dash, render, table};

/// Minimum driving time on a terrain for the check that it was measured.
const DRIVEN_MIN: Duration = Duration::from_secs(5);

/// Report at the end of a demo.
#[derive(Debug, Serialize)]
pub(super) struct Report {
    duration_s: f64,
    missions: BTreeMap<&'static str, usize>,
    terrains: Vec<TerrainReport>,
    checks: Vec<Check>,
}

/// Terrain with its true and its measured θ.
#[derive(Debug, Serialize)]
struct TerrainReport {
    terrain: TerrainId,
    driven_s: f64,
    true_theta: f64,
    measured_theta: Option<f64>,
    std_dev: Option<f64>,
    /// Whether the 95 % interval contains the true θ.
    interval_holds: Option<bool>,
    interval_95: Option<(f64, f64)>,
    segments: u64,
    robots: u32,
}

/// Check of a value against its goal.
#[derive(Debug, Serialize)]
struct Check {
    name: &'static str,
    goal: String,
    value: usize,
    holds: bool,
}

impl Report {
    pub(super) fn new(
        scenario: &Scenario,
        missions: &[Mission],
        driven: &BTreeMap<TerrainId, Duration>,
        measured: &[TerrainFriction],
        took: Duration,
    ) -> Self {
        let mut by_state = BTreeMap::new();
        for mission in missions {
            *by_state.entry(mission.state.as_str()).or_default() += 1;
        }
        let terrains: Vec<TerrainReport> = scenario
            .terrains
            .iter()
            .map(|terrain| {
                let known = measured.iter().find(|known| known.terrain.id == terrain.id);
                // All robots of a scenario have the same model.
                let friction = known.and_then(|known| known.models.first()?.friction);
                let driven = driven.get(&terrain.id).copied().unwrap_or_default();
                terrain_report(
                    terrain.id.clone(),
                    terrain.stiffness.recip(),
                    driven,
                    friction,
                )
            })
            .collect();
        let succeeded = missions
            .iter()
            .filter(|mission| mission.state == MissionState::Succeeded)
            .count();
        let is_driven = |terrain: &&TerrainReport| terrain.driven_s >= DRIVEN_MIN.as_secs_f64();
        let driven_count = terrains.iter().filter(is_driven).count();
        let measured_count = terrains
            .iter()
            .filter(is_driven)
            .filter(|terrain| terrain.measured_theta.is_some())
            .count();
        let checks = vec![
            Check {
                name: "missions succeeded",
                goal: format!("= {}", missions.len()),
                value: succeeded,
                holds: succeeded == missions.len(),
            },
            Check {
                name: "driven terrains measured",
                goal: format!("= {driven_count}, and at least 1"),
                value: measured_count,
                holds: measured_count == driven_count && measured_count > 0,
            },
        ];
        Self {
            duration_s: took.as_secs_f64(),
            missions: by_state,
            terrains,
            checks,
        }
    }

    /// Whether all missions succeeded and every terrain with sufficient driving time was measured.
    pub(super) fn holds(&self) -> bool {
        self.checks.iter().all(|check| check.holds)
    }

    pub(super) fn for_people(&self) -> String {
        let mut table = table([
            "TERRAIN",
            "DRIVEN S",
            "TRUE THETA",
            "MEASURED",
            "STD DEV",
            "95 % INTERVAL",
            "HOLDS",
            "SEGMENTS",
        ]);
        let number = |value: Option<f64>| or_dash(value.map(|value| format!("{value:.4}")));
        for terrain in &self.terrains {
            table.add_row([
                terrain.terrain.to_string(),
                format!("{:.0}", terrain.driven_s),
                format!("{:.4}", terrain.true_theta),
                number(terrain.measured_theta),
                number(terrain.std_dev),
                or_dash(
                    terrain
                        .interval_95
                        .map(|(low, high)| format!("{low:.4} to {high:.4}")),
                ),
                or_dash(
                    terrain
                        .interval_holds
                        .map(|holds| if holds { "yes" } else { "no" }),
                ),
                terrain.segments.to_string(),
            ]);
        }
        let states: Vec<String> = self
            .missions
            .iter()
            .map(|(state, count)| format!("{count} {state}"))
            .collect();
        format!("missions: {}\n\n{}", states.join(", "), render(&table))
    }
}

fn terrain_report(
    terrain: TerrainId,
    true_theta: f64,
    driven: Duration,
    friction: Option<FusedFriction>,
) -> TerrainReport {
    let interval = friction.map(|known| (known.theta_low_95, known.theta_high_95));
    TerrainReport {
        terrain,
        driven_s: driven.as_secs_f64(),
        true_theta,
        measured_theta: friction.map(|known| known.theta),
        std_dev: friction.map(|known| known.std_dev),
        interval_holds: interval.map(|(low, high)| (low..=high).contains(&true_theta)),
        interval_95: interval,
        segments: friction.map_or(0, |known| known.segments),
        robots: friction.map_or(0, |known| known.robots),
    }
}
