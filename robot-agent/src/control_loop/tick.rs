//! One tick of the control loop: read → localise → estimate → track → gate → write.
//!
//! Pure but for the drive and the channels' ends; nothing here waits, allocates or looks at a
//! clock. What has to be freed goes out with an event, to be freed by somebody else.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use tread_api::friction::ThetaEstimate;
use tread_api::robot::RobotMode;
use tread_control::estimation::{Estimate, Estimator, SensorNoise, SensorSample};
use tread_control::gate::{GateCause, GateInput, GateLimits, gate};
use tread_control::geometry::{Pose, Twist};
use tread_control::localisation::{FixOutcome, Localisation, LocalisationNoise, PositionFix};
use tread_control::measured::{Measured, WheelSpeeds};
use tread_control::robot::RobotModel;
use tread_control::tracking::ThetaKnowledge;

use super::active::{Active, Hold, News, progress_of};
use super::driven::TickRecord;
use super::outgoing::Outgoing;
use super::seam::{EndReason, Fault, Job, LoopCommand, LoopEnds, LoopEvent, Shared, Snapshot};
use super::segments::{CutInput, Moment, Place, SegmentCutter};
use super::site_view::{Footing, SiteView};
use crate::drive::{Battery, Drive, Feedback};
use crate::geometry::wire_point;

/// Oldest word of the base with which it does not count as silent.
const BASE_SILENT_AFTER: Duration = Duration::from_millis(200);
/// Oldest position fix with which the position does not count as lost.
const POSITION_LOST_AFTER: Duration = Duration::from_secs(3);
/// Longest time that one tick is taken to have lasted, seconds; a loop that slept does not leap.
const TICK_MAX_S: f64 = 0.2;
/// Longest that a mission is held for a revision that does not come.
const REPLACEMENT_MAX: Duration = Duration::from_secs(10);
/// Speed below which the robot counts as standing, m/s and rad/s.
const STANDING: f64 = 0.02;

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
    outgoing: Outgoing,
    command: WheelSpeeds,
    measured_wheels: WheelSpeeds,
    theta_loop: Option<f64>,
    footing: Option<Footing>,
    last_tick: Option<Duration>,
    last_sample: Option<Duration>,
    last_fix: Option<Duration>,
    /// Whether a wheel slips beyond the model.
    slips: bool,
    /// Until when the mission is held for its next revision.
    replacement_until: Option<Duration>,
    ticks: u64,
}

impl LoopCore {
    pub(crate) fn new(model: RobotModel, ends: LoopEnds) -> Self {
        let estimator = Estimator::new(model, SensorNoise::default());
        Self {
            model,
            limits: GateLimits::of(&model),
            localisation: Localisation::new(model, LocalisationNoise::default()),
            estimate: estimator.estimate(),
            estimator,
            cutter: SegmentCutter::default(),
            site: None,
            active: None,
            outgoing: Outgoing::new(ends.events.clone(), Arc::clone(&ends.shared)),
            ends,
            command: WheelSpeeds::default(),
            measured_wheels: WheelSpeeds::default(),
            theta_loop: None,
            footing: None,
            last_tick: None,
            last_sample: None,
            last_fix: None,
            slips: false,
            replacement_until: None,
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
        self.outgoing.flush();
        let dt_s = self.time_step_s(now.monotonic);
        let feedback = drive.read(now.monotonic);
        let ground_changed = self.take_samples(&feedback);
        self.take_commands(now, stop);
        self.cut_segments(now, ground_changed, dt_s);
        self.mind_bounds(now.monotonic);
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
        self.record(dt_s, ground_changed, gated.cause);
        if stop {
            self.end_mission(now, EndReason::AgentStopped);
        }
        self.report_start(now);
        self.ticks += 1;
        self.ends
            .shared
            .publish(&self.snapshot(now.monotonic, fault, drive.battery()));
    }

    /// What must not last for ever: the server's silence, and waiting for a revision.
    fn mind_bounds(&mut self, now: Duration) {
        let Some(active) = &mut self.active else {
            self.replacement_until = None;
            return;
        };
        if active.minds_silence(self.ends.shared.server_silence(now)) {
            active.stop(EndReason::ServerSilent);
        }
        if self.replacement_until.is_some_and(|until| now > until) {
            active.hold(Hold::Replacement, false);
            self.replacement_until = None;
        }
    }

    fn record(&mut self, dt_s: f64, ground_changed: bool, gate: Option<GateCause>) {
        let Some(active) = &mut self.active else {
            return;
        };
        let speed_m_s = self.localisation.twist().linear_m_s.abs();
        let measured = self.estimate.theta;
        active.record(TickRecord {
            dt_s,
            at: self.localisation.pose().map(Pose::point),
            driven_m: speed_m_s * dt_s,
            cross_track_m: None,
            is_saturated: false,
            is_paused: false,
            slips: self.slips || ground_changed,
            gate,
            theta_loop: self.theta_loop,
            theta_measured: measured.map(|theta| (theta.theta, theta.std_dev)),
        });
    }

    fn time_step_s(&mut self, now: Duration) -> f64 {
        let before = self.last_tick.replace(now).unwrap_or(now);
        now.saturating_sub(before).as_secs_f64().min(TICK_MAX_S)
    }

    /// Takes what the base said; true if the estimator found the ground changed.
    fn take_samples(&mut self, feedback: &Feedback) -> bool {
        let mut ground_changed = false;
        let mut has_new_block = false;
        let lost = u64::from(feedback.lost());
        self.ends
            .shared
            .lost_samples
            .fetch_add(lost, Ordering::Relaxed);
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
                        if outcome.block_done {
                            self.slips = outcome.slips;
                        }
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
                    if let Some(active) = self.of(mission) {
                        active.stop(EndReason::Cancelled);
                    }
                }
                LoopCommand::Hold(mission, hold) => {
                    if let Some(active) = self.of(mission) {
                        active.hold(hold, true);
                        if hold == Hold::Replacement {
                            self.replacement_until = Some(now.monotonic + REPLACEMENT_MAX);
                        }
                    }
                }
                LoopCommand::Release(mission, hold) => {
                    if let Some(active) = self.of(mission) {
                        active.hold(hold, false);
                    }
                }
                LoopCommand::Replace(job) => match self.of(job.mission) {
                    Some(active) => {
                        // The room of one revision that is replaced before it was driven.
                        if let Some(unused) = active.replace_at_rest(job) {
                            self.outgoing.send(LoopEvent::CameTooLate(unused));
                        }
                        self.replacement_until = None;
                    }
                    None => self.outgoing.send(LoopEvent::CameTooLate(job)),
                },
                LoopCommand::Site(site) => {
                    self.cutter.abandon(&mut self.estimator);
                    self.estimate = self.estimator.estimate();
                    if let Some(old) = self.site.replace(site) {
                        self.outgoing.send(LoopEvent::Retired(old));
                    }
                }
            }
        }
    }

    /// The mission in hand, if it is this one.
    fn of(&mut self, mission: tread_api::ids::MissionId) -> Option<&mut Active> {
        self.active
            .as_mut()
            .filter(|active| active.job.mission == mission)
    }

    fn begin(&mut self, now: Moment, mut job: Box<Job>, stop: bool) {
        let progress = progress_of(&job);
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
            self.outgoing.send(LoopEvent::Ended {
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
        self.active = Some(Active::new(job));
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
            self.outgoing.send(LoopEvent::Segment(segment));
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
        if active.is_at_rest_for_replacement() {
            let old = active.replace(knowledge);
            let (at, progress) = (now.wall, active.progress);
            if let Some(old) = old {
                self.outgoing
                    .send(LoopEvent::Replaced { at, progress, old });
            }
        }
        let active = self.active.as_mut()?;
        let step = active.step(&measured, knowledge, &self.model, self.command, dt_s);
        if step.theta_loop.is_finite() {
            self.theta_loop = Some(step.theta_loop);
        }
        let (at, progress) = (now.wall, active.progress);
        match step.news {
            Some(News::Paused) => self.outgoing.send(LoopEvent::Paused { at, progress }),
            Some(News::Resumed) => self.outgoing.send(LoopEvent::Resumed { at, progress }),
            None => {}
        }
        if let Some(reason) = step.end {
            self.end_mission(now, reason);
            return None;
        }
        // The gate would brake anyway; a follower that hears of it does not wind up meanwhile.
        fault.is_none().then_some(step.wanted)
    }

    fn end_mission(&mut self, now: Moment, reason: EndReason) {
        if let Some(active) = self.active.take() {
            if !active.has_started {
                self.outgoing.send(LoopEvent::Started {
                    at: now.wall,
                    progress: active.progress,
                });
            }
            let progress = active.progress;
            let (job, next) = active.into_jobs();
            if let Some(next) = next {
                self.outgoing.send(LoopEvent::CameTooLate(next));
            }
            self.outgoing.send(LoopEvent::Ended {
                at: now.wall,
                reason,
                progress,
                job,
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
        self.outgoing.send(LoopEvent::Started {
            at: now.wall,
            progress,
        });
    }

    fn snapshot(&self, now: Duration, fault: Option<Fault>, battery: Option<Battery>) -> Snapshot {
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
            governor: self
                .active
                .as_ref()
                .map(|active| *active.job.follower.governor()),
            is_held: self.active.as_ref().is_some_and(Active::is_held),
            battery,
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
        self.outgoing.flush()
    }
}

/// Age of something, seconds; infinite for what never was.
fn age_s(now: Duration, at: Option<Duration>) -> f64 {
    at.map_or(f64::INFINITY, |at| now.saturating_sub(at).as_secs_f64())
}
