//! Printing: tables for people, JSON for programs, and what went wrong.

use std::io::{self, Write};
use std::process::ExitCode;

use anyhow::Context;
use comfy_table::{ContentArrangement, Table, presets};
use serde::Serialize;

use serde_json::json;
use tread_api::problem::ProblemBody;

use crate::client::ClientError;
use crate::exit::Exit;

/// Where answers go: standard output, as tables or as JSON.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Output {
    json: bool,
}

impl Output {
    pub(crate) fn new(json: bool) -> Self {
        Self { json }
    }

    pub(crate) fn is_json(self) -> bool {
        self.json
    }

    /// Prints a value as JSON, or what `human` makes of it.
    pub(crate) fn show<T: Serialize>(
        self,
        value: &T,
        human: impl FnOnce(&T) -> String,
    ) -> anyhow::Result<()> {
        if self.json {
            json_line(value)
        } else {
            line(&human(value))
        }
    }

    /// Says what went wrong, its causes and what to do next, and chooses the exit code. Programs
    /// get one JSON object on standard error.
    pub(crate) fn report(self, error: &anyhow::Error) -> ExitCode {
        let closed_pipe = |cause: &(dyn std::error::Error + 'static)| {
            let io_error = cause.downcast_ref::<io::Error>();
            io_error.is_some_and(|error| error.kind() == io::ErrorKind::BrokenPipe)
        };
        if error.chain().any(closed_pipe) {
            return ExitCode::SUCCESS;
        }
        let client_error = error.downcast_ref::<ClientError>();
        let exit = match (client_error, error.downcast_ref::<TookTooLong>()) {
            (Some(client_error), _) => client_error.exit(),
            (None, Some(_)) => Exit::TimedOut,
            (None, None) => Exit::WentWrong,
        };
        let next_step = client_error.and_then(ClientError::next_step);
        let message = match client_error {
            // What lies between only says again that it could not be asked.
            Some(ClientError::Unreachable { .. }) => format!("{error}: {}", error.root_cause()),
            _ => format!("{error:#}"),
        };
        if self.json {
            let problem = client_error.and_then(ClientError::problem);
            note(&failure(&message, exit, next_step, problem).to_string());
        } else {
            note(&format!("tread: {message}"));
            if let Some(next_step) = next_step {
                note(&format!("next: {next_step}"));
            }
        }
        exit.into()
    }
}

/// What programs get when there is no success.
pub(crate) fn failure(
    message: &str,
    exit: Exit,
    next_step: Option<&str>,
    problem: Option<&ProblemBody>,
) -> serde_json::Value {
    json!({
        "error": message, "exit_code": exit as u8, "next_step": next_step, "problem": problem,
    })
}

/// Something was waited for and has not come.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub(crate) struct TookTooLong(pub(crate) String);

/// Prints a value as one line of JSON.
pub(crate) fn json_line<T: Serialize>(value: &T) -> anyhow::Result<()> {
    line(&serde_json::to_string(value).context("cannot write the answer as JSON")?)
}

/// Prints a line to standard output.
pub(crate) fn line(text: &str) -> anyhow::Result<()> {
    writeln!(io::stdout().lock(), "{text}").context("cannot print")
}

/// Prints a line to standard error, for people only.
pub(crate) fn note(text: &str) {
    // Nobody reads it when standard error is closed.
    _ = writeln!(io::stderr().lock(), "{text}");
}

/// A table without lines, as command lines print them.
pub(crate) fn table<const N: usize>(header: [&str; N]) -> Table {
    let mut table = Table::new();
    table.load_style(presets::NOTHING);
    table.set_content_arrangement(ContentArrangement::Disabled);
    table.set_header(header);
    table
}

/// A table as text, without the spaces at the ends of its lines.
pub(crate) fn render(table: &Table) -> String {
    let lines: Vec<String> = table
        .lines()
        .map(|line| line.trim_end().to_owned())
        .collect();
    lines.join("\n")
}

/// A value, or a dash where nothing is known.
pub(crate) fn or_dash<T: ToString>(value: Option<T>) -> String {
    value.map_or_else(|| "-".to_owned(), |value| value.to_string())
}

/// A number with so many decimals; what rounds to zero has no sign.
pub(crate) fn fixed(value: f64, digits: usize) -> String {
    let text = format!("{value:.digits$}");
    match text.strip_prefix('-') {
        Some(zero) if !zero.contains(|digit: char| ('1'..='9').contains(&digit)) => zero.to_owned(),
        _ => text,
    }
}

/// An age for people.
pub(crate) fn age(age_ms: u64) -> String {
    match age_ms {
        0..1_000 => format!("{age_ms} ms"),
        1_000..120_000 => format!("{}.{} s", age_ms / 1_000, age_ms % 1_000 / 100),
        120_000..7_200_000 => format!("{} min", age_ms / 60_000),
        _ => format!("{} h", age_ms / 3_600_000),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_number_that_rounds_to_zero_has_no_sign() {
        assert_eq!(fixed(-0.004, 2), "0.00");
        assert_eq!(fixed(-0.0, 0), "0");
        assert_eq!(fixed(-0.006, 2), "-0.01");
        assert_eq!(fixed(-10.0, 1), "-10.0");
    }
}
