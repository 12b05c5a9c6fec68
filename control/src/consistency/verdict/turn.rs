//! Turn rate: gyro, wheels, and the heading of position fixes.

use super::axis::{Axis, Rates, Tolerance, finding, kind_of};
use super::vote::{Differences, Favoured, Vote};
use super::wheels::{self, CORROBORATED, WHEELS};
use super::{
    BODY, NEARER_TO_FIXES_NOISE_RATIO, RAISE_FAST_S, RAISE_FIX_S, RAISE_FROZEN_S, RAISE_SLIP_S,
    Recent, Verdicts, View,
};
use crate::consistency::fixes::FixResidual;
use crate::consistency::history::Means;
use crate::consistency::{Comparison, Kind, Subject};

const AXIS: Axis = Axis::Turn;

/// Minimum difference by which the wheels must be nearer to the heading than the gyro is, in
/// addition to noise: more than a usual offset of the gyro, radians per second.
const NEARER_TO_FIXES_MIN_RAD_S: f64 = 0.04;
/// Tolerated difference of wheels and body once their gain is known.
const LEARNED: Tolerance = Tolerance {
    share_turn: 0.14,
    ..WHEELS
};

/// Compares the turn rates of gyro, wheels and fixes, and records the faulty sensor or slip in
/// `verdicts`. Returns whether nothing contradicts.
pub(super) fn check(view: &View<'_>, recent: &Recent, verdicts: &mut Verdicts) -> bool {
    let mut agreed = None;
    for residual in view.residuals() {
        let Some(means) = view.history.means(residual.span()) else {
            continue;
        };
        let heading = means.gyro_rad_s + residual.turn_error_rad_s;
        if view.channels.gyro && !agrees_with_heading(view, recent, residual, &means) {
            isolate_fault(view, residual, &means, verdicts);
            return false;
        }
        agreed = agreed.or(Some((heading, residual, means)));
    }
    if !view.channels.wheels {
        return true;
    }
    if !view.channels.gyro {
        return agreed.is_none_or(|(heading, residual, means)| {
            let rates = Rates {
                wheels: means.wheels.angular_rad_s,
                body: heading,
            };
            let commanded = view.commanded(residual);
            let (slack, share) = wheels::slack(view, AXIS, rates, &commanded);
            let slack = slack + share * residual.wheels_noise_rad_s + recent.turn_change;
            let is_clean = rates.difference() <= slack;
            if !is_clean {
                wheels::record_contradiction(view, rates, &commanded, AXIS, verdicts);
            }
            is_clean
        });
    }
    let is_frozen = view.repeats.gyro.is_frozen();
    let rates = Rates {
        wheels: recent.means.wheels.angular_rad_s,
        body: recent.means.gyro_rad_s,
    };
    let (slack, _) = wheels::slack(view, AXIS, rates, &recent.commanded);
    if rates.difference() <= slack + recent.turn_change {
        return true;
    }
    let follows_command = AXIS.follows_command(rates.wheels, &recent.commanded);
    if is_frozen && follows_command && !view.repeats.wheels.is_frozen() {
        let found = finding(Subject::Gyro, Kind::Frozen, rates.of_body(), AXIS);
        verdicts.contradict(found, RAISE_FROZEN_S);
        return false;
    }
    let is_opposite = kind_of(rates.of_body(), false) == Kind::Inverted;
    match agreed {
        // The wheels are at fault only if fixes over the same span contradict them too.
        Some((heading, _, means)) => {
            let by_fixes = Rates {
                wheels: means.wheels.angular_rad_s,
                body: heading,
            };
            let (slack, _) = wheels::slack(view, AXIS, by_fixes, &recent.commanded);
            if by_fixes.difference() <= slack {
                return false;
            }
            wheels::record_contradiction(view, rates, &recent.commanded, AXIS, verdicts);
        }
        None if view.residuals().next().is_some() => {}
        None if is_opposite && follows_command => {
            let found = finding(Subject::Gyro, Kind::Inverted, rates.of_body(), AXIS);
            verdicts.contradict(found, RAISE_FAST_S);
        }
        None => wheels::record_contradiction(view, rates, &recent.commanded, AXIS, verdicts),
    }
    false
}

/// Returns whether the gyro and the heading of fixes agree over a span.
fn agrees_with_heading(
    view: &View<'_>,
    recent: &Recent,
    residual: &FixResidual,
    means: &Means,
) -> bool {
    let gyro = means.gyro_rad_s;
    let heading = gyro + residual.turn_error_rad_s;
    let slack = |tolerance: Tolerance, other: f64| AXIS.slack(tolerance, gyro, other);
    let most = slack(BODY, heading) + residual.noise_rad_s + 0.3 * recent.turn_change;
    if residual.turn_error_rad_s.abs() > most {
        return false;
    }
    let wheels = means.wheels.angular_rad_s;
    let is_contradicted_by_wheels = view.channels.wheels
        && (gyro - wheels).abs() > slack(CORROBORATED, wheels) + recent.turn_change
        && residual.turn_error_rad_s.abs() - residual.wheels_turn_error_rad_s.abs()
            > NEARER_TO_FIXES_MIN_RAD_S + NEARER_TO_FIXES_NOISE_RATIO * residual.noise_rad_s;
    !is_contradicted_by_wheels
}

/// Names the wrong one of gyro and heading, or [`Subject::Motion`] if neither can be excluded.
fn isolate_fault(view: &View<'_>, residual: &FixResidual, means: &Means, verdicts: &mut Verdicts) {
    let (gyro, wheels) = (means.gyro_rad_s, means.wheels.angular_rad_s);
    let heading = gyro + residual.turn_error_rad_s;
    let commanded = view.commanded(residual);
    // Turn rate by wheels, corrected by the gain of this robot on this ground.
    let gain = view.turn_gain.known();
    let by_gain = (1.0 - gain.unwrap_or(1.0)) * wheels;
    let tolerance = if gain.is_some() { LEARNED } else { WHEELS };
    let vote = Vote {
        by_wheels: view.channels.wheels.then_some(Differences {
            fast: (residual.turn_error_rad_s - residual.wheels_turn_error_rad_s + by_gain).abs(),
            fixes: (residual.wheels_turn_error_rad_s + by_gain).abs(),
        }),
        slack: AXIS.slack(tolerance, wheels, gyro.abs().min(heading.abs())),
        noise: residual.wheels_noise_rad_s,
        by_command: (!view.is_saturated(means.wheels, &commanded)).then_some(Differences {
            fast: AXIS.command_distance(gyro, &commanded),
            fixes: AXIS.command_distance(heading, &commanded),
        }),
    };
    let repeats = view.repeats;
    let of_gyro = Comparison {
        observed: gyro,
        predicted: heading,
    };
    let of_heading = of_gyro.reversed();
    match vote.favoured() {
        // Fixes and wheels both lag where a turn begins, so a finding about the fixes takes longer.
        Some(Favoured::Fast) => {
            let kind = kind_of(of_heading, repeats.position.is_frozen());
            let found = finding(Subject::Position, kind, of_heading, AXIS);
            verdicts.contradict(found, RAISE_SLIP_S);
        }
        Some(Favoured::Fixes) => {
            let kind = kind_of(of_gyro, repeats.gyro.is_frozen());
            let found = finding(Subject::Gyro, kind, of_gyro, AXIS);
            verdicts.contradict(found, RAISE_FIX_S);
        }
        None => {
            let kind = Kind::Inconsistent;
            let found = finding(Subject::Motion, kind, of_gyro, AXIS);
            verdicts.contradict(found, RAISE_FIX_S);
        }
    }
}
