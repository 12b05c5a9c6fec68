//! Channels confirmed to be right: by motion, by the end of the fault found, or at standstill.

use super::axis::Axis;
use super::{Recent, Verdicts, View};
use crate::consistency::{Kind, Subject, Unit};

/// Minimum motion that confirms a channel, radians per second or metres per second.
const EXCITED: f64 = 0.1;
/// Minimum motion that confirms the position, radians per second or metres per second.
const EXCITED_PLACE: f64 = 0.2;

/// Records which channels agree; called only while nothing contradicts.
pub(super) fn check(view: &View<'_>, recent: &Recent, verdicts: &mut Verdicts) {
    let active = |subject: Subject| view.tracks[subject as usize].active;
    let means = &recent.means;
    let (gyro, wheels) = (means.gyro_rad_s, means.wheels);
    let turns = gyro.abs() >= EXCITED && wheels.angular_rad_s.abs() >= EXCITED;
    let drives = wheels.linear_m_s.abs() >= EXCITED;
    let has_fixes = view.residuals().next().is_some();
    // A fault found at standstill is over if the channel agrees at standstill.
    let was_at_rest = |subject: Subject| {
        active(subject).is_some_and(|found| {
            found.kind == Kind::Inconsistent && found.predicted.abs() < EXCITED
        })
    };
    let was_frozen =
        |subject: Subject| active(subject).is_some_and(|found| found.kind == Kind::Frozen);
    let (repeats, channels) = (view.repeats, &view.channels);
    let gyro_changes = was_frozen(Subject::Gyro) && !repeats.gyro.is_frozen();
    if channels.gyro && (turns || gyro_changes || was_at_rest(Subject::Gyro)) {
        verdicts.agree(Subject::Gyro);
    }
    let follows_command = Axis::Forward.follows_command(wheels.linear_m_s, &recent.commanded)
        && Axis::Turn.follows_command(wheels.angular_rad_s, &recent.commanded);
    let wheels_change = was_frozen(Subject::Wheels) && !repeats.wheels.is_frozen();
    if channels.wheels
        && follows_command
        && (drives || turns || wheels_change || was_at_rest(Subject::Wheels))
    {
        verdicts.agree(Subject::Wheels);
    }
    let position = active(Subject::Position);
    let has_jumped = position.is_some_and(|found| found.kind == Kind::Jumped);
    let position_changes = was_frozen(Subject::Position) && !repeats.position.is_frozen();
    // Motion of the kind in which the fault was found confirms the position; turning does not
    // confirm the scale.
    let shows_place = |subject: Subject| {
        let is_large = |speed: f64| speed.abs() >= EXCITED_PLACE;
        let drives = is_large(wheels.linear_m_s);
        let turns = is_large(gyro) && is_large(wheels.angular_rad_s);
        match view.tracks[subject as usize].found.map(|found| found.unit) {
            Some(Unit::MetresPerSecond) => drives,
            Some(Unit::RadiansPerSecond) => turns,
            Some(Unit::Metres | Unit::Radians | Unit::MetresPerSecondSquared) | None => {
                drives || turns
            }
        }
    };
    if has_fixes && (shows_place(Subject::Position) || position_changes || has_jumped) {
        verdicts.agree(Subject::Position);
    }
    let odometry_changes = was_frozen(Subject::Odometry) && !repeats.odometry.is_frozen();
    if channels.odometry
        && means.odometry_m_s.is_some()
        && (drives || odometry_changes || was_at_rest(Subject::Odometry))
    {
        verdicts.agree(Subject::Odometry);
    }
    if has_fixes && shows_place(Subject::Motion) {
        verdicts.agree(Subject::Motion);
    }
    verdicts.agree(Subject::WheelsAndMotion);
    // Standstill does not confirm a frozen source that still repeats. A source that repeats only
    // while the robot stands may be right; motion will show it immediately.
    let is_heard = channels.position && view.residuals.iter().any(Option::is_some);
    if is_heard && view.is_standing {
        if !(was_frozen(Subject::Position) && repeats.position.is_repeating()) {
            verdicts.agree_at_rest(Subject::Position);
        }
        verdicts.agree_at_rest(Subject::Motion);
    }
}
