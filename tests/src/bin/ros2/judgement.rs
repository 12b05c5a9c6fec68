//! What a run is held against.

use std::time::Duration;

use tread_tests::report::{Check, Figure};

/// What a run is held against.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Judgement {
    /// Everything: an optimised build on a machine that does nothing else.
    Figures,
    /// What the agent does, on any machine: times and accuracy are shown.
    Behaviour,
}

impl Judgement {
    /// A figure that is at most that where the machine is fit for it; elsewhere it need only exist.
    pub(crate) fn at_most(self, figure: Figure, most: f64) -> Check {
        match self {
            Self::Figures => figure.at_most(most),
            Self::Behaviour => figure.shown(),
        }
    }

    /// The longest wait for what must come soon, or on a slow machine at all.
    pub(crate) const fn patience(self, soon: Duration, at_all: Duration) -> Duration {
        match self {
            Self::Figures => soon,
            Self::Behaviour => at_all,
        }
    }
}
