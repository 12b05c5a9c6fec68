//! Forward and lateral speed: wheels, odometry over ground, and position fixes.

use super::axis::{Axis, Rates, Tolerance, finding, kind_of};
use super::wheels::{self, WHEELS, WITNESSED};
use super::witnesses::{Nearer, Witnesses};
use super::{BODY, RAISE_FIX_S, RAISE_FROZEN_S, RAISE_SLIP_S, Recent, Verdicts, View};
use crate::consistency::fixes::Seen;
use crate::consistency::history::{Means, Span};
use crate::consistency::{Comparison, Kind, Subject};

const AXIS: Axis = Axis::Forward;
/// Tolerated difference of the position to odometry, wheels and command where these three agree.
const ALONE: Tolerance = Tolerance {
    forward_share: 0.08,
    ..WITNESSED
};
/// Minimum distance by which wheels must be nearer to the fixes than odometry is, in addition to
/// noise, metres per second.
const WITNESSED_MIN_M_S: f64 = 0.03;
/// Fraction of the fixes' noise that is tolerated with [`ALONE`].
const ALONE_NOISE_RATIO: f64 = 0.75;
/// Span over which the present speed is taken, seconds.
const INSTANT_S: f64 = 0.1;
/// Minimum fraction of odometry's excess over the wheels that fixes must show to confirm it.
const SECONDED: f64 = 0.4;
/// Tolerated delay of odometry, seconds.
const ODOMETRY_LAG_S: f64 = 0.1;
/// Tolerated lateral speed by fixes, in addition to noise: metres per second, fraction of the
/// speed, and metres per radian of turn.
const LEFT: (f64, f64, f64) = (0.12, 0.4, 0.5);

/// Compares the forward speeds of wheels, odometry and fixes, and the lateral speed, over the time
/// of the fixes, and records the faulty sensor or slip in `verdicts`.
///
/// Returns false if two speeds disagree, even where no sensor can be blamed yet. Returns true if
/// all agree or nothing can be compared.
pub(super) fn check(
    view: &View<'_>,
    recent: &Recent,
    is_turn_clean: bool,
    verdicts: &mut Verdicts,
) -> bool {
    let mut is_seen = false;
    let mut error_m_s = None;
    // Dead reckoning with a wrong gyro gives no forward direction.
    for seen in view.seen().filter(|_| view.uses.gyro) {
        let Some(means) = view.history.means(seen.span()) else {
            continue;
        };
        is_seen = true;
        error_m_s = error_m_s.or(Some(seen.forward_error_m_s));
        let wheels = means.wheels.linear_m_s;
        let position = wheels + seen.forward_error_m_s;
        if let Some(odometry) = means.odometry_m_s.filter(|_| view.uses.odometry)
            && !agrees_with_position(view, recent, seen, &means, odometry)
        {
            isolate_fault(view, seen, &means, odometry, verdicts);
            return false;
        }
        if !view.uses.wheels {
            continue;
        }
        let commanded = view.commanded(seen);
        let rates = Rates {
            wheels,
            body: position,
        };
        let (slack, share) = wheels::slack(view, AXIS, rates, &commanded);
        let noise = share * seen.noise_m_s + 0.3 * recent.forward_change;
        if seen.forward_error_m_s.abs() > slack + noise {
            let odometry = means.odometry_m_s.filter(|_| view.uses.odometry);
            let is_seconded = odometry
                .is_some_and(|said| (said - wheels).abs() <= AXIS.slack(WITNESSED, said, wheels));
            if is_seconded {
                // The wheels are right: odometry and fixes are distinguished later.
                return false;
            }
            wheels::against_body(view, rates, &commanded, AXIS, verdicts);
            return false;
        }
        if is_turn_clean && moves_laterally(seen, &means) {
            let lateral = Comparison {
                observed: 0.0,
                predicted: seen.left_error_m_s,
            };
            let found = finding(Subject::WheelsAndMotion, Kind::Inconsistent, lateral, AXIS);
            verdicts.contradict(found, RAISE_SLIP_S);
            return false;
        }
    }
    let odometry = recent.means.odometry_m_s;
    let Some(odometry) = odometry.filter(|_| view.uses.odometry && view.uses.wheels) else {
        return true;
    };
    let (wheels, commanded) = (recent.means.wheels.linear_m_s, &recent.commanded);
    let rates = Rates {
        wheels,
        body: odometry,
    };
    let (slack, _) = wheels::slack(view, AXIS, rates, commanded);
    if (odometry - wheels).abs() <= slack + recent.forward_change {
        return true;
    }
    if AXIS.obeys(wheels, commanded) {
        if view.repeats.odometry.is_frozen() {
            let found = finding(Subject::Odometry, Kind::Frozen, rates.of_body(), AXIS);
            verdicts.contradict(found, RAISE_FROZEN_S);
            return false;
        }
        if is_seen {
            // Slip, or odometry: the fixes will distinguish them.
            return false;
        }
    }
    // Saturated motors with odometry that reads too high look like wheels that read too low.
    let off = odometry - wheels;
    let is_seconded = error_m_s.is_none_or(|error| error * off.signum() > SECONDED * off.abs());
    if view.is_saturated(recent.means.wheels, commanded) && !is_seconded {
        return false;
    }
    wheels::against_body(view, rates, commanded, AXIS, verdicts);
    false
}

/// Returns whether odometry and fixes agree over a span.
fn agrees_with_position(
    view: &View<'_>,
    recent: &Recent,
    seen: &Seen,
    means: &Means,
    odometry: f64,
) -> bool {
    let wheels = means.wheels.linear_m_s;
    let position = wheels + seen.forward_error_m_s;
    let at = |at_s: f64| {
        let means = view.history.means(Span {
            from_s: at_s - INSTANT_S,
            to_s: at_s,
        });
        means.map_or(wheels, |means| means.wheels.linear_m_s)
    };
    let span_s = seen.to_s - seen.from_s;
    let lag = ODOMETRY_LAG_S * (at(seen.to_s) - at(seen.from_s)).abs() / span_s;
    let change = 0.3 * recent.forward_change;
    // While a robot slides and turns, earlier lateral motion appears as forward motion.
    let turned = (means.gyro_rad_s.abs() * span_s).min(1.0);
    let noise_m_s = seen.odometry_noise_m_s + turned * seen.left_error_m_s.abs();
    let most = AXIS.slack(BODY, odometry, position) + noise_m_s + change + lag;
    if seen.odometry_error_m_s.abs() > most {
        return false;
    }
    if !view.uses.wheels {
        return true;
    }
    // Wheels agree with odometry and the position shows more: no slip causes that.
    let is_alone = (odometry - wheels).abs() <= AXIS.slack(ALONE, odometry, wheels) + change
        && position.abs() > odometry.abs()
        && seen.odometry_error_m_s.abs()
            > AXIS.slack(ALONE, odometry, position) + ALONE_NOISE_RATIO * noise_m_s + change + lag;
    let is_witnessed = (odometry - wheels).abs()
        > AXIS.slack(WITNESSED, odometry, wheels) + change + lag
        && seen.odometry_error_m_s.abs() - seen.forward_error_m_s.abs()
            > WITNESSED_MIN_M_S + noise_m_s;
    !(is_witnessed || is_alone)
}

/// Names the wrong one of odometry and fixes, or [`Subject::Motion`] if neither can be excluded.
fn isolate_fault(
    view: &View<'_>,
    seen: &Seen,
    means: &Means,
    odometry: f64,
    verdicts: &mut Verdicts,
) {
    let wheels = means.wheels.linear_m_s;
    let position = wheels + seen.forward_error_m_s;
    let commanded = view.commanded(seen);
    let witnesses = Witnesses {
        by_wheels: view.uses.wheels.then_some((
            (seen.odometry_error_m_s - seen.forward_error_m_s).abs(),
            seen.forward_error_m_s.abs(),
        )),
        slack: AXIS.slack(WHEELS, wheels, odometry.abs().min(position.abs())),
        noise: seen.noise_m_s,
        by_command: (!view.is_saturated(means.wheels, &commanded)).then_some((
            AXIS.off_command(odometry, &commanded),
            AXIS.off_command(position, &commanded),
        )),
    };
    let repeats = view.repeats;
    let of_odometry = Comparison {
        observed: odometry,
        predicted: position,
    };
    let of_position = of_odometry.reversed();
    let found = match witnesses.side() {
        Some(Nearer::First) => {
            let kind = kind_of(of_position, repeats.position.is_frozen());
            finding(Subject::Position, kind, of_position, AXIS)
        }
        Some(Nearer::Second) => {
            let kind = kind_of(of_odometry, repeats.odometry.is_frozen());
            finding(Subject::Odometry, kind, of_odometry, AXIS)
        }
        None => {
            let kind = Kind::Inconsistent;
            finding(Subject::Motion, kind, of_odometry, AXIS)
        }
    };
    verdicts.contradict(found, RAISE_FIX_S);
}

/// Returns whether fixes show lateral motion beyond the tolerance.
fn moves_laterally(seen: &Seen, means: &Means) -> bool {
    let wheels_m_s = means.wheels.linear_m_s;
    let position_m_s = wheels_m_s + seen.forward_error_m_s;
    let (own_m_s, share, lever_m) = LEFT;
    let speed_m_s = position_m_s.abs().max(wheels_m_s.abs());
    let slack = own_m_s + share * speed_m_s + lever_m * means.gyro_rad_s.abs() + seen.noise_m_s;
    seen.left_error_m_s.abs() > slack
}
