//! Findings of the doctor: each answers one question.

use serde::Serialize;

/// Severity of a finding.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum Verdict {
    Ok,
    Warning,
    Problem,
    Skipped,
}

/// Answer to one question.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub(super) struct Finding {
    /// The question, or the robot.
    pub(super) name: String,
    pub(super) verdict: Verdict,
    pub(super) text: String,
    /// The remedy, if one is needed.
    pub(super) next_step: Option<String>,
}

impl Finding {
    pub(super) fn new(
        name: &str,
        verdict: Verdict,
        text: impl Into<String>,
        next_step: Option<&str>,
    ) -> Self {
        Self {
            name: name.to_owned(),
            verdict,
            text: text.into(),
            next_step: next_step.map(str::to_owned),
        }
    }

    pub(super) fn well(name: &str, text: impl Into<String>) -> Self {
        Self::new(name, Verdict::Ok, text, None)
    }

    pub(super) fn warning(name: &str, text: impl Into<String>, next_step: &str) -> Self {
        Self::new(name, Verdict::Warning, text, Some(next_step))
    }

    pub(super) fn problem(name: &str, text: impl Into<String>, next_step: &str) -> Self {
        Self::new(name, Verdict::Problem, text, Some(next_step))
    }

    pub(super) fn mark(&self) -> &'static str {
        match self.verdict {
            Verdict::Ok => "ok   ",
            Verdict::Warning => "WARN ",
            Verdict::Problem => "WRONG",
            Verdict::Skipped => "--   ",
        }
    }
}
