//! Computes the coverage of the drives and of their strata.

use std::fmt::Write as _;

use serde::Serialize;
use tread_api::friction::NORMAL_95;
use tread_lab::held_out::process::Contacts;
use tread_lab::report::{Check, Part, WIDE_RATIO, median};
use tread_lab::rough::run::{Outcome, SLIPS_MOSTLY, Trial};

/// Goal for the coverage of 95 % intervals.
pub(crate) const COVERAGE_MIN: f64 = 0.85;

/// A drive and its result.
pub(crate) type Drive = (Trial, Outcome);

/// Drives that are evaluated together.
#[derive(Debug, Clone, Copy, Serialize)]
pub(crate) struct Group {
    pub(crate) contacts: Contacts,
    pub(crate) has_torque: bool,
}

impl Group {
    /// For people.
    pub(crate) fn torque(self) -> &'static str {
        if self.has_torque { "with" } else { "without" }
    }
}

/// Figures of all drives, or of a stratum.
#[derive(Debug, Serialize)]
pub(crate) struct Line {
    name: String,
    group: Group,
    /// Whether the coverage has a goal.
    has_goal: bool,
    drives: usize,
    /// Answers: each drive is asked several times.
    answers: usize,
    /// Answers with an interval that is narrow enough.
    estimates: usize,
    /// Fraction of the answers that abstain.
    abstained: f64,
    /// Figures of the estimates, if there are any.
    of_estimates: Option<Figures>,
}

#[derive(Debug, Serialize)]
struct Figures {
    /// Fraction of the estimates whose 95 % interval contains the true θ.
    coverage: f64,
    /// Fractions of the estimates whose interval is below and above the true θ.
    below: f64,
    above: f64,
    /// Median of θ̂/θ − 1.
    error: f64,
    /// Median half-width of the 95 % interval, relative to θ̂.
    half_width: f64,
}

impl Line {
    fn of(name: String, group: Group, has_goal: bool, drives: &[&Drive]) -> Self {
        let (mut errors, mut widths) = (Vec::new(), Vec::new());
        let (mut answers, mut covered, mut below, mut above) = (0, 0, 0, 0);
        for (_, outcome) in drives {
            answers += outcome.said.len();
            for said in outcome.said.into_iter().flatten() {
                let half_width = NORMAL_95 * said.std_dev / said.theta;
                if half_width > WIDE_RATIO {
                    continue;
                }
                errors.push(said.theta / outcome.truth - 1.0);
                widths.push(half_width);
                let (low, high) = said.interval_95();
                covered += usize::from((low..=high).contains(&outcome.truth));
                below += usize::from(high < outcome.truth);
                above += usize::from(low > outcome.truth);
            }
        }
        let estimates = errors.len();
        Self {
            name,
            group,
            has_goal,
            drives: drives.len(),
            answers,
            estimates,
            abstained: 1.0 - Part(estimates).of(answers),
            of_estimates: (estimates > 0).then(|| Figures {
                coverage: Part(covered).of(estimates),
                below: Part(below).of(estimates),
                above: Part(above).of(estimates),
                error: median(&mut errors),
                half_width: median(&mut widths),
            }),
        }
    }

    /// What must hold of the coverage, if it has a goal and there are estimates.
    pub(crate) fn check(&self) -> Option<Check> {
        let (contacts, torque) = (self.group.contacts.text(), self.group.torque());
        let name = format!("{contacts}, {}, {torque} torque: coverage", self.name);
        let figures = self.of_estimates.as_ref().filter(|_| self.has_goal)?;
        Some(Check::of(name, figures.coverage).at_least(COVERAGE_MIN))
    }

    fn cells(&self) -> [String; 9] {
        let percent = |value: f64| format!("{:.1}", 100.0 * value);
        let of = |text: &dyn Fn(&Figures) -> String| {
            self.of_estimates
                .as_ref()
                .map_or_else(|| "-".to_owned(), text)
        };
        [
            self.drives.to_string(),
            self.answers.to_string(),
            self.estimates.to_string(),
            of(&|figures| percent(figures.coverage)),
            of(&|figures| percent(figures.below)),
            of(&|figures| percent(figures.above)),
            of(&|figures| format!("{:+.1}", 100.0 * figures.error)),
            of(&|figures| format!("±{}", percent(figures.half_width))),
            percent(self.abstained),
        ]
    }
}

/// Names of the columns of [`Line::cells`]; shares in per cent.
const COLUMNS: [&str; 9] = [
    "drives",
    "answers",
    "estimates",
    "coverage",
    "below θ",
    "above θ",
    "error",
    "half-width",
    "abstained",
];

/// All drives, and their strata; those of the ground have a goal.
pub(crate) fn lines(group: Group, drives: &[Drive]) -> Vec<Line> {
    type Class = fn(&Drive) -> String;
    let everything: Vec<&Drive> = drives.iter().collect();
    let mut lines = vec![Line::of("all".to_owned(), group, true, &everything)];
    let classes: [(bool, Class); 4] = [
        (true, |(trial, _)| {
            format!("K {:.2}", trial.deviations.curve.stiffness)
        }),
        (false, |(trial, _)| trial.course.text().to_owned()),
        (false, |(trial, _)| trial.make.name.to_owned()),
        (false, |(_, outcome)| {
            let mostly = outcome.beyond_half_peak > SLIPS_MOSTLY;
            format!(
                "{} half the peak's slip",
                if mostly { "beyond" } else { "below" }
            )
        }),
    ];
    for (has_goal, class) in classes {
        let mut names: Vec<String> = drives.iter().map(class).collect();
        names.sort();
        names.dedup();
        for name in names {
            let of_class: Vec<&Drive> =
                drives.iter().filter(|drive| class(drive) == name).collect();
            lines.push(Line::of(name, group, has_goal, &of_class));
        }
    }
    lines
}

/// Prints the lines as a table for people.
pub(crate) fn text(lines: &[Line]) -> String {
    let row = |contacts: &str, name: &str, torque: &str, cells: &[String]| {
        let cells: Vec<String> = cells.iter().map(|cell| format!("{cell:>10}")).collect();
        format!("{contacts:<8} {name:<28} {torque:>8} {}\n", cells.join(" "))
    };
    let mut text = row("contacts", "", "torque", &COLUMNS.map(str::to_owned));
    for line in lines {
        text += &row(
            line.group.contacts.text(),
            &line.name,
            line.group.torque(),
            &line.cells(),
        );
    }
    text
}

/// Prints the lines as a table in Markdown.
pub(crate) fn markdown(lines: &[Line]) -> String {
    let mut text = format!("| contacts | | torque | {} |\n", COLUMNS.join(" | "));
    let _ = writeln!(text, "|---|---|---{}|", "|---".repeat(COLUMNS.len()));
    for line in lines {
        let cells = line.cells().join(" | ");
        let (contacts, torque) = (line.group.contacts.text(), line.group.torque());
        let _ = writeln!(text, "| {contacts} | {} | {torque} | {cells} |", line.name);
    }
    text
}
