//! The active mission of the loop: followed, held at zero velocity, replaced, and ended.
//!
//! ```text
//!          hold (pause, revision, outside)    stopped
//! driving ─────────────────────────► braking ────────► held at zero velocity
//!    ▲ └────────────── cancel, silence ──────┴────────────┤ │
//!    └──────────────────── release ───────────────────────┘ ▼
//!                                                         ended
//! ```
//! While the mission is held at zero velocity, the tracking law is not updated: no integral winds
//! up and the robot does not creep.

use std::time::Duration;

use tread_api::robot::{MissionProgress, PauseCause};
use tread_control::follower::FollowerStatus;
use tread_control::gate::GateCause;
use tread_control::measured::{Measured, WheelSpeeds};
use tread_control::robot::RobotModel;
use tread_control::tracking::ThetaKnowledge;

use super::STANDING_TICKS;
use super::channels::{EndReason, Hold};
use super::driven::TickRecord;
use super::job::Job;
use super::prior::Prior;
use super::surface::Comparison;

/// Speed below which a held robot counts as stopped, m/s; twice the value for the yaw rate, rad/s.
const STANDSTILL_SPEED_MAX: f64 = 0.04;

/// Result of one tick of the mission.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Step {
    /// Wheel speeds of the tracking law; zero while the robot is stopped on hold.
    pub(super) wheel_speeds: WheelSpeeds,
    /// Reason of the mission's end, if it ended in this tick.
    pub(super) end: Option<EndReason>,
    /// Begin or end of a pause in this tick.
    pub(super) pause_change: Option<PauseChange>,
    /// θ̂ of the tracking law.
    pub(super) theta_loop: Option<f64>,
}

/// Begin or end of a pause, which the agent reports to the server.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum PauseChange {
    Paused,
    Resumed,
}

/// The holds that are active.
#[derive(Debug, Clone, Copy, Default)]
#[expect(
    clippy::struct_excessive_bools,
    reason = "each says whether one independent hold is on"
)]
struct Holds {
    pause: bool,
    replacement: bool,
    outside: bool,
    base: bool,
    overrun: bool,
    sensors: bool,
}

/// The active mission.
#[derive(Debug)]
pub(super) struct Active {
    pub(super) job: Box<Job>,
    pub(super) progress: MissionProgress,
    pub(super) has_started: bool,
    holds: Holds,
    /// Begin of the reported cause of the pause, by the monotonic clock.
    paused_from: Option<Duration>,
    standing_ticks: u32,
    /// Whether the pause was reported to the server.
    is_pause_reported: bool,
    stopped_because: EndReason,
    /// Revision that takes over once the robot has stopped.
    next: Option<Box<Job>>,
    /// Whether a further revision was announced while one waits.
    is_another_announced: bool,
    /// Signed cross-track error in this tick, metres, and whether a wheel speed was saturated.
    tracked: Option<(f64, bool)>,
}

pub(super) fn progress_of(job: &Job) -> MissionProgress {
    MissionProgress {
        id: job.mission,
        revision: job.revision,
        plan_hash: job.plan_hash,
        driven_m: 0.0,
        length_m: job.follower.plan().length_m(),
        cross_track_m: 0.0,
        paused: false,
        paused_by: None,
    }
}

impl Active {
    pub(super) fn new(job: Box<Job>) -> Self {
        Self {
            progress: progress_of(&job),
            job,
            has_started: false,
            holds: Holds::default(),
            paused_from: None,
            standing_ticks: 0,
            is_pause_reported: false,
            stopped_because: EndReason::Cancelled,
            next: None,
            is_another_announced: false,
            tracked: None,
        }
    }

    /// Brakes along the path and ends the mission once the robot has stopped.
    pub(super) fn stop(&mut self, because: EndReason) {
        if self.job.follower.status() != FollowerStatus::Stopping {
            self.stopped_because = because;
            self.job.follower.stop();
        }
    }

    /// Pauses the mission until it is resumed on request; the cause of the highest rank is
    /// reported.
    pub(super) fn pause(&mut self, cause: PauseCause, now: Duration) {
        let rank = |cause: PauseCause| match cause {
            PauseCause::Other => 0,
            PauseCause::Request => 1,
            PauseCause::Teleoperation => 2,
            PauseCause::Stop => 3,
        };
        let is_stricter = |present: PauseCause| rank(cause) > rank(present);
        if self.progress.paused_by.is_none_or(is_stricter) {
            self.hold(Hold::Pause, true);
            self.progress.paused_by = Some(cause);
            self.paused_from = Some(now);
        }
    }

    /// Returns the duration of a pause for safety; `None` for a requested pause.
    pub(super) fn paused_for(&self, now: Duration) -> Option<Duration> {
        let is_on_hold = self.progress.is_paused_for_safety();
        self.paused_from
            .filter(|_| is_on_hold)
            .map(|from| now.saturating_sub(from))
    }

    /// Activates or releases one hold; the follower's pace is zero while any hold is active.
    pub(super) fn hold(&mut self, hold: Hold, is_wanted: bool) {
        let present = match hold {
            Hold::Pause => {
                self.progress.paused_by = match self.progress.paused_by {
                    _ if !is_wanted => None,
                    None => Some(PauseCause::Request),
                    known => known,
                };
                &mut self.holds.pause
            }
            Hold::Replacement => &mut self.holds.replacement,
            Hold::Outside => &mut self.holds.outside,
            Hold::Base => &mut self.holds.base,
            Hold::Overrun => &mut self.holds.overrun,
            Hold::Sensors => &mut self.holds.sensors,
        };
        if std::mem::replace(present, is_wanted) == is_wanted {
            return;
        }
        let is_on_hold = self.is_on_hold();
        if !is_on_hold {
            self.standing_ticks = 0;
        }
        self.job
            .follower
            .set_pace(if is_on_hold { 0.0 } else { 1.0 });
    }

    /// Whether any hold is active, braking or stopped.
    pub(super) fn is_on_hold(&self) -> bool {
        let holds = &self.holds;
        holds.pause
            || holds.replacement
            || holds.outside
            || holds.base
            || holds.overrun
            || holds.sensors
    }

    /// Whether the mission does not command the wheels: the robot is stopped on hold and the
    /// mission is not being ended.
    pub(super) fn rests(&self) -> bool {
        self.is_standing_on_hold() && self.job.follower.status() != FollowerStatus::Stopping
    }

    /// Limits the speed along the path, metres per second.
    pub(super) fn limit_speed(&mut self, limit_m_s: Option<f64>) {
        self.job.follower.set_speed_limit(limit_m_s);
    }

    /// Suspends or resumes the adaptation of θ̂ in the tracking law.
    pub(super) fn hold_adaptation(&mut self, is_on_hold: bool) {
        self.job.follower.hold_adaptation(is_on_hold);
    }

    fn is_standing_on_hold(&self) -> bool {
        self.is_on_hold() && self.standing_ticks >= STANDING_TICKS
    }

    /// Holds the mission for a revision that is being planned. If one waits already, the hold goes on
    /// after that one took over.
    pub(super) fn announce_replacement(&mut self) {
        self.is_another_announced = self.next.is_some();
        self.hold(Hold::Replacement, true);
    }

    /// Ends the hold for a revision that does not come. One that waits still takes over.
    pub(super) fn withdraw_replacement(&mut self) {
        self.is_another_announced = false;
        if self.next.is_none() {
            self.hold(Hold::Replacement, false);
        }
    }

    /// Stores the next revision, which replaces the active one when the robot has stopped. Returns
    /// a revision that was waiting already.
    pub(super) fn replace_at_rest(&mut self, next: Box<Job>) -> Option<Box<Job>> {
        self.is_another_announced = false;
        self.hold(Hold::Replacement, true);
        self.next.replace(next)
    }

    /// Whether a revision waits and the robot has stopped, or the active revision is done.
    pub(super) fn is_at_rest_for_replacement(&self) -> bool {
        let status = self.job.follower.status();
        let is_stopping = status == FollowerStatus::Stopping;
        let is_over = status == FollowerStatus::Done;
        self.next.is_some() && !is_stopping && (is_over || self.is_standing_on_hold())
    }

    /// Replaces the active revision by the waiting one and returns the old one. The record of the
    /// driven path continues.
    pub(super) fn replace(&mut self, knowledge: Option<ThetaKnowledge>) -> Option<Box<Job>> {
        let mut next = self.next.take()?;
        std::mem::swap(&mut self.job.driven, &mut next.driven);
        if let Some(knowledge) = knowledge {
            next.follower.warm_start(knowledge);
        }
        self.progress = MissionProgress {
            paused: self.is_pause_reported,
            paused_by: self.progress.paused_by,
            ..progress_of(&next)
        };
        let old = std::mem::replace(&mut self.job, next);
        let is_another_announced = std::mem::take(&mut self.is_another_announced);
        self.hold(Hold::Replacement, is_another_announced);
        if self.is_on_hold() {
            self.job.follower.set_pace(0.0);
        }
        Some(old)
    }

    /// Returns the map's friction along the path of the active revision, or of the waiting one if
    /// it takes over in this tick.
    pub(super) fn prior(&self) -> &Prior {
        let coming = self
            .next
            .as_ref()
            .filter(|_| self.is_at_rest_for_replacement());
        &coming.unwrap_or(&self.job).prior
    }

    /// Returns the active revision and the waiting one, if any.
    pub(super) fn into_jobs(self) -> (Box<Job>, Option<Box<Job>>) {
        (self.job, self.next)
    }

    /// Runs one tick. `command` holds the wheel speeds that the base was commanded last.
    pub(super) fn step(
        &mut self,
        measured: &Measured,
        knowledge: Option<ThetaKnowledge>,
        model: &RobotModel,
        command: WheelSpeeds,
        dt_s: f64,
    ) -> Step {
        self.record_standstill(measured, model, command);
        let pause_change = self.take_pause_change();
        let status = self.job.follower.status();
        let is_on_the_way = matches!(status, FollowerStatus::Approach | FollowerStatus::Tracking);
        if self.is_standing_on_hold() && is_on_the_way {
            self.tracked = None;
            return Step {
                wheel_speeds: WheelSpeeds::default(),
                end: None,
                pause_change,
                theta_loop: None,
            };
        }
        self.job.follower.set_commanded(command);
        let output = self.job.follower.step(measured, knowledge, dt_s);
        self.progress.driven_m = self.progress.driven_m.max(output.progress_m);
        self.progress.cross_track_m = output.errors.cross_track_m;
        self.tracked = Some((output.errors.cross_track_m, output.saturated));
        let end = match output.status {
            // With a revision to come, the end of the old one does not end the mission.
            FollowerStatus::Done if self.holds.replacement => None,
            FollowerStatus::Done => Some(EndReason::Reached),
            FollowerStatus::Stopped => Some(self.stopped_because),
            FollowerStatus::Failed(reason) => Some(EndReason::Failed(reason)),
            FollowerStatus::Approach
            | FollowerStatus::Tracking
            | FollowerStatus::Settling
            | FollowerStatus::Stopping => None,
        };
        Step {
            wheel_speeds: output.wheel_speeds,
            end,
            pause_change,
            theta_loop: Some(output.theta_loop),
        }
    }

    fn record_standstill(&mut self, measured: &Measured, model: &RobotModel, command: WheelSpeeds) {
        let command_m_s = command.magnitude_max_rad_s() * model.wheel_radius_m();
        let stands = self.is_on_hold()
            && command_m_s < STANDSTILL_SPEED_MAX
            && measured.twist.linear_m_s.abs() < STANDSTILL_SPEED_MAX
            && measured.twist.angular_rad_s.abs() < 2.0 * STANDSTILL_SPEED_MAX;
        self.standing_ticks = if stands || self.is_standing_on_hold() {
            self.standing_ticks.saturating_add(1)
        } else {
            0
        };
    }

    fn take_pause_change(&mut self) -> Option<PauseChange> {
        let is_paused = self.holds.pause && self.is_standing_on_hold();
        if is_paused == self.is_pause_reported || (self.is_pause_reported && self.holds.pause) {
            return None;
        }
        self.is_pause_reported = is_paused;
        self.progress.paused = is_paused;
        Some(if is_paused {
            PauseChange::Paused
        } else {
            PauseChange::Resumed
        })
    }

    /// Adds this tick to the record of the path.
    pub(super) fn record(&mut self, tick: TickRecord) {
        let (cross_track_m, is_saturated) = self.tracked.unzip();
        self.job.driven.add(&TickRecord {
            cross_track_m,
            is_saturated: is_saturated.unwrap_or(false),
            is_paused: self.is_pause_reported,
            // While the mission is held, reductions up to the cause `Speed` are expected and not
            // recorded.
            gate: tick
                .gate
                .filter(|cause| !self.is_on_hold() || *cause > GateCause::Speed),
            ..tick
        });
    }

    /// Records the comparison of a cell's measured θ with the map's.
    pub(super) fn compare(&mut self, comparison: &Comparison) {
        self.job.driven.compare(comparison);
    }

    /// Whether the server has been silent for longer than the mission allows.
    pub(super) fn is_server_silent_too_long(&self, silence: Duration) -> bool {
        self.job.silence_max.is_some_and(|most| silence > most)
    }
}
