//! State shared by several parts of the agent: its missions and its site.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use jiff::Timestamp;
use tracing::{error, warn};
use tread_api::wire::hello::SiteDefinition;
use tread_api::wire::ingest::{MissionPhase, MissionReport, RecordContent};

use crate::control_loop::site_view::SiteView;
use crate::missions::memory::Memory;
use crate::missions::{ActiveMission, MissionSlot};
use crate::outbox::Outbox;
use crate::start_error::StartError;

/// The robot's missions, shared by dispatcher and recorder.
#[derive(Debug)]
pub(crate) struct Missions {
    slot: Mutex<MissionSlot>,
    /// Locked during a write, so that no older state replaces a newer one.
    memory: Mutex<Memory>,
    /// Whether the last write failed.
    is_unsaved: AtomicBool,
}

impl Missions {
    pub(crate) fn new(slot: MissionSlot, memory: Memory) -> Arc<Self> {
        Arc::new(Self {
            slot: Mutex::new(slot),
            memory: Mutex::new(memory),
            is_unsaved: AtomicBool::new(false),
        })
    }

    /// Reads the memory after a start. Ends that may not be in the outbox are reported again; a
    /// mission that was active when the agent died is reported as failed.
    ///
    /// # Errors
    /// [`StartError`] if the memory cannot be read or the outbox does not take the report.
    pub(crate) fn restore(
        memory: Memory,
        outbox: &Outbox,
        now: Timestamp,
    ) -> Result<Arc<Self>, StartError> {
        let mut slot = memory.load()?;
        let mut reports: Vec<MissionReport> = slot.unrecorded_ends().cloned().collect();
        let unreadable = slot.unreadable_ends();
        if unreadable > 0 {
            warn!(
                unreadable,
                "{unreadable} reports of ended missions in the mission memory cannot be read and are \
                 dropped: another version of the agent may have written them"
            );
        }
        if let Some(active) = slot.active() {
            let is_over = reports.iter().any(|kept| kept.mission == active.mission);
            if !is_over {
                reports.push(interrupted(active, now));
            }
        }
        for report in &reports {
            outbox.append(&RecordContent::Mission(report.clone()))?;
            slot.end(report.mission, report.phase);
        }
        let is_changed = !reports.is_empty() || unreadable > 0;
        if is_changed {
            outbox.sync()?;
            slot.ends_are_recorded();
        }
        let missions = Self::new(slot, memory);
        if is_changed {
            missions.save();
        }
        Ok(missions)
    }

    pub(crate) fn slot(&self) -> MutexGuard<'_, MissionSlot> {
        self.slot.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Saves the missions on disk. Blocks.
    pub(crate) fn save(&self) {
        let memory = self.memory.lock().unwrap_or_else(PoisonError::into_inner);
        // The slot is not locked during the disk write.
        let slot = self.slot().clone();
        let saved = memory.save(&slot);
        self.is_unsaved.store(saved.is_err(), Ordering::Relaxed);
        if let Err(cause) = saved {
            error!(
                error = &cause as &dyn std::error::Error,
                "cannot save the missions; it is tried again"
            );
        }
    }

    /// Saves the missions if the last attempt failed. Blocks.
    pub(crate) fn save_again(&self) {
        if self.is_unsaved.load(Ordering::Relaxed) {
            self.save();
        }
    }
}

/// Report on a mission that was active when the agent died.
fn interrupted(active: &ActiveMission, now: Timestamp) -> MissionReport {
    let (phase, reason) = if active.is_cancelled {
        (
            MissionPhase::Cancelled,
            "cancelled on request; the agent restarted meanwhile",
        )
    } else {
        (
            MissionPhase::Failed,
            "the agent restarted during the mission",
        )
    };
    MissionReport {
        mission: active.mission,
        revision: active.revision,
        plan_hash: active.plan_hash,
        at: now,
        phase,
        since: None,
        reason: Some(reason.to_owned()),
        progress: None,
        quality: None,
        driven: None,
    }
}

/// The active site definition, for the parts outside the loop.
#[derive(Debug, Default)]
pub(crate) struct SiteCell {
    view: Mutex<Option<(SiteDefinition, Arc<SiteView>)>>,
}

impl SiteCell {
    pub(crate) fn lock(&self) -> MutexGuard<'_, Option<(SiteDefinition, Arc<SiteView>)>> {
        self.view.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns the view that was given to the loop last.
    pub(crate) fn view(&self) -> Option<Arc<SiteView>> {
        self.lock().as_ref().map(|(_, view)| Arc::clone(view))
    }
}

#[cfg(test)]
mod tests {
    use tread_api::ids::{BootId, MissionId, PlanHash};
    use tread_api::mission::PlanSummary;
    use uuid::Uuid;

    use super::*;
    use crate::outbox::Limits;

    const NOW: Timestamp = Timestamp::UNIX_EPOCH;

    fn active() -> ActiveMission {
        ActiveMission {
            mission: MissionId::from_uuid(Uuid::from_u128(7)),
            revision: 1,
            plan_hash: PlanHash::from_uuid(Uuid::from_u128(8)),
            plan: PlanSummary {
                length_m: 1.0,
                duration_s: 2.0,
                speed_peak_m_s: 0.5,
                begin: None,
            },
            is_cancelled: false,
        }
    }

    fn succeeded() -> MissionReport {
        MissionReport {
            phase: MissionPhase::Succeeded,
            reason: None,
            ..interrupted(&active(), NOW)
        }
    }

    fn outbox(folder: &std::path::Path) -> Outbox {
        let robot = "rover-1".parse().unwrap();
        let boot = BootId::from_uuid(Uuid::from_u128(1));
        Outbox::open(&folder.join("outbox"), Limits::default(), robot, boot).unwrap()
    }

    fn reports(outbox: &Outbox) -> Vec<MissionReport> {
        let pending = outbox.pending(100).unwrap();
        let records = pending.map(|pending| pending.batch.records);
        let of = |record: tread_api::wire::ingest::Record| match record.content {
            RecordContent::Mission(report) => report,
            RecordContent::Segment(segment) => panic!("a segment: {segment:?}"),
        };
        records.unwrap_or_default().into_iter().map(of).collect()
    }

    /// Starts twice from a memory and returns what the outbox has then.
    fn started_twice(slot: &MissionSlot, in_outbox: &[MissionReport]) -> Vec<MissionReport> {
        let folder = tempfile::tempdir().unwrap();
        let memory = Memory::new(folder.path());
        memory.save(slot).unwrap();
        let outbox = outbox(folder.path());
        for report in in_outbox {
            let content = RecordContent::Mission(report.clone());
            outbox.append(&content).unwrap();
        }
        for _ in 0..2 {
            let missions = Missions::restore(memory.clone(), &outbox, NOW).unwrap();
            let slot = missions.slot().clone();
            assert_eq!(slot.active(), None);
            assert_eq!(slot.unrecorded_ends().count(), 0);
            assert_eq!(slot.ended().count(), 1);
            assert_eq!(memory.load().unwrap(), slot);
        }
        reports(&outbox)
    }

    #[test]
    fn a_mission_that_was_active_when_the_agent_died_has_failed() {
        let mut slot = MissionSlot::default();
        assert!(slot.take(active()));
        assert_eq!(started_twice(&slot, &[]), [interrupted(&active(), NOW)]);
    }

    #[test]
    fn an_agent_that_died_while_it_recorded_an_end_reports_that_end_alone() {
        let mut slot = MissionSlot::default();
        assert!(slot.take(active()));
        slot.begin_end(active().mission, MissionPhase::Succeeded);
        slot.store_end(succeeded());
        // Before the outbox had it, and after.
        assert_eq!(started_twice(&slot, &[]), [succeeded()]);
        assert_eq!(
            started_twice(&slot, &[succeeded()]),
            [succeeded(), succeeded()]
        );
        // The memory was saved for another reason meanwhile.
        slot.end(active().mission, MissionPhase::Succeeded);
        assert_eq!(started_twice(&slot, &[]), [succeeded()]);
    }

    #[test]
    fn several_ends_that_the_outbox_did_not_take_are_all_reported() {
        let mut slot = MissionSlot::default();
        let mut expected = Vec::new();
        for number in 10..12 {
            let mission = MissionId::from_uuid(Uuid::from_u128(number));
            let active = ActiveMission {
                mission,
                ..active()
            };
            assert!(slot.take(active));
            let report = MissionReport {
                mission,
                ..succeeded()
            };
            slot.begin_end(mission, MissionPhase::Succeeded);
            slot.store_end(report.clone());
            assert!(slot.end(mission, MissionPhase::Succeeded).is_some());
            expected.push(report);
        }
        let folder = tempfile::tempdir().unwrap();
        let memory = Memory::new(folder.path());
        memory.save(&slot).unwrap();
        let outbox = outbox(folder.path());
        for _ in 0..2 {
            let missions = Missions::restore(memory.clone(), &outbox, NOW).unwrap();
            assert_eq!(missions.slot().unrecorded_ends().count(), 0);
        }
        assert_eq!(reports(&outbox), expected);
    }

    #[test]
    fn an_end_that_cannot_be_read_costs_no_other_one_and_the_agent_starts() {
        let mut slot = MissionSlot::default();
        assert!(slot.take(active()));
        slot.store_end(succeeded());
        let mut written = serde_json::to_value(&slot).unwrap();
        let mut unknown = written["unrecorded_ends"][0].clone();
        unknown["phase"] = "suspended".into();
        let ends = written["unrecorded_ends"].as_array_mut().unwrap();
        ends.insert(0, unknown);
        let folder = tempfile::tempdir().unwrap();
        let text = serde_json::to_vec(&written).unwrap();
        std::fs::write(folder.path().join("missions.json"), text).unwrap();
        let memory = Memory::new(folder.path());
        assert_eq!(memory.load().unwrap().unreadable_ends(), 1);
        let outbox = outbox(folder.path());
        for _ in 0..2 {
            let missions = Missions::restore(memory.clone(), &outbox, NOW).unwrap();
            assert_eq!(missions.slot().active(), None);
            assert_eq!(memory.load().unwrap(), *missions.slot());
        }
        assert_eq!(reports(&outbox), [succeeded()]);
    }

    #[test]
    fn the_end_in_a_file_of_an_earlier_agent_is_reported() {
        // As an agent wrote it that kept only the last end.
        let earlier = r#"{"active":{"mission":"00000000-0000-0000-0000-000000000007","revision":1,
            "plan_hash":"00000000-0000-0000-0000-000000000008",
            "plan":{"length_m":1.0,"duration_s":2.0,"speed_peak_m_s":0.5}},"ended":[],
            "unrecorded_end":{"mission":"00000000-0000-0000-0000-000000000007","revision":1,
            "plan_hash":"00000000-0000-0000-0000-000000000008","at":"1970-01-01T00:00:00Z",
            "phase":"succeeded"}}"#;
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("missions.json"), earlier).unwrap();
        let memory = Memory::new(folder.path());
        let slot = memory.load().unwrap();
        assert_eq!(slot.unrecorded_ends().collect::<Vec<_>>(), [&succeeded()]);
        assert_eq!(slot.unreadable_ends(), 0);
        let outbox = outbox(folder.path());
        let missions = Missions::restore(memory, &outbox, NOW).unwrap();
        assert_eq!(missions.slot().active(), None);
        assert_eq!(reports(&outbox), [succeeded()]);
    }

    #[test]
    fn what_several_threads_save_is_never_damaged_and_the_newest_stays() {
        let folder = tempfile::tempdir().unwrap();
        let memory = Memory::new(folder.path());
        let missions = Missions::new(MissionSlot::default(), memory.clone());
        std::thread::scope(|scope| {
            for thread in 0..4_u128 {
                let (missions, memory) = (&missions, &memory);
                scope.spawn(move || {
                    for number in 0..25 {
                        let mission = Uuid::from_u128(100 * thread + number);
                        missions.slot().cancel(MissionId::from_uuid(mission));
                        missions.save();
                        let is_there = |slot: &MissionSlot| {
                            let mut ended = slot.ended();
                            ended.any(|ended| ended.mission == MissionId::from_uuid(mission))
                        };
                        assert!(is_there(&memory.load().unwrap()));
                    }
                });
            }
        });
        assert_eq!(memory.load().unwrap(), *missions.slot());
    }

    #[test]
    fn what_could_not_be_saved_is_saved_again() {
        let folder = tempfile::tempdir().unwrap();
        let memory = Memory::new(&folder.path().join("later"));
        let missions = Missions::new(MissionSlot::default(), memory.clone());
        missions.slot().cancel(active().mission);
        missions.save();
        std::fs::create_dir(folder.path().join("later")).unwrap();
        missions.save_again();
        assert_eq!(memory.load().unwrap(), *missions.slot());
    }
}
