//! Tracking laws for comparison only, and the run that compares them. Shipped programs do not use
//! them.
//!
//! Every law drives the same [`Course`] on the same free plant from the same start, with the same
//! measurements. The caller supplies noise: a run draws no random numbers.

mod course;
mod driver;
mod kanayama;
mod paper_law;
mod pursuit;
mod robots;
mod run;

pub use course::{CLOSED_PATH_M, ClosestPoint, Course, Figure8};
pub use driver::{Driver, LawInput};
pub use kanayama::{Kanayama, KanayamaGains, Track};
pub use paper_law::PaperLaw;
pub use pursuit::{Pursuit, PursuitConfig};
pub use robots::husky_like;
pub use run::{BenchError, CrossTrack, Run, Scenario, TickInput, TickOutput, cross_track};

use tread_control::tracking::ThetaKnowledge;

/// Tracking law in a comparison.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Law {
    /// Kanayama's tracker.
    Kanayama(KanayamaGains),
    /// Regulated pure pursuit by Nav2's rules.
    Pursuit(PursuitConfig),
    /// The paper's law; its wheel speeds follow from inverting the measured velocity.
    Yi2007,
    /// The shipped law, with the θ that is known before the first tick.
    Shipped(Option<ThetaKnowledge>),
}
