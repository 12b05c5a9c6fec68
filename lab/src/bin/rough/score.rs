//! Computes the statistics of a line and of the strata of the population, with their goals.

use std::ops::RangeInclusive;

use serde::Serialize;
use tread_api::friction::{NORMAL_95, ThetaEstimate};
use tread_lab::report::{Check, Part, Table, WIDE_RATIO, median, percent};
use tread_lab::rough::run::{ASKED_AT_S, Course, Outcome, SLIPS_MOSTLY, Trial};

/// Goal for the coverage of a line with a single deviation and of a stratum.
const LINE_GOAL: RangeInclusive<f64> = 0.9..=1.0;
/// Goal for the coverage of the population.
const POPULATION_GOAL: RangeInclusive<f64> = 0.93..=0.975;
/// Relative half-width of the bound up to which a drive should give an estimate.
const USEFUL_RATIO: f64 = 0.4;
/// Goal for the median ratio of the half-width to that of the bound.
const OVER_BOUND_GOAL: f64 = 1.5;
/// Maximum relative half-width of the bound of a line, without and with torque, up to which the line counts
/// for the goal of the half-widths.
const NARROW_BOUND_RATIOS: [f64; 2] = [0.2, 0.1];
/// Goals for the median half-width over these lines.
const HALF_WIDTH_GOALS: [f64; 2] = [0.3, 0.15];
/// Goals for the share of drives that end without an estimate, without and with torque.
const ABSTAINED_GOALS: [f64; 2] = [0.3, 0.1];
/// Index of the last estimate of a drive.
const LAST: usize = ASKED_AT_S.len() - 1;
/// Name of the line with all deviations.
pub(crate) const POPULATION: &str = "population";

/// A drive and its result.
pub(crate) type Drive = (Trial, Outcome);

#[derive(Debug, Serialize)]
pub(crate) struct Line {
    pub(crate) name: String,
    has_torque: bool,
    estimates: usize,
    /// Fraction of the estimates whose 95 % interval contains the true θ.
    coverage: f64,
    /// Median of θ̂/θ − 1.
    error: f64,
    /// Median half-width of the 95 % interval, relative to θ̂.
    half_width: f64,
    /// Fraction of missing estimates.
    abstained: f64,
    /// Fraction of drives whose last estimate is missing.
    abstained_at_end: f64,
    /// Median fraction of the time in which a contact slipped by more than half the slip at the
    /// peak.
    beyond_half_peak: f64,
    /// Median relative half-width of the Cramér–Rao bound, if computed.
    bound: Option<f64>,
    /// Median ratio of the half-width to that of the bound, over estimates that have both.
    over_bound: Option<f64>,
    /// Fraction of drives without a last estimate, among those with a useful bound.
    abstained_needlessly: Option<f64>,
}

impl Line {
    /// Computes the statistics of drives with or without measured torque.
    pub(crate) fn of(name: impl Into<String>, has_torque: bool, drives: &[&Drive]) -> Self {
        let (mut errors, mut widths, mut beyond) = (Vec::new(), Vec::new(), Vec::new());
        let (mut covered, mut asked, mut last) = (0, 0, 0);
        let (mut bounds, mut over, mut useful, mut missing) = (Vec::new(), Vec::new(), 0, 0);
        for (_, outcome) in drives {
            for (bound, said) in outcome.bounds.iter().flatten().zip(outcome.said) {
                bounds.push(NORMAL_95 * bound);
                over.extend(said.map(|said| said.std_dev / said.theta / bound));
            }
            if let Some([.., last]) = outcome.bounds
                && NORMAL_95 * last <= USEFUL_RATIO
            {
                useful += 1;
                let is_narrow = |said: ThetaEstimate| half_width(&said) <= WIDE_RATIO;
                missing += usize::from(!outcome.said[LAST].is_some_and(is_narrow));
            }
            beyond.push(outcome.beyond_half_peak);
            asked += outcome.said.len();
            for (index, said) in outcome.said.into_iter().enumerate() {
                let Some(said) = said else { continue };
                let half_width = half_width(&said);
                if half_width > WIDE_RATIO {
                    continue;
                }
                last += usize::from(index + 1 == outcome.said.len());
                errors.push(said.theta / outcome.truth - 1.0);
                widths.push(half_width);
                let (low, high) = said.interval_95();
                covered += usize::from((low..=high).contains(&outcome.truth));
            }
        }
        Self {
            name: name.into(),
            has_torque,
            estimates: errors.len(),
            coverage: Part(covered).of(errors.len()),
            error: median(&mut errors),
            half_width: median(&mut widths),
            abstained: 1.0 - Part(errors.len()).of(asked),
            abstained_at_end: 1.0 - Part(last).of(drives.len()),
            beyond_half_peak: median(&mut beyond),
            bound: (!bounds.is_empty()).then(|| median(&mut bounds)),
            over_bound: (!over.is_empty()).then(|| median(&mut over)),
            abstained_needlessly: (useful > 0).then(|| Part(missing).of(useful)),
        }
    }

    /// Returns the checks of the line: its coverage, availability on figure-8s of the population, and, if
    /// bounds were computed, width and availability of the estimates.
    pub(crate) fn checks(&self) -> Vec<Check> {
        let named = |what: &str| {
            let torque = if self.has_torque { "with" } else { "without" };
            format!("{}, {torque} torque: {what}", self.name)
        };
        let mut checks = vec![self.coverage_check(named("coverage of the 95 % intervals"))];
        checks.extend(self.over_bound.map(|over| {
            Check::of(named("median half-width over the bound's"), over).at_most(OVER_BOUND_GOAL)
        }));
        let most = ABSTAINED_GOALS[usize::from(self.has_torque)];
        checks.extend(self.abstained_needlessly.map(|share| {
            Check::of(named("none after 60 s though the bound is useful"), share).at_most(most)
        }));
        if self.name == format!("{POPULATION}, {}", Course::Figure8.text()) {
            checks.push(Check::of(named("none after 60 s"), self.abstained_at_end).at_most(most));
        }
        checks
    }

    fn coverage_check(&self, name: String) -> Check {
        let goal = if self.name == POPULATION {
            POPULATION_GOAL
        } else {
            LINE_GOAL
        };
        Check::of(name, self.coverage).between(goal)
    }
}

/// Returns the checks of the median half-width over all lines with a single deviation whose bound is narrow;
/// none without bounds.
pub(crate) fn half_width_checks(lines: &[Line]) -> Vec<Check> {
    let check = |has_torque: bool| {
        let place = usize::from(has_torque);
        let is_narrow = |line: &&Line| {
            line.has_torque == has_torque
                && !line.name.starts_with(POPULATION)
                && line.estimates > 0
                && line
                    .bound
                    .is_some_and(|bound| bound <= NARROW_BOUND_RATIOS[place])
        };
        let mut widths: Vec<f64> = lines
            .iter()
            .filter(is_narrow)
            .map(|line| line.half_width)
            .collect();
        let torque = if has_torque { "with" } else { "without" };
        let name = format!(
            "median half-width over {} lines, {torque} torque",
            widths.len()
        );
        (!widths.is_empty())
            .then(|| Check::of(name, median(&mut widths)).at_most(HALF_WIDTH_GOALS[place]))
    };
    [true, false].into_iter().filter_map(check).collect()
}

/// Divides the population by thirds of some deviations, by friction curve, ground, course and make,
/// and by the amount of slip.
pub(crate) fn strata(has_torque: bool, drives: &[Drive]) -> Vec<Line> {
    type Figure = fn(&Drive) -> f64;
    let by_figure: [(&str, Figure); 4] = [
        ("payload", |(trial, _)| trial.deviations.payload_ratio),
        ("inertia over mass", |(trial, _)| {
            trial.deviations.inertia_ratio
        }),
        ("relaxation length", |(trial, _)| {
            trial.deviations.relaxation_m
        }),
        ("slope", |(trial, _)| {
            let [x_rad, y_rad] = trial.deviations.slope_rad;
            x_rad.hypot(y_rad)
        }),
    ];
    let by_class: [fn(&Drive) -> String; 5] = [
        |(trial, _)| trial.deviations.curve.shape.text().to_owned(),
        |(trial, _)| format!("K {}", trial.deviations.curve.stiffness),
        |(trial, _)| trial.course.text().to_owned(),
        |(trial, _)| trial.make.name.to_owned(),
        |(_, outcome)| {
            let mostly = outcome.beyond_half_peak > SLIPS_MOSTLY;
            format!(
                "{} half the peak's slip",
                if mostly { "beyond" } else { "below" }
            )
        },
    ];
    let mut lines = Vec::new();
    let mut add = |name: &str, drives: &[&Drive]| {
        lines.push(Line::of(
            format!("{POPULATION}, {name}"),
            has_torque,
            drives,
        ));
    };
    for (name, figure) in by_figure {
        let mut sorted: Vec<&Drive> = drives.iter().collect();
        sorted.sort_by(|one, other| figure(one).total_cmp(&figure(other)));
        let third = sorted.len().div_ceil(3).max(1);
        for (third, which) in sorted.chunks(third).zip(["low", "middle", "high"]) {
            add(&format!("{which} {name}"), third);
        }
    }
    for class in by_class {
        let mut classes: Vec<String> = drives.iter().map(class).collect();
        classes.sort();
        classes.dedup();
        for name in classes {
            let of_class: Vec<&Drive> =
                drives.iter().filter(|drive| class(drive) == name).collect();
            add(&name, &of_class);
        }
    }
    lines
}

/// The lines as a table.
pub(crate) fn table(lines: &[Line]) -> Table {
    let mut table = Table::new([
        "what differs",
        "torque",
        "estimates",
        "coverage",
        "error",
        "half-width",
        "none",
        "none at 60 s",
        "beyond half the peak",
        "bound",
        "half-width over bound",
        "needlessly none",
        "goals",
    ]);
    for line in lines {
        let holds = line.checks().iter().all(|check| check.holds);
        table.row([
            line.name.clone(),
            yes_or_no(line.has_torque),
            line.estimates.to_string(),
            percent(line.coverage),
            format!("{:+.1} %", 100.0 * line.error),
            percent(line.half_width),
            percent(line.abstained),
            percent(line.abstained_at_end),
            percent(line.beyond_half_peak),
            percent(line.bound),
            line.over_bound
                .map_or_else(|| "-".to_owned(), |over| format!("{over:.1}")),
            percent(line.abstained_needlessly),
            verdict(holds),
        ]);
    }
    table
}

pub(crate) fn yes_or_no(is_so: bool) -> String {
    if is_so { "yes" } else { "no" }.to_owned()
}

/// Whether all goals of a line are reached, for people.
pub(crate) fn verdict(holds: bool) -> String {
    if holds { "hold" } else { "MISSED" }.to_owned()
}

/// Returns the half-width of the 95 % interval, relative to θ̂.
fn half_width(said: &ThetaEstimate) -> f64 {
    NORMAL_95 * said.std_dev / said.theta
}
