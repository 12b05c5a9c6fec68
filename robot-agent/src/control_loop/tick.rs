//! One tick of the control loop: read → localise → estimate → track → gate → write.
//!
//! Pure but for the drive and the channels' ends; nothing here waits, allocates or looks at a
//! clock. What has to be freed goes out with an event, to be freed by somebody else.

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::sync::mpsc::TrySendError;
use std::time::Duration;

use tread_api::friction::ThetaEstimate;
use tread_api::robot::{MissionProgress, RobotMode};
use tread_control::estimation::{Estimate, Estimator, SensorNoise, SensorSample};
use tread_control::follower::FollowerStatus;
use tread_control::gate::{GateInput, GateLimits, gate};
use tread_control::geometry::Twist;
use tread_control::localisation::{FixOutcome, Localisation, LocalisationNoise, PositionFix};
use tread_control::measured::{Measured, WheelSpeeds};
use tread_control::robot::RobotModel;
use tread_control::tracking::ThetaKnowledge;

use super::seam::{EndReason, Fault, Job, LoopCommand, LoopEnds, LoopEvent, Shared, Snapshot};
use super::segments::{CutInput, Moment, Place, SegmentCutter};
use super::site_view::{Footing, SiteView};
use crate::drive::{Drive, Feedback};
use crate::geometry::wire_point;

/// Oldest word of the base with which it does not count as silent.
const BASE_SILENT_AFTER: Duration = Duration::from_millis(200);
/// Oldest position fix with which the position does not count as lost.
const POSITION_LOST_AFTER: Duration = Duration::from_secs(3);
/// Longest time that one tick is taken to have lasted, seconds; a loop that slept does not leap.
const TICK_MAX_S: f64 = 0.2;
/// Mission events that may wait for room in the channel; one mission at a time makes two.
const UNSENT_MAX: usize = 8;
/// Speed below which the robot counts as standing, m/s and rad/s.
const STANDING: f64 = 0.02;

/// The mission in hand.
#[derive(Debug)]
struct Active {
    job: Box<Job>,
    progress: MissionProgress,
    has_started: bool,
}

/// The state of the loop between two ticks.
#[derive(Debug)]
pub(crate) struct LoopCore {
    model: RobotModel,
    limits: GateLimits,
    ends: LoopEnds,
    localisation: Localisation,
    estimator: Estimator,
    estimate: Estimate,
    cutter: SegmentCutter,
    site: Option<Arc<SiteView>>,
    active: Option<Active>,
    unsent: VecDeque<LoopEvent>,
    command: WheelSpeeds,
    measured_wheels: WheelSpeeds,
    theta_loop: Option<f64>,
    footing: Option<Footing>,
    last_tick: Option<Duration>,
    last_sample: Option<Duration>,
    last_fix: Option<Duration>,
    ticks: u64,
}

impl LoopCore {
    pub(crate) fn new(model: RobotModel, ends: LoopEnds) -> Self {
        let estimator = Estimator::new(model, SensorNoise::default());
        Self {
            model,
            limits: GateLimits::of(&model),
            ends,
            localisation: Localisation::new(model, LocalisationNoise::default()),
            estimate: estimator.estimate(),
            estimator,
            cutter: SegmentCutter::default(),
            site: None,
            active: None,
            unsent: VecDeque::with_capacity(UNSENT_MAX),
            command: WheelSpeeds::default(),
            measured_wheels: WheelSpeeds::default(),
            theta_loop: None,
            footing: None,
            last_tick: None,
            last_sample: None,
            last_fix: None,
            ticks: 0,
        }
    }

    /// Whether the wheels are commanded to rest and do.
    pub(crate) fn stands(&self) -> bool {
        let radius_m = self.model.wheel_radius_m();
        self.command == WheelSpeeds::default()
            && self.measured_wheels.magnitude_max_rad_s() * radius_m < 5.0 * STANDING
    }

    /// One tick. With `stop`, the robot brakes and its mission ends.
    pub(crate) fn tick(&mut self, now: Moment, stop: bool, drive: &mut dyn Drive) {
        self.send_unsent();
        let dt_s = self.time_step_s(now.monotonic);
        let feedback = drive.read(now.monotonic);
        let ground_changed = self.take_samples(&feedback);
        self.take_commands(now, stop);
        self.cut_segments(now, ground_changed, dt_s);
        let fault = self.fault(now.monotonic);
        let wanted = self.follow(now, fault, dt_s);
        let gated = gate(
            &GateInput {
                // A robot without a mission holds still: that is a command, not the lack of one.
                command: Some(wanted.unwrap_or_default()),
                previous: self.command,
                stop,
                feedback_age_s: age_s(now.monotonic, self.last_sample),
                dt_s,
            },
            &self.limits,
        );
        self.command = gated.wheel_speeds;
        drive.write(self.command);
        if stop {
            self.end_mission(now, EndReason::AgentStopped);
        }
        self.report_start(now);
        self.ticks += 1;
        self.ends
            .shared
            .publish(self.snapshot(now.monotonic, fault));
    }

    fn time_step_s(&mut self, now: Duration) -> f64 {
        let before = self.last_tick.replace(now).unwrap_or(now);
        now.saturating_sub(before).as_secs_f64().min(TICK_MAX_S)
    }

    /// Takes what the base said; true if the estimator found the ground changed.
    fn take_samples(&mut self, feedback: &Feedback) -> bool {
        let mut ground_changed = false;
        let mut has_new_block = false;
        for sample in feedback.samples() {
            let dt_s = self
                .last_sample
                .map_or(0.0, |last| sample.at.saturating_sub(last).as_secs_f64())
                .min(TICK_MAX_S);
            self.last_sample = Some(sample.at);
            if let (Some(gyro_rad_s), Some(wheel_speeds)) =
                (sample.yaw_rate_rad_s, sample.wheel_speeds)
            {
                if wheel_speeds.is_finite() {
                    self.measured_wheels = wheel_speeds;
                }
                if dt_s > 0.0 {
                    self.localisation.predict(gyro_rad_s, wheel_speeds, dt_s);
                    // With wheels on two grounds there is no one θ to learn.
                    if self.footing != Some(Footing::Mixed) {
                        let taken = SensorSample {
                            wheel_speeds,
                            gyro_rad_s,
                            acceleration: sample.acceleration,
                            body_speed_m_s: sample.body_speed_m_s,
                            wheel_torques: sample.wheel_torques,
                        };
                        let outcome = self.estimator.update(&taken, dt_s);
                        ground_changed |= outcome.ground_changed;
                        has_new_block |= outcome.block_done;
                        if outcome.block_done && self.cutter.cell().is_none() {
                            Shared::count(&self.ends.shared.unplaced_blocks);
                        }
                    }
                }
            }
            if let Some(pose) = sample.position {
                let fix = PositionFix { pose, age_s: 0.0 };
                match self.localisation.correct(&fix) {
                    FixOutcome::Started | FixOutcome::Fused | FixOutcome::Restarted => {
                        self.last_fix = Some(sample.at);
                    }
                    FixOutcome::Invalid | FixOutcome::Outlier => {}
                }
            }
        }
        if has_new_block {
            self.estimate = self.estimator.estimate();
        }
        ground_changed
    }

    fn take_commands(&mut self, now: Moment, stop: bool) {
        // Bounded: the channel holds a few, and whoever refills it waits for the network.
        for _ in 0..super::seam::COMMANDS_MAX {
            let Ok(command) = self.ends.commands.try_recv() else {
                return;
            };
            match command {
                LoopCommand::Start(job) => self.begin(now, job, stop),
                LoopCommand::Cancel(mission) => {
                    if let Some(active) = self
                        .active
                        .as_mut()
                        .filter(|active| active.job.mission == mission)
                    {
                        active.job.follower.stop();
                    }
                }
                LoopCommand::Site(site) => {
                    self.cutter.abandon(&mut self.estimator);
                    self.estimate = self.estimator.estimate();
                    if let Some(old) = self.site.replace(site) {
                        self.send(LoopEvent::Retired(old));
                    }
                }
            }
        }
    }

    fn begin(&mut self, now: Moment, mut job: Box<Job>, stop: bool) {
        let progress = MissionProgress {
            id: job.mission,
            revision: job.revision,
            plan_hash: job.plan_hash,
            driven_m: 0.0,
            length_m: job.follower.plan().length_m(),
            cross_track_m: 0.0,
        };
        let refusal = if stop {
            Some(EndReason::AgentStopped)
        } else if self.active.is_some() {
            Some(EndReason::AnotherInHand)
        } else if job.start_by.is_some_and(|latest| now.monotonic > latest) {
            Some(EndReason::TooLate)
        } else {
            None
        };
        if let Some(reason) = refusal {
            self.send(LoopEvent::Ended {
                at: now.wall,
                reason,
                progress,
                job,
            });
            return;
        }
        if let Some(knowledge) = self.knowledge() {
            job.follower.warm_start(knowledge);
        }
        self.active = Some(Active {
            job,
            progress,
            has_started: false,
        });
    }

    fn knowledge(&self) -> Option<ThetaKnowledge> {
        let measured = self.estimate.theta?;
        Some(ThetaKnowledge {
            theta: measured.theta,
            std_dev: measured.std_dev,
        })
    }

    fn cut_segments(&mut self, now: Moment, ground_changed: bool, dt_s: f64) {
        let pose = self.localisation.pose();
        let mut place = None;
        self.footing = None;
        if let (Some(site), Some(pose)) = (&self.site, pose) {
            let footing = site.footing(pose, &self.model);
            self.footing = Some(footing);
            let former = self.cutter.cell();
            if let (Footing::Whole(terrain), Some(cell)) =
                (footing, site.cell(wire_point(pose), former))
            {
                place = Some(Place { cell, terrain });
            }
        }
        let speed_m_s = self.localisation.twist().linear_m_s.abs();
        let input = CutInput {
            now,
            place,
            site: self.site.as_ref(),
            mission: self.active.as_ref().map(|active| active.job.mission),
            driven_m: if speed_m_s.is_finite() {
                speed_m_s * dt_s
            } else {
                0.0
            },
            ground_changed,
        };
        let cut = self.cutter.step(input, &mut self.estimator);
        if cut.is_new_ground {
            // What was known of the ground before says nothing here.
            self.estimate = self.estimator.estimate();
        }
        if let Some(segment) = cut.segment {
            self.send(LoopEvent::Segment(segment));
        }
    }

    fn fault(&self, now: Duration) -> Option<Fault> {
        let is_older = |at: Option<Duration>, most: Duration| {
            at.is_some_and(|at| now.saturating_sub(at) > most)
        };
        if is_older(self.last_sample, BASE_SILENT_AFTER) {
            Some(Fault::BaseSilent)
        } else if is_older(self.last_fix, POSITION_LOST_AFTER) {
            Some(Fault::PositionLost)
        } else {
            None
        }
    }

    /// The wheel speeds that the mission wants; none without one.
    fn follow(&mut self, now: Moment, fault: Option<Fault>, dt_s: f64) -> Option<WheelSpeeds> {
        let knowledge = self.knowledge();
        let measured = Measured {
            pose: self.localisation.pose().unwrap_or_default(),
            twist: self.localisation.twist(),
            wheel_speeds: self.measured_wheels,
            pose_age_s: age_s(now.monotonic, self.last_fix),
        };
        let active = self.active.as_mut()?;
        let output = active.job.follower.step(&measured, knowledge, dt_s);
        self.theta_loop = Some(output.theta_loop);
        active.progress.driven_m = active.progress.driven_m.max(output.progress_m);
        active.progress.cross_track_m = output.errors.cross_m;
        let end = match output.status {
            FollowerStatus::Done => Some(EndReason::Reached),
            FollowerStatus::Stopped => Some(EndReason::Cancelled),
            FollowerStatus::Failed(reason) => Some(EndReason::Failed(reason)),
            FollowerStatus::Approach
            | FollowerStatus::Tracking
            | FollowerStatus::Settling
            | FollowerStatus::Stopping => None,
        };
        if let Some(reason) = end {
            self.end_mission(now, reason);
            return None;
        }
        // The gate would brake anyway; a follower that hears of it does not wind up meanwhile.
        fault.is_none().then_some(output.wheel_speeds)
    }

    fn end_mission(&mut self, now: Moment, reason: EndReason) {
        if let Some(active) = self.active.take() {
            if !active.has_started {
                self.send(LoopEvent::Started {
                    at: now.wall,
                    progress: active.progress,
                });
            }
            self.send(LoopEvent::Ended {
                at: now.wall,
                reason,
                progress: active.progress,
                job: active.job,
            });
        }
    }

    /// The first tick of a mission has given its first wheel command by now.
    fn report_start(&mut self, now: Moment) {
        let Some(active) = self.active.as_mut().filter(|active| !active.has_started) else {
            return;
        };
        active.has_started = true;
        let progress = active.progress;
        self.send(LoopEvent::Started {
            at: now.wall,
            progress,
        });
    }

    fn send_unsent(&mut self) {
        while let Some(event) = self.unsent.pop_front() {
            if let Err(TrySendError::Full(event)) = self.ends.events.try_send(event) {
                self.unsent.push_front(event);
                return;
            }
        }
    }

    /// Hands an event on. What matters waits for room; a segment is lost and counted instead.
    fn send(&mut self, event: LoopEvent) {
        let refused = if self.unsent.is_empty() {
            match self.ends.events.try_send(event) {
                Ok(()) | Err(TrySendError::Disconnected(_)) => return,
                Err(TrySendError::Full(event)) => event,
            }
        } else {
            event
        };
        if matches!(refused, LoopEvent::Segment(_)) {
            Shared::count(&self.ends.shared.lost_segments);
        } else if self.unsent.len() < UNSENT_MAX {
            self.unsent.push_back(refused);
        }
    }

    fn snapshot(&self, now: Duration, fault: Option<Fault>) -> Snapshot {
        let mode = match (fault, &self.active) {
            (Some(_), _) => RobotMode::Fault,
            (None, Some(_)) => RobotMode::Tracking,
            (None, None) => RobotMode::Idle,
        };
        let pose = self.localisation.pose().filter(|pose| pose.is_finite());
        let twist = Some(self.localisation.twist()).filter(|twist: &Twist| twist.is_finite());
        let terrain = match self.footing {
            Some(Footing::Whole(terrain)) => terrain,
            Some(Footing::Mixed) | None => None,
        };
        let measured = self.estimate.theta.map(|theta| ThetaEstimate {
            theta: theta.theta,
            std_dev: theta.std_dev,
        });
        Snapshot {
            at: now,
            mode,
            fault,
            pose: pose.zip(self.last_fix),
            twist: twist.zip(self.last_sample),
            mission: self.active.as_ref().map(|active| active.progress),
            theta_loop: self.theta_loop.filter(|theta| theta.is_finite()),
            theta_measured: measured
                .filter(|theta| theta.theta.is_finite() && theta.std_dev.is_finite()),
            excited: !self.estimate.no_new_information,
            cell: self.cutter.cell(),
            terrain,
            terrain_revision: self.site.as_ref().map(|site| site.terrain_revision()),
            ticks: self.ticks,
        }
    }

    /// Notes how long a tick computed.
    pub(crate) fn note_tick_time(&self, took: Duration) {
        let microseconds = u32::try_from(took.as_micros()).unwrap_or(u32::MAX);
        self.ends
            .shared
            .tick_max_us
            .fetch_max(microseconds, Ordering::Relaxed);
    }

    /// Notes a tick that began more than one period late.
    pub(crate) fn note_overrun(&self) {
        Shared::count(&self.ends.shared.overruns);
    }

    /// Whether the rest of the agent wants the loop to end.
    pub(crate) fn is_told_to_stop(&self) -> bool {
        self.ends.shared.stop.load(Ordering::Relaxed)
    }

    /// Hands out what still waits; false if there was no room for all of it.
    pub(crate) fn flush(&mut self) -> bool {
        self.send_unsent();
        self.unsent.is_empty()
    }
}

/// Age of something, seconds; infinite for what never was.
fn age_s(now: Duration, at: Option<Duration>) -> f64 {
    at.map_or(f64::INFINITY, |at| now.saturating_sub(at).as_secs_f64())
}
