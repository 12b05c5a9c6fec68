//! Estimated driving time of a curve, used to compare legs and splines.

#![expect(
    clippy::cast_precision_loss,
    reason = "counts of steps along a curve are small"
)]

use super::{Polynomial, RADIUS_MIN_M};
use crate::geometry::Point;
use crate::robot::RobotModel;

/// Number of steps in summing a leg's time.
const TIME_STEPS: usize = 48;
/// Minimum parameter speed of a curve relative to that at its end; below it a cusp is near.
const PARAMETER_SPEED_SHARE_MIN: f64 = 0.05;
/// How the time of a leg is summed.
const LEG: Timing = Timing {
    steps: TIME_STEPS,
    radius_min_m: 2.0 * RADIUS_MIN_M,
    limit_share: 1.0,
};
/// How the time of one piece of a spline is summed: below the full limits, to prefer splines that
/// do not need them.
const PIECE: Timing = Timing {
    steps: 10,
    radius_min_m: RADIUS_MIN_M,
    limit_share: 0.5,
};
/// Distance to its circle below which a leg counts as on it, metres.
const ON_TARGET_M: f64 = 0.03;

/// How the time of a curve is summed.
#[derive(Debug, Clone, Copy)]
struct Timing {
    /// Number of steps.
    steps: usize,
    /// Minimum radius, metres; a tighter curve has no time.
    radius_min_m: f64,
    /// Fraction of the robot's limits that is assumed in bends.
    limit_share: f64,
}

/// Circle to join; the part of a leg on it counts no time.
#[derive(Debug, Clone, Copy)]
pub(super) struct TargetCircle {
    pub(super) center: Point,
    pub(super) radius_m: f64,
}

impl TargetCircle {
    /// Returns the distance of a point from the circle, metres.
    pub(super) fn distance_m(&self, point: Point) -> f64 {
        (self.center.distance_m(point) - self.radius_m).abs()
    }
}

/// Parameters of timing a leg.
#[derive(Debug, Clone, Copy)]
pub(super) struct LegTime<'robot> {
    /// Desired speed on the leg, metres per second.
    pub(super) speed_m_s: f64,
    pub(super) model: &'robot RobotModel,
    pub(super) circle: Option<TargetCircle>,
}

/// One step in summing the time of a leg.
#[derive(Debug, Clone, Copy, Default)]
struct LegStep {
    length_m: f64,
    /// Maximum `v²/2`, metres squared per second squared.
    energy: f64,
}

impl LegTime<'_> {
    /// Returns the estimated time of a leg until it stays on its target circle, seconds;
    /// `from_rest` if it starts from zero speed. None if it is too tight to drive, or slower than
    /// `bound_s`.
    pub(super) fn leg_time_s(
        &self,
        leg: &Polynomial,
        from_rest: bool,
        bound_s: f64,
    ) -> Option<f64> {
        let mut leg_steps = [LegStep::default(); TIME_STEPS];
        let (mut least_s, mut counted, mut off_m) = (0.0, 0, 0.0);
        for (step, leg_step) in leg_steps.iter_mut().enumerate() {
            let (fastest_m_s, length_m, place) = LEG.step_of(leg, step, self.model)?;
            let fastest_m_s = fastest_m_s.min(self.speed_m_s);
            *leg_step = LegStep {
                length_m,
                energy: 0.5 * fastest_m_s * fastest_m_s,
            };
            least_s += length_m / fastest_m_s;
            if self
                .circle
                .is_none_or(|circle| circle.distance_m(place) > ON_TARGET_M)
            {
                counted = step + 1;
                off_m = least_s;
            }
            if off_m > bound_s {
                return None;
            }
        }
        self.apply_averaging_window(&mut leg_steps);
        self.limit_accelerations(&mut leg_steps, from_rest);
        let time_s = leg_steps[..counted]
            .iter()
            .map(|leg_step| leg_step.length_m / (2.0 * leg_step.energy).sqrt())
            .sum();
        (time_s <= bound_s).then_some(time_s)
    }

    /// Lowers each step's speed to the minimum within the distance over which the plan's timing
    /// averages speeds.
    fn apply_averaging_window(&self, leg_steps: &mut [LegStep; TIME_STEPS]) {
        let limits = self.model.limits();
        let reach_m = self.speed_m_s * 2.0 * limits.linear_acceleration_max_m_s2
            / limits.linear_jerk_max_m_s3;
        let bends = *leg_steps;
        for (index, leg_step) in leg_steps.iter_mut().enumerate() {
            let mut lower = |others: &mut dyn Iterator<Item = &LegStep>| {
                let mut away_m = 0.0;
                for other in others {
                    away_m += other.length_m;
                    if away_m > reach_m {
                        break;
                    }
                    leg_step.energy = leg_step.energy.min(other.energy);
                }
            };
            lower(&mut bends[index + 1..].iter());
            lower(&mut bends[..index].iter().rev());
        }
    }

    /// Limits the change of `v²/2` between neighbouring steps to the acceleration limit times the
    /// distance of their middles.
    fn limit_accelerations(&self, leg_steps: &mut [LegStep; TIME_STEPS], from_rest: bool) {
        let half_m_s2 = 0.5 * self.model.limits().linear_acceleration_max_m_s2;
        let mut energy = if from_rest { 0.0 } else { f64::INFINITY };
        for leg_step in leg_steps.iter_mut() {
            leg_step.energy = leg_step.energy.min(energy + half_m_s2 * leg_step.length_m);
            energy = leg_step.energy + half_m_s2 * leg_step.length_m;
        }
        energy = f64::INFINITY;
        for leg_step in leg_steps.iter_mut().rev() {
            leg_step.energy = leg_step.energy.min(energy + half_m_s2 * leg_step.length_m);
            energy = leg_step.energy + half_m_s2 * leg_step.length_m;
        }
    }
}

/// Returns the estimated time of a piece of a spline, seconds; None if it is too tight to drive.
pub(super) fn piece_time_s(piece: &Polynomial, speed_m_s: f64, model: &RobotModel) -> Option<f64> {
    let mut time_s = 0.0;
    for step in 0..PIECE.steps {
        let (fastest_m_s, length_m, _) = PIECE.step_of(piece, step, model)?;
        time_s += length_m / fastest_m_s.min(speed_m_s);
    }
    Some(time_s)
}

impl Timing {
    /// Returns maximum speed, length and middle point of one step; None if it is too tight.
    fn step_of(
        &self,
        curve: &Polynomial,
        step: usize,
        model: &RobotModel,
    ) -> Option<(f64, f64, Point)> {
        let limits = model.limits();
        let width = curve.span() / self.steps as f64;
        let parameter = (step as f64 + 0.5) * width;
        let at = curve.sample(parameter);
        let bend = at.curvature_1_m.abs().max(1.0e-6);
        let parameter_speed = curve.parameter_speed(parameter);
        let is_cusp_near =
            parameter_speed < PARAMETER_SPEED_SHARE_MIN * curve.parameter_speed(curve.span());
        if bend > self.radius_min_m.recip() || is_cusp_near {
            return None;
        }
        let fastest_m_s = (self.limit_share * limits.lateral_acceleration_max_m_s2 / bend)
            .sqrt()
            .min(self.limit_share * limits.angular_max_rad_s / bend);
        Some((fastest_m_s, parameter_speed * width, at.pose.point()))
    }
}
