//! The robot's base behind the drive interface, and the threads around it.

use std::sync::Arc;
use std::sync::mpsc::sync_channel;
use std::thread::JoinHandle;
use std::time::Duration;

use tread_control::robot::RobotModel;

use crate::clock::SharedClock;
use crate::config::{AgentConfig, DriveConfig, SimulatedConfig};
use crate::control_loop;
use crate::control_loop::channels::Shared;
use crate::control_loop::tick::LoopCore;
use crate::control_loop::watchdog;
use crate::drive::Drive;
use crate::drive::ros2::Ros2Drive;
use crate::drive::ros2::bus::Bus;
use crate::drive::ros2::refusal::Counts;
use crate::realtime::raise_priority;
use crate::ros2_status::AgentStatePublisher;
use crate::sim::drive::{SimMode, SimulatedDrive, SimulatedDriveError};
use crate::start_error::StartError;
use crate::supervisor::Supervisor;

/// A base before its loop is started.
pub(crate) struct Base {
    drive: Box<dyn Drive>,
    /// Bus of a ROS 2 base.
    bus: Option<Bus>,
    /// Counts of the base's dropped messages.
    counts: Option<Arc<Counts>>,
}

impl Base {
    /// Creates the base of a configuration.
    ///
    /// # Errors
    /// [`StartError`] if the simulated base cannot be made, or the bus's endpoint is invalid.
    pub(crate) fn new(
        config: &DriveConfig,
        model: RobotModel,
        clock: &SharedClock,
    ) -> Result<Self, StartError> {
        match config {
            DriveConfig::Simulated(simulated) => Ok(Self {
                drive: Box::new(simulated_drive(simulated, model)?),
                bus: None,
                counts: None,
            }),
            DriveConfig::Ros2(settings) => {
                let (drive, bus) = Ros2Drive::new((**settings).clone(), clock)?;
                Ok(Self {
                    counts: Some(drive.counts()),
                    drive: Box::new(drive),
                    bus: Some(bus),
                })
            }
        }
    }

    /// Returns the counts of the base's dropped messages, where they are counted.
    pub(crate) fn counts(&self) -> Option<Arc<Counts>> {
        self.counts.clone()
    }

    /// Returns the age of the last sample beyond which the base counts as silent.
    pub(crate) fn silent_after(&self) -> Duration {
        self.drive.silent_after()
    }

    /// Starts the threads of the loop, its watchdog and the robot's bus.
    ///
    /// # Errors
    /// A thread cannot be started, or the loop may not have the configured priority.
    pub(crate) fn spawn(
        self,
        core: LoopCore,
        config: &AgentConfig,
        supervisor: &Supervisor,
        shared: &Arc<Shared>,
        clock: &SharedClock,
    ) -> Result<Vec<JoinHandle<()>>, StartError> {
        let no_thread = |part| move |source| StartError::Thread { part, source };
        let mut threads = Vec::new();
        if let Some(mut bus) = self.bus {
            if let Some(settings) = bus.outward_settings().cloned() {
                let (shared, counts) = (Arc::clone(shared), self.counts.unwrap_or_default());
                let robot = config.robot.to_string();
                bus.publish(Box::new(AgentStatePublisher::new(
                    settings, shared, counts, robot,
                )));
            }
            // It ends when the loop drops its drive.
            let running = supervisor.spawn_thread("robot's bus", move || bus.run());
            threads.push(running.map_err(no_thread("robot's bus"))?);
        }
        let (drive, period, loop_clock) = (self.drive, config.period(), Arc::clone(clock));
        let priority = config.realtime.priority;
        let (raised, has_priority) = sync_channel(1);
        let looping = supervisor.spawn_thread("control loop", move || {
            let result = priority.map_or(Ok(()), raise_priority);
            let may_run = result.is_ok();
            // The starter waits for it.
            let _ = raised.send(result);
            if may_run {
                control_loop::run(core, drive, &loop_clock, period);
            }
        });
        threads.push(looping.map_err(no_thread("control loop"))?);
        // Without an answer the thread has panicked, which the supervisor reports.
        has_priority.recv().unwrap_or(Ok(()))?;
        let (shared, clock) = (Arc::clone(shared), Arc::clone(clock));
        let watching = supervisor.spawn_thread("watchdog of the control loop", move || {
            watchdog::run(&shared, &clock);
        });
        threads.push(watching.map_err(no_thread("watchdog of the control loop"))?);
        Ok(threads)
    }
}

fn simulated_drive(
    simulated: &SimulatedConfig,
    model: RobotModel,
) -> Result<SimulatedDrive, SimulatedDriveError> {
    let (scenario, start) = (&simulated.scenario, simulated.start);
    let drive = SimulatedDrive::new(scenario, model, start, simulated.individual, SimMode::Auto)?;
    let drive = drive.with_charge(simulated.battery_charge_ratio);
    let drive = drive.with_stall(simulated.stall);
    let drive = drive.with_faults(simulated.faults.clone());
    Ok(drive.with_trace(simulated.trace.clone()))
}
