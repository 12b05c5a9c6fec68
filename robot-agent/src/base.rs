//! What the agent drives: the base behind the drive interface, and the threads around it.

use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

use tread_control::robot::RobotModel;

use crate::agent::StartError;
use crate::clock::SharedClock;
use crate::config::{AgentConfig, DriveConfig, SimulatedConfig};
use crate::control_loop;
use crate::control_loop::channels::Shared;
use crate::control_loop::tick::LoopCore;
use crate::drive::Drive;
use crate::drive::ros2::Ros2Drive;
use crate::drive::ros2::bus::Bus;
use crate::drive::ros2::refusal::Counts;
use crate::drive::simulated::{SimMode, SimulatedDrive, SimulatedDriveError};
use crate::safety::watchdog;
use crate::supervisor::Supervisor;

/// A base that nothing drives yet.
pub(crate) struct Base {
    drive: Box<dyn Drive>,
    /// What is spoken with it.
    bus: Option<Bus>,
    /// What of its words was dropped.
    counts: Option<Arc<Counts>>,
}

impl Base {
    /// The base of a configuration.
    ///
    /// # Errors
    /// [`StartError`] when the simulated base cannot be made, or the bus's endpoint is none.
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

    /// What of its words was dropped, where that is counted.
    pub(crate) fn counts(&self) -> Option<Arc<Counts>> {
        self.counts.clone()
    }

    /// Oldest word with which it does not count as silent.
    pub(crate) fn silent_after(&self) -> Duration {
        self.drive.silent_after()
    }

    /// Starts the loop, what watches it, and what is spoken with the base.
    ///
    /// # Errors
    /// The operating system refused a thread.
    pub(crate) fn spawn(
        self,
        core: LoopCore,
        config: &AgentConfig,
        supervisor: &Supervisor,
        shared: &Arc<Shared>,
        clock: &SharedClock,
    ) -> std::io::Result<Vec<JoinHandle<()>>> {
        let mut threads = Vec::new();
        if let Some(mut bus) = self.bus {
            bus.tell_of(shared, self.counts.unwrap_or_default(), &config.robot);
            // It ends when the loop lets go of its drive.
            threads.push(supervisor.spawn_thread("robot's bus", move || bus.run())?);
        }
        let (drive, period, loop_clock) = (self.drive, config.period(), Arc::clone(clock));
        threads.push(supervisor.spawn_thread("control loop", move || {
            control_loop::run(core, drive, &loop_clock, period);
        })?);
        let (shared, clock) = (Arc::clone(shared), Arc::clone(clock));
        threads.push(
            supervisor.spawn_thread("watchdog of the control loop", move || {
                watchdog::run(&shared, &clock);
            })?,
        );
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
