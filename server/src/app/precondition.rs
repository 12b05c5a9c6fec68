//! The condition of a request: the revisions of an object that it may change.

use super::AppError;

/// Revisions of an object that a request may change.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Precondition {
    /// Any revision.
    Any,
    /// One of these; without any, no revision.
    OneOf(Vec<u64>),
}

impl Precondition {
    /// Checks the present revision of an object; `what` is its kind.
    ///
    /// # Errors
    /// [`AppError::PreconditionFailed`] if the request may not change this revision.
    pub(super) fn check(&self, what: &'static str, present: u64) -> Result<(), AppError> {
        match self {
            Self::OneOf(expected) if !expected.contains(&present) => {
                Err(AppError::PreconditionFailed {
                    what,
                    present,
                    expected: expected.clone(),
                })
            }
            Self::Any | Self::OneOf(_) => Ok(()),
        }
    }
}
