//! Test bench of the control loop: runs the agent's own tick with a simulated base, step by step.
//!
//! The bench uses no thread, machine clock or network, so runs are reproducible to the bit and
//! faster than real time. It is compiled for tests, reports and benchmarks, with the feature
//! `testing`.

pub mod lease_model;

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::sync::mpsc::SendError;
use std::time::Duration;

use jiff::Timestamp;
use tread_api::friction::{RobotParameters, Segment, ThetaEstimate};
use tread_api::ids::{BootId, ConfigurationId, MissionId, PlanHash, RobotId, SiteId};
use tread_api::safety::Geofence;
use tread_api::site::Grid;
use tread_api::terrain::{TerrainRef, TerrainShape};
use tread_api::trajectory::Trajectory;
use tread_api::wire::command::PathPrior;
use tread_api::wire::hello::SiteDefinition;
use tread_api::wire::ingest::MissionPhase;
use tread_api::wire::reply::CommandRefusal;
use tread_api::wire::safety::AcquireLease;
use tread_control::estimation::EstimatorPrior;
use tread_control::geometry::Pose;
use tread_control::measured::WheelSpeeds;
use tread_control::plan::Plan;
use tread_control::robot::RobotModel;
use uuid::Uuid;

use crate::clock::{ManualClock, SharedClock};
use crate::config::recording::RecordingConfig;
use crate::control_loop::channels::{
    AgentEnds, ClosedSegment, EndReason, Hold, LoopCommand, LoopEvent, loop_channels,
};
use crate::control_loop::driven::Driven;
use crate::control_loop::frame::{Notes, notes};
use crate::control_loop::job::{Job, JobOrigin};
use crate::control_loop::segments::Moment;
use crate::control_loop::site_view::SiteView;
use crate::control_loop::tick::LoopCore;
pub use crate::control_loop::tick::listener::{Listener, ListenerOutput};
use crate::dispatcher::answers;
use crate::drive::{Drive, Feedback, SILENT_AFTER_MAX, SensorSample};
use crate::geometry::paper_robot;
use crate::recorder::segment_of;
use crate::recording::{FORMAT, RecordWriter, RunHead, VERSION};
use crate::safety::stop::StopState;
use crate::safety::{Safety, microseconds};
use crate::sim::drive::{Individual, SimMode, SimulatedDrive, SimulatedDriveError};
use crate::sim::scenario::Scenario;

/// Period of the bench's ticks.
pub const PERIOD: Duration = Duration::from_millis(10);

/// Monotonic time at which the bench starts.
const START_AT: Duration = Duration::from_secs(1);

/// Returns the boot identifier of the bench's agent.
pub fn boot() -> BootId {
    BootId::from_uuid(Uuid::from_u128(1))
}

/// Error of a request to the bench.
#[derive(Debug, thiserror::Error)]
pub enum BenchError {
    /// The robot has no position fix yet.
    #[error("the robot does not know yet where it is")]
    NoPose,
    /// The trajectory cannot be driven.
    #[error("the trajectory cannot be driven: {0}")]
    Impossible(String),
    /// The loop no longer accepts commands.
    #[error("the loop takes no commands any more")]
    Gone,
}

impl<T> From<SendError<T>> for BenchError {
    fn from(_: SendError<T>) -> Self {
        Self::Gone
    }
}

/// Drive of a simulated base that advances in explicit steps.
pub trait SteppedDrive: Drive {
    /// Simulates the base up to `now`.
    fn advance(&mut self, now: Duration);
}

impl SteppedDrive for SimulatedDrive {
    fn advance(&mut self, now: Duration) {
        Self::advance(self, now);
    }
}

/// A robot on the bench, by default with the agent's own simulated base.
#[derive(Debug)]
pub struct Bench<D = SimulatedDrive> {
    pub(crate) core: LoopCore,
    pub(crate) drive: D,
    model: RobotModel,
    pub(crate) ends: AgentEnds,
    pub(crate) safety: Arc<Safety>,
    clock: Arc<ManualClock>,
    pub(crate) now: Duration,
    pub(crate) segments: Vec<ClosedSegment>,
    pub(crate) starts: Vec<MissionId>,
    pub(crate) ended: Vec<(MissionId, EndReason)>,
    /// Reported pauses, resumptions and new revisions of missions.
    pub(crate) phase_changes: Vec<MissionPhase>,
    /// Time from the start of the last safety pause until the robot stopped.
    pub(crate) paused_for: Option<jiff::SignedDuration>,
    /// Maximum silence of the server for missions planned from now on.
    pub(crate) silence_max: Option<Duration>,
    /// Prior along the path for missions planned from now on.
    prior: Option<PathPrior>,
    /// Driven path of the last mission that ended.
    pub(crate) last_driven: Option<Driven>,
    /// Cross-track error at the end of the last mission, metres.
    pub(crate) cross_track_m: Option<f64>,
    /// Writer of the recording, if enabled, and the queue of its input.
    record: Option<(RecordWriter, Notes)>,
}

/// Returns the definition of a scenario's site, as a server would send it.
///
/// # Errors
/// A message on an invalid polygon, which a parsed scenario does not contain.
pub fn site_of(scenario: &Scenario) -> Result<SiteDefinition, String> {
    let mut terrains = Vec::with_capacity(scenario.terrains.len());
    for terrain in &scenario.terrains {
        terrains.push(TerrainShape {
            terrain: TerrainRef {
                id: terrain.id.clone(),
                revision: 1,
            },
            polygon: terrain.outline()?,
            layer: terrain.layer,
        });
    }
    let grid = Grid {
        revision: 1,
        cell_m: scenario.cell_m,
    };
    Ok(SiteDefinition {
        grid,
        terrain_revision: 1,
        terrains,
        geofence: Geofence::default(),
    })
}

fn mission_of(number: u128) -> MissionId {
    MissionId::from_uuid(Uuid::from_u128(number))
}

/// Drive whose sensors report NaN.
struct NonFiniteDrive;

impl Drive for NonFiniteDrive {
    fn read(&mut self, now: Duration) -> Feedback {
        let mut feedback = Feedback::default();
        feedback.push(SensorSample {
            at: now,
            yaw_rate_rad_s: Some(0.0),
            wheel_speeds: Some(WheelSpeeds {
                left_rad_s: f64::NAN,
                right_rad_s: 0.0,
            }),
            ..SensorSample::default()
        });
        feedback
    }

    fn write(&mut self, _: WheelSpeeds) {}
}

/// Drive without position fixes.
struct WithoutPosition<'base, D>(&'base mut D);

impl<D: Drive> Drive for WithoutPosition<'_, D> {
    fn read(&mut self, now: Duration) -> Feedback {
        let mut feedback = Feedback::default();
        for &sample in self.0.read(now).samples() {
            feedback.push(SensorSample {
                position: None,
                ..sample
            });
        }
        feedback
    }

    fn write(&mut self, command: WheelSpeeds) {
        self.0.write(command);
    }
}

/// Drive that receives commands but whose messages are lost.
struct LostFeedback<'base, D>(&'base mut D);

impl<D: Drive> Drive for LostFeedback<'_, D> {
    fn read(&mut self, now: Duration) -> Feedback {
        self.0.read(now);
        Feedback::default()
    }

    fn write(&mut self, command: WheelSpeeds) {
        self.0.write(command);
    }
}

/// Drive of a moving base whose sensors report constant values with current stamps.
#[cfg(test)]
struct Frozen<'base, D> {
    base: &'base mut D,
    said: SensorSample,
}

#[cfg(test)]
impl<D: Drive> Drive for Frozen<'_, D> {
    fn read(&mut self, now: Duration) -> Feedback {
        self.base.read(now);
        let mut feedback = Feedback::default();
        feedback.push(SensorSample {
            at: now,
            ..self.said
        });
        feedback
    }

    fn write(&mut self, command: WheelSpeeds) {
        self.base.write(command);
    }
}

/// Drive without any messages.
struct Silence;

impl Drive for Silence {
    fn read(&mut self, _: Duration) -> Feedback {
        Feedback::default()
    }

    fn write(&mut self, _: WheelSpeeds) {}
}

impl LoopCore {
    /// Runs one tick that takes no time; see [`Self::tick_by`].
    fn tick(&mut self, now: Moment, stop: bool, drive: &mut dyn Drive) {
        self.tick_by(now, &|| now.monotonic, stop, drive);
    }
}

impl Bench {
    /// Creates a bench with the paper's robot, stopped at `start` on a scenario's ground.
    ///
    /// # Errors
    /// [`SimulatedDriveError`] if `start` is not finite.
    pub fn new(scenario: &Scenario, start: Pose, seed: u64) -> Result<Self, SimulatedDriveError> {
        let model = RobotModel::yi2007();
        let individual = Individual::of_seed(seed);
        let drive = SimulatedDrive::new(scenario, model, start, individual, SimMode::Explicit)?;
        // A simulated robot equals its model.
        Ok(Self::with_drive(drive, model).with_prior(EstimatorPrior::exact()))
    }

    /// Starts a recording; call it before the first tick.
    pub fn record(&mut self, config: RecordingConfig, site: SiteId, robot: RobotId) {
        let head = RunHead {
            format: FORMAT,
            version: VERSION.to_owned(),
            boot: boot(),
            site,
            robot,
            part: 0,
            model: paper_robot(),
            blind_within_fence: false,
            silent_after: SILENT_AFTER_MAX,
            rate_hz: PERIOD.as_secs_f64().recip(),
            prior: EstimatorPrior::exact(),
        };
        let (taker, notes) = notes();
        self.core.record_to(Some(taker));
        let clock = Arc::clone(&self.clock) as SharedClock;
        let writer = RecordWriter::new(config, head, self.model, clock);
        self.record = Some((writer, notes));
    }
}

impl<D: SteppedDrive> Bench<D> {
    /// Creates a bench with a base and an agent that is configured with this model.
    pub fn with_drive(drive: D, model: RobotModel) -> Self {
        let (loop_ends, ends) = loop_channels();
        let clock = Arc::new(ManualClock::new(Timestamp::UNIX_EPOCH));
        clock.advance(START_AT);
        let safety = Safety::open(
            // The folder does not exist; nothing is written without a pending confirmation.
            Path::new("no-such-folder"),
            StopState::default(),
            boot(),
            model,
            &[],
            Arc::clone(&ends.shared.safety),
            Arc::clone(&clock) as SharedClock,
        );
        Self {
            core: LoopCore::new(model, loop_ends).with_period(PERIOD),
            drive,
            model,
            ends,
            safety,
            clock,
            now: START_AT,
            segments: Vec::new(),
            starts: Vec::new(),
            ended: Vec::new(),
            phase_changes: Vec::new(),
            paused_for: None,
            silence_max: None,
            prior: None,
            last_driven: None,
            cross_track_m: None,
            record: None,
        }
    }

    /// Sets the estimator's prior.
    #[must_use]
    pub fn with_prior(mut self, prior: EstimatorPrior) -> Self {
        self.core = self.core.with_prior(prior);
        self
    }

    /// Returns the drive.
    pub fn drive(&self) -> &D {
        &self.drive
    }

    /// Returns the reported θ of the present ground; `None` without an estimate.
    pub fn theta(&self) -> Option<ThetaEstimate> {
        self.ends.shared.snapshot().theta_measured
    }

    /// Parameters of the robot, as it reports them.
    pub fn robot_parameters(&self) -> Option<RobotParameters> {
        self.ends.shared.snapshot().robot_parameters
    }

    /// How many changes of the ground it has detected.
    pub fn ground_changes(&self) -> u64 {
        self.ends.shared.snapshot().ground_changes
    }

    /// Whether it reports a change of its payload.
    pub fn reports_payload_change(&self) -> bool {
        self.ends.shared.snapshot().payload_change.is_some()
    }

    /// The base, to change what it is.
    pub fn drive_mut(&mut self) -> &mut D {
        &mut self.drive
    }

    /// Writes the pending input of the recording, if there is one.
    fn write_record(&mut self) {
        if let Some((writer, notes)) = &mut self.record {
            writer.drain(notes);
        }
    }

    /// Ends the recording. Returns the number of notes that were dropped because the queue was
    /// full.
    pub fn end_record(&mut self) -> u64 {
        self.write_record();
        self.core.record_to(None);
        let Some((mut writer, notes)) = self.record.take() else {
            return 0;
        };
        writer.close();
        notes.lost.load(Ordering::Relaxed)
    }

    /// Sends the definition of the site to the loop.
    ///
    /// # Errors
    /// [`BenchError::Gone`] if the loop accepts no commands.
    pub fn send_site(&mut self, definition: SiteDefinition) -> Result<(), BenchError> {
        let view = Arc::new(SiteView::new(definition));
        Ok(self.ends.commands.send(LoopCommand::Site(view))?)
    }

    /// Sets the prior along the path, from the next mission on.
    pub fn set_prior(&mut self, prior: &PathPrior) {
        self.prior = Some(prior.clone());
    }

    fn planned(
        &self,
        number: u128,
        revision: u32,
        trajectory: &Trajectory,
        start: Pose,
        start_by: Option<Duration>,
    ) -> Result<Box<Job>, BenchError> {
        let model = self.model;
        let origin = JobOrigin {
            mission: mission_of(number),
            revision,
            plan_hash: PlanHash::from_uuid(Uuid::from_u128(number)),
            trajectory: trajectory.clone(),
            start,
            prior: self.prior.clone(),
            grid: None,
            start_by,
            silence_max: self.silence_max,
        };
        let plan = origin.plan(&model).map_err(BenchError::Impossible)?;
        origin.job(plan, model).map_err(BenchError::Impossible)
    }

    /// Plans a trajectory from the robot's pose and starts it as mission `number`.
    ///
    /// # Errors
    /// [`BenchError::NoPose`] without a position fix, [`BenchError::Impossible`] if the trajectory
    /// cannot be driven, [`BenchError::Gone`] if the loop accepts no commands.
    pub fn begin(
        &mut self,
        number: u128,
        trajectory: &Trajectory,
        start_by: Option<Duration>,
    ) -> Result<MissionId, BenchError> {
        let (pose, _) = self.ends.shared.snapshot().pose.ok_or(BenchError::NoPose)?;
        let job = self.planned(number, 1, trajectory, pose, start_by)?;
        let mission = job.mission;
        self.ends.commands.send(LoopCommand::Start(job))?;
        Ok(mission)
    }

    /// Holds the active mission, plans its next revision from the pose at which the robot stops,
    /// and sends it to the loop.
    ///
    /// # Errors
    /// As [`Bench::begin`].
    pub fn replace(
        &mut self,
        number: u128,
        revision: u32,
        driving: &Plan,
        trajectory: &Trajectory,
    ) -> Result<(), BenchError> {
        let mission = mission_of(number);
        let hold = LoopCommand::Hold(mission, Hold::Replacement);
        self.ends.commands.send(hold)?;
        self.tick();
        let governor = self.ends.shared.snapshot().governor;
        let rest = governor.ok_or(BenchError::Gone)?.rest(driving);
        let job = self.planned(number, revision, trajectory, rest, None)?;
        Ok(self.ends.commands.send(LoopCommand::Replace(job))?)
    }

    /// Pauses the active mission if `is_wanted`, else resumes it.
    ///
    /// # Errors
    /// [`BenchError::Gone`] if the loop accepts no commands.
    pub fn pause(&mut self, mission: MissionId, is_wanted: bool) -> Result<(), BenchError> {
        let command = if is_wanted {
            LoopCommand::Hold(mission, Hold::Pause)
        } else {
            LoopCommand::Release(mission, Hold::Pause)
        };
        Ok(self.ends.commands.send(command)?)
    }

    /// Simulates the base for one period.
    pub fn simulate(&mut self) {
        self.pass_time(PERIOD);
        self.drive.advance(self.now);
    }

    /// Advances the bench's clock without a tick.
    pub fn pass_time(&mut self, time: Duration) {
        self.now += time;
        self.clock.advance(time);
    }

    /// Returns the monotonic time of the bench.
    pub fn now(&self) -> Duration {
        self.now
    }

    /// Returns the robot's monotonic clock, to which end times refer, in microseconds.
    pub fn now_us(&self) -> u64 {
        microseconds(self.now)
    }

    /// Acquires or takes over the teleoperation lease, and returns its epoch.
    ///
    /// # Errors
    /// [`CommandRefusal`] if the robot refuses the lease.
    pub fn lease(&self, command: &AcquireLease) -> Result<u64, CommandRefusal> {
        answers::acquire_lease(&self.safety, command)
    }

    /// Passes a drive command, as received from the network, to the robot. Returns whether it was
    /// accepted.
    pub fn teleoperate(&self, payload: &[u8]) -> bool {
        let accepted = || {
            let status = self.safety.drive_status();
            status.map_or(0, |status| status.counts.accepted)
        };
        let before = accepted();
        self.safety.handle_drive(payload);
        accepted() > before
    }

    /// Returns whether the target of the wheel speeds is zero.
    pub fn target_rests(&self) -> bool {
        self.ends.shared.snapshot().gate.target_rests
    }

    /// Returns whether the robot is stopped.
    pub fn is_standing(&self) -> bool {
        self.core.is_standing()
    }

    fn moment(&self) -> Moment {
        Moment {
            monotonic: self.now,
            wall: Timestamp::UNIX_EPOCH + self.now,
        }
    }

    /// Runs one tick of the loop alone, without simulating the base. With `stop`, the robot brakes
    /// and its mission ends.
    pub fn tick_loop(&mut self, stop: bool) {
        let now = self.moment();
        self.core.tick(now, stop, &mut self.drive);
    }

    /// Runs one period in which the base sends nothing and does not move.
    pub fn tick_without_base(&mut self) {
        self.pass_time(PERIOD);
        let now = self.moment();
        self.core.tick(now, false, &mut Silence);
        self.collect();
    }

    /// Runs one period in which the sensors report NaN.
    pub fn tick_with_nonsense(&mut self) {
        self.pass_time(PERIOD);
        let now = self.moment();
        self.core.tick(now, false, &mut NonFiniteDrive);
        self.collect();
    }

    /// Runs one period without position fixes.
    pub fn tick_without_position(&mut self) {
        self.simulate();
        let now = self.moment();
        self.core
            .tick(now, false, &mut WithoutPosition(&mut self.drive));
        self.collect();
    }

    /// Runs one period in which the base follows its command but its messages are lost.
    pub fn tick_unheard(&mut self) {
        self.simulate();
        let now = self.moment();
        self.core
            .tick(now, false, &mut LostFeedback(&mut self.drive));
        self.collect();
    }

    /// Runs one period whose thread is suspended for `time` between reading the clock and
    /// evaluating commands.
    #[cfg(test)]
    pub(crate) fn tick_interrupted(&mut self, time: Duration) {
        self.simulate();
        let now = self.moment();
        self.pass_time(time);
        let judged = self.now;
        self.core.tick_by(now, &|| judged, false, &mut self.drive);
        self.collect();
    }

    /// Runs one period in which the base follows its command but its sensors report the constant
    /// `said`.
    #[cfg(test)]
    pub(crate) fn tick_frozen(&mut self, said: SensorSample) {
        self.simulate();
        let now = self.moment();
        let base = &mut self.drive;
        self.core.tick(now, false, &mut Frozen { base, said });
        self.collect();
    }

    /// Processes the events that the loop has reported.
    pub fn collect(&mut self) {
        self.write_record();
        for event in self.ends.events.try_iter() {
            match event {
                LoopEvent::Started { progress, .. } => self.starts.push(progress.id),
                LoopEvent::Ended {
                    reason,
                    job,
                    progress,
                    ..
                } => {
                    self.ended.push((job.mission, reason));
                    self.last_driven = Some(job.driven);
                    self.cross_track_m = Some(progress.cross_track_m);
                }
                LoopEvent::Segment(segment) => self.segments.push(segment),
                LoopEvent::Paused { at, since, .. } => {
                    self.phase_changes.push(MissionPhase::Paused);
                    self.paused_for = since.map(|since| at.duration_since(since));
                }
                LoopEvent::Resumed { .. } => self.phase_changes.push(MissionPhase::Resumed),
                LoopEvent::Replaced { .. } => self.phase_changes.push(MissionPhase::Replaced),
                LoopEvent::CameTooLate(_) | LoopEvent::Retired(_) => {}
            }
        }
    }

    /// Runs one complete period: base, loop, events.
    pub fn tick(&mut self) {
        self.simulate();
        self.tick_loop(false);
        self.collect();
    }

    /// Runs complete periods until `time` has passed.
    pub fn run_for(&mut self, time: Duration) {
        let until = self.now + time;
        while self.now < until {
            self.tick();
        }
    }

    /// Returns the final phase of a mission; `None` if it has not ended.
    pub fn end_of(&self, mission: MissionId) -> Option<MissionPhase> {
        let ended = self.ended.iter().find(|(ended, _)| *ended == mission);
        ended.map(|(_, reason)| reason.phase())
    }

    /// Returns the number of segments closed so far.
    pub fn segment_count(&self) -> usize {
        self.segments.len()
    }

    /// The segments that were closed so far, as they are uploaded for a robot of this configuration.
    pub fn segments(&self, configuration: ConfigurationId) -> Vec<Segment> {
        let segments = self.segments.iter();
        segments
            .map(|closed| segment_of(closed, configuration))
            .collect()
    }
}
