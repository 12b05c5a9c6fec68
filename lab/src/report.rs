//! What report programs print of the goals that they check: one table for all of them.

use std::fmt::Write as _;
use std::ops::RangeInclusive;

use serde_json::{Value, json};

/// One figure that must be reached.
#[derive(Debug, Clone, PartialEq)]
pub struct Check {
    /// What is measured, and where.
    pub name: String,
    /// The goal in words, for instance `≤ 0.6`.
    pub goal: String,
    /// What was measured; `None` if nothing was.
    pub value: Option<f64>,
    /// Whether the goal is reached.
    pub holds: bool,
}

impl Check {
    /// Begins the check of a figure, `None` if nothing was measured. The comparison follows:
    /// `Check::of(name, value).at_most(bound)`. So value and bound cannot be swapped.
    #[must_use]
    pub fn of(name: impl Into<String>, value: impl Into<Option<f64>>) -> Figure {
        Figure {
            name: name.into(),
            value: value.into(),
        }
    }

    /// What was measured, for people.
    pub fn figure(&self, decimals: usize) -> String {
        let figure = |value| format!("{value:.decimals$}");
        self.value.map_or_else(|| "none".to_owned(), figure)
    }

    /// Whether it holds, for people.
    pub fn verdict(&self) -> &'static str {
        if self.holds { "holds" } else { "FAILS" }
    }
}

/// A figure before it is held against its bound; none, and NaN, are within no bound.
#[derive(Debug, Clone, PartialEq)]
pub struct Figure {
    name: String,
    value: Option<f64>,
}

impl Figure {
    /// The figure must not be above a bound.
    #[must_use]
    pub fn at_most(self, bound: f64) -> Check {
        self.check(format!("≤ {bound}"), |value| value <= bound)
    }

    /// The figure must not be below a bound.
    #[must_use]
    pub fn at_least(self, bound: f64) -> Check {
        self.check(format!("≥ {bound}"), |value| value >= bound)
    }

    /// The figure must lie between two bounds or on one of them.
    #[must_use]
    pub fn between(self, range: RangeInclusive<f64>) -> Check {
        let goal = format!("{} … {}", range.start(), range.end());
        self.check(goal, |value| range.contains(&value))
    }

    fn check(self, goal: String, is_within: impl FnOnce(f64) -> bool) -> Check {
        let Self { name, value } = self;
        Check {
            holds: value.is_some_and(is_within),
            name,
            goal,
            value,
        }
    }
}

/// The checks for programs.
pub fn checks_json<'a>(checks: impl IntoIterator<Item = &'a Check>) -> Value {
    let one = |check: &Check| {
        json!({
            "name": check.name, "goal": check.goal,
            "value": check.value, "holds": check.holds,
        })
    };
    checks.into_iter().map(one).collect()
}

/// The checks as a table in Markdown.
pub fn checks_markdown<'a>(checks: impl IntoIterator<Item = &'a Check>) -> String {
    let mut text = String::from("| figure | goal | value | |\n|---|---|---|---|\n");
    for check in checks {
        // A bar would end the cell.
        let name = check.name.replace('|', "\\|");
        let (goal, value, verdict) = (&check.goal, check.figure(4), check.verdict());
        let _ = writeln!(text, "| {name} | {goal} | {value} | {verdict} |");
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bar_in_a_name_ends_no_cell_and_no_number_holds_no_goal() {
        let check = Check::of("|ε|, m", f64::NAN).at_most(0.1);
        let table = checks_markdown([&check]);
        let last = table.lines().last().unwrap();
        assert_eq!(last, "| \\|ε\\|, m | ≤ 0.1 | NaN | FAILS |");
        assert!(!Check::of("x", f64::NAN).between(0.0..=1.0).holds);
        let nothing = Check::of("x", None).at_most(1.0);
        assert!(!nothing.holds && nothing.figure(4) == "none");
    }
}
