//! Governor: advances the reference along a plan by a clock of its own.
//!
//! The plan's time τ advances by `dτ = σ dt`, σ from 0 to 1. σ falls when the robot lags or its
//! wheels saturate, has an external upper bound (pause, speed limit), and falls to zero along the
//! path on a stop. The speed `v = σ v₁(τ)` changes within the robot's acceleration limit and with
//! bounded jerk. τ never decreases. States: running → (stop) braking → stopped.

use crate::geometry::Pose;
use crate::plan::{Plan, PlanSample};
use crate::robot::RobotModel;
use crate::sliding::SlidingBounds;

/// Lower bound of the plan speed in computing limits of σ̇, metres per second.
const SPEED_FLOOR_M_S: f64 = 0.05;
/// Speed below which a reference that brakes for a stop is set to zero, metres per second.
const REST_M_S: f64 = 2.0e-3;
/// Time step of the prediction of the stopping pose, seconds.
const REST_STEP_S: f64 = 0.02;
/// Maximum number of steps of the prediction of the stopping pose.
const REST_STEPS_MAX: u32 = 1_000;
/// Gain from the error of σ to σ̇, per second.
const RATE_GAIN_1_S: f64 = 3.0;
/// Maximum σ̇ where σ rises, per second.
const RISE_MAX_1_S: f64 = 1.0;
/// Distance between robot and reference up to which the reference is not slowed, metres.
const LAG_FREE_M: f64 = 0.10;
/// Distance between robot and reference from which the reference waits (σ target 0), metres.
const LAG_FULL_M: f64 = 0.40;
/// Minimum σ beside the path, however large the cross-track error: the robot must drive to come
/// back to its path.
const CROSS_TRACK_RATE_MIN: f64 = 0.3;
/// Target of σ while the wheels are saturated.
const SATURATED_RATE: f64 = 0.5;

/// Horizon over which a speed limit is checked, plan seconds.
const LOOK_AHEAD_S: f64 = 1.5;
/// Number of intervals in [`LOOK_AHEAD_S`].
const LOOK_AHEAD_STEPS: u8 = 6;

/// Horizon over which the bounds on sliding ground are checked, plan seconds.
const SLIDING_AHEAD_S: f64 = 0.96;
/// Number of intervals in [`SLIDING_AHEAD_S`].
const SLIDING_STEPS: u8 = 16;
/// Gain from the error of σ to σ̇ on sliding ground, per second.
const SLIDING_GAIN_1_S: f64 = 10.0;
/// Heading error up to which a sliding robot's reference is not slowed, radians.
const HEADING_FREE_RAD: f64 = 0.2;
/// Heading error at which the slowing of a sliding robot would reach σ = 0, radians.
const HEADING_FULL_RAD: f64 = 0.8;
/// Minimum σ that a heading error causes: the robot must drive to come back to its path.
const HEADING_RATE_MIN: f64 = 0.3;

/// Desired pose and motion at one time, in the site frame.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ReferenceSample {
    /// Position, and heading tangential to the path.
    pub pose: Pose,
    /// Speed along the path v, metres per second, ≥ 0.
    pub speed_m_s: f64,
    /// Acceleration along the path a, metres per second squared.
    pub acceleration_m_s2: f64,
    /// Turn rate of the path's heading ω, radians per second, counter-clockwise positive.
    pub turn_rad_s: f64,
    /// Turn acceleration ω̇, radians per second squared.
    pub turn_acceleration_rad_s2: f64,
    /// Curvature, per metre, positive to the left.
    pub curvature_1_m: f64,
    /// Arc length from the plan's start, metres; never decreases.
    pub arc_m: f64,
}

impl From<&PlanSample> for ReferenceSample {
    fn from(planned: &PlanSample) -> Self {
        let &PlanSample {
            path,
            arc_m,
            speed_m_s,
            acceleration_m_s2,
        } = planned;
        Self {
            pose: path.pose,
            speed_m_s,
            acceleration_m_s2,
            turn_rad_s: path.curvature_1_m * speed_m_s,
            turn_acceleration_rad_s2: path.curvature_1_m * acceleration_m_s2
                + path.curvature_slope_1_m2 * speed_m_s * speed_m_s,
            curvature_1_m: path.curvature_1_m,
            arc_m,
        }
    }
}

/// Input of the governor in one tick.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct GovernorInput {
    /// Distance between the robot and its reference, metres; a non-finite value makes the reference
    /// wait.
    pub lag_m: f64,
    /// Part of this distance along the path, metres, of either sign. The reference waits for a
    /// robot that is behind or ahead, and only slows down for one that is beside it.
    pub along_track_m: f64,
    /// Whether the wheels cannot follow their commands.
    pub saturated: bool,
}

impl GovernorInput {
    /// Returns the largest σ at this distance from the reference.
    fn rate_for_lag(&self) -> f64 {
        if !(self.lag_m.is_finite() && self.along_track_m.is_finite()) {
            return 0.0;
        }
        let rate_at =
            |lag_m: f64| ((LAG_FULL_M - lag_m) / (LAG_FULL_M - LAG_FREE_M)).clamp(0.0, 1.0);
        let lateral_rate = CROSS_TRACK_RATE_MIN * rate_at(self.along_track_m.abs());
        rate_at(self.lag_m).max(lateral_rate)
    }
}

/// Acceleration bounds of a robot that slides, and its heading error to the path in radians.
#[derive(Debug, Clone, Copy, PartialEq)]
struct SlidingState {
    bounds: SlidingBounds,
    heading_rad: f64,
}

/// Reference generator of one plan.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Governor {
    /// τ.
    clock_s: f64,
    /// σ.
    rate: f64,
    /// σ̇.
    rate_slope_1_s: f64,
    /// Upper bound of σ.
    rate_cap: f64,
    speed_limit_m_s: Option<f64>,
    sliding: Option<SlidingState>,
    stopping: bool,
    brake_m_s2: f64,
    jerk_m_s3: f64,
}

impl Governor {
    /// Creates a governor at the start of a plan, at zero speed and σ = 1.
    pub fn new(model: &RobotModel) -> Self {
        Self {
            clock_s: 0.0,
            rate: 1.0,
            rate_slope_1_s: 0.0,
            rate_cap: 1.0,
            speed_limit_m_s: None,
            sliding: None,
            stopping: false,
            brake_m_s2: model.limits().linear_acceleration_max_m_s2,
            jerk_m_s3: model.limits().linear_jerk_max_m_s3,
        }
    }

    /// Sets the upper bound of σ, clamped to 0 to 1: 0 pauses, 1 is full speed. A non-finite value
    /// acts as 0.
    pub fn set_rate_cap(&mut self, rate_cap: f64) {
        self.rate_cap = if rate_cap.is_finite() {
            rate_cap.clamp(0.0, 1.0)
        } else {
            0.0
        };
    }

    /// Sets the maximum speed along the path, metres per second; None removes it. A non-finite or
    /// non-positive value pauses.
    pub fn set_speed_limit(&mut self, limit_m_s: Option<f64>) {
        self.speed_limit_m_s = limit_m_s.map(|limit| {
            if limit.is_finite() {
                limit.max(0.0)
            } else {
                0.0
            }
        });
    }

    /// Returns the largest σ that keeps the speed within its limit over the next [`LOOK_AHEAD_S`].
    fn rate_within_speed_limit(&self, plan: &Plan) -> f64 {
        let Some(limit_m_s) = self.speed_limit_m_s else {
            return 1.0;
        };
        let fastest_m_s = (0..=LOOK_AHEAD_STEPS)
            .map(|step| LOOK_AHEAD_S * f64::from(step) / f64::from(LOOK_AHEAD_STEPS))
            .map(|ahead_s| plan.sample(self.clock_s + ahead_s).speed_m_s)
            .fold(f64::MIN_POSITIVE, f64::max);
        (limit_m_s / fastest_m_s).min(1.0)
    }

    /// Returns the speed that plan, rate cap and speed limit allow a robot without lag, now or
    /// [`LOOK_AHEAD_S`] ahead, whichever is larger, metres per second; 0 after a stop.
    pub(crate) fn allowed_speed_m_s(&self, plan: &Plan) -> f64 {
        if self.stopping {
            return 0.0;
        }
        let speed_m_s = |ahead_s: f64| plan.sample(self.clock_s + ahead_s).speed_m_s;
        let planned_m_s = speed_m_s(0.0).max(speed_m_s(LOOK_AHEAD_S));
        planned_m_s * self.rate_cap.min(self.rate_within_speed_limit(plan))
    }

    /// Sets acceleration bounds on sliding ground and the heading error in radians; None removes
    /// the bounds.
    pub(crate) fn set_sliding(&mut self, bounds: Option<SlidingBounds>, heading_rad: f64) {
        self.sliding = bounds.map(|bounds| SlidingState {
            bounds,
            heading_rad,
        });
    }

    /// Returns the largest σ that sliding ground allows: braking along the path reaches the lateral
    /// and yaw bound of every bend within [`SLIDING_AHEAD_S`], and σ is smaller while the heading
    /// error is large.
    fn rate_on_sliding_ground(&self, plan: &Plan, planned: &PlanSample) -> f64 {
        let Some(SlidingState {
            bounds,
            heading_rad,
        }) = self.sliding
        else {
            return 1.0;
        };
        let mut energy = f64::INFINITY;
        for step in 0..=SLIDING_STEPS {
            let ahead_s = SLIDING_AHEAD_S * f64::from(step) / f64::from(SLIDING_STEPS);
            let sample = plan.sample(self.clock_s + ahead_s);
            let bend_1_m = sample.path.curvature_1_m.abs().max(f64::MIN_POSITIVE);
            let slope_1_m2 = sample
                .path
                .curvature_slope_1_m2
                .abs()
                .max(f64::MIN_POSITIVE);
            let square = (bounds.lateral_m_s2 / bend_1_m).min(bounds.yaw_rad_s2 / slope_1_m2);
            let distance_m = sample.arc_m - planned.arc_m;
            energy = energy.min(0.5 * square + bounds.longitudinal_m_s2 * distance_m);
        }
        let turned = (HEADING_FULL_RAD - heading_rad.abs()) / (HEADING_FULL_RAD - HEADING_FREE_RAD);
        ((2.0 * energy).sqrt() / planned.speed_m_s.max(f64::MIN_POSITIVE))
            .min(turned.max(HEADING_RATE_MIN))
            .min(1.0)
    }

    /// Starts to brake to zero speed along the path; cannot be revoked.
    pub fn stop(&mut self) {
        self.stopping = true;
    }

    /// Returns whether [`Governor::stop`] was called.
    pub fn is_stopping(&self) -> bool {
        self.stopping
    }

    /// Returns σ, plan seconds per second, 0 to 1.
    pub fn rate(&self) -> f64 {
        self.rate
    }

    /// Returns τ, the plan's time, seconds.
    pub fn clock_s(&self) -> f64 {
        self.clock_s
    }

    /// Returns whether the reference has reached the plan's end.
    pub fn is_at_end(&self, plan: &Plan) -> bool {
        self.clock_s >= plan.duration_s()
    }

    /// Returns whether the reference has reached zero speed after a stop.
    pub fn is_stopped(&self, plan: &Plan) -> bool {
        self.stopping
            && (self.rate <= 0.0 || plan.sample(self.clock_s).speed_m_s * self.rate < REST_M_S)
    }

    /// Advances the clock by `dt_s` seconds, at least 0 and finite, and returns the new reference.
    pub fn step(&mut self, plan: &Plan, input: &GovernorInput, dt_s: f64) -> ReferenceSample {
        let planned = plan.sample(self.clock_s);
        let floor_m_s = planned.speed_m_s.max(SPEED_FLOOR_M_S);
        let lag_rate = input.rate_for_lag();
        let target = if self.stopping {
            0.0
        } else {
            let saturation_rate = if input.saturated { SATURATED_RATE } else { 1.0 };
            lag_rate
                .min(saturation_rate)
                .min(self.rate_cap)
                .min(self.rate_within_speed_limit(plan))
                .min(self.rate_on_sliding_ground(plan, &planned))
        };
        // A change of σ adds σ̇v₁ to the acceleration σ²a₁; braking gets what the limit leaves. The
        // deceleration falls with the speed, a = √(jv), so that zero speed is reached without a
        // jump of acceleration.
        let speed_m_s = self.rate * planned.speed_m_s;
        let own_m_s2 = self.rate * self.rate * planned.acceleration_m_s2;
        let brake_m_s2 = self
            .brake_m_s2
            .min((self.jerk_m_s3 * speed_m_s).sqrt().max(0.05));
        let fall_1_s = -((brake_m_s2 + own_m_s2) / floor_m_s).max(0.0);
        let rise_1_s = ((0.5 * self.brake_m_s2 - own_m_s2) / floor_m_s).clamp(0.0, RISE_MAX_1_S);
        let gap = target - self.rate;
        let gain_1_s = if self.sliding.is_some() {
            SLIDING_GAIN_1_S
        } else {
            RATE_GAIN_1_S
        };
        let wanted_1_s = if self.stopping {
            fall_1_s
        } else {
            (gain_1_s * gap).clamp(fall_1_s, rise_1_s)
        };
        let slew = self.jerk_m_s3 / floor_m_s * dt_s;
        self.rate_slope_1_s +=
            (wanted_1_s - self.rate_slope_1_s).clamp(-slew.max(0.0), slew.max(0.0));
        let before = self.rate;
        self.rate = (self.rate + self.rate_slope_1_s * dt_s).clamp(0.0, 1.0);
        let at_bound = self.rate <= 0.0 || self.rate >= 1.0;
        if at_bound && (self.rate - before) * self.rate_slope_1_s <= 0.0 {
            self.rate_slope_1_s = 0.0;
        }
        if self.stopping && speed_m_s < REST_M_S {
            self.rate = 0.0;
            self.rate_slope_1_s = 0.0;
        }
        self.clock_s = (self.clock_s + 0.5 * (before + self.rate) * dt_s).min(plan.duration_s());
        self.reference(&plan.sample(self.clock_s))
    }

    /// Predicts the pose, in the site frame, in which the reference stops if it is paused from now
    /// on.
    pub fn rest(mut self, plan: &Plan) -> Pose {
        self.set_rate_cap(0.0);
        let input = GovernorInput::default();
        let mut reference = self.sample(plan);
        for _ in 0..REST_STEPS_MAX {
            reference = self.step(plan, &input, REST_STEP_S);
            if reference.speed_m_s < REST_M_S || self.is_at_end(plan) {
                break;
            }
        }
        reference.pose
    }

    /// Returns the present reference.
    pub fn sample(&self, plan: &Plan) -> ReferenceSample {
        self.reference(&plan.sample(self.clock_s))
    }

    fn reference(&self, planned: &PlanSample) -> ReferenceSample {
        ReferenceSample::from(&PlanSample {
            speed_m_s: self.rate * planned.speed_m_s,
            acceleration_m_s2: self.rate * self.rate * planned.acceleration_m_s2
                + self.rate_slope_1_s * planned.speed_m_s,
            ..*planned
        })
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::geometry::Point;
    use crate::trajectory::{CircleSpec, Direction, Trajectory};

    /// Time within which the robot must be slowed, seconds.
    const BRAKED_S: f64 = 2.0;

    proptest! {
        #![proptest_config(ProptestConfig { cases: 32, ..ProptestConfig::default() })]
        #[test]
        fn sliding_ground_slows_the_reference_without_a_jump_and_lets_it_arrive(
            from_s in 0.0..4.0_f64, demonstrated_m_s2 in 0.27..0.8_f64,
            heading_rad in -3.0..3.0_f64,
        ) {
            let model = RobotModel::yi2007();
            let circle = Trajectory::Circle(CircleSpec {
                center: Point::default(),
                radius_m: 5.0,
                speed_m_s: 0.6,
                direction: Direction::CounterClockwise,
                turns: 0.2,
            });
            let start = Pose { x_m: 7.5, y_m: 0.0, heading_rad: 1.5 };
            let plan = Plan::new(&circle, start, &model).unwrap();
            let mut governor = Governor::new(&model);
            let bounds = SlidingBounds {
                longitudinal_m_s2: 0.5 * demonstrated_m_s2,
                lateral_m_s2: 0.5 * demonstrated_m_s2,
                yaw_rad_s2: demonstrated_m_s2,
            };
            let dt_s = 0.01;
            let mut before = governor.sample(&plan);
            for tick in 0..30_000 {
                if f64::from(tick) * dt_s >= from_s {
                    governor.set_sliding(Some(bounds), heading_rad);
                }
                let now = governor.step(&plan, &GovernorInput::default(), dt_s);
                prop_assert!(now.arc_m >= before.arc_m - 1.0e-9);
                let change_m_s2 = (now.speed_m_s - before.speed_m_s).abs() / dt_s;
                let most_m_s2 = 2.0 * model.limits().linear_acceleration_max_m_s2;
                prop_assert!(change_m_s2 < most_m_s2, "{change_m_s2} m/s²");
                if f64::from(tick) * dt_s >= from_s + BRAKED_S {
                    let lateral_m_s2 = now.speed_m_s.powi(2) * now.curvature_1_m.abs();
                    prop_assert!(lateral_m_s2 < 1.1 * bounds.lateral_m_s2, "{lateral_m_s2} m/s²");
                }
                before = now;
            }
            prop_assert!(governor.is_at_end(&plan));
        }
    }
}
