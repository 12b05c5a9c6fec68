//! Histories of missions, and the reports of robots that were applied.

use tread_api::event::MissionStep;
use tread_api::ids::MissionId;
use tread_api::mission::MissionEvent;
use tread_store::RecordKey;

use super::{DbError, Tx, forward};

forward! {
    history;
    fn begin(id: MissionId, first: &MissionEvent, second: Option<&MissionEvent>) -> ();
    fn add_event(id: MissionId, event: &MissionEvent) -> ();
    fn events(id: MissionId, limit: u32) -> Vec<MissionEvent>;
    fn event_count(id: MissionId) -> u32;
    fn has_report(key: RecordKey) -> bool;
    fn record_report(key: RecordKey) -> ();
    fn newest_step() -> i64;
    fn steps_after(after: i64, limit: u32) -> Vec<(i64, MissionStep)>;
}
