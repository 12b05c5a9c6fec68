//! Who contradicts whom, and who is wrong.

use super::fixes::{Jump, Seen};
use super::history::{Commanded, History, Means};
use super::{AllRepeats, Finding, Kind, Subject, Track, Unit};
use crate::geometry::Twist;
use crate::measured::WheelSpeeds;
use crate::robot::RobotModel;

/// Span over which fast channels are compared, seconds.
const RECENT_S: f64 = 0.4;
/// Share of the commanded speed below which motors are at their limit.
const SATURATED: f64 = 0.95;
/// Span that says how fast it is now, seconds.
const INSTANT_S: f64 = 0.1;
/// Delay of odometry that is let be, seconds.
const ODOMETRY_LAG_S: f64 = 0.1;
/// How long a command may take to show, seconds.
const COMMAND_LAG_S: f64 = 0.6;
/// What wheels and body may differ by: wheels slip, and scrub in turns.
const WHEELS: Tolerance = Tolerance {
    own_rad_s: 0.08,
    own_m_s: 0.06,
    share_turn: 0.28,
    share_ahead: 0.18,
};
/// The same where the command, or another channel of the body, says as well that one is wrong.
const WITNESSED: Tolerance = Tolerance {
    own_rad_s: 0.06,
    own_m_s: 0.05,
    share_turn: 0.15,
    share_ahead: 0.12,
};
/// Share of the fixes' noise by which one channel must be nearer to them than another.
const WITNESS_NOISE_RATIO: f64 = 0.6;
/// What two channels of the body may differ by, above their noise.
const BODY: Tolerance = Tolerance {
    own_rad_s: 0.02,
    own_m_s: 0.05,
    share_turn: 0.12,
    share_ahead: 0.12,
};
/// How well the body or the wheels obey a command.
const COMMAND: Tolerance = Tolerance {
    own_rad_s: 0.15,
    own_m_s: 0.08,
    share_turn: 0.2,
    share_ahead: 0.2,
};
/// Nearer to one than to the other: at most this share of the distance.
const NEARER: f64 = 0.6;
/// The same where both are as near as wheels can tell.
const NEARER_OF_BOTH: f64 = 0.35;
/// Slowest motions that show an inverted sign, radians and metres per second.
const SIGN_MIN: f64 = 0.12;
/// Motion that shows whether a channel agrees, radians and metres per second.
const EXCITED: f64 = 0.1;
/// Path and turn in which a frozen position should have moved, metres and radians.
const FROZEN_PATH: (f64, f64) = (0.08, 0.12);
/// Longest time for that, seconds.
const FROZEN_SPAN_MAX_S: f64 = 2.0;
/// Speed to the left, beside its noise, that fixes may show: metres per second, a share of the
/// speed, and metres per radian of turn.
const LEFT: (f64, f64, f64) = (0.12, 0.4, 0.5);
/// A wheel stands below this share of its command and goes above that one.
const LOCKED: (f64, f64) = (0.2, 0.5);
/// Slowest command by which a locked wheel shows, metres per second.
const LOCKED_MIN_M_S: f64 = 0.2;
/// How long contradictions must last, seconds: of fast channels, of fixes, where slip is one
/// explanation, of a frozen channel, and of a locked wheel.
const RAISE_FAST_S: f64 = 0.3;
const RAISE_FIX_S: f64 = 0.15;
const RAISE_SLIP_S: f64 = 0.6;
const RAISE_FROZEN_S: f64 = 0.1;
const RAISE_LOCKED_S: f64 = 0.6;

/// How far two motions may be apart: a part of its own and a share of the larger.
#[derive(Debug, Clone, Copy)]
struct Tolerance {
    own_rad_s: f64,
    own_m_s: f64,
    share_turn: f64,
    share_ahead: f64,
}

/// What is looked at.
pub(super) struct View<'a> {
    pub(super) model: &'a RobotModel,
    pub(super) history: &'a History,
    pub(super) seen: &'a [Option<Seen>],
    pub(super) jump: Option<Jump>,
    pub(super) repeats: &'a AllRepeats,
    pub(super) tracks: &'a [Track],
}

/// What is found in one bin, by subject.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Verdicts {
    against: [Option<(Finding, f64)>; Subject::ALL.len()],
    agrees: [bool; Subject::ALL.len()],
}

impl Verdicts {
    pub(super) fn contradict(&mut self, finding: Finding, raise_s: f64) {
        self.against[finding.subject as usize].get_or_insert((finding, raise_s));
    }

    pub(super) fn agree(&mut self, subject: Subject) {
        self.agrees[subject as usize] = true;
    }

    pub(super) fn is_consistent(&self) -> bool {
        self.against.iter().all(Option::is_none)
    }

    pub(super) fn each(&self) -> impl Iterator<Item = (Option<(Finding, f64)>, bool)> {
        self.against.into_iter().zip(self.agrees)
    }
}

/// One of the two motions.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Axis {
    Turn,
    Ahead,
}

impl Axis {
    fn of(self, twist: Twist) -> f64 {
        match self {
            Self::Turn => twist.angular_rad_s,
            Self::Ahead => twist.linear_m_s,
        }
    }

    fn unit(self) -> Unit {
        match self {
            Self::Turn => Unit::RadiansPerSecond,
            Self::Ahead => Unit::MetresPerSecond,
        }
    }

    fn slack(self, tolerance: Tolerance, one: f64, other: f64) -> f64 {
        let (own, share) = match self {
            Self::Turn => (tolerance.own_rad_s, tolerance.share_turn),
            Self::Ahead => (tolerance.own_m_s, tolerance.share_ahead),
        };
        own + share * one.abs().max(other.abs())
    }

    /// How far a motion is from all that was commanded.
    fn off_command(self, motion: f64, commanded: &Commanded) -> f64 {
        let (least, most) = (self.of(commanded.least), self.of(commanded.most));
        (least - motion).max(motion - most).max(0.0)
    }

    fn obeys(self, motion: f64, commanded: &Commanded) -> bool {
        let (least, most) = (self.of(commanded.least), self.of(commanded.most));
        self.off_command(motion, commanded) <= self.slack(COMMAND, least, most)
    }
}

fn finding(subject: Subject, kind: Kind, observed: f64, predicted: f64, axis: Axis) -> Finding {
    Finding {
        subject,
        kind,
        observed,
        predicted,
        unit: axis.unit(),
    }
}

/// How a channel is wrong.
fn kind_of(observed: f64, predicted: f64, is_frozen: bool) -> Kind {
    let (small, large) = if observed.abs() < predicted.abs() {
        (observed.abs(), predicted.abs())
    } else {
        (predicted.abs(), observed.abs())
    };
    if is_frozen {
        Kind::Frozen
    } else if observed * predicted < 0.0 && small > SIGN_MIN && small > 0.6 * large {
        Kind::Inverted
    } else {
        Kind::Inconsistent
    }
}

/// What the body does, by which channels.
#[derive(Debug, Clone, Copy)]
struct Body {
    motion: f64,
    /// Two independent channels agree on it.
    is_confirmed: bool,
}

/// Looks at everything.
pub(super) fn judge(view: &View<'_>, verdicts: &mut Verdicts) {
    let now_s = view.history.now().at_s;
    let Some(recent) = view.history.means(now_s - RECENT_S, now_s) else {
        return;
    };
    let halves = (
        view.history.means(now_s - RECENT_S, now_s - 0.5 * RECENT_S),
        view.history.means(now_s - 0.5 * RECENT_S, now_s),
    );
    let change = |axis: Axis| match halves {
        (Some(early), Some(late)) => (axis.of(late.wheels) - axis.of(early.wheels)).abs(),
        _ => 0.0,
    };
    let recent = Recent {
        means: recent,
        turn_change: change(Axis::Turn),
        ahead_change: change(Axis::Ahead),
        commanded: view
            .history
            .commanded(now_s - RECENT_S - COMMAND_LAG_S, now_s),
    };
    jumped(view, verdicts);
    frozen_base(view, &recent, verdicts);
    frozen_position(view, &recent, verdicts);
    let is_turn_clean = turn(view, &recent, verdicts);
    let is_ahead_clean = ahead(view, &recent, verdicts);
    locked(view, &recent, is_turn_clean, verdicts);
    if is_turn_clean && is_ahead_clean && verdicts.is_consistent() {
        healthy(view, &recent, verdicts);
    }
}

struct Recent {
    means: Means,
    turn_change: f64,
    ahead_change: f64,
    commanded: Commanded,
}

fn jumped(view: &View<'_>, verdicts: &mut Verdicts) {
    let Some(jump) = view.jump else {
        return;
    };
    // The larger of both, a metre being as far as a radian.
    let (observed, unit) = if jump.by_m >= jump.by_rad.abs() {
        (jump.by_m, Unit::Metres)
    } else {
        (jump.by_rad, Unit::Radians)
    };
    let finding = Finding {
        subject: Subject::Position,
        kind: Kind::Jumped,
        observed,
        predicted: 0.0,
        unit,
    };
    verdicts.contradict(finding, 0.0);
}

/// Wheels and gyro that both repeat themselves while the wheels are to do something else: a base that
/// says the same for ever. A gyro with noise would not.
fn frozen_base(view: &View<'_>, recent: &Recent, verdicts: &mut Verdicts) {
    if !(view.repeats.wheels.is_frozen() && view.repeats.gyro.is_frozen()) {
        return;
    }
    for axis in [Axis::Ahead, Axis::Turn] {
        let wheels = axis.of(recent.means.wheels);
        let commanded = &recent.commanded;
        if !axis.obeys(wheels, commanded) {
            let (least, most) = (axis.of(commanded.least), axis.of(commanded.most));
            let predicted = if wheels < least { least } else { most };
            let found = finding(Subject::Wheels, Kind::Frozen, wheels, predicted, axis);
            verdicts.contradict(found, RAISE_FAST_S);
            return;
        }
    }
}

/// Fixes that stay the same to the last bit while wheels or gyro say that the robot went on.
fn frozen_position(view: &View<'_>, recent: &Recent, verdicts: &mut Verdicts) {
    let repeats = &view.repeats.position;
    let Some(since) = repeats.since().filter(|_| repeats.is_frozen()) else {
        return;
    };
    let now_s = view.history.now().at_s;
    let from_s = since.as_secs_f64().max(now_s - FROZEN_SPAN_MAX_S);
    let span_s = now_s - from_s;
    let Some(means) = view.history.means(from_s, now_s) else {
        return;
    };
    let path_m = means.wheels.linear_m_s.abs() * span_s;
    let turn_rad = means.gyro_rad_s.abs() * span_s;
    let odometry_stands = means.odometry_m_s.is_some_and(|ahead_m_s| {
        !view.repeats.odometry.is_frozen() && ahead_m_s.abs() < 0.25 * means.wheels.linear_m_s.abs()
    });
    let moves = path_m >= FROZEN_PATH.0 && !odometry_stands;
    // A gyro that is frozen too says nothing.
    let turns = turn_rad >= FROZEN_PATH.1
        && !view.repeats.gyro.is_frozen()
        && recent.means.gyro_rad_s * recent.means.wheels.angular_rad_s > 0.0;
    if moves || turns {
        let (predicted, axis) = if moves {
            (means.wheels.linear_m_s, Axis::Ahead)
        } else {
            (means.gyro_rad_s, Axis::Turn)
        };
        let finding = finding(Subject::Position, Kind::Frozen, 0.0, predicted, axis);
        verdicts.contradict(finding, RAISE_FROZEN_S);
    }
}

/// The turn rate; whether nothing contradicts.
fn turn(view: &View<'_>, recent: &Recent, verdicts: &mut Verdicts) -> bool {
    let axis = Axis::Turn;
    let is_frozen = view.repeats.gyro.is_frozen();
    let (gyro, wheels) = (recent.means.gyro_rad_s, recent.means.wheels.angular_rad_s);
    let slack = wheels_slack(axis, wheels, gyro, &recent.commanded);
    let contradicts = (gyro - wheels).abs() > slack + recent.turn_change;
    let mut agreed = None;
    for seen in view.seen.iter().flatten() {
        let Some(means) = view.history.means(seen.from_s, seen.to_s) else {
            continue;
        };
        let gyro = means.gyro_rad_s;
        let heading = gyro + seen.turn_error_rad_s;
        let slack = axis.slack(BODY, gyro, heading) + seen.noise_rad_s + 0.3 * recent.turn_change;
        let wheels = means.wheels.angular_rad_s;
        let is_witnessed = (gyro - wheels).abs()
            > axis.slack(WITNESSED, gyro, wheels) + recent.turn_change
            && seen.turn_error_rad_s.abs() - seen.wheels_turn_error_rad_s.abs()
                > WITNESS_NOISE_RATIO * seen.noise_rad_s;
        if seen.turn_error_rad_s.abs() <= slack && !is_witnessed {
            agreed = agreed.or(Some((heading, means.wheels.angular_rad_s)));
            continue;
        }
        let commanded = view
            .history
            .commanded(seen.from_s - COMMAND_LAG_S, seen.to_s);
        let witnesses = Witnesses {
            by_wheels: (
                (seen.turn_error_rad_s - seen.wheels_turn_error_rad_s).abs(),
                seen.wheels_turn_error_rad_s.abs(),
            ),
            slack: axis.slack(WHEELS, wheels, gyro.abs().min(heading.abs())),
            noise: seen.noise_rad_s,
            by_command: (
                axis.off_command(gyro, &commanded),
                axis.off_command(heading, &commanded),
            ),
        };
        let found = match witnesses.side() {
            Some(Nearer::First) => {
                let kind = kind_of(heading, gyro, view.repeats.position.is_frozen());
                finding(Subject::Position, kind, heading, gyro, axis)
            }
            Some(Nearer::Second) => {
                let kind = kind_of(gyro, heading, is_frozen);
                finding(Subject::Gyro, kind, gyro, heading, axis)
            }
            None => finding(Subject::Motion, Kind::Inconsistent, gyro, heading, axis),
        };
        // Fixes and wheels are both slow where a turn begins: blaming the fixes takes longer.
        let raise_s = if found.subject == Subject::Position {
            RAISE_SLIP_S
        } else {
            RAISE_FIX_S
        };
        verdicts.contradict(found, raise_s);
        return false;
    }
    if !contradicts {
        return true;
    }
    let obeys = axis.obeys(wheels, &recent.commanded);
    if is_frozen && obeys && !view.repeats.wheels.is_frozen() {
        let found = finding(Subject::Gyro, Kind::Frozen, gyro, wheels, axis);
        verdicts.contradict(found, RAISE_FROZEN_S);
        return false;
    }
    let body = match agreed {
        // Fixes of the same span see the same contradiction: two channels of the body agree.
        Some((heading, wheels)) => {
            let slack = wheels_slack(axis, wheels, heading, &recent.commanded);
            let is_seen = (heading - wheels).abs() > slack;
            if !is_seen {
                return false;
            }
            Body {
                motion: gyro,
                is_confirmed: true,
            }
        }
        None if view.seen.iter().any(Option::is_some) => return false,
        None => Body {
            motion: gyro,
            is_confirmed: false,
        },
    };
    let is_opposite = kind_of(gyro, wheels, false) == Kind::Inverted;
    if !body.is_confirmed && is_opposite && obeys {
        let found = finding(Subject::Gyro, Kind::Inverted, gyro, wheels, axis);
        verdicts.contradict(found, RAISE_FAST_S);
    } else {
        wheels_against_body(view, &body, wheels, &recent.commanded, axis, verdicts);
    }
    false
}

/// Whether wheels contradict their command and the body obeys it.
fn is_of_sensor(axis: Axis, wheels: f64, body: f64, commanded: &Commanded) -> bool {
    !axis.obeys(wheels, commanded)
        && axis.off_command(body, commanded) < NEARER * axis.off_command(wheels, commanded)
}

/// What wheels and body may differ by.
fn wheels_slack(axis: Axis, wheels: f64, body: f64, commanded: &Commanded) -> f64 {
    let tolerance = if is_of_sensor(axis, wheels, body, commanded) {
        WITNESSED
    } else {
        WHEELS
    };
    axis.slack(tolerance, wheels, body)
}

/// Wheels that contradict the body: their sensor, or slip.
fn wheels_against_body(
    view: &View<'_>,
    body: &Body,
    wheels: f64,
    commanded: &Commanded,
    axis: Axis,
    verdicts: &mut Verdicts,
) {
    let is_frozen = view.repeats.wheels.is_frozen();
    // Motors that reach less than is asked of them turn less as well.
    let now_s = view.history.now().at_s;
    let is_slow = view
        .history
        .means(now_s - RECENT_S, now_s)
        .is_some_and(|recent| {
            let ahead_m_s = recent.wheels.linear_m_s;
            let (least, most) = (commanded.least.linear_m_s, commanded.most.linear_m_s);
            ahead_m_s.abs() < SATURATED * least.abs().max(most.abs())
        });
    let is_saturated = axis == Axis::Turn
        && is_slow
        && wheels.abs()
            < commanded
                .least
                .angular_rad_s
                .abs()
                .max(commanded.most.angular_rad_s.abs());
    let kind = kind_of(wheels, body.motion, is_frozen);
    if is_of_sensor(axis, wheels, body.motion, commanded) && !is_saturated {
        let found = finding(Subject::Wheels, kind, wheels, body.motion, axis);
        let raise_s = if is_frozen {
            RAISE_FROZEN_S
        } else {
            RAISE_SLIP_S
        };
        verdicts.contradict(found, raise_s);
    } else {
        let subject = Subject::WheelsAndMotion;
        let found = finding(subject, Kind::Inconsistent, wheels, body.motion, axis);
        verdicts.contradict(found, RAISE_SLIP_S);
    }
}

/// Which of two channels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Nearer {
    First,
    Second,
}

/// What wheels and command say of two channels of the body that disagree: how far each is from
/// them, a fast one first and position fixes second.
struct Witnesses {
    by_wheels: (f64, f64),
    /// What the wheels may differ by, and what noise of the fixes adds.
    slack: f64,
    noise: f64,
    by_command: (f64, f64),
}

impl Witnesses {
    /// Which of both is right, if anything distinguishes them.
    fn side(&self) -> Option<Nearer> {
        let agrees = (
            self.by_wheels.0 <= self.slack,
            self.by_wheels.1 <= self.slack + self.noise,
        );
        let by_command = nearer(self.by_command, NEARER);
        let by_wheels = match agrees {
            (true, false) => Some(Nearer::First),
            (false, true) => Some(Nearer::Second),
            (true, true) => nearer(self.by_wheels, NEARER_OF_BOTH),
            (false, false) => by_command,
        };
        // Two witnesses that contradict each other name nobody.
        by_wheels.filter(|side| by_command.is_none_or(|other| other == *side))
    }
}

/// Which of two distances is clearly the smaller one.
fn nearer((first, second): (f64, f64), share: f64) -> Option<Nearer> {
    if first < share * second {
        Some(Nearer::First)
    } else if second < share * first {
        Some(Nearer::Second)
    } else {
        None
    }
}

/// The speed ahead, and to the left; whether nothing contradicts.
fn ahead(view: &View<'_>, recent: &Recent, verdicts: &mut Verdicts) -> bool {
    let axis = Axis::Ahead;
    let mut is_clean = true;
    let mut is_seen = false;
    for seen in view.seen.iter().flatten() {
        let Some(means) = view.history.means(seen.from_s, seen.to_s) else {
            continue;
        };
        is_seen = true;
        let commanded = view
            .history
            .commanded(seen.from_s - COMMAND_LAG_S, seen.to_s);
        let wheels = means.wheels.linear_m_s;
        let position = wheels + seen.ahead_error_m_s;
        let noise = seen.noise_m_s + 0.3 * recent.ahead_change;
        let at = |at_s: f64| {
            let means = view.history.means(at_s - INSTANT_S, at_s);
            means.map_or(wheels, |means| means.wheels.linear_m_s)
        };
        let span_s = seen.to_s - seen.from_s;
        let lag = ODOMETRY_LAG_S * (at(seen.to_s) - at(seen.from_s)).abs() / span_s;
        let is_witnessed = |odometry: f64| {
            (odometry - wheels).abs()
                > axis.slack(WITNESSED, odometry, wheels) + 0.3 * recent.ahead_change + lag
                && seen.odometry_error_m_s.abs() - seen.ahead_error_m_s.abs()
                    > WITNESS_NOISE_RATIO * seen.noise_m_s
        };
        if let Some(odometry) = means.odometry_m_s
            && (seen.odometry_error_m_s.abs() > axis.slack(BODY, odometry, position) + noise + lag
                || is_witnessed(odometry))
        {
            let witnesses = Witnesses {
                by_wheels: (
                    (seen.odometry_error_m_s - seen.ahead_error_m_s).abs(),
                    seen.ahead_error_m_s.abs(),
                ),
                slack: axis.slack(WHEELS, wheels, odometry.abs().min(position.abs())),
                noise: seen.noise_m_s,
                by_command: (
                    axis.off_command(odometry, &commanded),
                    axis.off_command(position, &commanded),
                ),
            };
            let found = match witnesses.side() {
                Some(Nearer::First) => {
                    let kind = kind_of(position, odometry, view.repeats.position.is_frozen());
                    finding(Subject::Position, kind, position, odometry, axis)
                }
                Some(Nearer::Second) => {
                    let kind = kind_of(odometry, position, view.repeats.odometry.is_frozen());
                    finding(Subject::Odometry, kind, odometry, position, axis)
                }
                None => finding(
                    Subject::Motion,
                    Kind::Inconsistent,
                    odometry,
                    position,
                    axis,
                ),
            };
            verdicts.contradict(found, RAISE_FIX_S);
            return false;
        }
        let slack = wheels_slack(axis, wheels, position, &commanded);
        if seen.ahead_error_m_s.abs() > slack + noise {
            is_clean = false;
            let body = Body {
                motion: position,
                is_confirmed: means.odometry_m_s.is_some(),
            };
            wheels_against_body(view, &body, wheels, &commanded, axis, verdicts);
            break;
        }
        if moves_laterally(seen, &means, position, wheels) {
            is_clean = false;
            let (subject, left) = (Subject::WheelsAndMotion, seen.left_error_m_s);
            let found = finding(subject, Kind::Inconsistent, 0.0, left, axis);
            verdicts.contradict(found, RAISE_SLIP_S);
            break;
        }
    }
    let Some(odometry) = recent.means.odometry_m_s.filter(|_| !is_seen) else {
        return is_clean;
    };
    let wheels = recent.means.wheels.linear_m_s;
    if (odometry - wheels).abs() > axis.slack(WHEELS, odometry, wheels) + recent.ahead_change {
        is_clean = false;
        if view.repeats.odometry.is_frozen() && axis.obeys(wheels, &recent.commanded) {
            let found = finding(Subject::Odometry, Kind::Frozen, odometry, wheels, axis);
            verdicts.contradict(found, RAISE_FROZEN_S);
        } else {
            let body = Body {
                motion: odometry,
                is_confirmed: false,
            };
            wheels_against_body(view, &body, wheels, &recent.commanded, axis, verdicts);
        }
    }
    is_clean
}

/// Whether fixes say that the robot goes where it does not look.
fn moves_laterally(seen: &Seen, means: &Means, position_m_s: f64, wheels_m_s: f64) -> bool {
    let (own_m_s, share, lever_m) = LEFT;
    let speed_m_s = position_m_s.abs().max(wheels_m_s.abs());
    let slack = own_m_s + share * speed_m_s + lever_m * means.gyro_rad_s.abs() + seen.noise_m_s;
    seen.left_error_m_s.abs() > slack
}

/// A side that stands though it is commanded to turn, while the other one turns.
fn locked(view: &View<'_>, recent: &Recent, is_turn_clean: bool, verdicts: &mut Verdicts) {
    let model = view.model;
    let measured = model.wheel_speeds_from_twist(recent.means.wheels);
    let now_s = view.history.now().at_s;
    let commanded = view.history.commanded(now_s - RECENT_S, now_s);
    let sides = |of: fn(WheelSpeeds) -> f64| {
        // The slowest that this side was commanded, by both ends of what both motions were.
        let corners = [
            Twist {
                linear_m_s: commanded.least.linear_m_s,
                angular_rad_s: commanded.least.angular_rad_s,
            },
            Twist {
                linear_m_s: commanded.least.linear_m_s,
                angular_rad_s: commanded.most.angular_rad_s,
            },
            Twist {
                linear_m_s: commanded.most.linear_m_s,
                angular_rad_s: commanded.least.angular_rad_s,
            },
            Twist {
                linear_m_s: commanded.most.linear_m_s,
                angular_rad_s: commanded.most.angular_rad_s,
            },
        ];
        let speeds = corners.map(|twist| of(model.wheel_speeds_from_twist(twist)));
        let is_one_way =
            speeds.iter().all(|speed| *speed > 0.0) || speeds.iter().all(|speed| *speed < 0.0);
        let slowest = speeds.into_iter().fold(f64::INFINITY, |least, speed| {
            if speed.abs() < least.abs() {
                speed
            } else {
                least
            }
        });
        (of(measured), if is_one_way { slowest } else { 0.0 })
    };
    let (left, right) = (
        sides(|wheels| wheels.left_rad_s),
        sides(|wheels| wheels.right_rad_s),
    );
    let least_rad_s = LOCKED_MIN_M_S / model.wheel_radius_m();
    let (stands, goes) = LOCKED;
    for (subject, side, other) in [
        (Subject::LeftWheels, left, right),
        (Subject::RightWheels, right, left),
    ] {
        let (measured, commanded) = side;
        let is_told = commanded.abs() >= least_rad_s;
        let other_goes =
            other.1.abs() < least_rad_s || other.0 * other.1.signum() >= goes * other.1.abs();
        let is_shown = other_goes
            && is_turn_clean
            && !(view.repeats.wheels.is_frozen() && view.repeats.gyro.is_frozen());
        if is_told && is_shown && measured.abs() <= stands * commanded.abs() {
            let finding = Finding {
                subject,
                kind: Kind::Locked,
                observed: measured,
                predicted: commanded,
                unit: Unit::RadiansPerSecond,
            };
            verdicts.contradict(finding, RAISE_LOCKED_S);
        } else if is_told && measured * commanded.signum() >= goes * commanded.abs() {
            verdicts.agree(subject);
        }
    }
}

/// What is shown to be right by motion, or by no longer being what was found.
fn healthy(view: &View<'_>, recent: &Recent, verdicts: &mut Verdicts) {
    let standing = |subject: Subject| view.tracks[subject as usize].standing;
    let means = &recent.means;
    let turns = means.gyro_rad_s.abs() >= EXCITED && means.wheels.angular_rad_s.abs() >= EXCITED;
    let goes = means.wheels.linear_m_s.abs() >= EXCITED;
    let has_fixes = view.seen.iter().any(Option::is_some);
    // What was wrong at rest is right where it agrees at rest.
    let was_at_rest = |subject: Subject| {
        standing(subject).is_some_and(|found| {
            found.kind == Kind::Inconsistent && found.predicted.abs() < EXCITED
        })
    };
    let was_frozen =
        |subject: Subject| standing(subject).is_some_and(|found| found.kind == Kind::Frozen);
    let repeats = view.repeats;
    let gyro_lives = was_frozen(Subject::Gyro) && !repeats.gyro.is_frozen();
    if turns || gyro_lives || was_at_rest(Subject::Gyro) {
        verdicts.agree(Subject::Gyro);
    }
    let obeys = Axis::Ahead.obeys(means.wheels.linear_m_s, &recent.commanded)
        && Axis::Turn.obeys(means.wheels.angular_rad_s, &recent.commanded);
    let wheels_live = was_frozen(Subject::Wheels) && !repeats.wheels.is_frozen();
    if obeys && (goes || turns || wheels_live || was_at_rest(Subject::Wheels)) {
        verdicts.agree(Subject::Wheels);
    }
    let position = standing(Subject::Position);
    let has_jumped = position.is_some_and(|found| found.kind == Kind::Jumped);
    let position_lives = was_frozen(Subject::Position) && !repeats.position.is_frozen();
    if has_fixes
        && (goes || turns || position_lives || has_jumped || was_at_rest(Subject::Position))
    {
        verdicts.agree(Subject::Position);
    }
    let odometry_lives = was_frozen(Subject::Odometry) && !repeats.odometry.is_frozen();
    if means.odometry_m_s.is_some() && (goes || odometry_lives || was_at_rest(Subject::Odometry)) {
        verdicts.agree(Subject::Odometry);
    }
    if has_fixes && (goes || turns) {
        verdicts.agree(Subject::Motion);
    }
    verdicts.agree(Subject::WheelsAndMotion);
}
