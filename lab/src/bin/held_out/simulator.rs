//! What shows that the simulator is right.

use std::fmt::Write as _;

use serde::Serialize;
use tread_lab::held_out::drawn;
use tread_lab::held_out::process::OdeProgram;
use tread_lab::held_out::truth::{Pull, StepDifference, pulls, step_differences, unequal_loads};
use tread_lab::report::Check;

/// Stiffnesses of the grounds that are measured, rounded.
const GROUNDS: [f64; 3] = [0.457, 3.03, 18.4];
/// Largest relative difference of a measured θ from the true one.
const THETA_ERROR_MAX: f64 = 0.01;
/// Robots whose drives are compared between integration steps, by their seeds.
const COMPARED_SEEDS: [u64; 6] = [1, 2, 3, 4, 5, 6];
/// Largest RMS differences between the step of the drives and half of it: a third of what the sensors'
/// noise is in one sample.
const ACCELERATION_MAX_M_S2: f64 = 0.02;
const YAW_RATE_MAX_RAD_S: f64 = 0.001;

/// Measurements of the simulator itself.
#[derive(Debug, Serialize)]
pub(crate) struct Simulator {
    pulls: Vec<Pull>,
    /// Largest relative difference of a wheel's θ on a circle with unequal loads, for each ground.
    unequal_loads: Vec<f64>,
    steps: Vec<StepDifference>,
}

impl Simulator {
    /// Measures.
    pub(crate) fn tested(program: &OdeProgram) -> anyhow::Result<Self> {
        let mut tested = Self {
            pulls: Vec::new(),
            unequal_loads: Vec::new(),
            steps: Vec::new(),
        };
        for stiffness in GROUNDS {
            eprintln!("held_out: pulling robots on K {stiffness}");
            tested.pulls.extend(pulls(program, stiffness)?);
            tested
                .unequal_loads
                .push(unequal_loads(program, stiffness)?);
        }
        for seed in COMPARED_SEEDS {
            let trial = drawn(seed, true);
            let found = step_differences(program, trial.make, trial.deviations)?;
            tested.steps.extend(found);
        }
        Ok(tested)
    }

    /// The worst of the drives with each integration step.
    fn worst_steps(&self) -> Vec<StepDifference> {
        let mut worst: Vec<StepDifference> = Vec::new();
        for found in &self.steps {
            let same = |one: &&mut StepDifference| one.step_s.total_cmp(&found.step_s).is_eq();
            if let Some(one) = worst.iter_mut().find(same) {
                one.end_m = one.end_m.max(found.end_m);
                one.heading_rad = one.heading_rad.max(found.heading_rad);
                one.yaw_rate_rad_s = one.yaw_rate_rad_s.max(found.yaw_rate_rad_s);
                one.acceleration_m_s2 = one.acceleration_m_s2.max(found.acceleration_m_s2);
                one.torque_mu = one.torque_mu.max(found.torque_mu);
            } else {
                worst.push(*found);
            }
        }
        worst
    }

    /// What must hold.
    pub(crate) fn checks(&self) -> Vec<Check> {
        let errors = self.pulls.iter();
        let errors = errors.map(|pull| (pull.theta_measured() / pull.theta - 1.0).abs());
        let loads = self.unequal_loads.iter().copied().fold(0.0, f64::max);
        let mut checks = vec![
            Check::of(
                "simulator: θ by known pulls, largest relative error",
                errors.fold(0.0, f64::max),
            )
            .at_most(THETA_ERROR_MAX),
            Check::of(
                "simulator: θ of a wheel with unequal loads, largest relative error",
                loads,
            )
            .at_most(THETA_ERROR_MAX),
        ];
        if let Some(finest) = self.worst_steps().last() {
            checks.push(
                Check::of(
                    "simulator: acceleration with half the step, RMS difference, m/s²",
                    finest.acceleration_m_s2,
                )
                .at_most(ACCELERATION_MAX_M_S2),
            );
            checks.push(
                Check::of(
                    "simulator: turn rate with half the step, RMS difference, rad/s",
                    finest.yaw_rate_rad_s,
                )
                .at_most(YAW_RATE_MAX_RAD_S),
            );
        }
        checks
    }

    fn pull_cells(pull: &Pull) -> [String; 6] {
        [
            format!("{:.4}", pull.theta),
            pull.direction.text().to_owned(),
            format!("{:+.3}", pull.mu),
            format!("{:+.3}", pull.mu_of_contacts),
            format!("{:+.5}", pull.slip),
            format!("{:.4}", pull.theta_measured()),
        ]
    }

    fn step_cells(found: &StepDifference) -> [String; 6] {
        [
            format!("{:.2}", 1.0e3 * found.step_s),
            format!("{:.1}", 1.0e3 * found.end_m),
            format!("{:.2}", 1.0e3 * found.heading_rad),
            format!("{:.5}", found.yaw_rate_rad_s),
            format!("{:.4}", found.acceleration_m_s2),
            format!("{:.4}", found.torque_mu),
        ]
    }

    /// Tables in Markdown.
    pub(crate) fn markdown(&self) -> String {
        let mut text = format!(
            "| {} |\n|---|---|---|---|---|---|\n",
            PULL_COLUMNS.join(" | ")
        );
        for pull in &self.pulls {
            let _ = writeln!(text, "| {} |", Self::pull_cells(pull).join(" | "));
        }
        let _ = write!(
            text,
            "\n| {} |\n|---|---|---|---|---|---|\n",
            STEP_COLUMNS.join(" | ")
        );
        for found in self.worst_steps() {
            let _ = writeln!(text, "| {} |", Self::step_cells(&found).join(" | "));
        }
        text
    }

    /// Tables for people.
    pub(crate) fn text(&self) -> String {
        let row = |cells: &[String]| {
            let cells: Vec<String> = cells.iter().map(|cell| format!("{cell:>22}")).collect();
            format!("{}\n", cells.join(" "))
        };
        let mut text = row(&PULL_COLUMNS.map(str::to_owned));
        for pull in &self.pulls {
            text += &row(&Self::pull_cells(pull));
        }
        text.push('\n');
        text += &row(&STEP_COLUMNS.map(str::to_owned));
        for found in self.worst_steps() {
            text += &row(&Self::step_cells(&found));
        }
        text
    }
}

const PULL_COLUMNS: [&str; 6] = [
    "true θ",
    "pull",
    "force over weight",
    "of contacts",
    "slip",
    "measured θ",
];
const STEP_COLUMNS: [&str; 6] = [
    "step, ms",
    "end, mm",
    "heading, mrad",
    "turn rate, rad/s",
    "acceleration, m/s²",
    "torque over load",
];
