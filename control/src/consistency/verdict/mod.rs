//! Comparison of channels with each other, and identification of the wrong one.
//!
//! A channel named by a finding is left out when the others are compared. It is then compared with
//! them separately, to see whether its finding may end.

mod axis;
mod forward;
mod healthy;
mod position;
mod turn;
mod vote;
mod wheels;

use super::fixes::{FixResidual, Jump};
use super::history::{Commanded, History, Means, Span};
use super::track::{Track, Verdict};
use super::turn_gain::TurnGain;
use super::{AllRepeats, Finding, Subject};
use crate::geometry::Twist;
use crate::robot::RobotModel;
use axis::{Axis, Tolerance};

/// Span over which fast channels are compared, seconds.
const RECENT_S: f64 = 0.3;
/// Maximum delay from a command to its effect, seconds.
const COMMAND_LAG_S: f64 = 0.3;
/// Fraction of the fixes' noise by which the wheels must be nearer to the fixes than the gyro is,
/// to contradict the gyro.
const NEARER_TO_FIXES_NOISE_RATIO: f64 = 0.8;
/// Tolerated difference of two channels of the body's motion, in addition to noise.
const BODY: Tolerance = Tolerance {
    own_rad_s: 0.02,
    own_m_s: 0.06,
    share_turn: 0.12,
    forward_share: 0.12,
};
/// Ratio of measured to commanded wheel speed below which motors may be saturated.
const SATURATED: f64 = 0.95;
/// Duration of a contradiction until it becomes a finding, seconds: of fast channels, of fixes,
/// where slip is one explanation, and of a frozen channel.
const RAISE_FAST_S: f64 = 0.3;
const RAISE_FIX_S: f64 = 0.15;
const RAISE_SLIP_S: f64 = 0.6;
const RAISE_FROZEN_S: f64 = 0.1;

/// Channels that are compared.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[expect(clippy::struct_excessive_bools, reason = "each is one channel")]
pub(super) struct Channels {
    gyro: bool,
    wheels: bool,
    odometry: bool,
    position: bool,
}

impl Channels {
    /// Returns the channels that no active finding names.
    fn trusted(tracks: &[Track]) -> Self {
        let is_right = |subject: Subject| tracks[subject as usize].active.is_none();
        Self {
            gyro: is_right(Subject::Gyro),
            wheels: is_right(Subject::Wheels),
            odometry: is_right(Subject::Odometry),
            position: is_right(Subject::Position),
        }
    }

    /// Adds the channel of a subject; None if it is included already or the subject is no single
    /// channel.
    fn with(self, subject: Subject) -> Option<Self> {
        let mut with = self;
        match subject {
            Subject::Gyro => with.gyro = true,
            Subject::Wheels => with.wheels = true,
            Subject::Odometry => with.odometry = true,
            Subject::Position => with.position = true,
            Subject::Accelerometer
            | Subject::LeftWheels
            | Subject::RightWheels
            | Subject::WheelsAndMotion
            | Subject::Motion => {}
        }
        (with != self).then_some(with)
    }
}

/// Input of one comparison.
#[derive(Clone, Copy)]
pub(super) struct View<'a> {
    pub(super) model: &'a RobotModel,
    pub(super) history: &'a History,
    pub(super) residuals: &'a [Option<FixResidual>],
    pub(super) jump: Option<Jump>,
    pub(super) repeats: &'a AllRepeats,
    pub(super) tracks: &'a [Track],
    pub(super) turn_gain: TurnGain,
    /// Whether the robot stands, by command, wheels and fixes.
    pub(super) is_standing: bool,
    pub(super) channels: Channels,
}

impl<'a> View<'a> {
    /// Returns this view with the channels that no active finding names.
    pub(super) fn with_trusted(self) -> Self {
        let channels = Channels::trusted(self.tracks);
        Self { channels, ..self }
    }

    /// Returns the motion by fixes for each span, the shortest first; empty while fixes repeat.
    fn residuals(&self) -> impl Iterator<Item = &'a FixResidual> {
        let is_used = self.channels.position && !self.repeats.position.is_repeating();
        self.residuals.iter().flatten().filter(move |_| is_used)
    }

    /// Returns the range of commands for a span, including their delay.
    fn commanded(&self, residual: &FixResidual) -> Commanded {
        self.history.commanded(Span {
            from_s: residual.from_s - COMMAND_LAG_S,
            to_s: residual.to_s,
        })
    }

    /// Returns whether the motors may be saturated, so that wheels turn less than commanded.
    fn is_saturated(&self, wheels: Twist, commanded: &Commanded) -> bool {
        let rim = |twist| {
            let wheels = self.model.wheel_speeds_from_twist(twist);
            wheels.magnitude_max_rad_s()
        };
        let most = rim(commanded.least).max(rim(commanded.most));
        rim(wheels) < SATURATED * most
    }

    fn recent_means(&self) -> Option<Means> {
        self.history.means(self.history.last(RECENT_S))
    }
}

/// Results of one bin, each indexed by [`Subject`].
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Verdicts {
    /// New contradiction, and the seconds until it becomes a finding.
    contradictions: [Option<(Finding, f64)>; Subject::ALL.len()],
    agrees: [bool; Subject::ALL.len()],
    /// Whether it agrees at standstill.
    agrees_at_rest: [bool; Subject::ALL.len()],
    /// Whether a subject with an active finding still contradicts.
    still_contradicts: [bool; Subject::ALL.len()],
}

impl Verdicts {
    /// Records a contradiction, which becomes a finding after `raise_s` seconds; the first one of a
    /// subject in a bin counts.
    pub(super) fn contradict(&mut self, finding: Finding, raise_s: f64) {
        self.contradictions[finding.subject as usize].get_or_insert((finding, raise_s));
    }

    /// Records that a subject is confirmed to be right.
    pub(super) fn agree(&mut self, subject: Subject) {
        self.agrees[subject as usize] = true;
    }

    fn agree_at_rest(&mut self, subject: Subject) {
        self.agrees_at_rest[subject as usize] = true;
    }

    /// Returns whether there is no contradiction.
    pub(super) fn is_consistent(&self) -> bool {
        self.contradictions.iter().all(Option::is_none)
    }

    /// Returns the result of a subject; a contradiction precedes an agreement.
    pub(super) fn of(&self, subject: Subject) -> Verdict {
        let at = subject as usize;
        match self.contradictions[at] {
            Some((finding, raise_s)) => Verdict::Contradicts(finding, raise_s),
            None if self.still_contradicts[at] => Verdict::StillContradicts,
            None if self.agrees[at] => Verdict::Agrees,
            None if self.agrees_at_rest[at] => Verdict::AgreesAtRest,
            None => Verdict::Nothing,
        }
    }
}

/// Fast channels over the last [`RECENT_S`].
struct Recent {
    means: Means,
    /// Change of the wheels' turn rate between the two halves of the span, rad/s, ≥ 0.
    turn_change: f64,
    /// Change of the wheels' forward speed between the two halves of the span, m/s, ≥ 0.
    forward_change: f64,
    /// Range of the commands that may act in the span.
    commanded: Commanded,
}

impl Recent {
    /// Returns None if the history does not reach back.
    fn of(view: &View<'_>) -> Option<Self> {
        let now_s = view.history.now().at_s;
        let middle_s = now_s - 0.5 * RECENT_S;
        let halves = (
            view.history.means(Span {
                from_s: now_s - RECENT_S,
                to_s: middle_s,
            }),
            view.history.means(Span {
                from_s: middle_s,
                to_s: now_s,
            }),
        );
        let change = |axis: Axis| match halves {
            (Some(early), Some(late)) => (axis.of(late.wheels) - axis.of(early.wheels)).abs(),
            _ => 0.0,
        };
        Some(Self {
            means: view.recent_means()?,
            turn_change: change(Axis::Turn),
            forward_change: change(Axis::Forward),
            commanded: view.history.commanded(Span {
                from_s: now_s - RECENT_S - COMMAND_LAG_S,
                to_s: now_s,
            }),
        })
    }
}

/// Compares all channels, then each one that a finding names.
pub(super) fn evaluate(view: &View<'_>, verdicts: &mut Verdicts) {
    let Some(recent) = Recent::of(view) else {
        return;
    };
    compare(view, &recent, verdicts);
    for subject in Subject::ALL {
        let Some(channels) = view.channels.with(subject) else {
            continue;
        };
        let mut own = Verdicts::default();
        let view = View { channels, ..*view };
        compare(&view, &recent, &mut own);
        if own.is_consistent() {
            verdicts.agrees[subject as usize] = own.agrees[subject as usize];
            verdicts.agrees_at_rest[subject as usize] = own.agrees_at_rest[subject as usize];
        } else {
            verdicts.still_contradicts[subject as usize] = true;
        }
    }
}

/// Compares the channels in use.
fn compare(view: &View<'_>, recent: &Recent, verdicts: &mut Verdicts) {
    if view.channels.position {
        position::jumped(view, verdicts);
        position::frozen(view, recent, verdicts);
    }
    wheels::frozen_base(view, recent, verdicts);
    if view.channels.wheels {
        wheels::locked(view, verdicts);
    }
    let is_turn_clean = turn::check(view, recent, verdicts);
    let is_forward_clean = forward::check(view, recent, is_turn_clean, verdicts);
    if is_turn_clean && is_forward_clean && verdicts.is_consistent() {
        healthy::check(view, recent, verdicts);
    }
}
