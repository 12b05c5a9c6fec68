//! The report programs, and how they are run.

use std::fmt::{self, Display, Formatter};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use anyhow::{Context, bail};
use serde::Deserialize;
use serde_json::{Value, json};
use tread_lab::report::Check;

/// Returns the present time, of which only differences are used.
#[expect(clippy::disallowed_methods, reason = "it times programs")]
pub(crate) fn now() -> std::time::Instant {
    std::time::Instant::now()
}

/// Exit code of a report program with a check that does not hold; 0 if all do.
const MISSED: i32 = 1;

/// A report program with the arguments of its page.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Program {
    pub(crate) name: &'static str,
    arguments: &'static [&'static str],
    /// Folder below that of the programs.
    folder: &'static str,
    /// Command that builds it.
    build: &'static str,
}

const BUILD_LAB: &str = "cargo build --release -p tread-lab --bins";

const fn of_lab(name: &'static str, arguments: &'static [&'static str]) -> Program {
    Program {
        name,
        arguments,
        folder: "",
        build: BUILD_LAB,
    }
}

/// All programs, in the order in which they run. The tick is timed first, before the machine is warm.
pub(crate) const PROGRAMS: [Program; 8] = [
    Program {
        name: "cost",
        arguments: &[],
        folder: "examples",
        build: "cargo build --release -p tread-control --example cost",
    },
    of_lab(
        "rough",
        &["--runs", "200", "--bounds", "6", "--seed", "1000001"],
    ),
    of_lab("robustness", &[]),
    of_lab("ground_change", &[]),
    of_lab("held_out", &["--runs", "60"]),
    Program {
        name: "scenario",
        arguments: &["cells"],
        folder: "",
        build: "cargo build --release -p tread-tests --bin scenario",
    },
    of_lab("tracking", &["--seeds", "12", "--seed", "1001"]),
    of_lab("accuracy", &["--runs", "400"]),
];

impl Display for Program {
    fn fmt(&self, out: &mut Formatter<'_>) -> fmt::Result {
        write!(out, "{}", self.name)?;
        for argument in self.arguments {
            write!(out, " {argument}")?;
        }
        Ok(())
    }
}

/// What a report program prints with `--json`, as far as it is read here.
#[derive(Debug, Deserialize)]
struct Report {
    checks: Vec<ReportedCheck>,
}

#[derive(Debug, Deserialize)]
struct ReportedCheck {
    name: String,
    goal: String,
    value: Option<f64>,
    holds: bool,
}

/// A run of a program.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Run {
    pub(crate) program: Program,
    pub(crate) minutes: f64,
    pub(crate) checks: Vec<Check>,
}

impl Program {
    /// Returns the path of the program.
    ///
    /// # Errors
    /// It is not built.
    pub(crate) fn path(&self, folder: &Path) -> anyhow::Result<PathBuf> {
        let path = folder.join(self.folder).join(self.name);
        if !path.is_file() {
            bail!(
                "{} is missing: build it with `{}`",
                path.display(),
                self.build
            );
        }
        Ok(path)
    }

    /// Runs the program, whose progress goes to standard error.
    ///
    /// # Errors
    /// It cannot be run, or ends with an error.
    pub(crate) fn run(&self, folder: &Path) -> anyhow::Result<Output> {
        let path = self.path(folder)?;
        let begin = now();
        let mut command = Command::new(&path);
        command
            .args(self.arguments)
            .arg("--json")
            .stdin(Stdio::null());
        let output = command.stderr(Stdio::inherit()).output();
        let output = output.with_context(|| format!("cannot run {}", path.display()))?;
        if !matches!(output.status.code(), Some(0 | MISSED)) {
            bail!("{self} ended with {}", output.status);
        }
        Ok(Output {
            program: *self,
            minutes: begin.elapsed().as_secs_f64() / 60.0,
            report: output.stdout,
        })
    }
}

impl Program {
    /// Returns what the program printed in an earlier run.
    ///
    /// # Errors
    /// The report cannot be read.
    pub(crate) fn kept(&self, reports: &Path) -> anyhow::Result<Output> {
        let path = self.report_path(reports);
        let report =
            std::fs::read(&path).with_context(|| format!("cannot read {}", path.display()))?;
        Ok(Output {
            program: *self,
            minutes: 0.0,
            report,
        })
    }

    /// Returns where the program's report is kept.
    pub(crate) fn report_path(&self, reports: &Path) -> PathBuf {
        reports.join(format!("{}.json", self.name))
    }
}

/// What a program printed.
#[derive(Debug)]
pub(crate) struct Output {
    program: Program,
    minutes: f64,
    pub(crate) report: Vec<u8>,
}

impl Output {
    /// Reads the report.
    ///
    /// # Errors
    /// It is none.
    pub(crate) fn read(&self) -> anyhow::Result<Run> {
        let report: Report = serde_json::from_slice(&self.report)
            .with_context(|| format!("{} printed no report", self.program))?;
        anyhow::ensure!(
            !report.checks.is_empty(),
            "{} checked nothing",
            self.program
        );
        let checks = report.checks.into_iter().map(|check| Check {
            name: check.name,
            goal: check.goal,
            value: check.value,
            holds: check.holds,
        });
        Ok(Run {
            program: self.program,
            minutes: self.minutes,
            checks: checks.collect(),
        })
    }
}

impl Run {
    /// Returns the run of a program that could not be run, as a check that does not hold.
    pub(crate) fn failed(program: Program, error: &anyhow::Error) -> Self {
        Self {
            program,
            minutes: 0.0,
            checks: vec![Check {
                name: format!("{error:#}"),
                goal: "a report".to_owned(),
                value: None,
                holds: false,
            }],
        }
    }

    /// Returns the checks with the program before their names.
    pub(crate) fn named_checks(&self) -> impl Iterator<Item = Check> {
        let name = self.program.name;
        self.checks.iter().map(move |check| Check {
            name: format!("{name}: {}", check.name),
            ..check.clone()
        })
    }

    /// Returns how many of its checks hold.
    pub(crate) fn reached(&self) -> usize {
        self.checks.iter().filter(|check| check.holds).count()
    }

    pub(crate) fn json(&self) -> Value {
        json!({
            "program": self.program.to_string(), "minutes": self.minutes,
            "figures": self.checks.len(), "reached": self.reached(),
        })
    }
}

impl Display for Run {
    fn fmt(&self, out: &mut Formatter<'_>) -> fmt::Result {
        let (program, minutes) = (self.program.name, self.minutes);
        let (reached, figures) = (self.reached(), self.checks.len());
        write!(
            out,
            "{program}: {minutes:.1} minutes, {reached} of {figures} goals reached"
        )
    }
}
