//! What every test here starts with: a folder, a port, and what a server and an agent need.

use tempfile::TempDir;
use tread_agent::sim::scenario::Scenario;
use tread_agent::{Agent, AgentConfig, RunningAgent};
use tread_api::ids::{BootId, RobotId};

use crate::support::{FakeServer, Memory, SharedMemory, eventually, free_address};

/// One test's server, agent and folder.
pub(crate) struct Rig {
    pub(crate) port: u16,
    pub(crate) scenario: Scenario,
    pub(crate) robot: RobotId,
    pub(crate) folder: TempDir,
    pub(crate) memory: SharedMemory,
}

impl Rig {
    pub(crate) fn new() -> Self {
        Self {
            port: free_address().port(),
            scenario: Scenario::built_in().unwrap(),
            robot: "rover-1".parse().unwrap(),
            folder: TempDir::new().unwrap(),
            memory: SharedMemory::default(),
        }
    }

    pub(crate) fn serve(&self) -> FakeServer {
        FakeServer::start(self.port, &self.scenario, &self.memory)
    }

    pub(crate) fn endpoint(&self) -> String {
        format!("tcp/127.0.0.1:{}", self.port)
    }

    pub(crate) fn config(&self) -> AgentConfig {
        let config = AgentConfig::simulated(
            self.scenario.clone(),
            self.robot.clone(),
            self.endpoint(),
            self.folder.path().to_owned(),
        );
        config.unwrap()
    }

    pub(crate) fn agent(&self) -> RunningAgent {
        Agent::start(self.config()).unwrap()
    }

    /// Waits until the server's memory shows something.
    pub(crate) async fn sees<T: std::fmt::Debug>(
        &self,
        what: &str,
        mut look: impl FnMut(&Memory) -> Option<T>,
    ) -> T {
        eventually(what, || {
            let memory = self.memory.lock().unwrap();
            look(&memory).ok_or_else(|| {
                let phases: Vec<_> = memory.records.keys().collect();
                let last = memory.states.last();
                format!(
                    "{} hellos, records {phases:?}, {last:?}",
                    memory.hellos.len()
                )
            })
        })
        .await
    }

    pub(crate) async fn ready(&self, boot: BootId) {
        self.sees("the robot is welcome and knows where it is", |memory| {
            let is_ready = |state: &&tread_api::wire::state::RobotState| {
                state.boot == boot && state.pose.is_some() && state.terrain_revision == Some(5)
            };
            memory.states.iter().rev().find(is_ready).map(|_| ())
        })
        .await;
    }

    pub(crate) fn assert_every_record_came_once_per_name(&self) {
        let memory = self.memory.lock().unwrap();
        let mut boots: Vec<BootId> = memory.records.keys().map(|(boot, _)| *boot).collect();
        boots.dedup();
        for boot in boots {
            let of_boot = memory.records.keys().filter(|(other, _)| *other == boot);
            let seqs: Vec<u64> = of_boot.map(|(_, seq)| *seq).collect();
            let expected: Vec<u64> = (0..seqs.len() as u64).collect();
            assert_eq!(seqs, expected, "a gap: something was lost");
        }
    }
}
