//! Wheels that contradict the body: faulty sensor, slip, or a locked side.

use super::axis::{Axis, NEARER, Rates, Tolerance, finding, kind_of};
use super::{RAISE_FAST_S, RAISE_FROZEN_S, RAISE_SLIP_S, Recent, Verdicts, View};
use crate::consistency::history::{Commanded, Span};
use crate::consistency::{Comparison, Finding, Kind, Subject, Unit};
use crate::geometry::Twist;
use crate::measured::WheelSpeeds;

/// Tolerated difference of wheels and body: wheels slip, and scrub in turns.
pub(super) const WHEELS: Tolerance = Tolerance {
    own_rad_s: 0.08,
    own_m_s: 0.06,
    share_turn: 0.28,
    forward_share: 0.16,
};
/// Tolerated difference where the command, or another channel of the body, also indicates a fault.
pub(super) const CORROBORATED: Tolerance = Tolerance {
    own_rad_s: 0.06,
    own_m_s: 0.05,
    share_turn: 0.15,
    forward_share: 0.12,
};
/// Tolerated difference where wheels measure more than commanded.
const ABOVE: Tolerance = Tolerance {
    own_rad_s: 0.06,
    own_m_s: 0.05,
    share_turn: 0.15,
    forward_share: 0.1,
};
/// Fractions of the fixes' noise that are tolerated where the command also indicates a fault of the
/// wheels.
const SENSOR_NOISE_RATIO: f64 = 0.6;
const ABOVE_NOISE_RATIO: f64 = 0.5;
/// Change of the command, radians or metres per second plus a fraction of it, that must change the
/// value of turning wheels, and the maximum delay of that, seconds.
const HELD_MIN: f64 = 0.08;
const HELD_SHARE: f64 = 0.1;
const HELD_LAG_S: f64 = 0.25;
/// Span in which a locked side is detected, seconds.
const LOCKED_SPAN_S: f64 = 0.2;
/// Maximum delay from a side's command to its effect, seconds.
const LOCKED_LAG_S: f64 = 0.3;
/// Fractions of the command: a side is locked below the first and turns above the second.
const LOCKED: (f64, f64) = (0.2, 0.5);
/// Minimum command at which a locked side is detected, metres per second.
const LOCKED_MIN_M_S: f64 = 0.16;
/// Duration of a fault of the wheels' sensor, of a locked side, and of repeating wheels until a
/// finding, seconds.
const RAISE_SENSOR_S: f64 = 0.2;
const RAISE_LOCKED_S: f64 = 0.3;
const RAISE_REPEATING_S: f64 = 0.5;

/// Detects a base whose wheels and gyro both repeat while the wheels are commanded otherwise. A
/// gyro with noise does not repeat.
pub(super) fn frozen_base(view: &View<'_>, recent: &Recent, verdicts: &mut Verdicts) {
    let are_used = view.channels.wheels && view.channels.gyro;
    if !(are_used && view.repeats.wheels.is_frozen() && view.repeats.gyro.is_frozen()) {
        return;
    }
    for axis in [Axis::Forward, Axis::Turn] {
        let wheels = axis.of(recent.means.wheels);
        let commanded = &recent.commanded;
        if !axis.follows_command(wheels, commanded) {
            let (least, most) = (axis.of(commanded.least), axis.of(commanded.most));
            let predicted = if wheels < least { least } else { most };
            let comparison = Comparison {
                observed: wheels,
                predicted,
            };
            let found = finding(Subject::Wheels, Kind::Frozen, comparison, axis);
            verdicts.contradict(found, RAISE_FAST_S);
            return;
        }
    }
}

/// Returns the tolerated magnitude of the difference of wheel and body rate on an axis, in m/s
/// forward or rad/s in turns, and the factor of the body rate's noise to add to it. Both are
/// smaller where the command also indicates a fault of the wheels.
pub(super) fn slack(
    view: &View<'_>,
    axis: Axis,
    rates: Rates,
    commanded: &Commanded,
) -> (f64, f64) {
    let Rates { wheels, body } = rates;
    if axis.exceeds_command(rates, commanded) {
        (axis.slack(ABOVE, wheels, body), ABOVE_NOISE_RATIO)
    } else if axis.is_sensor_fault(rates, commanded) || is_held(view, axis) {
        (axis.slack(CORROBORATED, wheels, body), SENSOR_NOISE_RATIO)
    } else {
        (axis.slack(WHEELS, wheels, body), 1.0)
    }
}

/// Returns whether the wheels repeat their value while the command changes, which turning wheels
/// never do. Stopped wheels may.
fn is_held(view: &View<'_>, axis: Axis) -> bool {
    let repeats = &view.repeats.wheels;
    let Some(since) = repeats.since().filter(|_| repeats.is_frozen()) else {
        return false;
    };
    let history = view.history;
    let commanded = history.commanded(Span {
        from_s: since.as_secs_f64(),
        to_s: history.now().at_s - HELD_LAG_S,
    });
    let (least, most) = (axis.of(commanded.least), axis.of(commanded.most));
    let is_at_rest = view
        .recent_means()
        .is_none_or(|means| means.wheels == Twist::default());
    !is_at_rest && most - least > HELD_MIN + HELD_SHARE * least.abs().max(most.abs())
}

/// Returns the duration of a fault of the wheels' sensor until a finding, seconds.
fn sensor_raise_s(view: &View<'_>) -> f64 {
    let repeats = &view.repeats.wheels;
    if repeats.is_frozen() {
        RAISE_FROZEN_S
    } else if repeats.is_repeating() {
        // Shortly later it is certain whether they are frozen.
        RAISE_REPEATING_S
    } else {
        RAISE_SENSOR_S
    }
}

/// Records a contradiction of wheels and body: a faulty sensor of the wheels, or slip.
pub(super) fn record_contradiction(
    view: &View<'_>,
    rates: Rates,
    commanded: &Commanded,
    axis: Axis,
    verdicts: &mut Verdicts,
) {
    let is_frozen = view.repeats.wheels.is_frozen();
    // Saturated motors also turn the robot less than commanded.
    let most_rad_s = (commanded.least.angular_rad_s.abs()).max(commanded.most.angular_rad_s.abs());
    let is_saturated = axis == Axis::Turn
        && !is_frozen
        && rates.wheels.abs() < most_rad_s
        && view
            .recent_means()
            .is_some_and(|recent| view.is_saturated(recent.wheels, commanded));
    let comparison = rates.of_wheels();
    let kind = kind_of(comparison, is_frozen);
    let is_sensor_fault = axis.is_sensor_fault(rates, commanded) && !is_saturated;
    if is_sensor_fault || is_held(view, axis) {
        let found = finding(Subject::Wheels, kind, comparison, axis);
        verdicts.contradict(found, sensor_raise_s(view));
    } else {
        let subject = Subject::WheelsAndMotion;
        let found = finding(subject, Kind::Inconsistent, comparison, axis);
        verdicts.contradict(found, RAISE_SLIP_S);
    }
}

/// Detects a side that stands still though it is commanded to turn, while the other one turns. The
/// gyro follows the wheels if the side is locked, and the command if only its encoder is faulty.
pub(super) fn locked(view: &View<'_>, verdicts: &mut Verdicts) {
    let model = view.model;
    let now_s = view.history.now().at_s;
    let Some(means) = view.history.means(view.history.last(LOCKED_SPAN_S)) else {
        return;
    };
    let measured = model.wheel_speeds_from_twist(means.wheels);
    let commanded = view.history.commanded(Span {
        from_s: now_s - LOCKED_SPAN_S - LOCKED_LAG_S,
        to_s: now_s,
    });
    let sides = |of: fn(WheelSpeeds) -> f64| {
        // The slowest command of this side over the ranges of forward speed and turn rate.
        let corner = |linear: Twist, angular: Twist| Twist {
            linear_m_s: linear.linear_m_s,
            angular_rad_s: angular.angular_rad_s,
        };
        let (least, most) = (commanded.least, commanded.most);
        let corners = [least, corner(least, most), corner(most, least), most];
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
        let is_commanded = commanded.abs() >= least_rad_s;
        let other_goes =
            other.1.abs() < least_rad_s || other.0 * other.1.signum() >= goes * other.1.abs();
        let is_shown = other_goes && view.channels.gyro && !view.repeats.gyro.is_frozen();
        if is_commanded && is_shown && measured.abs() <= stands * commanded.abs() {
            let lever_m = if subject == Subject::LeftWheels {
                -model.effective_track_m()
            } else {
                model.effective_track_m()
            };
            let by_wheels = means.wheels.angular_rad_s;
            let missing = (commanded - measured) * model.wheel_radius_m() / lever_m;
            let (wheels_distance, command_distance) = (
                (means.gyro_rad_s - by_wheels).abs(),
                (means.gyro_rad_s - by_wheels - missing).abs(),
            );
            let finding = Finding {
                subject,
                kind: Kind::Locked,
                observed: measured,
                predicted: commanded,
                unit: Unit::RadiansPerSecond,
            };
            if wheels_distance < NEARER * command_distance {
                verdicts.contradict(finding, RAISE_LOCKED_S);
            } else if command_distance < NEARER * wheels_distance {
                let is_frozen = view.repeats.wheels.is_frozen();
                let found = Finding {
                    subject: Subject::Wheels,
                    kind: kind_of(
                        Comparison {
                            observed: measured,
                            predicted: commanded,
                        },
                        is_frozen,
                    ),
                    ..finding
                };
                verdicts.contradict(found, sensor_raise_s(view));
            }
        } else if is_commanded && measured * commanded.signum() >= goes * commanded.abs() {
            verdicts.agree(subject);
        }
    }
}
