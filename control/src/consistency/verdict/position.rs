//! Position fixes alone: jumps, and fixes that stay constant while the robot moves.

use super::axis::{Axis, finding};
use super::{RAISE_FROZEN_S, Recent, Verdicts, View};
use crate::consistency::history::Span;
use crate::consistency::{Comparison, Finding, Kind, Subject, Unit};

/// Distance and turn during which a constant position is a fault, metres and radians.
const FROZEN_PATH: (f64, f64) = (0.08, 0.12);
/// Maximum time over which distance and turn are taken, seconds.
const FROZEN_SPAN_MAX_S: f64 = 2.0;

/// Records a jump of the fixes.
pub(super) fn jumped(view: &View<'_>, verdicts: &mut Verdicts) {
    let Some(jump) = view.jump else {
        return;
    };
    // The larger of both values, one metre counting as one radian.
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

/// Detects fixes that repeat to the last bit while wheels or gyro show motion.
pub(super) fn frozen(view: &View<'_>, recent: &Recent, verdicts: &mut Verdicts) {
    let repeats = &view.repeats.position;
    let Some(since) = repeats.since().filter(|_| repeats.is_frozen()) else {
        return;
    };
    let now_s = view.history.now().at_s;
    let from_s = since.as_secs_f64().max(now_s - FROZEN_SPAN_MAX_S);
    let span_s = now_s - from_s;
    let Some(means) = view.history.means(Span {
        from_s,
        to_s: now_s,
    }) else {
        return;
    };
    let path_m = means.wheels.linear_m_s.abs() * span_s;
    let turn_rad = means.gyro_rad_s.abs() * span_s;
    let odometry_m_s = means.odometry_m_s.filter(|_| view.channels.odometry);
    let odometry_stands = odometry_m_s.is_some_and(|forward_m_s| {
        !view.repeats.odometry.is_frozen()
            && forward_m_s.abs() < 0.25 * means.wheels.linear_m_s.abs()
    });
    let moves = view.channels.wheels && path_m >= FROZEN_PATH.0 && !odometry_stands;
    // A gyro that is frozen too is no evidence.
    let turns = view.channels.gyro
        && turn_rad >= FROZEN_PATH.1
        && !view.repeats.gyro.is_frozen()
        && recent.means.gyro_rad_s * recent.means.wheels.angular_rad_s > 0.0;
    if moves || turns {
        let (predicted, axis) = if moves {
            (means.wheels.linear_m_s, Axis::Forward)
        } else {
            (means.gyro_rad_s, Axis::Turn)
        };
        let comparison = Comparison {
            observed: 0.0,
            predicted,
        };
        let finding = finding(Subject::Position, Kind::Frozen, comparison, axis);
        verdicts.contradict(finding, RAISE_FROZEN_S);
    }
}
