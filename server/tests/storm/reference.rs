//! What must hold of missions, whatever happens, judged by the history that the server wrote.

use std::collections::{BTreeMap, HashMap, HashSet};

use tread_api::ids::{MissionId, RobotId};
use tread_api::mission::{Cause, MissionState};
use tread_server::db::{self, Db};

/// What the reference knows: where each mission stands, by the history alone.
#[derive(Debug, Default)]
pub(super) struct Reference {
    pub(super) missions: BTreeMap<MissionId, (RobotId, MissionState, Cause)>,
    /// Missions that were cancelled while they waited: the server decided that without the robot, which an
    /// offer may reach later.
    pub(super) cancelled_in_queue: HashSet<MissionId>,
    last_step: i64,
}

impl Reference {
    /// Reads what the server wrote, and checks it.
    pub(super) async fn follow(&mut self, db: &Db) -> Result<(), String> {
        let mut tx = db.read("test").await.map_err(|error| error.to_string())?;
        let steps = db::history::steps_after(&mut tx, self.last_step, 10_000).await;
        drop(tx);
        for (pk, step) in steps.map_err(|error| error.to_string())? {
            self.last_step = pk;
            let before = self.missions.get(&step.mission).map(|known| known.1);
            if before != step.step.from {
                return Err(format!("{step:?} does not follow {before:?}"));
            }
            let moved = before != Some(step.step.to);
            if moved && before.is_some_and(MissionState::is_terminal) {
                return Err(format!("revived: {step:?}"));
            }
            if (before, step.step.to) == (Some(MissionState::Queued), MissionState::Cancelled) {
                self.cancelled_in_queue.insert(step.mission);
            }
            let cause = match self.missions.get(&step.mission) {
                Some(&(_, _, cause)) if !moved => cause,
                _ => step.step.cause,
            };
            let standing = (step.robot.clone(), step.step.to, cause);
            self.missions.insert(step.mission, standing);
            let mut in_progress: HashMap<&RobotId, usize> = HashMap::new();
            for (robot, state, _) in self.missions.values() {
                if !state.is_terminal() && *state != MissionState::Queued {
                    *in_progress.entry(robot).or_default() += 1;
                }
            }
            if let Some((robot, count)) = in_progress.into_iter().find(|(_, count)| *count > 1) {
                return Err(format!(
                    "robot {robot} has {count} active missions: {step:?}"
                ));
            }
        }
        Ok(())
    }

    /// A robot's missions that have not ended.
    pub(super) fn open_of(&self, robot: &RobotId) -> Vec<MissionId> {
        let of_robot = self.missions.iter().filter(|(_, known)| known.0 == *robot);
        let open = of_robot.filter(|(_, known)| !known.1.is_terminal());
        open.map(|(id, _)| *id).collect()
    }

    pub(super) fn open(&self) -> Vec<(MissionId, MissionState)> {
        let standing = self.missions.iter().map(|(id, known)| (*id, known.1));
        standing.filter(|(_, state)| !state.is_terminal()).collect()
    }
}
