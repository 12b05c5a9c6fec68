//! Evidence on one subject over time: start and end of a finding.
//!
//! A finding ends when its channel has agreed for [`CLEAR_S`] during motion that excites it. A
//! finding about the position may forbid the robot to move, so it also ends at standstill, when
//! fixes agree with each other and with a stopped robot for [`REST_CLEAR_S`]. That does not prove
//! the channel right in motion: until motion does, the track is on probation, and the first
//! contradiction makes the finding active again. Each such relapse doubles the time required at
//! standstill.

use super::Finding;
use super::history::BIN_S;

/// Time for which a channel must agree until its finding ends, seconds.
const CLEAR_S: f64 = 2.0;

/// Time for which fixes must agree with each other and with a stopped robot until a finding about
/// them ends at standstill, seconds; it doubles with each relapse, up to the second value.
const REST_CLEAR_S: f64 = 10.0;
const REST_CLEAR_MAX_S: f64 = 600.0;
/// Maximum number of relapses that are counted.
const RELAPSES_MAX: u32 = 16;

/// Result for one subject in one bin.
#[derive(Debug, Clone, Copy)]
pub(super) enum Verdict {
    /// It contradicts; the finding becomes active once that has lasted the given number of seconds.
    Contradicts(Finding, f64),
    /// It contradicts, and a finding is active already.
    StillContradicts,
    /// It is confirmed to be right.
    Agrees,
    /// It agrees with a stopped robot.
    AgreesAtRest,
    /// There is no evidence.
    Nothing,
}

impl Verdict {
    /// Returns this result with a duration of 0 until the finding becomes active.
    pub(super) fn at_once(self) -> Self {
        match self {
            Self::Contradicts(finding, _) => Self::Contradicts(finding, 0.0),
            Self::StillContradicts | Self::Agrees | Self::AgreesAtRest | Self::Nothing => self,
        }
    }
}

/// Evidence on one subject.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Track {
    /// Time for which the subject has contradicted the others, less twice the time since, seconds.
    pub(super) contradicting_s: f64,
    /// Time for which it has been confirmed to be right, seconds.
    agreeing_s: f64,
    /// Time for which it has agreed at standstill, seconds.
    pub(super) rested_s: f64,
    /// Number of findings that ended at standstill and became active again.
    relapses: u32,
    /// Whether its finding ended at standstill and no motion has confirmed that since.
    pub(super) is_on_probation: bool,
    /// Active finding.
    pub(super) active: Option<Finding>,
    /// Last finding, kept until motion has shown that it is over.
    pub(super) found: Option<Finding>,
}

impl Track {
    /// Adds the result of one bin; starts or ends the finding.
    pub(super) fn step(&mut self, verdict: Verdict) {
        match verdict {
            Verdict::Contradicts(finding, raise_s) => {
                self.agreeing_s = 0.0;
                self.rested_s = 0.0;
                self.contradicting_s += BIN_S;
                if self.contradicting_s >= raise_s - 0.5 * BIN_S && self.active.is_none() {
                    self.active = Some(finding);
                    self.found = Some(finding);
                }
                return;
            }
            Verdict::StillContradicts => {
                self.agreeing_s = 0.0;
                // A short contradiction by noise reduces the time at standstill only in part.
                self.rested_s = (self.rested_s - 5.0 * BIN_S).max(0.0);
                return;
            }
            Verdict::Agrees => self.agreeing_s += BIN_S,
            Verdict::AgreesAtRest => {
                self.rested_s += BIN_S;
                if self.active.is_some() && self.rested_s >= self.rest_s() {
                    self.active = None;
                    self.is_on_probation = true;
                    self.rested_s = 0.0;
                }
            }
            Verdict::Nothing => self.rested_s = 0.0,
        }
        self.contradicting_s = (self.contradicting_s - 2.0 * BIN_S).max(0.0);
        if self.agreeing_s >= CLEAR_S {
            *self = Self::default();
        }
    }

    /// Returns the required time of agreement at standstill, seconds, doubled with each relapse.
    fn rest_s(&self) -> f64 {
        (REST_CLEAR_S * 2.0_f64.powi(self.relapses.cast_signed())).min(REST_CLEAR_MAX_S)
    }

    /// Records that a finding that ended at standstill is active again.
    pub(super) fn record_relapse(&mut self) {
        self.is_on_probation = false;
        self.relapses = (self.relapses + 1).min(RELAPSES_MAX);
    }
}
