//! Drives over ground that changes, or does not, and what the agent detects of it.

use std::time::Duration;

use tread_agent::testing::Bench;
use tread_api::safety::Geofence;
use tread_api::site::Grid;
use tread_api::wire::hello::SiteDefinition;
use tread_control::estimation::EstimatorPrior;
use tread_control::geometry::Pose;

use super::drive::RoughDrive;
use super::run::{Course, SETTLES};
use super::sensors::SensorSpec;
use super::spec::{Deviations, Make};
use crate::random::Random;

/// Edge of a cell, metres: so large that segments end by time.
const CELL_M: f64 = 100.0;
/// Time after a change in which it may be detected.
const DETECTED_WITHIN: Duration = Duration::from_secs(15);

/// A drive.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ChangeTrial {
    /// The robot.
    pub make: Make,
    /// Differences of robot and first ground from the agent's model.
    pub deviations: Deviations,
    /// Specification of the sensors.
    pub sensors: SensorSpec,
    /// Course to drive.
    pub course: Course,
    /// Number of laps of the course.
    pub laps: u32,
    /// Seed of the sensor noise.
    pub seed: u64,
    /// Time on the first ground.
    pub before: Duration,
    /// Stiffness K of the second ground; `None` if the drive ends without a change.
    pub after: Option<f64>,
}

/// Result of one drive.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ChangeOutcome {
    /// Number of alarms before the change.
    pub false_alarms: u64,
    /// Time from the change to its detection, seconds; `None` if it was not detected.
    pub delay_s: Option<f64>,
    /// Whether θ was known when the ground changed.
    pub was_known: bool,
}

/// Runs one drive.
///
/// # Errors
/// The robot, its start pose or its plan is impossible.
pub fn run(trial: &ChangeTrial) -> anyhow::Result<ChangeOutcome> {
    let model = trial.make.model()?;
    let random = Random::new(trial.seed);
    let (deviations, sensors) = (trial.deviations, trial.sensors);
    let drive = RoughDrive::new(&model, deviations, sensors, Pose::default(), random)
        .ok_or_else(|| anyhow::anyhow!("the wheels of {} are no rectangle", trial.make.name))?;
    let mut bench = Bench::with_drive(drive, model).with_prior(EstimatorPrior::default());
    bench.send_site(SiteDefinition {
        grid: Grid {
            revision: 1,
            cell_m: CELL_M,
        },
        terrain_revision: 1,
        terrains: Vec::new(),
        geofence: Geofence::default(),
    })?;
    bench.run_for(SETTLES);
    bench.begin(1, &trial.course.laps(trial.laps), None)?;
    bench.run_for(trial.before);
    let false_alarms = bench.ground_changes();
    let was_known = bench.theta().is_some();
    let mut delay_s = None;
    if let Some(stiffness) = trial.after {
        bench.drive_mut().change_ground(stiffness);
        let changed_at = bench.now();
        while delay_s.is_none() && bench.now() < changed_at + DETECTED_WITHIN {
            bench.tick();
            if bench.ground_changes() > false_alarms {
                delay_s = Some(bench.now().saturating_sub(changed_at).as_secs_f64());
            }
        }
    }
    Ok(ChangeOutcome {
        false_alarms,
        delay_s,
        was_known,
    })
}
