//! Last stage: checks standstill, publishes the snapshot, and records the tick.
//!
//! Standstill is detected by [`crate::control_loop::standstill`]. A record holds the inputs and
//! outputs of a tick, so that the tick can be run again and the results compared.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use tread_api::friction::{NoEstimate, ParameterEstimate, RobotParameters, ThetaEstimate};
use tread_api::robot::RobotMode;
use tread_control::consistency::Subject;
use tread_control::estimation::{IdentifiedRobot, IdentifiedValue, manoeuvre};
use tread_control::geometry::{Pose, Twist};
use tread_control::measured::WheelSpeeds;
use tread_control::robot::RobotModel;

use super::demands::Demands;
use super::estimation::EstimationOutput;
use super::mission::MissionStatus;
use super::safety::SafetyOutput;
use super::sensing::SensingOutput;
use super::{STANDING, Tick};
use crate::control_loop::channels::{LoopCommand, Shared, Snapshot};
use crate::control_loop::frame::{RecordSender, TickFrame, TickInputs, TickOutputs};
use crate::control_loop::site_view::SiteView;
use crate::control_loop::standstill::{Motion, StandstillWatch};
use crate::drive::{Battery, Feedback, StatedNoise};

/// Input of the stage.
#[derive(Debug)]
pub(super) struct OutputInput<'tick> {
    pub(super) tick: Tick,
    pub(super) feedback: &'tick Feedback,
    pub(super) noise: StatedNoise,
    pub(super) battery: Option<Battery>,
    pub(super) sensed: &'tick SensingOutput,
    pub(super) estimated: &'tick EstimationOutput<'tick>,
    pub(super) demands: &'tick Demands,
    pub(super) gated: &'tick SafetyOutput,
    pub(super) mission: &'tick MissionStatus,
}

/// The stage's state.
#[derive(Debug)]
pub(super) struct Output {
    model: RobotModel,
    shared: Arc<Shared>,
    standstill: StandstillWatch,
    /// Latest measurements for the standstill watch.
    motion: Motion,
    /// Whether the wheels are commanded to zero and are measured near zero.
    stands: bool,
    ticks: u64,
    /// Recorder of ticks, if they are recorded.
    notes: Option<RecordSender>,
}

impl Output {
    pub(super) fn new(model: RobotModel, shared: Arc<Shared>) -> Self {
        Self {
            model,
            shared,
            standstill: StandstillWatch::default(),
            motion: Motion::default(),
            stands: true,
            ticks: 0,
            notes: None,
        }
    }

    /// Starts recording ticks; `None` stops it.
    pub(super) fn record_to(&mut self, notes: Option<RecordSender>) {
        self.notes = notes;
    }

    /// Whether the last tick commanded the wheels to zero and measured them near zero.
    pub(super) fn is_standing(&self) -> bool {
        self.stands
    }

    /// Records a command that the tick takes.
    pub(super) fn record_command(&mut self, command: &LoopCommand) {
        if let Some(notes) = &mut self.notes {
            notes.command(self.ticks + 1, command);
        }
    }

    /// Updates the standstill watch, the counters and the snapshot, and records the tick.
    pub(super) fn step(&mut self, input: &OutputInput<'_>) {
        self.check_standstill(input);
        let command = input.gated.output.wheel_speeds;
        let wheels_m_s = self.fastest_rim_m_s(input.sensed.wheel_speeds);
        self.stands = command == WheelSpeeds::default() && wheels_m_s < 5.0 * STANDING;
        self.ticks += 1;
        self.count(input);
        let snapshot = self.snapshot(input);
        self.shared.publish(&snapshot);
        self.record(input, &snapshot);
    }

    fn fastest_rim_m_s(&self, wheel_speeds: WheelSpeeds) -> f64 {
        wheel_speeds.magnitude_max_rad_s() * self.model.wheel_radius_m()
    }

    fn count(&self, input: &OutputInput<'_>) {
        let lost = u64::from(input.sensed.lost_samples);
        let shared = &self.shared;
        shared.lost_samples.fetch_add(lost, Ordering::Relaxed);
        shared
            .unmapped_blocks
            .fetch_add(input.estimated.unmapped_blocks, Ordering::Relaxed);
        shared.ticks.store(self.ticks, Ordering::Relaxed);
    }

    /// Updates the standstill watch.
    fn check_standstill(&mut self, input: &OutputInput<'_>) {
        let (sensed, now) = (input.sensed, input.tick.now.monotonic);
        let is_heard = sensed.is_heard(now);
        if let Some(turn_rad_s) = sensed.turn_rad_s {
            self.motion.turn_rad_s = Some(turn_rad_s).filter(|rate| rate.is_finite());
        }
        if !(is_heard && sensed.is_right(Subject::Gyro)) {
            self.motion.turn_rad_s = None;
        }
        self.motion.wheels_m_s = (is_heard && sensed.is_right(Subject::Wheels))
            .then(|| self.fastest_rim_m_s(sensed.wheel_speeds));
        self.motion.odometry_m_s = sensed.odometry_m_s(now);
        self.motion.fix = sensed.fix.filter(|_| !sensed.is_position_doubted());
        // Without any measurement it is unknown whether the robot has stopped.
        let is_rest_commanded = input.gated.output.target == WheelSpeeds::default();
        if is_heard || self.motion.odometry_m_s.is_some() || self.motion.fix.is_some() {
            self.standstill.step(now, is_rest_commanded, &self.motion);
        } else if is_rest_commanded {
            self.standstill.reset();
        } else {
            self.standstill.step(now, false, &self.motion);
        }
    }

    fn snapshot(&self, input: &OutputInput<'_>) -> Snapshot {
        let (sensed, estimated, mission) = (input.sensed, input.estimated, input.mission);
        let pose = estimated.pose.filter(|pose: &Pose| pose.is_finite());
        let twist = Some(estimated.twist).filter(|twist: &Twist| twist.is_finite());
        let measured = estimated.estimate.theta.map(|theta| ThetaEstimate {
            theta: theta.theta,
            std_dev: theta.std_dev,
        });
        Snapshot {
            at: input.tick.now.monotonic,
            mode: mode(input),
            fault: estimated.fault,
            pose: pose.zip(estimated.last_fix),
            twist: twist.zip(sensed.last_sample),
            mission: mission.progress,
            governor: mission.governor,
            is_on_hold: mission.is_on_hold,
            off_path_m: mission.off_path_m,
            stands: self.stands,
            gate: input.gated.gate,
            fence_revision: estimated.site.map(SiteView::fence_revision),
            battery: input.battery,
            theta_loop: mission.theta_loop.filter(|theta| theta.is_finite()),
            theta_measured: measured
                .filter(|theta| theta.theta.is_finite() && theta.std_dev.is_finite()),
            no_estimate: estimated.estimate.no_estimate.map(no_estimate),
            robot_parameters: estimated.estimate.robot.map(robot_parameters),
            payload_change: estimated.estimate.payload_change,
            frozen_torque: estimated.estimate.frozen_torque,
            excited: !estimated.estimate.no_new_information,
            ground_changes: estimated.ground_changes,
            surface_change: mission.surface_change,
            dug_in_at: estimated.dug_in_at,
            overrun: input.demands.overrun,
            findings: sensed.findings,
            standstill: self.standstill.report(),
            slip: estimated.slip,
            cell: estimated.cell,
            terrain: estimated.terrain,
            terrain_revision: estimated.site.map(SiteView::terrain_revision),
            ticks: self.ticks,
        }
    }

    /// Records the tick that ends, if ticks are recorded.
    fn record(&mut self, input: &OutputInput<'_>, snapshot: &Snapshot) {
        let Some(notes) = &mut self.notes else {
            return;
        };
        let (estimated, gated, demands) = (input.estimated, input.gated, input.demands);
        let mission = snapshot.mission;
        notes.tick(&TickFrame {
            number: self.ticks,
            inputs: TickInputs {
                now: input.tick.now,
                judged: gated.judged,
                stop_requested: input.tick.stop,
                commands: notes.commands(),
                feedback: *input.feedback,
                is_base_silent: input.sensed.is_base_silent,
                noise: input.noise,
                battery: snapshot.battery,
                stop: demands.stop,
                server_silence: demands.server_silence,
                view: demands.view,
            },
            outputs: TickOutputs {
                requested: gated.requested,
                command: gated.output.wheel_speeds,
                pose: estimated.pose,
                twist: estimated.twist,
                theta_loop: input.mission.theta_loop,
                theta: estimated
                    .estimate
                    .theta
                    .map(|theta| (theta.theta, theta.std_dev)),
                mission: mission.map(|mission| (mission.driven_m, mission.cross_track_m)),
                slip: snapshot.slip,
                segment: estimated.closed,
                mode: snapshot.mode,
                fault: snapshot.fault,
                gate: snapshot.gate.cause,
            },
        });
    }
}

fn mode(input: &OutputInput<'_>) -> RobotMode {
    if input.demands.is_stopped() {
        RobotMode::Stopped
    } else if input.estimated.fault.is_some() {
        RobotMode::Fault
    } else if input.gated.is_leased {
        RobotMode::Teleoperated
    } else if input.mission.progress.is_some() {
        RobotMode::Tracking
    } else {
        RobotMode::Idle
    }
}

fn no_estimate(reason: manoeuvre::NoEstimate) -> NoEstimate {
    match reason {
        manoeuvre::NoEstimate::Misfit => NoEstimate::Misfit,
        manoeuvre::NoEstimate::LateSensor => NoEstimate::LateSensor,
        manoeuvre::NoEstimate::Short => NoEstimate::Short,
        manoeuvre::NoEstimate::Slip => NoEstimate::Slip,
        manoeuvre::NoEstimate::NoTurns => NoEstimate::NoTurns,
        manoeuvre::NoEstimate::OneSided => NoEstimate::OneSided,
        manoeuvre::NoEstimate::NoAcceleration => NoEstimate::NoAcceleration,
        manoeuvre::NoEstimate::Uncertain => NoEstimate::Uncertain,
    }
}

fn robot_parameters(robot: IdentifiedRobot) -> RobotParameters {
    let estimate = |found: IdentifiedValue| ParameterEstimate {
        value: found.value,
        std_dev: found.std_dev,
        prior_dominated: found.is_prior_dominated,
    };
    RobotParameters {
        apparent_mass_ratio: estimate(robot.apparent_mass_ratio),
        mass_kg: estimate(robot.mass_kg),
        yaw_inertia_ratio: estimate(robot.inertia_ratio),
        center_of_mass_forward_m: estimate(robot.centre_forward_m),
        center_of_mass_left_m: estimate(robot.centre_left_m),
    }
}
