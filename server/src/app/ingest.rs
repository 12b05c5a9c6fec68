//! The ingest writer: one task that stores what robots upload, many batches in one commit.
//!
//! Transactions begin at least [`GROUP_INTERVAL`] apart; uploads that arrive meanwhile go into the
//! next one, up to a limit. One fsync thus serves many robots, and a single upload does not wait
//! for others. The answer is sent after the commit. Only newly inserted segments are added to the
//! cell sums, with the commit in memory, and later in the database ([`super::sums`]). A
//! segment that is sent twice counts once.

mod deduplication;
mod keys;
mod prepared;

use std::borrow::Cow;
use std::collections::{HashMap, HashSet};
use std::time::Duration;

use jiff::{SignedDuration, Timestamp};
use serde_json::value::RawValue;
use tokio::sync::{mpsc, oneshot};
use tokio::time::{Instant, timeout_at};
use tokio_util::sync::CancellationToken;
use tracing::warn;
use tread_api::friction::Segment;
use tread_api::ids::{ConfigurationId, RobotId, SiteId};
use tread_api::robot::Alert;
use tread_api::site::Grid;
use tread_api::wire::ingest::{
    BATCH_RECORDS_MAX, Batch, MissionReport, Receipt, RecordContent, RefusedRecord,
};
use tread_api::wire::{Refusal, RefusalCode};

use self::deduplication::Deduplication;
use self::keys::{CONFIGURATIONS_MAX, Configured, Keys, RobotKeys};
pub(super) use self::prepared::SKEW_MIN;
use self::prepared::{Prepared, Ready, Skew, prepared, us_of};
use super::App;
use super::map::{Folded, MapChange};
use super::missions::reports::{Foreign, ReportEffect, Reporting, apply_mission_report};
use crate::db::deferred_segments::{DeferredFilter, DeferredTimes, Origin};
use crate::db::segments::{Added, NewSegment};
use crate::db::sums::SumKey;
use crate::db::withdrawals::WithdrawalRow;
use crate::db::{self, DbError, RecordKey, Tx};
use crate::friction::epoch_h_at;

/// Maximum number of uploads that wait for the writer.
pub const UPLOADS_WAITING_MAX: usize = 256;
/// Number of records in a transaction beyond which it takes no further batch.
const GROUP_RECORDS_MAX: usize = 5_000;
/// Minimum interval between the beginnings of two transactions while uploads keep arriving: each
/// transaction has a cost of its own, in processor time and on the disk.
const GROUP_INTERVAL: Duration = Duration::from_millis(40);
/// Limit of sequence numbers; integers below it are exact in JSON.
const SEQ_MAX: u64 = 1 << 53;
/// Maximum number of one robot's measurements that may wait until the clock of their run is known.
const DEFERRED_MAX: u64 = 10_000;
/// Maximum number of deferred measurements that one upload may release.
const RELEASED_MAX: u32 = 500;

/// One batch of one robot, with the channel for its answer.
#[derive(Debug)]
pub struct Upload {
    /// The site in the key expression of the upload.
    pub site: SiteId,
    /// The batch; its robot is checked to be that of the key expression.
    pub batch: Batch,
    /// Channel for the answer.
    pub answer: oneshot::Sender<Result<Receipt, Refusal>>,
}

/// Stores uploads until the stop, then those that are already queued.
pub async fn run(app: App, mut uploads: mpsc::Receiver<Upload>, stop: CancellationToken) {
    let mut writer = Writer::new(app);
    let mut next_begin = Instant::now();
    loop {
        let first = tokio::select! {
            biased;
            () = stop.cancelled() => {
                uploads.close();
                uploads.recv().await
            }
            upload = uploads.recv() => upload,
        };
        // The queue does not close before the stop: the network holds its senders.
        let Some(first) = first else { break };
        let mut records = first.batch.records.len();
        let mut group = vec![first];
        while records < GROUP_RECORDS_MAX
            && let Ok(Some(upload)) = timeout_at(next_begin, uploads.recv()).await
        {
            records += upload.batch.records.len();
            group.push(upload);
        }
        next_begin = Instant::now() + GROUP_INTERVAL;
        writer.store(group).await;
    }
    stop.cancelled().await;
}

/// Stores groups of uploads, one transaction each.
#[derive(Debug)]
pub struct Writer {
    app: App,
    keys: Keys,
}

/// A segment to be stored.
struct Candidate<'group> {
    /// Index of the upload whose receipt counts it; `None` for a segment that was deferred.
    upload: Option<usize>,
    key: RecordKey,
    site_pk: i64,
    robot_pk: i64,
    configuration_pk: i64,
    robot: &'group RobotId,
    ready: Ready<'group>,
}

impl Candidate<'_> {
    fn row(&self) -> NewSegment<'_> {
        let RecordKey { boot_pk, seq } = self.key;
        NewSegment {
            boot_pk,
            seq,
            robot_pk: self.robot_pk,
            site_pk: self.site_pk,
            configuration_pk: self.configuration_pk,
            segment: &self.ready.segment,
            times_ns: self.ready.times_ns,
        }
    }

    /// Returns whether the sums of a segment that ended in an hour belong to these.
    fn belongs_to(&self, folded: &Folded, epoch_h: i64) -> bool {
        let (key, segment) = (&folded.key, &*self.ready.segment);
        (key.robot_pk, key.site_pk, key.configuration_pk)
            == (self.robot_pk, self.site_pk, self.configuration_pk)
            && (key.epoch_h, key.grid_revision) == (epoch_h, segment.grid_revision)
            && key.terrain == segment.terrain
    }
}

/// A batch whose robot and run are known.
struct Admitted {
    of: RobotKeys,
    boot_pk: i64,
    /// Database keys of the configurations that it measured with; those beyond the limit are
    /// missing.
    configurations: HashMap<ConfigurationId, i64>,
}

/// Result of one batch.
type Outcome = Result<Receipt, Refusal>;

/// Counts of a transaction, for the server's counters.
#[derive(Debug, Default)]
struct TransactionCounts {
    segments: u64,
    reports: u64,
    foreign: u64,
    deferred: u64,
    /// Alerts that were raised or cleared by mission reports.
    alerts: Vec<Alert>,
}

impl TransactionCounts {
    fn record_report(
        &mut self,
        taken: Option<Result<ReportEffect, Foreign>>,
        seq: u64,
        receipt: &mut Receipt,
    ) {
        match taken {
            Some(Ok(_taken)) => {
                receipt.committed += 1;
                self.reports += 1;
            }
            Some(Err(Foreign(reason))) => {
                receipt.refused.push(RefusedRecord { seq, reason });
                self.foreign += 1;
            }
            None => receipt.duplicates += 1,
        }
    }
}

impl Writer {
    /// Creates a writer with an empty cache of keys.
    pub fn new(app: App) -> Self {
        Self {
            app,
            keys: Keys::default(),
        }
    }

    /// Stores a group in one transaction, or, if that fails, each batch in one of its own; then
    /// answers all.
    pub async fn store(&mut self, group: Vec<Upload>) {
        let outcomes = match self.commit(&group).await {
            Ok(outcomes) => outcomes,
            Err(cause) => {
                self.app.log_failure("store a group of batches", &cause);
                let mut outcomes = Vec::with_capacity(group.len());
                for upload in &group {
                    let alone = self.commit(std::slice::from_ref(upload)).await;
                    outcomes.push(alone.map_or_else(
                        |_logged_above| {
                            Err(refusal(RefusalCode::Busy, "the server cannot write now"))
                        },
                        |mut alone| alone.remove(0),
                    ));
                }
                outcomes
            }
        };
        let counters = self.app.counters();
        for (upload, outcome) in group.into_iter().zip(outcomes) {
            if let Ok(receipt) = &outcome {
                counters.records_duplicate.add(receipt.duplicates);
                counters.records_refused.add(receipt.refused.len() as u64);
                if let Some(refused) = receipt.refused.first() {
                    warn!(
                        robot.id = %upload.batch.robot,
                        "{} records of robot `{}` were refused, the first because {}",
                        receipt.refused.len(), upload.batch.robot, refused.reason,
                    );
                }
            }
            counters.batches_answered.one();
            // Fails if the requester is gone; the robot then sends again, and the records are
            // duplicates.
            let _ = upload.answer.send(outcome);
        }
    }

    async fn commit(&mut self, group: &[Upload]) -> Result<Vec<Outcome>, DbError> {
        self.keys.bound();
        let result = db::limited(self.commit_once(group)).await;
        if result.is_err() {
            // Keys of a transaction that was rolled back are invalid.
            self.keys.clear();
        }
        let (outcomes, tally) = result?;
        let counters = self.app.counters();
        counters.ingest_transactions.one();
        counters.segments_committed.add(tally.segments);
        counters.mission_reports_committed.add(tally.reports);
        counters.reports_foreign.add(tally.foreign);
        counters.segments_deferred.add(tally.deferred);
        if tally.reports > 0 {
            self.app.wake();
        }
        Ok(outcomes)
    }

    /// Converts a time of the robot's wall clock to the server's, accurate to a few milliseconds;
    /// `None` unless the batch is of the robot's present run.
    fn to_server_time(&self, upload: &Upload, at: Timestamp) -> Option<Timestamp> {
        let key = (upload.site.clone(), upload.batch.robot.clone());
        let presence = self.app.presences().get(&key);
        let (boot, _since) = presence.boot()?;
        let ahead = SignedDuration::from_millis(presence.clock_offset_ms());
        (boot == upload.batch.boot)
            .then(|| at.checked_sub(ahead).ok())
            .flatten()
    }

    /// Returns who reports on a mission and when, with the progress that the robot showed last.
    fn reporting(
        &self,
        upload: &Upload,
        robot_pk: i64,
        report: &MissionReport,
        (now, skew): (Timestamp, Skew),
    ) -> Reporting {
        let at = skew.corrected(report.at);
        let since = report
            .since
            .and_then(|since| self.to_server_time(upload, since));
        let key = (upload.site.clone(), upload.batch.robot.clone());
        Reporting {
            robot_pk,
            boot: upload.batch.boot,
            now,
            at,
            since: since.unwrap_or(at),
            shown: self.app.presences().get(&key).progress_of(report.mission),
            restored_at: self.app.restoration().map(|(newest, _)| newest.restored_at),
        }
    }

    async fn commit_once(
        &mut self,
        group: &[Upload],
    ) -> Result<(Vec<Outcome>, TransactionCounts), DbError> {
        let mut outcomes: Vec<Outcome> = Vec::with_capacity(group.len());
        let records = group.iter().map(|upload| upload.batch.records.len());
        let mut candidates = Vec::with_capacity(records.sum());
        let (mut tally, app) = (TransactionCounts::default(), self.app.clone());
        app.bound_unwritten_sums().await?;
        let turn = app.lock_map_for_write().await?;
        let mut tx = app.db().write_uncounted("ingest").await?;
        // One look for deferred segments of the whole group: there are hardly ever some.
        let is_any_deferred = db::deferred_segments::is_any(&mut tx).await?;
        let now = app.clock().now();
        for (index, upload) in group.iter().enumerate() {
            let batch = &upload.batch;
            let Admitted {
                of,
                boot_pk,
                mut configurations,
            } = match self.admit(&mut tx, upload).await? {
                Ok(admitted) => admitted,
                Err(refused) => {
                    outcomes.push(Err(refused));
                    continue;
                }
            };
            let (site_pk, robot_pk, grid) = (of.site_pk, of.robot_pk, of.grid);
            let skew = Skew::of(batch.robot_time, now);
            let candidate = |upload, key, configuration_pk, ready| Candidate {
                upload,
                key,
                site_pk,
                robot_pk,
                configuration_pk,
                robot: &batch.robot,
                ready,
            };
            if is_any_deferred && batch.robot_time.is_some() {
                for (key, ready) in released(&mut tx, boot_pk, &grid, skew).await? {
                    // The key was cached when the segment was deferred.
                    let id = ready.segment.configuration;
                    let found = db::robots::record_measured(&mut tx, robot_pk, id).await?;
                    candidates.push(candidate(None, key, found, ready));
                    configurations.insert(id, found);
                }
            }
            let mut receipt = Receipt {
                committed: 0,
                duplicates: 0,
                refused: Vec::new(),
            };
            for record in &batch.records {
                let seq = record.seq;
                let mut refuse = |reason| receipt.refused.push(RefusedRecord { seq, reason });
                let Some(key) = record_key(boot_pk, seq) else {
                    refuse("seq is beyond 2^53".to_owned());
                    continue;
                };
                match &record.content {
                    RecordContent::Segment(segment) => {
                        match possible(segment, &grid, skew, &configurations) {
                            Ok((configuration, Prepared::Ready(ready))) => {
                                candidates.push(candidate(Some(index), key, configuration, ready));
                            }
                            Ok((_, Prepared::Ahead(measurement))) => {
                                let origin = Origin {
                                    key,
                                    site_pk,
                                    robot_pk,
                                };
                                match defer(&mut tx, origin, segment, now, &measurement).await? {
                                    Ok(true) => {
                                        receipt.committed += 1;
                                        tally.deferred += 1;
                                    }
                                    Ok(false) => receipt.duplicates += 1,
                                    Err(reason) => refuse(reason),
                                }
                            }
                            Err(reason) => refuse(reason),
                        }
                    }
                    RecordContent::Mission(report) => {
                        let of = self.reporting(upload, robot_pk, report, (now, skew));
                        let taken = self.apply_report(&mut tx, of, key, report, &mut tally);
                        let taken = taken.await?;
                        tally.record_report(taken, seq, &mut receipt);
                    }
                }
            }
            count_refused(&mut tx, robot_pk, &receipt).await?;
            outcomes.push(Ok(receipt));
        }
        let (folded, added) = self
            .insert(&mut tx, &candidates, now, &mut outcomes, &mut tally)
            .await?;
        let alerts = tally.alerts.clone();
        turn.commit(tx, MapChange::Add(folded, added), alerts)
            .await?;
        Ok((outcomes, tally))
    }

    /// Applies a report with its alerts, unless it was applied before; then it returns `None`.
    async fn apply_report(
        &self,
        tx: &mut Tx,
        of: Reporting,
        key: RecordKey,
        report: &MissionReport,
        tally: &mut TransactionCounts,
    ) -> Result<Option<Result<ReportEffect, Foreign>>, DbError> {
        let robot_pk = of.robot_pk;
        let taken = apply_new_report(tx, of, key, report).await?;
        if let Some(Ok(taken)) = &taken {
            let alerts = self.app.alert_report(tx, robot_pk, report, taken);
            tally.alerts.extend(alerts.await?);
        }
        Ok(taken)
    }

    /// Returns the database keys of a batch, or the reason why all of it is refused.
    async fn admit(
        &mut self,
        tx: &mut Tx,
        upload: &Upload,
    ) -> Result<Result<Admitted, Refusal>, DbError> {
        let (app, batch) = (self.app.clone(), &upload.batch);
        let named = (upload.site.clone(), batch.robot.clone());
        let found = self.keys.robot(&app, tx, (&named.0, &named.1)).await?;
        if let Some(refused) = refused_whole(upload, found.is_some()) {
            return Ok(Err(refused));
        }
        let busy = |detail| Ok(Err(refusal(RefusalCode::Busy, detail)));
        let Some(of) = found else {
            return busy("the robot is not known here");
        };
        let Some(boot_pk) = self.keys.boot(&app, tx, upload, of.robot_pk).await? else {
            return busy("the robot's agent has begun too many runs of late");
        };
        let mut configurations = HashMap::new();
        for id in measured_with(batch) {
            let robot = (&named, of.robot_pk);
            match self.keys.configuration(&app, tx, robot, id).await? {
                Configured::As(pk) => {
                    configurations.insert(id, pk);
                }
                Configured::Later => {
                    return busy("the robot has measured with too many new configurations of late");
                }
                Configured::Never => {}
            }
        }
        Ok(Ok(Admitted {
            of,
            boot_pk,
            configurations,
        }))
    }

    /// Stores segments. Returns the sums of those that are new and not withdrawn, and the keys of
    /// all that are new.
    async fn insert(
        &mut self,
        tx: &mut Tx,
        candidates: &[Candidate<'_>],
        now: Timestamp,
        outcomes: &mut [Outcome],
        tally: &mut TransactionCounts,
    ) -> Result<(Vec<Folded>, Added), DbError> {
        let removed = self.app.removed();
        let keys = &mut self.keys;
        let mut stored = Deduplication::read(tx, candidates, removed, keys).await?;
        let withdrawals = db::withdrawals::all(tx).await?;
        let mut rows = Vec::with_capacity(candidates.len());
        let mut folded: Vec<Folded> = Vec::new();
        for candidate in candidates {
            // A segment that occurs twice in this group is new once.
            let is_new = stored.insert(candidate.key);
            let upload = candidate.upload.and_then(|upload| outcomes.get_mut(upload));
            if let Some(Ok(receipt)) = upload {
                if is_new {
                    receipt.committed += 1;
                } else {
                    receipt.duplicates += 1;
                }
            }
            if !is_new {
                continue;
            }
            tally.segments += 1;
            rows.push(candidate.row());
            let Ready {
                segment,
                times_ns,
                sums,
            } = &candidate.ready;
            let epoch_h = epoch_h_at(us_of(times_ns.1));
            let is_withdrawn = |row: &WithdrawalRow| {
                row.robot_pk == candidate.robot_pk && row.hours.contains(epoch_h)
            };
            if withdrawals.iter().any(is_withdrawn) {
                continue;
            }
            let last = folded.last_mut();
            match last.filter(|last| candidate.belongs_to(last, epoch_h)) {
                Some(last) => last.cells.push((segment.cell, *sums)),
                None => folded.push(Folded {
                    key: SumKey {
                        site_pk: candidate.site_pk,
                        cell: segment.cell,
                        grid_revision: segment.grid_revision,
                        terrain: segment.terrain.clone(),
                        robot_pk: candidate.robot_pk,
                        configuration_pk: candidate.configuration_pk,
                        epoch_h,
                    },
                    robot: candidate.robot.clone(),
                    configuration: segment.configuration,
                    cells: vec![(segment.cell, *sums)],
                }),
            }
        }
        let added = db::segments::insert(tx, &rows, now).await?;
        Ok((folded, added))
    }
}

/// Returns the key of a record; `None` if its number is beyond [`SEQ_MAX`].
fn record_key(boot_pk: i64, seq: u64) -> Option<RecordKey> {
    let seq = i64::try_from(seq).ok().filter(|_| seq < SEQ_MAX)?;
    Some(RecordKey { boot_pk, seq })
}

/// Returns the configurations that a batch measured with.
fn measured_with(batch: &Batch) -> HashSet<ConfigurationId> {
    let mut found = HashSet::new();
    let mut last = None;
    for record in &batch.records {
        if let RecordContent::Segment(segment) = &record.content
            && last != Some(segment.configuration)
        {
            last = Some(segment.configuration);
            found.insert(segment.configuration);
        }
    }
    found
}

/// Checks a segment. Returns it with the key of its configuration, or the reason why it is refused.
fn possible<'segment>(
    segment: &'segment Segment,
    grid: &Grid,
    skew: Skew,
    configurations: &HashMap<ConfigurationId, i64>,
) -> Result<(i64, Prepared<'segment>), String> {
    let prepared = prepared(Cow::Borrowed(segment), grid, skew)?;
    let configuration = configurations.get(&segment.configuration).ok_or_else(|| {
        format!("the robot has measured with {CONFIGURATIONS_MAX} other configurations")
    })?;
    Ok((*configuration, prepared))
}

fn refusal(code: RefusalCode, detail: &str) -> Refusal {
    Refusal {
        code,
        detail: detail.to_owned(),
    }
}

/// Counts on the robot's row the records that were refused for ever.
async fn count_refused(tx: &mut Tx, robot_pk: i64, receipt: &Receipt) -> Result<(), DbError> {
    let Some(last) = receipt.refused.last() else {
        return Ok(());
    };
    let count = receipt.refused.len() as u64;
    db::robots::count_refused(tx, robot_pk, count, &last.reason).await?;
    Ok(())
}

/// Returns the refusal of a whole batch; `None` if its records are to be checked one by one.
fn refused_whole(group: &Upload, is_known: bool) -> Option<Refusal> {
    if group.batch.records.len() > BATCH_RECORDS_MAX {
        let detail = format!("a batch has at most {BATCH_RECORDS_MAX} records");
        return Some(refusal(RefusalCode::Malformed, &detail));
    }
    let detail = "the robot is not known here: say hello first";
    (!is_known).then(|| refusal(RefusalCode::Busy, detail))
}

/// Takes the deferred segments of a run whose clock is known now.
async fn released(
    tx: &mut Tx,
    boot_pk: i64,
    grid: &Grid,
    skew: Skew,
) -> Result<Vec<(RecordKey, Ready<'static>)>, DbError> {
    let filter = DeferredFilter {
        boot_pk,
        ended_until_us: skew.latest_us(),
    };
    let waiting = db::deferred_segments::take(tx, filter, RELEASED_MAX).await?;
    let ready = |waiting: db::deferred_segments::DeferredSegment| match prepared(
        Cow::Owned(waiting.segment),
        grid,
        skew,
    ) {
        Ok(Prepared::Ready(ready)) => {
            let seq = waiting.seq;
            Some((RecordKey { boot_pk, seq }, ready))
        }
        // It was valid when it arrived, and its time is no longer in the future.
        Ok(Prepared::Ahead(_)) | Err(_) => None,
    };
    Ok(waiting.into_iter().filter_map(ready).collect())
}

/// Defers a segment with a time in the future until the clock of its run is known. Returns whether
/// it is new, or the reason why it cannot be deferred.
async fn defer(
    tx: &mut Tx,
    origin: Origin,
    segment: &Segment,
    received_at: Timestamp,
    measurement: &RawValue,
) -> Result<Result<bool, String>, DbError> {
    if db::deferred_segments::count(tx, origin.robot_pk).await? >= DEFERRED_MAX {
        return Ok(Err(format!(
            "{DEFERRED_MAX} of this robot's measurements already wait for their clock"
        )));
    }
    let times = DeferredTimes {
        ended_at: segment.ended_at,
        received_at,
    };
    let put = db::deferred_segments::put(tx, origin, times, measurement);
    Ok(Ok(put.await?))
}

/// Applies a report, unless it was applied before; then it returns `None`.
async fn apply_new_report(
    tx: &mut Tx,
    reporting: Reporting,
    key: RecordKey,
    report: &MissionReport,
) -> Result<Option<Result<ReportEffect, Foreign>>, DbError> {
    if db::history::has_report(tx, key).await? {
        return Ok(None);
    }
    let taken = apply_mission_report(tx, reporting, report).await?;
    // A refused report is not recorded, so that it is refused again and not counted as a duplicate.
    if taken.is_ok() {
        db::history::record_report(tx, key).await?;
    }
    Ok(Some(taken))
}
