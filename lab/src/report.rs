//! What report programs print: their tables, and the goals that they check.

use std::fmt::{self, Display, Formatter, Write as _};
use std::ops::RangeInclusive;

use serde_json::{Value, json};
use tread_control::estimation::manoeuvre::ESTIMATE_HALF_WIDTH_MAX_RATIO;

/// Half-width of a 95 % interval of θ over its value above which an answer counts as none.
pub const WIDE_RATIO: f64 = ESTIMATE_HALF_WIDTH_MAX_RATIO;

/// Returns the median; 0 of nothing.
pub fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or_default()
}

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

/// A number of cases. Its share of all follows: `Part(part).of(whole)`. So part and whole cannot be
/// swapped.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Part(pub usize);

impl Part {
    /// Returns the share of a whole; 0 of nothing.
    #[expect(clippy::cast_precision_loss, reason = "counts far below 2^53")]
    pub fn of(self, whole: usize) -> f64 {
        self.0 as f64 / whole.max(1) as f64
    }
}

/// A table of a report: for people in a terminal by [`Display`], for a page by
/// [`Table::markdown`].
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Table {
    head: Vec<String>,
    rows: Vec<Vec<String>>,
}

impl Table {
    /// Begins a table with the names of its columns. The first column is aligned to the left, all
    /// others to the right.
    #[must_use]
    pub fn new<'a>(head: impl IntoIterator<Item = &'a str>) -> Self {
        Self {
            head: head.into_iter().map(str::to_owned).collect(),
            rows: Vec::new(),
        }
    }

    /// Adds a row; cells that are missing are empty, those beyond the last column are left out.
    pub fn row(&mut self, cells: impl IntoIterator<Item = String>) {
        let empty = std::iter::repeat_with(String::new);
        let row = cells.into_iter().chain(empty).take(self.head.len());
        self.rows.push(row.collect());
    }

    /// The table in Markdown.
    pub fn markdown(&self) -> String {
        let mut text = String::new();
        // A bar would end the cell.
        let line = |cells: &[String]| {
            let cells: Vec<String> = cells.iter().map(|cell| cell.replace('|', "\\|")).collect();
            format!("| {} |\n", cells.join(" | "))
        };
        text.push_str(&line(&self.head));
        text.push('|');
        for place in 0..self.head.len() {
            text.push_str(if place == 0 { "---|" } else { "---:|" });
        }
        text.push('\n');
        for row in &self.rows {
            text.push_str(&line(row));
        }
        text
    }
}

impl Display for Table {
    fn fmt(&self, out: &mut Formatter<'_>) -> fmt::Result {
        let lines = || std::iter::once(&self.head).chain(&self.rows);
        let widths: Vec<usize> = (0..self.head.len())
            .map(|place| lines().map(|cells| cells[place].chars().count()).max())
            .map(Option::unwrap_or_default)
            .collect();
        for cells in lines() {
            let mut text = String::new();
            for (place, (cell, width)) in cells.iter().zip(&widths).enumerate() {
                if place == 0 {
                    write!(text, "{cell:<width$}")?;
                } else {
                    write!(text, "  {cell:>width$}")?;
                }
            }
            writeln!(out, "{}", text.trim_end())?;
        }
        Ok(())
    }
}

/// A report for a page: its tables in Markdown, and then the checks.
pub fn page_markdown<'a>(tables: &[Table], checks: impl IntoIterator<Item = &'a Check>) -> String {
    let tables: Vec<String> = tables.iter().map(Table::markdown).collect();
    format!("{}\n{}", tables.join("\n"), checks_markdown(checks))
}

/// A ratio in per cent, with one decimal; a dash for none.
pub fn percent(ratio: impl Into<Option<f64>>) -> String {
    let text = |ratio: f64| format!("{:.1} %", 100.0 * ratio);
    ratio.into().map_or_else(|| "-".to_owned(), text)
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
    let mut table = Table::new(["figure", "goal", "value", "verdict"]);
    for check in checks {
        table.row([
            check.name.clone(),
            check.goal.clone(),
            check.figure(4),
            check.verdict().to_owned(),
        ]);
    }
    table.markdown()
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

    #[test]
    fn columns_of_a_table_are_aligned_by_characters_and_short_rows_are_filled() {
        let mut table = Table::new(["line", "θ", "coverage"]);
        table.row(["circle".to_owned(), "0.2".to_owned(), percent(0.951)]);
        table.row(["8".to_owned()]);
        assert_eq!(
            table.to_string(),
            "line      θ  coverage\ncircle  0.2    95.1 %\n8\n"
        );
        assert_eq!(
            table.markdown(),
            "| line | θ | coverage |\n|---|---:|---:|\n| circle | 0.2 | 95.1 % |\n| 8 |  |  |\n"
        );
        assert_eq!(percent(None), "-");
    }
}
