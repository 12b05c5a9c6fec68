//! Writes the loop's events to the outbox as records.
//!
//! Runs on a thread of its own, which may block on the disk and deallocates what the loop returns.

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError};
use std::time::Duration;

use jiff::Timestamp;
use tracing::{error, info, warn};
use tread_api::friction::{
    COMMON_RATIO_MAX, INFORMATION_MAX, Information, MU_PEAK_MAX, SAMPLES_MAX, Segment, ThetaErrors,
};
use tread_api::ids::ConfigurationId;
use tread_api::robot::MissionProgress;
use tread_api::wire::ingest::{MissionPhase, MissionReport, RecordContent};
use tread_telemetry::{Place, Span, Telemetry};

use crate::control_loop::channels::{ClosedSegment, LoopEvent};
use crate::knowledge::Missions;
use crate::outbox::Outbox;

/// Pause between two attempts after a disk error.
const RETRY_EVERY: Duration = Duration::from_secs(1);
/// Number of records that wait in memory for a failing disk; beyond it the oldest are dropped.
const UNSAVED_MAX: usize = 10_000;

/// Writes events to the outbox.
#[derive(Debug)]
pub(crate) struct Recorder {
    pub(crate) configuration: ConfigurationId,
    pub(crate) missions: Arc<Missions>,
    pub(crate) outbox: Outbox,
    pub(crate) telemetry: Telemetry,
}

impl Recorder {
    /// Records until the loop has ended and all its events are in the outbox.
    pub(crate) fn run(&self, events: &Receiver<LoopEvent>) {
        let mut unsaved = VecDeque::new();
        loop {
            let event = match events.recv_timeout(RETRY_EVERY) {
                Ok(event) => Some(event),
                Err(RecvTimeoutError::Timeout) => {
                    self.missions.save_again();
                    None
                }
                Err(RecvTimeoutError::Disconnected) => break,
            };
            if let Some(event) = event {
                self.take(event, &mut unsaved);
            }
            self.save(&mut unsaved);
        }
        self.save(&mut unsaved);
        if !unsaved.is_empty() {
            error!(
                "{} records are lost: the disk does not take them",
                unsaved.len()
            );
        }
    }

    fn take(&self, event: LoopEvent, unsaved: &mut VecDeque<RecordContent>) {
        match event {
            LoopEvent::Started { at, progress } => {
                self.telemetry.began(progress.id, at);
                let report = report_of(&progress, at, MissionPhase::Started);
                unsaved.push_back(RecordContent::Mission(report));
            }
            LoopEvent::Paused {
                at,
                since,
                progress,
            } => {
                let mut report = report_of(&progress, at, MissionPhase::Paused);
                report.since = since;
                unsaved.push_back(RecordContent::Mission(report));
            }
            LoopEvent::Resumed { at, progress } => {
                let report = report_of(&progress, at, MissionPhase::Resumed);
                unsaved.push_back(RecordContent::Mission(report));
            }
            LoopEvent::Replaced { at, progress, old } => {
                info!(mission.id = %progress.id, "revision {} is driven now", progress.revision);
                let report = report_of(&progress, at, MissionPhase::Replaced);
                unsaved.push_back(RecordContent::Mission(report));
                drop(old);
            }
            LoopEvent::CameTooLate(job) => {
                let (mission, revision) = (job.mission, job.revision);
                info!(mission.id = %mission, "revision {revision} came too late");
            }
            LoopEvent::Ended {
                at,
                reason,
                progress,
                job,
            } => {
                let mission = job.mission;
                let phase = self.missions.slot().begin_end(mission, reason.phase());
                info!(
                    mission.id = %mission,
                    driven_m = progress.driven_m,
                    "mission {mission} ended: {phase:?} {}",
                    reason.text().unwrap_or_default(),
                );
                self.trace_end(&progress, at, phase, reason.text());
                let mut report = report_of(&progress, at, phase);
                report.reason = reason.text().map(str::to_owned);
                report.quality = Some(job.driven.quality());
                report.driven = Some(job.driven.path());
                self.record_end(report, unsaved);
            }
            LoopEvent::Segment(closed) => {
                let segment = segment_of(&closed, self.configuration);
                match segment.validate() {
                    Ok(()) => unsaved.push_back(RecordContent::Segment(segment)),
                    Err(cause) => warn!("a measured segment is impossible: {cause}"),
                }
            }
            LoopEvent::Retired(site) => drop(site),
        }
    }

    /// Records the end of a mission. The memory has the report before the outbox: an agent that is
    /// killed in between reports this end when it starts, instead of an interruption. The state counts
    /// the record as pending from the beginning: a robot without mission and without records has
    /// forgotten its mission.
    fn record_end(&self, report: MissionReport, unsaved: &mut VecDeque<RecordContent>) {
        let _expected = self.outbox.expect_record();
        self.missions.slot().store_end(report.clone());
        self.missions.save();
        self.missions.slot().end(report.mission, report.phase);
        unsaved.push_back(RecordContent::Mission(report));
        self.save(unsaved);
    }

    /// Sends the span of a mission from its start to its end.
    fn trace_end(
        &self,
        progress: &MissionProgress,
        at: Timestamp,
        phase: MissionPhase,
        reason: Option<&str>,
    ) {
        if !self.telemetry.is_on() {
            return;
        }
        let open = self.telemetry.open(progress.id);
        let failure = (phase != MissionPhase::Succeeded)
            .then(|| reason.map_or_else(|| format!("{phase:?}"), str::to_owned));
        self.telemetry.send(Span {
            name: "drive",
            place: Place::below(open.parent),
            began_at: open.began_at.unwrap_or(at),
            ended_at: at,
            attributes: vec![
                ("mission.id", progress.id.to_string()),
                ("mission.revision", progress.revision.to_string()),
                ("driven_m", format!("{:.3}", progress.driven_m)),
            ],
            failure,
        });
    }

    /// Appends records in order; those that the disk refuses stay for later, the oldest are
    /// dropped.
    fn save(&self, unsaved: &mut VecDeque<RecordContent>) {
        while let Some(content) = unsaved.front() {
            if let Err(cause) = self.outbox.append(content) {
                error!(
                    error = &cause as &dyn std::error::Error,
                    "a record is not saved"
                );
                while unsaved.len() > UNSAVED_MAX {
                    unsaved.pop_front();
                }
                return;
            }
            unsaved.pop_front();
        }
        self.settle_ends();
    }

    /// Drops the reports of ends from the memory once the outbox has them on disk.
    fn settle_ends(&self) {
        if self.missions.slot().unrecorded_ends().next().is_none() {
            return;
        }
        match self.outbox.sync() {
            Ok(()) => {
                self.missions.slot().ends_are_recorded();
                self.missions.save();
            }
            Err(cause) => error!(
                error = &cause as &dyn std::error::Error,
                "the end of a mission is not on disk"
            ),
        }
    }
}

fn report_of(
    progress: &MissionProgress,
    at: jiff::Timestamp,
    phase: MissionPhase,
) -> MissionReport {
    MissionReport {
        mission: progress.id,
        revision: progress.revision,
        plan_hash: progress.plan_hash,
        at,
        phase,
        since: None,
        reason: None,
        progress: Some(*progress),
        quality: None,
        driven: None,
    }
}

/// The segment as it is uploaded.
pub(crate) fn segment_of(closed: &ClosedSegment, configuration: ConfigurationId) -> Segment {
    let statistics = &closed.statistics;
    let track = Information {
        information: statistics.effective_track_information,
        weighted: statistics.effective_track_weighted,
    };
    let rolling = Information {
        information: statistics.rolling_resistance_information,
        weighted: statistics.rolling_resistance_weighted,
    };
    Segment {
        configuration,
        mission: closed.mission,
        started_at: closed.started_at,
        ended_at: closed.ended_at,
        grid_revision: closed.site.grid().revision,
        cell: closed.cell,
        terrain: closed
            .terrain
            .and_then(|place| closed.site.terrain(place))
            .cloned(),
        theta: Information {
            information: statistics.theta_information,
            weighted: statistics.theta_weighted,
        },
        theta_errors: (statistics.own_information > 0.0).then(|| ThetaErrors {
            independent_information: statistics.own_information.min(INFORMATION_MAX),
            robot_ratio: statistics.common_ratio.robot.min(COMMON_RATIO_MAX),
            tyre_ratio: statistics.common_ratio.tyres.min(COMMON_RATIO_MAX),
        }),
        effective_track_ratio: (track.information > 0.0).then_some(track),
        rolling_resistance: (rolling.information > 0.0).then_some(rolling),
        // The server refuses a segment with a larger value, which noise alone can produce.
        mu_peak_lower_bound: statistics.mu_peak_lower_bound.map(|mu| mu.min(MU_PEAK_MAX)),
        samples: u32::try_from(statistics.samples)
            .unwrap_or(SAMPLES_MAX)
            .min(SAMPLES_MAX),
        distance_m: closed.distance_m,
        saturation_ratio: closed.saturation_ratio.clamp(0.0, 1.0),
    }
}
