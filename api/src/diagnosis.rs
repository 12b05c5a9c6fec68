//! Findings of `tread doctor` and `tread-server doctor`: each answers one question.

use serde::{Deserialize, Serialize};

/// Severity of a finding.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// Nothing is wrong.
    Ok,
    /// The server works, but somebody should act.
    Warning,
    /// Something does not work, at least for some clients.
    Problem,
    /// The question could not be examined, or does not apply.
    Skipped,
}

/// Answer to one question.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Finding {
    /// The question, or the robot.
    pub name: String,
    /// The severity.
    pub verdict: Verdict,
    /// Description for people.
    pub text: String,
    /// The remedy, if one is needed.
    pub next_step: Option<String>,
}

/// The remedy of a [`Finding`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct NextStep<S>(pub S);

/// A question that is about to be answered, see [`Finding::on`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Question<'a>(&'a str);

impl Question<'_> {
    fn answer(self, verdict: Verdict, text: impl Into<String>) -> Finding {
        Finding {
            name: self.0.to_owned(),
            verdict,
            text: text.into(),
            next_step: None,
        }
    }

    /// Returns the finding that nothing is wrong.
    #[must_use]
    pub fn ok(self, text: impl Into<String>) -> Finding {
        self.answer(Verdict::Ok, text)
    }

    /// Returns the finding that the question was not examined.
    #[must_use]
    pub fn skipped(self, text: impl Into<String>) -> Finding {
        self.answer(Verdict::Skipped, text)
    }

    /// Returns a warning with its remedy.
    #[must_use]
    pub fn warning(
        self,
        text: impl Into<String>,
        next_step: NextStep<impl Into<String>>,
    ) -> Finding {
        self.answer(Verdict::Warning, text).with(next_step)
    }

    /// Returns a problem with its remedy.
    #[must_use]
    pub fn problem(
        self,
        text: impl Into<String>,
        next_step: NextStep<impl Into<String>>,
    ) -> Finding {
        self.answer(Verdict::Problem, text).with(next_step)
    }
}

impl Finding {
    /// Begins the answer to the question of this name.
    #[must_use]
    pub fn on(name: &str) -> Question<'_> {
        Question(name)
    }

    fn with(self, NextStep(next_step): NextStep<impl Into<String>>) -> Self {
        Self {
            next_step: Some(next_step.into()),
            ..self
        }
    }

    /// Returns whether the finding is no problem.
    #[must_use]
    pub fn holds(&self) -> bool {
        self.verdict != Verdict::Problem
    }

    /// Returns the verdict as a column of a table.
    #[must_use]
    pub fn mark(&self) -> &'static str {
        match self.verdict {
            Verdict::Ok => "ok   ",
            Verdict::Warning => "WARN ",
            Verdict::Problem => "WRONG",
            Verdict::Skipped => "--   ",
        }
    }
}
