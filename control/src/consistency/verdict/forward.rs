//! Forward and lateral speed: wheels, odometry over ground, and position fixes.

use super::axis::{Axis, Rates, Tolerance, finding, kind_of};
use super::vote::{Differences, Favoured, Vote};
use super::wheels::{self, CORROBORATED, WHEELS};
use super::{BODY, RAISE_FIX_S, RAISE_FROZEN_S, RAISE_SLIP_S, Recent, Verdicts, View};
use crate::consistency::fixes::FixResidual;
use crate::consistency::history::{Means, Span};
use crate::consistency::{Comparison, Kind, Subject};

const AXIS: Axis = Axis::Forward;
/// Tolerated difference of the fixes from odometry, where odometry and wheels agree.
const ALONE: Tolerance = Tolerance {
    forward_share: 0.08,
    ..CORROBORATED
};
/// Minimum distance by which wheels must be nearer to the fixes than odometry is, in addition to
/// noise, metres per second.
const NEARER_TO_FIXES_MIN_M_S: f64 = 0.03;
/// Fraction of the fixes' noise that is tolerated with [`ALONE`].
const ALONE_NOISE_RATIO: f64 = 0.75;
/// Span of the mean that counts as the speed at one time, seconds.
const INSTANT_S: f64 = 0.1;
/// Minimum fraction of odometry's excess over the wheels that fixes must show to confirm it.
const CORROBORATED_RATIO_MIN: f64 = 0.4;
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
    let mut has_residual = false;
    let mut error_m_s = None;
    // Dead reckoning with a wrong gyro gives no forward direction.
    for residual in view.residuals().filter(|_| view.channels.gyro) {
        let Some(means) = view.history.means(residual.span()) else {
            continue;
        };
        has_residual = true;
        error_m_s = error_m_s.or(Some(residual.forward_error_m_s));
        let wheels = means.wheels.linear_m_s;
        let position = wheels + residual.forward_error_m_s;
        if let Some(odometry) = means.odometry_m_s.filter(|_| view.channels.odometry)
            && !agrees_with_position(view, recent, residual, &means, odometry)
        {
            isolate_fault(view, residual, &means, odometry, verdicts);
            return false;
        }
        if !view.channels.wheels {
            continue;
        }
        let commanded = view.commanded(residual);
        let rates = Rates {
            wheels,
            body: position,
        };
        let (slack, share) = wheels::slack(view, AXIS, rates, &commanded);
        let noise = share * residual.noise_m_s + 0.3 * recent.forward_change;
        if residual.forward_error_m_s.abs() > slack + noise {
            let odometry = means.odometry_m_s.filter(|_| view.channels.odometry);
            let is_corroborated = odometry.is_some_and(|odometry_m_s| {
                (odometry_m_s - wheels).abs() <= AXIS.slack(CORROBORATED, odometry_m_s, wheels)
            });
            if is_corroborated {
                // The wheels are right: odometry and fixes are distinguished later.
                return false;
            }
            wheels::record_contradiction(view, rates, &commanded, AXIS, verdicts);
            return false;
        }
        if is_turn_clean && moves_laterally(residual, &means) {
            let lateral = Comparison {
                observed: 0.0,
                predicted: residual.left_error_m_s,
            };
            let found = finding(Subject::WheelsAndMotion, Kind::Inconsistent, lateral, AXIS);
            verdicts.contradict(found, RAISE_SLIP_S);
            return false;
        }
    }
    let odometry = recent.means.odometry_m_s;
    let Some(odometry) = odometry.filter(|_| view.channels.odometry && view.channels.wheels) else {
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
    if AXIS.follows_command(wheels, commanded) {
        if view.repeats.odometry.is_frozen() {
            let found = finding(Subject::Odometry, Kind::Frozen, rates.of_body(), AXIS);
            verdicts.contradict(found, RAISE_FROZEN_S);
            return false;
        }
        if has_residual {
            // Slip, or odometry: the fixes will distinguish them.
            return false;
        }
    }
    // Saturated motors with odometry that reads too high look like wheels that read too low.
    let off = odometry - wheels;
    let is_corroborated =
        error_m_s.is_none_or(|error| error * off.signum() > CORROBORATED_RATIO_MIN * off.abs());
    if view.is_saturated(recent.means.wheels, commanded) && !is_corroborated {
        return false;
    }
    wheels::record_contradiction(view, rates, commanded, AXIS, verdicts);
    false
}

/// Returns whether odometry and fixes agree over a span.
fn agrees_with_position(
    view: &View<'_>,
    recent: &Recent,
    residual: &FixResidual,
    means: &Means,
    odometry: f64,
) -> bool {
    let wheels = means.wheels.linear_m_s;
    let position = wheels + residual.forward_error_m_s;
    let at = |at_s: f64| {
        let means = view.history.means(Span {
            from_s: at_s - INSTANT_S,
            to_s: at_s,
        });
        means.map_or(wheels, |means| means.wheels.linear_m_s)
    };
    let span_s = residual.to_s - residual.from_s;
    let lag = ODOMETRY_LAG_S * (at(residual.to_s) - at(residual.from_s)).abs() / span_s;
    let change = 0.3 * recent.forward_change;
    // While a robot slides and turns, earlier lateral motion appears as forward motion.
    let turned = (means.gyro_rad_s.abs() * span_s).min(1.0);
    let noise_m_s = residual.odometry_noise_m_s + turned * residual.left_error_m_s.abs();
    let most = AXIS.slack(BODY, odometry, position) + noise_m_s + change + lag;
    if residual.odometry_error_m_s.abs() > most {
        return false;
    }
    if !view.channels.wheels {
        return true;
    }
    // Wheels agree with odometry and the position shows more: no slip causes that.
    let is_alone = (odometry - wheels).abs() <= AXIS.slack(ALONE, odometry, wheels) + change
        && position.abs() > odometry.abs()
        && residual.odometry_error_m_s.abs()
            > AXIS.slack(ALONE, odometry, position) + ALONE_NOISE_RATIO * noise_m_s + change + lag;
    let is_contradicted_by_wheels = (odometry - wheels).abs()
        > AXIS.slack(CORROBORATED, odometry, wheels) + change + lag
        && residual.odometry_error_m_s.abs() - residual.forward_error_m_s.abs()
            > NEARER_TO_FIXES_MIN_M_S + noise_m_s;
    !(is_contradicted_by_wheels || is_alone)
}

/// Names the wrong one of odometry and fixes, or [`Subject::Motion`] if neither can be excluded.
fn isolate_fault(
    view: &View<'_>,
    residual: &FixResidual,
    means: &Means,
    odometry: f64,
    verdicts: &mut Verdicts,
) {
    let wheels = means.wheels.linear_m_s;
    let position = wheels + residual.forward_error_m_s;
    let commanded = view.commanded(residual);
    let vote = Vote {
        by_wheels: view.channels.wheels.then_some(Differences {
            fast: (residual.odometry_error_m_s - residual.forward_error_m_s).abs(),
            fixes: residual.forward_error_m_s.abs(),
        }),
        slack: AXIS.slack(WHEELS, wheels, odometry.abs().min(position.abs())),
        noise: residual.noise_m_s,
        by_command: (!view.is_saturated(means.wheels, &commanded)).then_some(Differences {
            fast: AXIS.command_distance(odometry, &commanded),
            fixes: AXIS.command_distance(position, &commanded),
        }),
    };
    let repeats = view.repeats;
    let of_odometry = Comparison {
        observed: odometry,
        predicted: position,
    };
    let of_position = of_odometry.reversed();
    let found = match vote.favoured() {
        Some(Favoured::Fast) => {
            let kind = kind_of(of_position, repeats.position.is_frozen());
            finding(Subject::Position, kind, of_position, AXIS)
        }
        Some(Favoured::Fixes) => {
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
fn moves_laterally(residual: &FixResidual, means: &Means) -> bool {
    let wheels_m_s = means.wheels.linear_m_s;
    let position_m_s = wheels_m_s + residual.forward_error_m_s;
    let (own_m_s, share, lever_m) = LEFT;
    let speed_m_s = position_m_s.abs().max(wheels_m_s.abs());
    let slack = own_m_s + share * speed_m_s + lever_m * means.gyro_rad_s.abs() + residual.noise_m_s;
    residual.left_error_m_s.abs() > slack
}
