//! Parts, passes, and how the robot moved in them.
//!
//! * A **part** is a run of samples without a gap above [`PART_GAP`].
//! * A **drive** is a maximal stretch of a part in which the robot moves; it may stand in between
//!   for at most [`STANDSTILL_MAX`].
//! * A **pass** is a drive, or an equal share of one that is longer than the wanted length of a
//!   pass. Passes are disjoint. Drives shorter than [`PASS_MIN`] are none.

use std::ops::Range;
use std::time::Duration;

use serde::Serialize;
use tread_control::estimation::manoeuvre::{MOVING_M_S, ManoeuvreTimes, Manoeuvres, RimMotion};
use tread_control::robot::RobotModel;

use super::timeline::LoopInput;
use crate::report::median;

/// Gap between two samples of wheels and gyro above which a new part begins.
pub const PART_GAP: Duration = Duration::from_secs(1);
/// Longest standstill within a drive.
pub const STANDSTILL_MAX: Duration = Duration::from_secs(2);
/// Shortest drive that is a pass: below it the estimator knows nothing yet.
pub const PASS_MIN: Duration = Duration::from_secs(8);
/// Interval of samples above which the estimator knows nothing of the time between them, seconds.
pub const ESTIMATOR_GAP_S: f64 = 0.1;
/// Longest interval of samples whose time counts as driven, seconds.
const COUNTED_MAX_S: f64 = 0.5;

/// How a robot moved.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct Motion {
    /// Time between the first and the last sample, seconds.
    pub duration_s: f64,
    /// Times of manoeuvres.
    #[serde(flatten)]
    pub manoeuvres: ManoeuvreTimes,
    /// Samples with wheel speeds and yaw rate per second.
    pub samples_hz: f64,
    /// Median interval of wheel speeds, seconds.
    pub wheel_interval_s: f64,
    /// Share of the intervals of wheel speeds that the estimator takes for gaps.
    pub long_interval_ratio: f64,
    /// Share of wheel samples without a yaw rate near them.
    pub without_gyro_ratio: f64,
    /// Largest rim speed, metres per second.
    pub rim_max_m_s: f64,
    /// Whether wheel torques were measured.
    pub has_torque: bool,
    /// Whether the acceleration was measured.
    pub has_acceleration: bool,
}

/// Whole samples, by which gaps and motion are judged.
fn whole(fed: &[LoopInput]) -> impl Iterator<Item = (usize, &LoopInput)> {
    let whole =
        |fed: &LoopInput| fed.sample.wheel_speeds.is_some() && fed.sample.yaw_rate_rad_s.is_some();
    fed.iter().enumerate().filter(move |(_, fed)| whole(fed))
}

fn rims_m_s(fed: &LoopInput, radius_m: f64) -> Option<[f64; 2]> {
    let speeds = fed.sample.wheel_speeds?;
    Some([speeds.left_rad_s * radius_m, speeds.right_rad_s * radius_m])
}

fn faster(rims_m_s: [f64; 2]) -> f64 {
    rims_m_s[0].abs().max(rims_m_s[1].abs())
}

/// Divides samples into parts. A sample that is not whole belongs to the part before it.
pub fn parts(fed: &[LoopInput]) -> Vec<Range<usize>> {
    let mut parts = Vec::new();
    let mut begin = None;
    let mut last: Option<Duration> = None;
    for (index, fed) in whole(fed) {
        let at = fed.sample.at;
        if last.is_some_and(|last| at.saturating_sub(last) > PART_GAP) {
            parts.extend(begin.replace(index).map(|begin| begin..index));
        }
        begin.get_or_insert(index);
        last = Some(at);
    }
    parts.extend(begin.map(|begin| begin..fed.len()));
    parts
}

/// Returns the drives of a part, however short.
pub fn drives(fed: &[LoopInput], part: Range<usize>, model: &RobotModel) -> Vec<Range<usize>> {
    let mut drives: Vec<Range<usize>> = Vec::new();
    let mut last: Option<Duration> = None;
    for (index, one) in whole(&fed[part.clone()]) {
        let index = part.start + index;
        let is_moving = rims_m_s(one, model.wheel_radius_m())
            .is_some_and(|rims_m_s| faster(rims_m_s) > MOVING_M_S);
        if !is_moving {
            continue;
        }
        let at = one.sample.at;
        let goes_on = last.is_some_and(|last| at.saturating_sub(last) <= STANDSTILL_MAX);
        match drives.last_mut().filter(|_| goes_on) {
            Some(drive) => drive.end = index + 1,
            None => drives.push(index..index + 1),
        }
        last = Some(at);
    }
    drives
}

/// Divides a drive into passes of about the wanted length; none if it is too short for one.
pub fn passes(fed: &[LoopInput], drive: Range<usize>, wanted: Duration) -> Vec<Range<usize>> {
    let (Some(first), Some(last)) = (fed.get(drive.start), fed.get(drive.end.saturating_sub(1)))
    else {
        return Vec::new();
    };
    let begin = first.sample.at;
    let length = last.sample.at.saturating_sub(begin);
    if length < PASS_MIN {
        return Vec::new();
    }
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "a recording has fewer passes than samples"
    )]
    let count = (length.as_secs_f64() / wanted.max(PASS_MIN).as_secs_f64())
        .floor()
        .max(1.0) as u32;
    let mut passes = Vec::new();
    let mut from = drive.start;
    for number in 1..=count {
        let until = begin + length * number / count;
        let to = if number == count {
            drive.end
        } else {
            from + fed[from..drive.end].partition_point(|fed| fed.sample.at < until)
        };
        if to > from {
            passes.push(from..to);
        }
        from = to;
    }
    passes
}

/// Returns how the robot moved.
#[expect(clippy::cast_precision_loss, reason = "counts of samples")]
pub fn motion(fed: &[LoopInput], model: &RobotModel) -> Motion {
    let radius_m = model.wheel_radius_m();
    let mut motion = Motion::default();
    let (mut intervals_s, mut last_wheels): (Vec<f64>, Option<Duration>) = (Vec::new(), None);
    let (mut wheels, mut wholes) = (0_u64, 0_u64);
    let mut manoeuvres = Manoeuvres::default();
    for one in fed {
        let Some(rims_m_s) = rims_m_s(one, radius_m) else {
            continue;
        };
        wheels += 1;
        let sample = &one.sample;
        motion.has_torque |= sample.wheel_torques.is_some();
        motion.has_acceleration |= sample.acceleration.is_some();
        let before = last_wheels.replace(sample.at);
        let dt_s = before.map_or(0.0, |before| sample.at.saturating_sub(before).as_secs_f64());
        if before.is_some() {
            intervals_s.push(dt_s);
        }
        let Some(turn_rad_s) = sample.yaw_rate_rad_s else {
            continue;
        };
        wholes += 1;
        let counted_s = dt_s.min(COUNTED_MAX_S);
        motion.rim_max_m_s = motion.rim_max_m_s.max(faster(rims_m_s));
        let rim_motion = RimMotion {
            rims_m_s,
            turn_rad_s,
        };
        manoeuvres.add(rim_motion, counted_s);
    }
    motion.manoeuvres = manoeuvres.times();
    if let (Some(first), Some(last)) = (fed.first(), fed.last()) {
        motion.duration_s = last.sample.at.saturating_sub(first.sample.at).as_secs_f64();
    }
    if motion.duration_s > 0.0 {
        motion.samples_hz = wholes as f64 / motion.duration_s;
    }
    let long = intervals_s
        .iter()
        .filter(|interval_s| **interval_s > ESTIMATOR_GAP_S)
        .count();
    motion.long_interval_ratio = long as f64 / intervals_s.len().max(1) as f64;
    motion.wheel_interval_s = median(&mut intervals_s);
    if wheels > 0 {
        motion.without_gyro_ratio = (wheels - wholes) as f64 / wheels as f64;
    }
    motion
}

#[cfg(test)]
mod tests;
