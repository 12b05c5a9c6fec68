//! Reports of ended missions that may not be in the outbox yet.

use std::collections::VecDeque;

use serde::{Deserialize, Serialize, Serializer};
use serde_json::Value;
use tread_api::wire::ingest::MissionReport;

/// Maximum number of reports that wait for the outbox; the oldest is dropped first. Several wait only
/// while the disk refuses the outbox's writes.
pub const UNRECORDED_ENDS_MAX: usize = 16;

/// The reports, oldest first, one for each mission.
///
/// In the file they are an array. An earlier agent wrote a single report without an array. A report
/// that this agent cannot read, as of a later agent, is counted and left out: the other missions of
/// the file do not depend on it.
#[derive(Debug, Clone, PartialEq, Default, Deserialize)]
#[serde(from = "Value")]
pub(super) struct StoredEnds {
    reports: VecDeque<MissionReport>,
    unreadable: usize,
}

impl StoredEnds {
    /// Keeps a report, in place of an earlier one of the same mission.
    pub(super) fn keep(&mut self, report: MissionReport) {
        self.reports.retain(|kept| kept.mission != report.mission);
        if self.reports.len() >= UNRECORDED_ENDS_MAX {
            self.reports.pop_front();
        }
        self.reports.push_back(report);
    }

    /// Returns the reports, oldest first.
    pub(super) fn reports(&self) -> impl Iterator<Item = &MissionReport> {
        self.reports.iter()
    }

    /// Returns the number of reports in the file that could not be read.
    pub(super) fn unreadable(&self) -> usize {
        self.unreadable
    }

    /// Returns whether the file needs no entry for them.
    pub(super) fn is_empty(&self) -> bool {
        self.reports.is_empty()
    }
}

impl Serialize for StoredEnds {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        self.reports.serialize(serializer)
    }
}

impl From<Value> for StoredEnds {
    fn from(value: Value) -> Self {
        let written = if let Value::Array(reports) = value {
            reports
        } else {
            vec![value]
        };
        let mut kept = Self::default();
        for report in written {
            match serde_json::from_value(report) {
                Ok(report) => kept.keep(report),
                Err(_) => kept.unreadable += 1,
            }
        }
        kept
    }
}
