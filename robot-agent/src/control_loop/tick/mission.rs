//! Third stage: begins, holds, replaces, follows and ends the mission.

mod holds;

use std::sync::Arc;
use std::time::Duration;

use tread_api::friction::TYRE_DIFFERENCE_SHARE;
use tread_api::ids::MissionId;
use tread_api::robot::MissionProgress;
use tread_control::gate::GateCause;
use tread_control::geometry::Pose;
use tread_control::measured::{Measured, WheelSpeeds};
use tread_control::reference::Governor;
use tread_control::robot::RobotModel;
use tread_control::tracking::{ThetaKnowledge, TrackingErrors};

use super::Tick;
use super::demands::Demands;
use super::estimation::{EstimationOutput, Released};
use super::sensing::SensingOutput;
use crate::control_loop::BRAKING_MAX;
use crate::control_loop::active::{Active, PauseChange, progress_of};
use crate::control_loop::channels::{ClosedSegment, EndReason, Hold, LoopCommand, LoopEvent};
use crate::control_loop::driven::TickRecord;
use crate::control_loop::gain::GroundRecord;
use crate::control_loop::job::Job;
use crate::control_loop::outgoing::Outgoing;
use crate::control_loop::segments::Moment;
use crate::control_loop::site_view::SiteView;
use crate::control_loop::surface::{Comparison, SurfaceWatch};

/// Longest hold for a revision that does not arrive; the mission then goes on.
const REPLACEMENT_MAX: Duration = Duration::from_secs(10);
/// Effects of a tick's commands on the other stages.
#[derive(Debug, Default)]
pub(super) struct CommandEffects {
    /// A new definition of the site.
    pub(super) site: Option<Arc<SiteView>>,
    /// Whether a mission begins in this tick.
    pub(super) has_begun: bool,
}

/// Input of the stage.
#[derive(Debug)]
pub(super) struct MissionInput<'tick> {
    pub(super) tick: Tick,
    pub(super) sensed: &'tick SensingOutput,
    pub(super) estimated: &'tick EstimationOutput<'tick>,
    pub(super) demands: &'tick Demands,
    /// Whether the mission began in this tick.
    pub(super) has_begun: bool,
    /// Wheel speeds that the last tick commanded.
    pub(super) commanded: WheelSpeeds,
}

/// Output of the stage.
#[derive(Debug, Clone, Copy)]
pub(super) struct MissionOutput {
    /// Wheel speeds of the mission; `None` without a mission or while the base is silent.
    pub(super) wheel_speeds: Option<WheelSpeeds>,
    /// Whether there is a mission.
    pub(super) is_active: bool,
    /// Whether the mission does not command the wheels.
    pub(super) rests: bool,
    /// Whether the server has been silent for so long that the mission's braking should be over.
    pub(super) is_long_silent: bool,
}

/// Input of the stage once the command is known.
#[derive(Debug)]
pub(super) struct RecordInput<'tick> {
    pub(super) tick: Tick,
    pub(super) sensed: &'tick SensingOutput,
    pub(super) estimated: &'tick EstimationOutput<'tick>,
    /// Cause for which the gate reduced the command.
    pub(super) gate: Option<GateCause>,
}

/// State of the mission at the end of a tick.
#[derive(Debug, Clone, Copy)]
pub(super) struct MissionStatus {
    pub(super) progress: Option<MissionProgress>,
    /// Position of the reference on the plan.
    pub(super) governor: Option<Governor>,
    pub(super) is_on_hold: bool,
    /// Distance from the robot to the reference of a held mission, metres.
    pub(super) off_path_m: Option<f64>,
    /// Adapted θ̂ of the tracking law; that of the last mission between missions.
    pub(super) theta_loop: Option<f64>,
    /// The comparison that raised the alert that the ground differs from the map.
    pub(super) surface_change: Option<Comparison>,
}

/// The stage's state.
#[derive(Debug)]
pub(super) struct MissionStage {
    model: RobotModel,
    active: Option<Active>,
    theta_loop: Option<f64>,
    /// Knowledge of the ground in this tick of a mission.
    known: GroundRecord,
    surface: SurfaceWatch,
    /// Time of the last silence of the base, while the mission is held for it.
    base_silent_at: Option<Duration>,
    /// Begin of the hold for sensors.
    sensors_hold_since: Option<Duration>,
    /// End of the hold for the next revision.
    replacement_until: Option<Duration>,
}

impl MissionStage {
    pub(super) fn new(model: RobotModel) -> Self {
        Self {
            model,
            active: None,
            theta_loop: None,
            known: GroundRecord::default(),
            surface: SurfaceWatch::default(),
            base_silent_at: None,
            sensors_hold_since: None,
            replacement_until: None,
        }
    }

    /// Processes one command of the rest of the agent.
    pub(super) fn take(
        &mut self,
        command: LoopCommand,
        tick: Tick,
        effects: &mut CommandEffects,
        events: &mut Outgoing,
    ) {
        match command {
            LoopCommand::Start(job) => effects.has_begun |= self.begin(tick, job, events),
            LoopCommand::Cancel(mission) => {
                if let Some(active) = self.of(mission) {
                    active.stop(EndReason::Cancelled);
                }
            }
            LoopCommand::Hold(mission, hold) => {
                if let Some(active) = self.of(mission) {
                    if hold == Hold::Replacement {
                        active.announce_replacement();
                        self.replacement_until = Some(tick.now.monotonic + REPLACEMENT_MAX);
                    } else {
                        active.hold(hold, true);
                    }
                }
            }
            LoopCommand::Release(mission, hold) => {
                if let Some(active) = self.of(mission) {
                    if hold == Hold::Replacement {
                        active.withdraw_replacement();
                        self.replacement_until = None;
                    } else {
                        active.hold(hold, false);
                    }
                }
            }
            LoopCommand::Replace(job) => match self.of(job.mission) {
                Some(active) => {
                    // A waiting revision that was replaced before it was driven.
                    if let Some(unused) = active.replace_at_rest(job) {
                        events.send(LoopEvent::CameTooLate(unused));
                    }
                    self.replacement_until = None;
                }
                None => events.send(LoopEvent::CameTooLate(job)),
            },
            LoopCommand::Site(site) => {
                if let Some(unused) = effects.site.replace(site) {
                    events.send(LoopEvent::Retired(unused));
                }
            }
        }
    }

    /// Returns the active mission.
    pub(super) fn active(&self) -> Option<MissionId> {
        self.active.as_ref().map(|active| active.job.mission)
    }

    /// Returns the active mission if it has this identifier.
    fn of(&mut self, mission: MissionId) -> Option<&mut Active> {
        self.active
            .as_mut()
            .filter(|active| active.job.mission == mission)
    }

    /// Makes a mission the active one; returns false if it is refused, which ends it.
    fn begin(&mut self, tick: Tick, job: Box<Job>, events: &mut Outgoing) -> bool {
        let is_too_late = |latest: Duration| tick.now.monotonic > latest;
        let refusal = if tick.stop {
            Some(EndReason::AgentStopped)
        } else if self.active.is_some() {
            Some(EndReason::AnotherActive)
        } else if job.start_by.is_some_and(is_too_late) {
            Some(EndReason::TooLate)
        } else {
            None
        };
        if let Some(reason) = refusal {
            events.send(LoopEvent::Ended {
                at: tick.now.wall,
                reason,
                progress: progress_of(&job),
                job,
            });
            return false;
        }
        self.surface.begin_mission();
        self.active = Some(Active::new(job));
        true
    }

    /// Applies the holds and follows the mission.
    pub(super) fn step(
        &mut self,
        input: &MissionInput<'_>,
        released: Released,
        events: &mut Outgoing,
    ) -> MissionOutput {
        let (tick, estimated) = (input.tick, input.estimated);
        let now = tick.now.monotonic;
        let server_silence = input.demands.server_silence;
        if input.has_begun {
            self.warm_start(estimated);
        }
        self.send_released(released, events);
        self.hold_for_demands(input);
        self.check_bounds(input);
        self.hold_for_base(now, estimated.fault);
        self.hold_for_sensors(tick.now, input.sensed, events);
        let wheel_speeds = self.follow(input, events);
        let active = self.active.as_ref();
        let beyond_braking = server_silence.saturating_sub(BRAKING_MAX);
        MissionOutput {
            wheel_speeds,
            is_active: active.is_some(),
            rests: active.is_none_or(Active::rests),
            is_long_silent: active
                .is_some_and(|active| active.is_server_silent_too_long(beyond_braking)),
        }
    }

    /// Initialises the tracking law with the knowledge of the ground where the mission begins.
    fn warm_start(&mut self, estimated: &EstimationOutput<'_>) {
        if let Some(active) = &mut self.active
            && let Some(knowledge) = estimated.ground_at_begin.with(&active.job.prior).given
        {
            active.job.follower.warm_start(knowledge);
        }
    }

    fn send_released(&mut self, released: Released, events: &mut Outgoing) {
        if let Some(site) = released.site {
            events.send(LoopEvent::Retired(site));
        }
        if let Some(segment) = released.segment {
            self.compare(&segment);
            events.send(LoopEvent::Segment(segment));
        }
    }

    /// Compares the θ of a closed segment with the map's for its cell.
    fn compare(&mut self, segment: &ClosedSegment) {
        let active = self.active.as_mut();
        let Some(active) = active.filter(|active| segment.mission == Some(active.job.mission))
        else {
            return;
        };
        let (prior, statistics) = (&active.job.prior, &segment.statistics);
        let expected = prior.at(segment.site.grid().revision, segment.cell);
        let Some((expected, theta)) = expected.zip(statistics.theta()) else {
            return;
        };
        let comparison = Comparison {
            cell: segment.cell,
            measured: ThetaKnowledge {
                theta,
                std_dev: statistics.own_information.sqrt().recip(),
            },
            expected,
            robot_bias_ratio: prior
                .robot_bias_ratio()
                .max(statistics.common_ratio.robot)
                .hypot(TYRE_DIFFERENCE_SHARE * statistics.common_ratio.tyres),
        };
        active.compare(&comparison);
        self.surface.record(comparison);
    }

    /// Runs the active mission; returns its wheel speeds, `None` without a mission or while the
    /// base is silent.
    fn follow(&mut self, input: &MissionInput<'_>, events: &mut Outgoing) -> Option<WheelSpeeds> {
        let (now, estimated) = (input.tick.now, input.estimated);
        let active = self.active.as_mut()?;
        self.known = estimated.ground.with(active.prior());
        let knowledge = self.known.given;
        if active.is_at_rest_for_replacement() {
            let old = active.replace(knowledge);
            let (at, progress) = (now.wall, active.progress);
            if let Some(old) = old {
                events.send(LoopEvent::Replaced { at, progress, old });
            }
        }
        let measured = &estimated.measured;
        let step = active.step(
            measured,
            knowledge,
            &self.model,
            input.commanded,
            input.tick.dt_s,
        );
        if let Some(theta) = step.theta_loop.filter(|theta| theta.is_finite()) {
            self.theta_loop = Some(theta);
        }
        let (at, progress) = (now.wall, active.progress);
        match step.pause_change {
            Some(PauseChange::Paused) => {
                let paused_for = active.paused_for(now.monotonic);
                let since = paused_for.and_then(|lasting| at.checked_sub(lasting).ok());
                events.send(LoopEvent::Paused {
                    at,
                    since,
                    progress,
                });
            }
            Some(PauseChange::Resumed) => events.send(LoopEvent::Resumed { at, progress }),
            None => {}
        }
        if let Some(reason) = step.end {
            self.end(now, reason, events);
            return None;
        }
        // The gate would brake anyway; without a command the follower does not wind up. A base that
        // is heard again after a silence stops first.
        let is_heard = estimated.fault.is_none() && self.base_silent_at.is_none();
        is_heard.then_some(step.wheel_speeds)
    }

    fn end(&mut self, now: Moment, reason: EndReason, events: &mut Outgoing) {
        let Some(active) = self.active.take() else {
            return;
        };
        let (at, progress) = (now.wall, active.progress);
        if !active.has_started {
            events.send(LoopEvent::Started { at, progress });
        }
        let (job, next) = active.into_jobs();
        if let Some(next) = next {
            events.send(LoopEvent::CameTooLate(next));
        }
        events.send(LoopEvent::Ended {
            at,
            reason,
            progress,
            job,
        });
    }

    /// Records the tick on the driven path, reports the begin of the mission, and ends the mission
    /// if the agent stops.
    pub(super) fn record(
        &mut self,
        input: &RecordInput<'_>,
        events: &mut Outgoing,
    ) -> MissionStatus {
        let now = input.tick.now;
        self.record_path(input);
        if input.tick.stop {
            self.end(now, EndReason::AgentStopped, events);
        }
        // By now the mission's first tick has commanded the wheels.
        if let Some(active) = self.active.as_mut().filter(|active| !active.has_started) {
            active.has_started = true;
            let (at, progress) = (now.wall, active.progress);
            events.send(LoopEvent::Started { at, progress });
        }
        self.status(&input.estimated.measured)
    }

    fn record_path(&mut self, input: &RecordInput<'_>) {
        let Some(active) = &mut self.active else {
            return;
        };
        let (estimated, gate) = (input.estimated, input.gate);
        let speed_m_s = estimated.twist.linear_m_s.abs();
        let measured = estimated.estimate.theta;
        // While the command is reduced, tracking errors carry no information on the ground.
        let may_learn = input.sensed.findings.consequence().is_none();
        active.hold_adaptation(
            !may_learn || gate.is_some_and(|cause| cause > GateCause::Acceleration),
        );
        active.record(TickRecord {
            dt_s: input.tick.dt_s,
            at: estimated.pose.map(Pose::point),
            driven_m: speed_m_s * input.tick.dt_s,
            cross_track_m: None,
            is_saturated: false,
            is_paused: false,
            slips: estimated.slips || estimated.ground_changed,
            gate,
            theta_loop: self.theta_loop,
            theta_measured: measured.map(|theta| (theta.theta, theta.std_dev)),
            ground: self.known,
        });
    }

    fn status(&self, measured: &Measured) -> MissionStatus {
        let active = self.active.as_ref();
        let held = active.filter(|active| active.is_on_hold());
        MissionStatus {
            progress: active.map(|active| active.progress),
            governor: active.map(|active| *active.job.follower.governor()),
            is_on_hold: held.is_some(),
            off_path_m: held.map(|active| off_path_m(active, measured)),
            theta_loop: self.theta_loop,
            surface_change: self.surface.raised(),
        }
    }
}

/// Returns the distance from the robot to the mission's reference, metres.
fn off_path_m(active: &Active, measured: &Measured) -> f64 {
    let follower = &active.job.follower;
    let reference = follower.governor().sample(follower.plan());
    TrackingErrors::between(&reference, measured).distance_m()
}
