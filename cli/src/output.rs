//! Output: tables for people, JSON for programs, and error messages.

use std::io::{self, Write};
use std::process::ExitCode;

use anyhow::Context;
use comfy_table::{ContentArrangement, Table, presets};
use serde::Serialize;

use serde_json::json;
use tread_api::problem::ProblemBody;

use crate::client::ClientError;
use crate::exit::Exit;

/// Format of answers on standard output: tables or JSON.
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

    /// Prints a value as JSON, or as the text that `human` returns.
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

    /// Prints an error with its causes and a hint what to do next, and returns the exit code. With
    /// `--json` it is one JSON object on standard error. A closed pipe is not an error.
    pub(crate) fn report(self, error: &anyhow::Error) -> ExitCode {
        let closed_pipe = |cause: &(dyn std::error::Error + 'static)| {
            let io_error = cause.downcast_ref::<io::Error>();
            io_error.is_some_and(|error| error.kind() == io::ErrorKind::BrokenPipe)
        };
        if error.chain().any(closed_pipe) {
            return ExitCode::SUCCESS;
        }
        let client_error = error.downcast_ref::<ClientError>();
        let exit = match (client_error, error.downcast_ref::<WaitTimeout>()) {
            (Some(client_error), _) => client_error.exit(),
            (None, Some(_)) => Exit::TimedOut,
            (None, None) => Exit::BadResult,
        };
        let next_step = client_error.and_then(ClientError::next_step);
        let message = match client_error {
            // The errors in between repeat that the server was unreachable.
            Some(ClientError::Unreachable { .. }) => format!("{error}: {}", error.root_cause()),
            _ => format!("{error:#}"),
        };
        if self.json {
            let problem = client_error.and_then(ClientError::problem);
            print_note(&failure(&message, exit, next_step, problem).to_string());
        } else {
            print_note(&format!("tread: {message}"));
            if let Some(next_step) = next_step {
                print_note(&format!("next: {next_step}"));
            }
        }
        exit.into()
    }
}

/// Returns the JSON object for an error.
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

/// Error: an awaited event did not happen in the allowed time.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub(crate) struct WaitTimeout(pub(crate) String);

/// Prints a value as one line of JSON.
pub(crate) fn json_line<T: Serialize>(value: &T) -> anyhow::Result<()> {
    line(&serde_json::to_string(value).context("cannot write the answer as JSON")?)
}

/// Prints a line to standard output.
pub(crate) fn line(text: &str) -> anyhow::Result<()> {
    writeln!(io::stdout().lock(), "{text}").context("cannot print")
}

/// Prints a line to standard error.
pub(crate) fn print_note(text: &str) {
    // An error is ignored: without standard error there is no place to report it.
    _ = writeln!(io::stderr().lock(), "{text}");
}

/// Creates a table without borders.
pub(crate) fn table<const N: usize>(header: [&str; N]) -> Table {
    let mut table = Table::new();
    table.load_style(presets::NOTHING);
    table.set_content_arrangement(ContentArrangement::Disabled);
    table.set_header(header);
    table
}

/// Returns a table as text, without spaces at the ends of lines.
pub(crate) fn render(table: &Table) -> String {
    let lines: Vec<String> = table
        .lines()
        .map(|line| line.trim_end().to_owned())
        .collect();
    lines.join("\n")
}

/// Returns values with commas between them.
pub(crate) fn joined<T: ToString>(values: &[T]) -> String {
    let texts: Vec<String> = values.iter().map(ToString::to_string).collect();
    texts.join(", ")
}

/// Returns a value as text, `-` for `None`.
pub(crate) fn or_dash<T: ToString>(value: Option<T>) -> String {
    value.map_or_else(|| "-".to_owned(), |value| value.to_string())
}

/// Formats a number with `digits` decimals; a number that rounds to zero has no sign.
pub(crate) fn fixed(value: f64, digits: usize) -> String {
    let text = format!("{value:.digits$}");
    match text.strip_prefix('-') {
        Some(zero) if !zero.contains(|digit: char| ('1'..='9').contains(&digit)) => zero.to_owned(),
        _ => text,
    }
}

/// Formats a change with its sign and `digits` decimals; a change that rounds to zero has no sign.
pub(crate) fn signed(value: f64, digits: usize) -> String {
    let text = fixed(value, digits);
    let is_zero = !text.contains(|digit: char| ('1'..='9').contains(&digit));
    if text.starts_with('-') || is_zero || !value.is_finite() {
        text
    } else {
        format!("+{text}")
    }
}

/// Formats an age for people.
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
        assert_eq!(signed(-0.0004, 1), "0.0");
        assert_eq!(signed(0.0004, 1), "0.0");
        assert_eq!(signed(0.05, 1), "+0.1");
        assert_eq!(signed(-5.0, 1), "-5.0");
        assert_eq!(signed(f64::NAN, 1), "NaN");
    }
}
