//! What a report program prints: figures with what they must be, and whether they are.
//!
//! With `--json` one object: the program's own details and `checks`. Otherwise lines for people. The exit code
//! is 1 if a check does not hold.

use std::fmt::Display;
use std::io::{self, Write};
use std::process::ExitCode;

use serde::Serialize;
use tread_lab::report::checks_markdown;

/// A figure with what it must be.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Check {
    /// What it is, with its unit.
    pub name: String,
    /// What it must be.
    pub goal: String,
    /// What it is in this run.
    pub value: f64,
    /// Whether it is that.
    pub holds: bool,
}

impl Check {
    /// Begins the check of a figure; the comparison follows: `Check::of(name, value).at_most(limit)`.
    /// So value and limit cannot be swapped.
    #[must_use]
    pub fn of(name: impl Into<String>, value: f64) -> Figure {
        let name = name.into();
        Figure { name, value }
    }

    /// Begins the check of a count: `Check::of_count(name, count).exactly(goal)`.
    #[must_use]
    pub fn of_count(name: impl Into<String>, value: u64) -> Count {
        let name = name.into();
        Count { name, value }
    }

    /// Something that must be so.
    pub fn so(name: impl Into<String>, holds: bool) -> Self {
        Self::new(name, "= 1".to_owned(), f64::from(u8::from(holds)), holds)
    }

    /// A figure that is shown beside others and need only exist.
    pub fn shown(name: impl Into<String>, value: f64) -> Self {
        Self::new(name, "shown".to_owned(), value, value.is_finite())
    }

    fn new(name: impl Into<String>, goal: String, value: f64, holds: bool) -> Self {
        Self {
            name: name.into(),
            goal,
            value,
            holds,
        }
    }
}

/// A figure before it is held against its limit; NaN is within none.
#[derive(Debug, Clone, PartialEq)]
pub struct Figure {
    name: String,
    value: f64,
}

impl Figure {
    /// The figure must be at least `least`.
    #[must_use]
    pub fn at_least(self, least: f64) -> Check {
        let holds = self.value >= least;
        Check::new(self.name, format!(">= {least}"), self.value, holds)
    }

    /// The figure must be at most `most`.
    #[must_use]
    pub fn at_most(self, most: f64) -> Check {
        let holds = self.value <= most;
        Check::new(self.name, format!("<= {most}"), self.value, holds)
    }

    /// The figure must be below `limit`.
    #[must_use]
    pub fn below(self, limit: f64) -> Check {
        let holds = self.value < limit;
        Check::new(self.name, format!("< {limit}"), self.value, holds)
    }

    /// The figure is shown beside others and need only exist.
    #[must_use]
    pub fn shown(self) -> Check {
        Check::shown(self.name, self.value)
    }
}

/// A count before it is held against its goal.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Count {
    name: String,
    value: u64,
}

impl Count {
    /// The count must be `goal`.
    #[must_use]
    pub fn exactly(self, goal: u64) -> Check {
        let holds = self.value == goal;
        Check::new(self.name, format!("= {goal}"), figure(self.value), holds)
    }
}

/// A count as a figure.
#[must_use]
#[expect(clippy::cast_precision_loss, reason = "counts far below 2^53")]
pub fn figure(count: u64) -> f64 {
    count as f64
}

/// The value below which that share of the figures lies; infinite without any.
pub fn quantile(figures: &mut [f64], share: f64) -> f64 {
    figures.sort_by(f64::total_cmp);
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_precision_loss,
        clippy::cast_sign_loss,
        reason = "an index into a list in memory"
    )]
    let index = (figures.len() as f64 * share).ceil() as usize;
    let found = figures.get(index.saturating_sub(1));
    found.copied().unwrap_or(f64::INFINITY)
}

/// Prints the checks and says with what code the program ends.
///
/// # Errors
/// Nothing can be written.
pub fn print(json: bool, checks: &[Check]) -> anyhow::Result<ExitCode> {
    print_with(json, &(), "", checks)
}

/// The same with details: fields of the object, or words for people.
///
/// # Errors
/// Nothing can be written.
pub fn print_with(
    json: bool,
    details: &impl Serialize,
    words: impl Display,
    checks: &[Check],
) -> anyhow::Result<ExitCode> {
    #[derive(Serialize)]
    struct Object<'a, D> {
        #[serde(flatten)]
        details: &'a D,
        checks: &'a [Check],
    }
    let mut out = io::stdout().lock();
    if json {
        serde_json::to_writer(&mut out, &Object { details, checks })?;
        writeln!(out)?;
    } else {
        write!(out, "{words}")?;
        lines(&mut out, checks)?;
    }
    Ok(exit_code(checks))
}

/// Prints a report for a page: its tables in Markdown, then the checks.
///
/// # Errors
/// Nothing can be written.
pub fn print_markdown(tables: &str, checks: &[Check]) -> anyhow::Result<ExitCode> {
    let of_lab = |check: &Check| tread_lab::report::Check {
        name: check.name.clone(),
        goal: check.goal.clone(),
        value: Some(check.value),
        holds: check.holds,
    };
    let table = checks_markdown(&checks.iter().map(of_lab).collect::<Vec<_>>());
    write!(io::stdout().lock(), "{tables}\n{table}")?;
    Ok(exit_code(checks))
}

fn exit_code(checks: &[Check]) -> ExitCode {
    if checks.iter().all(|check| check.holds) {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    }
}

fn lines(out: &mut impl Write, checks: &[Check]) -> io::Result<()> {
    let widest = checks.iter().map(|check| check.name.chars().count()).max();
    let width = widest.unwrap_or(0);
    for check in checks {
        let verdict = if check.holds { "ok" } else { "FAILED" };
        writeln!(
            out,
            "{verdict:<7}{:<width$}{:>14.3}   goal {}",
            check.name, check.value, check.goal
        )?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_not_a_number_never_holds() {
        let checks = [
            Check::of("", f64::NAN).at_least(0.0),
            Check::of("", f64::NAN).at_most(0.0),
            Check::of("", f64::NAN).below(0.0),
            Check::shown("", f64::NAN),
        ];
        assert!(checks.iter().all(|check| !check.holds), "{checks:?}");
    }

    #[test]
    fn bounds_belong_to_what_holds_but_not_to_below() {
        assert!(Check::of("", 2.0).at_least(2.0).holds);
        assert!(Check::of("", 2.0).at_most(2.0).holds);
        assert!(!Check::of("", 2.0).below(2.0).holds);
        assert!(Check::of_count("", 2).exactly(2).holds);
        assert!(!Check::of_count("", 3).exactly(2).holds);
        assert!(!Check::so("", false).holds);
    }

    #[test]
    fn a_quantile_is_a_figure_that_was_seen() {
        let of = |share: f64| quantile(&mut [3.0, 1.0, 2.0, 4.0], share);
        let seen = [0.0, 0.5, 0.99].map(of);
        assert_eq!(seen.map(f64::to_bits), [1.0, 2.0, 4.0].map(f64::to_bits));
        assert!(quantile(&mut [], 0.5).is_infinite());
    }
}
