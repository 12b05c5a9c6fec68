//! Missions: their content, state and outcome.

use jiff::Timestamp;
use tread_api::ids::MissionId;
use tread_api::mission::{DrivenPath, MissionQuality, MissionState, Replacement};
pub use tread_store::missions::OpenMission;
pub use tread_store::missions::{Facts, Inserted, MissionFilter, MissionRow, Transition};

use super::{DbError, Tx, forward};

forward! {
    missions;
    fn insert(row: &MissionRow, inserted: Inserted<'_>) -> ();
    fn find(id: MissionId) -> Option<MissionRow>;
    fn list(filter: &MissionFilter, limit: u32, bytes_max: usize) -> (Vec<MissionRow>, bool);
    fn compare_and_set(id: MissionId, transition: Transition<'_>) -> bool;
    fn add_facts(id: MissionId, facts: Facts) -> ();
    fn set_pause_requested(id: MissionId, requested: bool) -> bool;
    fn set_replacement(id: MissionId, replacement: Option<&Replacement>) -> ();
    fn swap_content(id: MissionId, from: u32, to: &Replacement) -> bool;
    fn set_silence(id: MissionId, since: Option<Timestamp>) -> ();
    fn add_outcome(id: MissionId, quality: Option<&MissionQuality>, driven: Option<&DrivenPath>) -> ();
    fn outcome(id: MissionId) -> (Option<MissionQuality>, Option<DrivenPath>);
    fn counts() -> Vec<(MissionState, u64)>;
    fn in_progress() -> Vec<OpenMission>;
    fn next_in_queues() -> Vec<OpenMission>;
    fn overdue(now: Timestamp, limit: u32) -> Vec<OpenMission>;
    fn open_of_robot(robot_pk: i64) -> Vec<OpenMission>;
}
