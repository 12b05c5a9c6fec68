//! About how long a curve takes: what tells good legs and splines from others.

#![expect(
    clippy::cast_precision_loss,
    reason = "counts of steps along a curve are small"
)]

use super::{Polynomial, RADIUS_MIN_M};
use crate::geometry::Point;
use crate::robot::RobotModel;

/// Points at which a leg's time is summed.
const TIME_STEPS: usize = 48;
/// Points at which the time of a spline's piece is summed.
const PIECE_TIME_STEPS: usize = 10;
/// Slowest advance of a curve over that at its end; a slower one is about to come to a point.
const ADVANCE_SHARE_MIN: f64 = 0.05;
/// Tightest turn of a leg, metres.
const LEG_RADIUS_MIN_M: f64 = 2.0 * RADIUS_MIN_M;
/// Share of the limits assumed in the bends of a spline: one that needs them all is no good
/// one.
const SPLINE_LIMIT_SHARE: f64 = 0.5;
/// A leg nearer to its circle than this is on it, metres.
const ON_RING_M: f64 = 0.03;

/// A circle that is joined: what of a leg lies on it counts no time.
#[derive(Debug, Clone, Copy)]
pub(super) struct Ring {
    pub(super) center: Point,
    pub(super) radius_m: f64,
}

impl Ring {
    /// How far a point is off it, metres.
    pub(super) fn distance_m(&self, point: Point) -> f64 {
        (self.center.distance_m(point) - self.radius_m).abs()
    }
}

/// How legs are timed.
#[derive(Debug, Clone, Copy)]
pub(super) struct LegTime<'robot> {
    /// Speed on the leg, metres per second.
    pub(super) speed_m_s: f64,
    pub(super) model: &'robot RobotModel,
    pub(super) ring: Option<Ring>,
}

/// A part of a leg.
#[derive(Debug, Clone, Copy, Default)]
struct Part {
    length_m: f64,
    /// `v²/2` at most, metres squared per second squared.
    energy: f64,
}

impl LegTime<'_> {
    /// About how long a leg takes, from rest or in passing, until it is on its ring for good; none
    /// when it is too tight to drive, or slower than a bound.
    pub(super) fn of_leg_s(&self, leg: &Polynomial, from_rest: bool, bound_s: f64) -> Option<f64> {
        let mut parts = [Part::default(); TIME_STEPS];
        let (mut least_s, mut counted, mut off_m) = (0.0, 0, 0.0);
        for (step, part) in parts.iter_mut().enumerate() {
            let (fastest_m_s, length_m, place) =
                step_of(leg, (step, TIME_STEPS), LEG_RADIUS_MIN_M, self.model, 1.0)?;
            let fastest_m_s = fastest_m_s.min(self.speed_m_s);
            *part = Part {
                length_m,
                energy: 0.5 * fastest_m_s * fastest_m_s,
            };
            least_s += length_m / fastest_m_s;
            if self
                .ring
                .is_none_or(|ring| ring.distance_m(place) > ON_RING_M)
            {
                counted = step + 1;
                off_m = least_s;
            }
            if off_m > bound_s {
                return None;
            }
        }
        self.keep_distance(&mut parts);
        self.gather(&mut parts, from_rest);
        let time_s = parts[..counted]
            .iter()
            .map(|part| part.length_m / (2.0 * part.energy).sqrt())
            .sum();
        (time_s <= bound_s).then_some(time_s)
    }

    /// As in the plan's timing, no limit is passed within the way over which speeds are averaged.
    fn keep_distance(&self, parts: &mut [Part; TIME_STEPS]) {
        let limits = self.model.limits();
        let reach_m = self.speed_m_s * 2.0 * limits.linear_acceleration_max_m_s2
            / limits.linear_jerk_max_m_s3;
        let bends = *parts;
        for (index, part) in parts.iter_mut().enumerate() {
            let mut lower = |others: &mut dyn Iterator<Item = &Part>| {
                let mut away_m = 0.0;
                for other in others {
                    away_m += other.length_m;
                    if away_m > reach_m {
                        break;
                    }
                    part.energy = part.energy.min(other.energy);
                }
            };
            lower(&mut bends[index + 1..].iter());
            lower(&mut bends[..index].iter().rev());
        }
    }

    /// Speed is gathered and lost within the acceleration limit.
    fn gather(&self, parts: &mut [Part; TIME_STEPS], from_rest: bool) {
        let half_m_s2 = 0.5 * self.model.limits().linear_acceleration_max_m_s2;
        let mut energy = if from_rest { 0.0 } else { f64::INFINITY };
        for part in parts.iter_mut() {
            part.energy = part.energy.min(energy + half_m_s2 * part.length_m);
            energy = part.energy + half_m_s2 * part.length_m;
        }
        energy = f64::INFINITY;
        for part in parts.iter_mut().rev() {
            part.energy = part.energy.min(energy + half_m_s2 * part.length_m);
            energy = part.energy + half_m_s2 * part.length_m;
        }
    }
}

/// About how long a piece of a spline takes, seconds; none when it is too tight to drive.
pub(super) fn piece_time_s(piece: &Polynomial, speed_m_s: f64, model: &RobotModel) -> Option<f64> {
    let mut time_s = 0.0;
    for step in 0..PIECE_TIME_STEPS {
        let (fastest_m_s, length_m, _) = step_of(
            piece,
            (step, PIECE_TIME_STEPS),
            RADIUS_MIN_M,
            model,
            SPLINE_LIMIT_SHARE,
        )?;
        time_s += length_m / fastest_m_s.min(speed_m_s);
    }
    Some(time_s)
}

/// Fastest speed, length and middle of one of a number of steps; none where it is too tight.
fn step_of(
    curve: &Polynomial,
    (step, steps): (usize, usize),
    radius_min_m: f64,
    model: &RobotModel,
    limit_share: f64,
) -> Option<(f64, f64, Point)> {
    let limits = model.limits();
    let width = curve.span() / steps as f64;
    let parameter = (step as f64 + 0.5) * width;
    let at = curve.sample(parameter);
    let bend = at.curvature_1_m.abs().max(1.0e-6);
    let advance = curve.advance(parameter);
    if bend > radius_min_m.recip() || advance < ADVANCE_SHARE_MIN * curve.advance(curve.span()) {
        return None;
    }
    let fastest_m_s = (limit_share * limits.lateral_acceleration_max_m_s2 / bend)
        .sqrt()
        .min(limit_share * limits.angular_max_rad_s / bend);
    Some((fastest_m_s, advance * width, at.pose.point()))
}
