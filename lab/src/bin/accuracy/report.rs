//! Options of the program, and what its parts hand back.

use std::fmt::Write as _;

use serde_json::{Value, json};
pub(crate) use tread_lab::report::Check;
use tread_lab::report::{checks_json, checks_markdown};

/// Most seeded runs per scenario.
const RUNS_MAX: u32 = 100_000;

/// Arguments of the command line.
pub(crate) struct Options {
    /// Number of seeded runs for each scenario with noise.
    pub(crate) runs: u32,
    /// Number of threads that share the runs.
    pub(crate) threads: usize,
    /// Whether to print one JSON object instead of tables.
    pub(crate) json: bool,
    only: Vec<String>,
}

impl Options {
    /// Reads the arguments of the command line.
    ///
    /// # Errors
    /// The usage line, if an argument is unknown or a number is out of range.
    pub(crate) fn from_arguments(
        arguments: impl Iterator<Item = String>,
    ) -> Result<Self, &'static str> {
        const USAGE: &str = "accuracy [--runs N] [--threads N] [--json | --markdown] [--only tracking,theta,change,held-out]";
        let mut options = Self {
            runs: 200,
            threads: std::thread::available_parallelism().map_or(1, usize::from),
            json: false,
            only: Vec::new(),
        };
        let mut arguments = arguments;
        while let Some(argument) = arguments.next() {
            let mut value = || arguments.next().ok_or(USAGE);
            match argument.as_str() {
                "--json" => options.json = true,
                // The default; accepted because the other report programs have it.
                "--markdown" => options.json = false,
                "--runs" => options.runs = value()?.parse().map_err(|_| USAGE)?,
                "--threads" => options.threads = value()?.parse().map_err(|_| USAGE)?,
                "--only" => options.only = value()?.split(',').map(str::to_owned).collect(),
                _ => return Err(USAGE),
            }
        }
        let known = ["tracking", "theta", "change", "held-out"];
        if options
            .only
            .iter()
            .any(|name| !known.contains(&name.as_str()))
            || !(1..=RUNS_MAX).contains(&options.runs)
            || options.threads == 0
        {
            return Err(USAGE);
        }
        Ok(options)
    }

    /// Returns whether a part is to run: all parts do if none is named.
    pub(crate) fn wants(&self, part: &str) -> bool {
        self.only.is_empty() || self.only.iter().any(|name| name == part)
    }
}

/// Result of one part of the program.
pub(crate) struct Section {
    /// Tables for people, in Markdown.
    pub(crate) text: String,
    /// The same figures for programs.
    pub(crate) figures: Value,
    /// Checks of the part, some of which may have failed.
    pub(crate) checks: Vec<Check>,
}

impl Section {
    /// Returns whether every check holds.
    pub(crate) fn holds(&self) -> bool {
        self.checks.iter().all(|check| check.holds)
    }
}

/// Returns the whole report, in JSON or Markdown.
pub(crate) fn render(sections: &[(&str, Section)], as_json: bool) -> String {
    let checks = sections.iter().flat_map(|(_, section)| &section.checks);
    if as_json {
        let figures: serde_json::Map<String, Value> = sections
            .iter()
            .map(|(name, section)| ((*name).to_owned(), section.figures.clone()))
            .collect();
        return json!({ "figures": figures, "checks": checks_json(checks) }).to_string();
    }
    let mut text = String::new();
    for (name, section) in sections {
        let _ = write!(text, "## {name}\n\n{}\n\n", section.text);
    }
    let _ = write!(text, "## checks\n\n{}", checks_markdown(checks));
    text
}
