//! Friction maps of robots unlike the simulator: robots of the rough world measure a ground
//! together, the server's own fusion makes cells of their segments, and each cell's 95 % interval is
//! held against the true θ.
//!
//! On each ground all robots have the same make, tyres, surface and slope, as those of one
//! configuration on one site. Payload, inertia, centre of mass, torque constants, gears and rolling radii
//! are each robot's own.

use std::collections::BTreeMap;
use std::time::Duration;

use anyhow::Context as _;
use serde::Serialize;
use tread_agent::testing::Bench;
use tread_api::friction::Segment;
use tread_api::ids::ConfigurationId;
use tread_api::safety::Geofence;
use tread_api::site::{Cell, Grid};
use tread_api::wire::hello::SiteDefinition;
use tread_control::estimation::EstimatorPrior;
use tread_control::geometry::Pose;
use tread_lab::parallel::in_parallel;
use tread_lab::random::Random;
use tread_lab::report::WIDE_RATIO;
use tread_lab::rough::drive::RoughDrive;
use tread_lab::rough::run::{Course, SETTLES};
use tread_lab::rough::sensors::SensorSpec;
use tread_lab::rough::spec::{Deviations, MAKES};
use tread_server::config::FrictionConfig;
use tread_server::friction::{EpochMeasurement, Ground, Sums, fuse};
use uuid::Uuid;

use crate::report::{Check, figure, quantile};

/// Time that a robot drives: nearly three laps of the figure-8.
const DRIVES: Duration = Duration::from_secs(110);
/// Edge of a cell, metres.
const CELL_M: f64 = 1.0;
/// Least share of the cells whose 95 % interval must hold the truth.
const COVERAGE_MIN: f64 = 0.93;

/// How large a run is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Size {
    /// Seed of the first ground.
    pub seed: u64,
    /// Grounds, each with and without wheel torque.
    pub grounds: u32,
    /// Robots on each ground.
    pub robots: u32,
}

/// What a ground's cells came to.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct GroundMap {
    /// Seed of its robots.
    pub seed: u64,
    /// Whether they measure wheel torque.
    pub has_torque: bool,
    /// True θ.
    pub theta: f64,
    /// Cells that at least one robot measured.
    pub cells: u32,
    /// Cells with an interval.
    pub estimates: u32,
    /// Of these, those whose interval holds the truth.
    pub covered: u32,
    /// Sum of (estimate − truth) over the truth.
    pub error_ratios: f64,
    /// Half-widths of the intervals over their values.
    pub half_widths: Vec<f64>,
}

/// What all grounds came to.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Report {
    /// How large it was.
    pub size: Size,
    /// Each ground with and without torque.
    pub grounds: Vec<GroundMap>,
}

/// Runs all grounds, on all processors.
///
/// # Errors
/// A robot cannot drive, or a segment is beyond the range of the map.
pub fn run(size: Size) -> anyhow::Result<Report> {
    let seeds = (size.seed..).take(size.grounds as usize);
    let jobs: Vec<(u64, bool)> = seeds
        .flat_map(|seed| [(seed, true), (seed, false)])
        .collect();
    let maps = in_parallel(&jobs, |&(seed, has_torque)| {
        map(seed, has_torque, size.robots)
    });
    Ok(Report {
        size,
        grounds: maps.into_iter().collect::<anyhow::Result<_>>()?,
    })
}

/// Another robot on the same tyres and ground.
fn fellow(random: &mut Random, ground: &Deviations) -> Deviations {
    Deviations {
        relaxation_m: ground.relaxation_m,
        lateral_stiffness_ratio: ground.lateral_stiffness_ratio,
        slope_rad: ground.slope_rad,
        rolling_resistance_ratio: ground.rolling_resistance_ratio,
        curve: ground.curve,
        ..Deviations::drawn(random)
    }
}

fn map(seed: u64, has_torque: bool, robots: u32) -> anyhow::Result<GroundMap> {
    let mut random = Random::new(seed);
    let make = random.one_of(&MAKES).context("there are no makes")?;
    let ground = Deviations::drawn(&mut random);
    let theta = ground.curve.theta();
    let mut cells: BTreeMap<Cell, Vec<(u32, Sums)>> = BTreeMap::new();
    let mut now_us = 0;
    for robot in 0..robots {
        let deviations = fellow(&mut random, &ground);
        let sensors = SensorSpec::drawn(&mut random, has_torque);
        let model = make.model()?;
        let noise = Random::new(seed.wrapping_mul(1_000).wrapping_add(u64::from(robot)));
        let drive = RoughDrive::new(&model, deviations, sensors, Pose::default(), noise)
            .context("the wheels are no rectangle")?;
        let mut bench = Bench::with_drive(drive, model).with_prior(EstimatorPrior::default());
        bench.send_site(site())?;
        bench.run_for(SETTLES);
        bench.begin(1, &Course::Figure8.trajectory(), None)?;
        bench.run_for(DRIVES);
        for segment in bench.segments(ConfigurationId::from_uuid(Uuid::nil())) {
            now_us = now_us.max(segment.ended_at.as_microsecond());
            add(&mut cells, robot, &segment)?;
        }
    }
    let mut found = GroundMap {
        seed,
        has_torque,
        theta,
        cells: 0,
        estimates: 0,
        covered: 0,
        error_ratios: 0.0,
        half_widths: Vec::new(),
    };
    for sums in cells.into_values() {
        found.judge(&sums, now_us);
    }
    Ok(found)
}

fn add(
    cells: &mut BTreeMap<Cell, Vec<(u32, Sums)>>,
    robot: u32,
    segment: &Segment,
) -> anyhow::Result<()> {
    let sums = Sums::of(segment).context("a segment is beyond the range of the map")?;
    let of_cell = cells.entry(segment.cell).or_default();
    match of_cell.last_mut() {
        Some((last, before)) if *last == robot => before.add(&sums),
        _ => of_cell.push((robot, sums)),
    }
    Ok(())
}

fn site() -> SiteDefinition {
    SiteDefinition {
        grid: Grid {
            revision: 1,
            cell_m: CELL_M,
        },
        terrain_revision: 1,
        terrains: Vec::new(),
        geofence: Geofence::default(),
    }
}

impl GroundMap {
    fn judge(&mut self, sums: &[(u32, Sums)], now_us: i64) {
        self.cells += 1;
        let seen = sums.iter();
        let mut seen: Vec<EpochMeasurement<u32>> = seen
            .filter_map(|(robot, sums)| EpochMeasurement::of(*robot, 0, sums))
            .collect();
        let config = FrictionConfig::default();
        let Some(fused) = fuse(&mut seen, Ground::Cell, &config, now_us) else {
            return;
        };
        let (low, high) = fused.theta.interval_95();
        let half_width = 0.5 * (high - low) / fused.theta.value;
        if half_width > WIDE_RATIO {
            return;
        }
        self.estimates += 1;
        self.covered += u32::from((low..=high).contains(&self.theta));
        self.error_ratios += fused.theta.value / self.theta - 1.0;
        self.half_widths.push(half_width);
    }
}

/// The grounds of one line.
#[derive(Debug, Clone, PartialEq)]
pub struct Line {
    /// Of which grounds.
    pub name: String,
    /// Cells that were measured.
    pub cells: u32,
    /// Cells with an interval.
    pub estimates: u32,
    /// Share of the intervals that hold the truth.
    pub coverage: f64,
    /// Mean error over the truth.
    pub error_ratio: f64,
    /// Median half-width over the value.
    pub half_width: f64,
}

impl Report {
    /// Lines by torque, and by the stiffness of the ground.
    pub fn lines(&self) -> Vec<Line> {
        let mut lines = Vec::new();
        for (has_torque, name) in [(true, "with torque"), (false, "without torque")] {
            lines.push(self.line(name.to_owned(), |map| map.has_torque == has_torque));
            for stiffness in [0.7, 3.0, 12.0] {
                let is_of = |map: &GroundMap| {
                    map.has_torque == has_torque && (map.theta * stiffness - 1.0).abs() < 0.1
                };
                lines.push(self.line(format!("{name}, K {stiffness}"), is_of));
            }
        }
        lines
    }

    fn line(&self, name: String, is_of: impl Fn(&GroundMap) -> bool) -> Line {
        let maps: Vec<&GroundMap> = self.grounds.iter().filter(|map| is_of(map)).collect();
        let estimates: u32 = maps.iter().map(|map| map.estimates).sum();
        let covered: u32 = maps.iter().map(|map| map.covered).sum();
        let errors: f64 = maps.iter().map(|map| map.error_ratios).sum();
        let widths = maps.iter().flat_map(|map| map.half_widths.iter().copied());
        let mut widths: Vec<f64> = widths.collect();
        Line {
            name,
            cells: maps.iter().map(|map| map.cells).sum(),
            estimates,
            coverage: f64::from(covered) / f64::from(estimates),
            error_ratio: errors / f64::from(estimates),
            half_width: quantile(&mut widths, 0.5),
        }
    }

    /// What must hold.
    pub fn checks(&self) -> Vec<Check> {
        let lines = self.lines();
        let all = lines.iter().filter(|line| !line.name.contains('K'));
        let mut checks: Vec<Check> = all
            .map(|line| {
                let name = format!("{}: coverage of fused cells", line.name);
                Check::of(name, line.coverage).at_least(COVERAGE_MIN)
            })
            .collect();
        let estimates = lines.iter().map(|line| u64::from(line.estimates)).sum();
        checks.push(Check::shown("cells with an interval", figure(estimates)));
        checks
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fused_cells_of_robots_that_differ_hold_the_truth() {
        let report = run(Size {
            seed: 7_000_001,
            grounds: 4,
            robots: 2,
        })
        .expect("robots drive");
        for line in report.lines() {
            if line.name.contains('K') {
                continue;
            }
            assert!(line.estimates > 60, "{line:?}");
            assert!(line.coverage >= 0.93, "{line:?}");
        }
    }
}
