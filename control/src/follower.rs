//! Execution of one mission on one robot: plan, governor and tracking law.
//!
//! ```text
//! Approach ─► Tracking ─► Settling ─► Done
//!     └──────────┴───────────┴─ stop ─► Stopping ─► Stopped
//! any state that is not final ─► Failed(reason)
//! ```
//! `Approach` first turns on the spot where the path starts in another direction, then drives the
//! leg to the trajectory. `Done`, `Stopped` and `Failed` are final and command zero wheel speeds.

use crate::geometry::{Twist, wrap_angle_rad};
use crate::measured::{Measured, WheelSpeeds};
use crate::plan::Plan;
use crate::progress::{ProgressBounds, ProgressMonitor, ProgressTick};
use crate::reference::{Governor, GovernorInput, ReferenceSample};
use crate::robot::RobotModel;
use crate::sliding::Sliding;
use crate::tracking::{
    ThetaKnowledge, Tracker, TrackerConfig, TrackerError, TrackingErrors, desaturated,
};

/// Heading error to the path's start above which the robot turns on the spot, radians.
const ALIGN_FROM_RAD: f64 = 0.12;
/// Heading error at which a turn on the spot ends, radians.
const ALIGNED_RAD: f64 = 0.04;
/// Turn rate below which a turn on the spot may end, radians per second.
const ALIGNED_RATE_RAD_S: f64 = 0.08;
/// Gain from heading error to turn rate on the spot, per second.
const ALIGN_GAIN_1_S: f64 = 2.0;
/// Fraction of the turn rate limit used on the spot.
const ALIGN_SHARE: f64 = 0.4;
/// Maximum angular acceleration on the spot, radians per second squared.
const ALIGN_ACCELERATION_RAD_S2: f64 = 2.0;
/// Maximum duration of a turn on the spot, seconds; longer fails the mission.
const ALIGN_MAX_S: f64 = 30.0;

/// Tolerances and bounds of one mission.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FollowerConfig {
    /// Gains and bounds of the tracking law.
    pub tracker: TrackerConfig,
    /// Distance to the reference below which the path's end counts as reached, metres.
    pub end_tolerance_m: f64,
    /// Speed below which the robot counts as stopped, metres per second.
    pub rest_speed_m_s: f64,
    /// Time for which the robot must be at the end and stopped, seconds.
    pub settle_hold_s: f64,
    /// Maximum time for that, seconds; longer fails the mission. Also bounds the wait for zero
    /// speed after a stop.
    pub settle_max_s: f64,
    /// Cross-track error above which the mission fails if it lasts, metres.
    pub cross_track_max_m: f64,
    /// Time for which the cross-track error must last to fail the mission, seconds.
    pub cross_track_max_for_s: f64,
    /// Bounds beyond which a robot without progress fails the mission.
    pub progress: ProgressBounds,
    /// Pose age above which the reference pauses, seconds.
    pub pose_age_hold_s: f64,
    /// Pose age above which the mission fails, seconds.
    pub pose_age_max_s: f64,
}

impl Default for FollowerConfig {
    fn default() -> Self {
        Self {
            tracker: TrackerConfig::default(),
            end_tolerance_m: 0.10,
            rest_speed_m_s: 0.05,
            settle_hold_s: 0.3,
            settle_max_s: 5.0,
            cross_track_max_m: 0.5,
            cross_track_max_for_s: 2.0,
            progress: ProgressBounds {
                time_max_s: 20.0,
                gain_m: 0.3,
                beyond_plan_max_m: 5.0,
            },
            pose_age_hold_s: 0.3,
            pose_age_max_s: 3.0,
        }
    }
}

/// Reason why a mission failed on the robot.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FailureReason {
    /// The cross-track error was too large for too long.
    LeftPath,
    /// The robot did not stop at the path's end in time.
    NotSettled,
    /// The robot did not turn to the path's start heading in time.
    NotAligned,
    /// The robot made no progress although it was allowed to drive.
    Stuck,
    /// There was no usable pose for too long.
    PoseLost,
}

impl FailureReason {
    /// Returns a clause to display.
    pub fn text(self) -> &'static str {
        match self {
            Self::LeftPath => "the robot left its path",
            Self::NotSettled => "the robot did not come to rest at the end of its path",
            Self::NotAligned => "the robot could not turn to the direction of its path",
            Self::Stuck => "the robot made no progress",
            Self::PoseLost => "the robot lost its position",
        }
    }
}

/// State of a mission.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum FollowerStatus {
    /// On the approach to the trajectory.
    Approach,
    /// On the trajectory.
    Tracking,
    /// At the trajectory's end, stopping.
    Settling,
    /// At the trajectory's end, stopped. Final.
    Done,
    /// Braking along the path after a stop.
    Stopping,
    /// Stopped after a stop. Final.
    Stopped,
    /// Failed. Final.
    Failed(FailureReason),
}

impl FollowerStatus {
    /// Returns whether the state is final.
    pub fn is_final(self) -> bool {
        matches!(self, Self::Done | Self::Stopped | Self::Failed(_))
    }
}

/// Output of one tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FollowerOutput {
    /// Wheel speeds to command, before the gate.
    pub wheel_speeds: WheelSpeeds,
    /// Twist of these wheel speeds.
    pub twist: Twist,
    /// State of the mission.
    pub status: FollowerStatus,
    /// Arc length of the reference, metres; never decreases.
    pub progress_m: f64,
    /// Length of the path including the approach, metres.
    pub length_m: f64,
    /// Remaining plan time, seconds.
    pub remaining_s: f64,
    /// Tracking errors in the frame of the reference.
    pub errors: TrackingErrors,
    /// Desired pose and motion.
    pub reference: ReferenceSample,
    /// Adapted θ̂; not a measurement of θ.
    pub theta_loop: f64,
    /// Confidence in the known θ, 0 to 1; 0 without one, and while not driving.
    pub confidence: f64,
    /// Whether the wheel speed limit cut the command.
    pub saturated: bool,
}

/// Controller of one mission.
#[derive(Debug, Clone, PartialEq)]
pub struct Follower {
    plan: Plan,
    model: RobotModel,
    config: FollowerConfig,
    governor: Governor,
    tracker: Tracker,
    /// Slide detector; only on an approach over ground of unknown friction.
    sliding: Option<Sliding>,
    status: FollowerStatus,
    /// Whether the robot still turns on the spot at the start.
    aligning: bool,
    /// Commanded turn rate on the spot.
    align_rate_rad_s: f64,
    /// Time in the present state.
    phase_s: f64,
    /// Time for which the robot has stood at the end, or the reference has stood after a stop.
    hold_s: f64,
    /// Time for which the cross-track error has been too large.
    off_path_s: f64,
    monitor: ProgressMonitor,
    is_stuck: bool,
    best_arc_m: f64,
    /// Fraction of the plan's speed set by the operator; 0 pauses.
    rate_cap: f64,
    /// Time for which there has been no usable pose.
    invalid_s: f64,
    last_errors: TrackingErrors,
    saturated: bool,
}

impl Follower {
    /// Creates a mission in its initial state.
    ///
    /// # Errors
    /// [`TrackerError`] names a gain that is out of its range.
    pub fn new(
        plan: Plan,
        model: RobotModel,
        config: FollowerConfig,
    ) -> Result<Self, TrackerError> {
        let tracker = Tracker::new(model, config.tracker)?;
        let status = if plan.approach_length_m() > 0.0 {
            FollowerStatus::Approach
        } else {
            FollowerStatus::Tracking
        };
        let sliding = plan
            .assumed_mu()
            .map(|assumed_mu| Sliding::new(model, assumed_mu));
        Ok(Self {
            sliding,
            governor: Governor::new(&model),
            plan,
            model,
            config,
            tracker,
            status,
            aligning: true,
            align_rate_rad_s: 0.0,
            phase_s: 0.0,
            hold_s: 0.0,
            off_path_s: 0.0,
            monitor: ProgressMonitor::default(),
            is_stuck: false,
            best_arc_m: 0.0,
            rate_cap: 1.0,
            invalid_s: 0.0,
            last_errors: TrackingErrors::default(),
            saturated: false,
        })
    }

    /// Returns the plan.
    pub fn plan(&self) -> &Plan {
        &self.plan
    }

    /// Returns the governor, which advances the reference along the plan.
    pub fn governor(&self) -> &Governor {
        &self.governor
    }

    /// Returns the state of the mission.
    pub fn status(&self) -> FollowerStatus {
        self.status
    }

    /// Sets θ̂ at once to a known θ times its confidence, see [`Tracker::warm_start`].
    pub fn warm_start(&mut self, knowledge: ThetaKnowledge) {
        self.tracker.warm_start(knowledge);
    }

    /// Brakes to zero speed along the path and ends the mission; cannot be revoked.
    pub fn stop(&mut self) {
        if !self.status.is_final() {
            self.governor.stop();
            self.enter(FollowerStatus::Stopping);
        }
    }

    /// Limits the speed to a fraction of the plan's, clamped to 0 to 1: 0 pauses, 1 ends the limit.
    /// A non-finite value pauses.
    pub fn set_pace(&mut self, share: f64) {
        self.rate_cap = if share.is_finite() {
            share.clamp(0.0, 1.0)
        } else {
            0.0
        };
    }

    /// Sets the maximum speed along the path, metres per second; None removes the limit.
    pub fn set_speed_limit(&mut self, limit_m_s: Option<f64>) {
        self.governor.set_speed_limit(limit_m_s);
    }

    /// Sets the last command to the base if it differs from this mission's own; the next tick's
    /// acceleration limits start from it.
    pub fn set_commanded(&mut self, commanded: WheelSpeeds) {
        self.tracker.set_commanded(commanded);
    }

    /// Holds θ̂, χ̂ and the integral, for instance while another stage reduces the command.
    pub fn hold_adaptation(&mut self, held: bool) {
        self.tracker.hold_adaptation(held);
    }

    /// Computes the command of one tick of `dt_s` seconds. An invalid `dt_s` or a final state gives
    /// zero wheel speeds.
    pub fn step(
        &mut self,
        measured: &Measured,
        knowledge: Option<ThetaKnowledge>,
        dt_s: f64,
    ) -> FollowerOutput {
        if self.status.is_final() || !(dt_s.is_finite() && dt_s > 0.0) {
            return self.at_rest();
        }
        self.phase_s += dt_s;
        let usable = measured.is_finite() && measured.pose_age_s <= self.config.pose_age_hold_s;
        self.invalid_s = if usable { 0.0 } else { self.invalid_s + dt_s };
        if !measured.is_finite() || measured.pose_age_s > self.config.pose_age_max_s {
            if self.invalid_s > self.config.pose_age_max_s || measured.is_finite() {
                self.enter(FollowerStatus::Failed(FailureReason::PoseLost));
            }
            return self.at_rest();
        }
        if self.aligning
            && let Some(output) = self.align(measured, dt_s)
        {
            return output;
        }
        self.drive(measured, knowledge, usable, dt_s)
    }

    fn drive(
        &mut self,
        measured: &Measured,
        knowledge: Option<ThetaKnowledge>,
        usable: bool,
        dt_s: f64,
    ) -> FollowerOutput {
        self.governor
            .set_rate_cap(if usable { self.rate_cap } else { 0.0 });
        let errors = TrackingErrors::between(&self.governor.sample(&self.plan), measured);
        if self.status != FollowerStatus::Approach {
            self.sliding = None;
        }
        if let Some(sliding) = self.sliding.as_mut() {
            sliding.step(measured, dt_s);
        }
        let bounds = self.sliding.and_then(|sliding| sliding.bounds());
        self.governor.set_sliding(bounds, errors.heading_rad);
        let input = GovernorInput {
            lag_m: errors.distance_m(),
            along_track_m: errors.along_track_m,
            saturated: self.saturated,
        };
        let reference = self.governor.step(&self.plan, &input, dt_s);
        let tracked = self.tracker.step(&reference, measured, knowledge, dt_s);
        self.saturated = tracked.saturated;
        self.last_errors = tracked.errors;
        self.watch_progress(&reference, tracked.twist, dt_s);
        self.advance(&reference, measured, dt_s);
        if self.status.is_final() {
            return self.at_rest();
        }
        FollowerOutput {
            wheel_speeds: tracked.wheel_speeds,
            twist: tracked.twist,
            saturated: tracked.saturated,
            confidence: tracked.confidence,
            ..self.at_rest()
        }
    }

    /// Turns on the spot; None once the robot's heading is along the path.
    fn align(&mut self, measured: &Measured, dt_s: f64) -> Option<FollowerOutput> {
        let error_rad = wrap_angle_rad(self.plan.start_heading_rad() - measured.pose.heading_rad);
        let started = self.align_rate_rad_s.abs() > 0.0;
        let bound_rad = if started { ALIGNED_RAD } else { ALIGN_FROM_RAD };
        let slow = measured.twist.angular_rad_s.abs() < ALIGNED_RATE_RAD_S;
        if error_rad.abs() < bound_rad && (slow || !started) {
            self.aligning = false;
            self.phase_s = 0.0;
            return None;
        }
        let stopping = self.status == FollowerStatus::Stopping;
        let held = stopping || self.rate_cap <= 0.0;
        if self.phase_s > ALIGN_MAX_S && !held {
            self.enter(FollowerStatus::Failed(FailureReason::NotAligned));
            return Some(self.at_rest());
        }
        let most_rad_s = ALIGN_SHARE * self.model.limits().angular_max_rad_s;
        let wanted_rad_s = if held {
            0.0
        } else {
            (ALIGN_GAIN_1_S * error_rad).clamp(-most_rad_s, most_rad_s) * self.rate_cap
        };
        let step =
            ALIGN_ACCELERATION_RAD_S2.min(self.model.angular_acceleration_max_rad_s2()) * dt_s;
        self.align_rate_rad_s += (wanted_rad_s - self.align_rate_rad_s).clamp(-step, step);
        if held {
            self.phase_s -= dt_s;
            if stopping && self.align_rate_rad_s.abs() < ALIGNED_RATE_RAD_S {
                self.enter(FollowerStatus::Stopped);
                return Some(self.at_rest());
            }
        }
        let twist = Twist {
            linear_m_s: 0.0,
            angular_rad_s: self.align_rate_rad_s,
        };
        let (wheel_speeds, saturated) = desaturated(&self.model, twist);
        self.last_errors = TrackingErrors::between(&self.governor.sample(&self.plan), measured);
        Some(FollowerOutput {
            wheel_speeds,
            twist,
            saturated,
            ..self.at_rest()
        })
    }

    /// Checks whether the robot itself makes progress along its path.
    fn watch_progress(&mut self, reference: &ReferenceSample, commanded: Twist, dt_s: f64) {
        let tick = ProgressTick {
            robot_m: reference.arc_m - self.last_errors.along_track_m,
            allowed_m_s: self.governor.allowed_speed_m_s(&self.plan),
            commanded_m_s: commanded.linear_m_s,
            reference_m_s: reference.speed_m_s,
            dt_s,
        };
        self.is_stuck = self.monitor.step(&tick, &self.config.progress);
    }

    /// Updates the state after a tick of driving.
    fn advance(&mut self, reference: &ReferenceSample, measured: &Measured, dt_s: f64) {
        let config = self.config;
        let far = self.last_errors.cross_track_m.abs() > config.cross_track_max_m;
        self.off_path_s = if far { self.off_path_s + dt_s } else { 0.0 };
        self.best_arc_m = self.best_arc_m.max(reference.arc_m);
        let standing = measured.twist.linear_m_s.abs() < config.rest_speed_m_s;
        match self.status {
            FollowerStatus::Approach | FollowerStatus::Tracking
                if self.off_path_s > config.cross_track_max_for_s =>
            {
                self.enter(FollowerStatus::Failed(FailureReason::LeftPath));
            }
            FollowerStatus::Approach | FollowerStatus::Tracking
                if self.governor.is_at_end(&self.plan) =>
            {
                self.enter(FollowerStatus::Settling);
            }
            FollowerStatus::Approach | FollowerStatus::Tracking if self.is_stuck => {
                self.enter(FollowerStatus::Failed(FailureReason::Stuck));
            }
            FollowerStatus::Approach if reference.arc_m >= self.plan.approach_length_m() => {
                self.enter(FollowerStatus::Tracking);
            }
            FollowerStatus::Settling => {
                let settled = self.last_errors.distance_m() < config.end_tolerance_m && standing;
                self.hold_s = if settled { self.hold_s + dt_s } else { 0.0 };
                if self.hold_s >= config.settle_hold_s {
                    self.enter(FollowerStatus::Done);
                } else if self.phase_s > config.settle_max_s {
                    self.enter(FollowerStatus::Failed(FailureReason::NotSettled));
                }
            }
            FollowerStatus::Stopping => {
                let rests = self.governor.is_stopped(&self.plan);
                self.hold_s = if rests { self.hold_s + dt_s } else { 0.0 };
                // The gate stops a robot that does not stop in time.
                if (self.hold_s > 0.0 && standing) || self.hold_s > config.settle_max_s {
                    self.enter(FollowerStatus::Stopped);
                }
            }
            FollowerStatus::Approach
            | FollowerStatus::Tracking
            | FollowerStatus::Done
            | FollowerStatus::Stopped
            | FollowerStatus::Failed(_) => {}
        }
    }

    fn enter(&mut self, status: FollowerStatus) {
        if self.status != status {
            self.status = status;
            self.phase_s = 0.0;
            self.hold_s = 0.0;
        }
    }

    /// Returns the present state with zero wheel speeds.
    fn at_rest(&self) -> FollowerOutput {
        let reference = self.governor.sample(&self.plan);
        FollowerOutput {
            wheel_speeds: WheelSpeeds::default(),
            twist: Twist::default(),
            status: self.status,
            // Rounding may reduce the reference's arc length in its last digit.
            progress_m: reference.arc_m.max(self.best_arc_m),
            length_m: self.plan.length_m(),
            remaining_s: (self.plan.duration_s() - self.governor.clock_s()).max(0.0),
            errors: self.last_errors,
            reference,
            theta_loop: self.tracker.theta_loop(),
            confidence: 0.0,
            saturated: false,
        }
    }
}
