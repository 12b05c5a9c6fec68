//! Evidence on one subject over time: when a finding begins to stand, and when it ends.
//!
//! A finding ends when its channel has agreed for [`CLEAR_S`] in motion that shows it. One about the
//! place may leave the robot where it must not move, so it ends at rest as well, when fixes agree with
//! each other and with the robot that stands for [`REST_CLEAR_S`]. That does not show that it is right
//! in motion: until motion has shown it, the track is on probation, and the first contradiction lets
//! the finding stand again. Each such relapse doubles the time at rest that the next one takes.

use super::Finding;
use super::history::BIN_S;
use super::verdict::Verdict;

/// How long a channel must agree until its finding ends, seconds.
const CLEAR_S: f64 = 2.0;

/// How long fixes must agree with each other and with a robot that stands until a finding about
/// them ends at rest, seconds; after relapses longer, up to the second one.
const REST_CLEAR_S: f64 = 10.0;
const REST_CLEAR_MAX_S: f64 = 600.0;
/// Relapses that are counted.
const RELAPSES_MAX: u32 = 16;

/// Evidence on one subject.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Track {
    pub(super) against_s: f64,
    agreeing_s: f64,
    /// How long it has agreed at rest, and how often that was not the end of it.
    pub(super) rested_s: f64,
    relapses: u32,
    /// Its finding ended at rest, and no motion has shown yet that it is right.
    pub(super) is_on_probation: bool,
    pub(super) standing: Option<Finding>,
    /// What was found last, until motion has shown that it is over.
    pub(super) found: Option<Finding>,
}

impl Track {
    pub(super) fn step(&mut self, verdict: Verdict) {
        match verdict {
            Verdict::Against(finding, raise_s) => {
                self.agreeing_s = 0.0;
                self.rested_s = 0.0;
                self.against_s += BIN_S;
                if self.against_s >= raise_s - 0.5 * BIN_S && self.standing.is_none() {
                    self.standing = Some(finding);
                    self.found = Some(finding);
                }
                return;
            }
            Verdict::StillAgainst => {
                self.agreeing_s = 0.0;
                // Noise of a moment costs a part of the time at rest.
                self.rested_s = (self.rested_s - 5.0 * BIN_S).max(0.0);
                return;
            }
            Verdict::Agrees => self.agreeing_s += BIN_S,
            Verdict::AgreesAtRest => {
                self.rested_s += BIN_S;
                if self.standing.is_some() && self.rested_s >= self.rest_s() {
                    self.standing = None;
                    self.is_on_probation = true;
                    self.rested_s = 0.0;
                }
            }
            Verdict::Nothing => self.rested_s = 0.0,
        }
        self.against_s = (self.against_s - 2.0 * BIN_S).max(0.0);
        if self.agreeing_s >= CLEAR_S {
            *self = Self::default();
        }
    }

    /// How long it must agree at rest: twice as long after each time that motion has shown it wrong
    /// again.
    fn rest_s(&self) -> f64 {
        (REST_CLEAR_S * 2.0_f64.powi(self.relapses.cast_signed())).min(REST_CLEAR_MAX_S)
    }

    /// What ended at rest is there again.
    pub(super) fn relapse(&mut self) {
        self.is_on_probation = false;
        self.relapses = (self.relapses + 1).min(RELAPSES_MAX);
    }
}
