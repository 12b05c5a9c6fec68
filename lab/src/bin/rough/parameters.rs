//! Coverage of the intervals of the robot's own parameters.

use serde::Serialize;
use tread_api::friction::NORMAL_95;
use tread_lab::report::{Check, Part, Table, median, percent};
use tread_lab::rough::run::{PARAMETERS, estimates};

use super::score::{Drive, verdict, yes_or_no};

/// Coverage that each parameter must have.
const COVERAGE_MIN: f64 = 0.9;

/// Figures of one parameter over the population, at the end of the drives.
#[derive(Debug, Serialize)]
pub(crate) struct ParameterLine {
    name: &'static str,
    has_torque: bool,
    estimates: usize,
    /// Fraction of the 95 % intervals that contain the true value.
    coverage: f64,
    /// Median half-width of the 95 % interval.
    half_width: f64,
    /// Fraction of the estimates that are prior-dominated.
    prior_dominated: f64,
}

/// A line for each parameter.
pub(crate) fn parameter_lines(has_torque: bool, drives: &[Drive]) -> Vec<ParameterLine> {
    let line = |place: usize, name: &'static str| {
        let (mut covered, mut prior, mut widths) = (0, 0, Vec::new());
        for (_, outcome) in drives {
            let Some(parameters) = &outcome.parameters else {
                continue;
            };
            let estimate = estimates(parameters)[place];
            let (low, high) = estimate.interval_95();
            covered += usize::from((low..=high).contains(&outcome.true_parameters[place]));
            prior += usize::from(estimate.prior_dominated);
            widths.push(NORMAL_95 * estimate.std_dev);
        }
        ParameterLine {
            name,
            has_torque,
            estimates: widths.len(),
            coverage: Part(covered).of(widths.len()),
            half_width: median(&mut widths),
            prior_dominated: Part(prior).of(widths.len()),
        }
    };
    PARAMETERS
        .into_iter()
        .enumerate()
        .map(|(place, name)| line(place, name))
        .collect()
}

impl ParameterLine {
    /// Returns the check of the coverage.
    pub(crate) fn check(&self) -> Check {
        let torque = if self.has_torque { "with" } else { "without" };
        let name = format!("{}, {torque} torque: coverage", self.name);
        Check::of(name, self.coverage).at_least(COVERAGE_MIN)
    }
}

/// The lines as a table.
pub(crate) fn table(lines: &[ParameterLine]) -> Table {
    let mut table = Table::new([
        "parameter of the robot, population",
        "torque",
        "estimates",
        "coverage",
        "half-width",
        "mostly prior",
        "goals",
    ]);
    for line in lines {
        table.row([
            line.name.to_owned(),
            yes_or_no(line.has_torque),
            line.estimates.to_string(),
            percent(line.coverage),
            format!("{:.4}", line.half_width),
            percent(line.prior_dominated),
            verdict(line.check().holds),
        ]);
    }
    table
}
