//! Findings of the doctor: each answers one question.

use serde::Serialize;

/// Severity of a finding.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum Verdict {
    /// Nothing is wrong.
    Ok,
    /// The server works, but somebody should act.
    Warning,
    /// The server does not work, at least for some clients.
    Problem,
    /// The question could not be examined, or does not apply.
    Skipped,
}

/// Answer to one question.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub(super) struct Finding {
    /// The question.
    pub(super) name: &'static str,
    /// The severity.
    pub(super) verdict: Verdict,
    /// Description for people.
    pub(super) text: String,
    /// The remedy, if one is needed.
    pub(super) next_step: Option<String>,
}

impl Finding {
    fn new(name: &'static str, verdict: Verdict, text: impl Into<String>) -> Self {
        Self {
            name,
            verdict,
            text: text.into(),
            next_step: None,
        }
    }

    pub(super) fn well(name: &'static str, text: impl Into<String>) -> Self {
        Self::new(name, Verdict::Ok, text)
    }

    pub(super) fn skipped(name: &'static str, text: impl Into<String>) -> Self {
        Self::new(name, Verdict::Skipped, text)
    }

    pub(super) fn warning(
        name: &'static str,
        text: impl Into<String>,
        next_step: impl Into<String>,
    ) -> Self {
        let next_step = Some(next_step.into());
        Self {
            next_step,
            ..Self::new(name, Verdict::Warning, text)
        }
    }

    pub(super) fn problem(
        name: &'static str,
        text: impl Into<String>,
        next_step: impl Into<String>,
    ) -> Self {
        Self {
            verdict: Verdict::Problem,
            ..Self::warning(name, text, next_step)
        }
    }

    /// Returns whether the finding is no problem.
    pub(super) fn holds(&self) -> bool {
        self.verdict != Verdict::Problem
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
