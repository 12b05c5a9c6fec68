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
    /// A figure that must not be above a bound; none, and NaN, do not hold.
    pub fn at_most(name: impl Into<String>, value: impl Into<Option<f64>>, bound: f64) -> Self {
        let value = value.into();
        Self {
            name: name.into(),
            goal: format!("≤ {bound}"),
            value,
            holds: value.is_some_and(|value| value <= bound),
        }
    }

    /// A figure that must not be below a bound; NaN does not hold.
    pub fn at_least(name: impl Into<String>, value: f64, bound: f64) -> Self {
        Self {
            name: name.into(),
            goal: format!("≥ {bound}"),
            value: Some(value),
            holds: value >= bound,
        }
    }

    /// A figure that must lie between two bounds; NaN does not hold.
    pub fn between(name: impl Into<String>, value: f64, range: RangeInclusive<f64>) -> Self {
        Self {
            name: name.into(),
            goal: format!("{} … {}", range.start(), range.end()),
            value: Some(value),
            holds: range.contains(&value),
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
        let check = Check::at_most("|ε|, m", f64::NAN, 0.1);
        let table = checks_markdown([&check]);
        let last = table.lines().last().unwrap();
        assert_eq!(last, "| \\|ε\\|, m | ≤ 0.1 | NaN | FAILS |");
        assert!(!Check::between("x", f64::NAN, 0.0..=1.0).holds);
        let nothing = Check::at_most("x", None, 1.0);
        assert!(!nothing.holds && nothing.figure(4) == "none");
    }
}
