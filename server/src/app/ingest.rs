//! The ingest writer: one task that stores what robots upload, many batches in one commit.
//!
//! Transactions begin at least [`GROUP_INTERVAL`] apart; what arrives meanwhile goes into the next
//! one, up to a bound. So one fsync serves many robots, and a lone upload waits for nobody. Only
//! newly inserted segments are folded into the cell sums, in the
//! same transaction, and the answer goes out after the commit. Sent twice is counted once.

use std::collections::{HashMap, HashSet};
use std::time::Duration;

use jiff::{SignedDuration, Timestamp};
use serde_json::value::{RawValue, to_raw_value};
use tokio::sync::{mpsc, oneshot};
use tokio::time::{Instant, timeout_at};
use tokio_util::sync::CancellationToken;
use tracing::{error, warn};
use tread_api::friction::Segment;
use tread_api::ids::{BootId, ConfigurationId, RobotId, SiteId};
use tread_api::wire::ingest::{
    BATCH_RECORDS_MAX, Batch, MissionReport, Receipt, RecordContent, RefusedRecord,
};
use tread_api::wire::{Refusal, RefusalCode};

use super::App;
use super::missions::reports::{Foreign, Reporting, take_report};
use crate::db::segments::{Inserted, NewSegment};
use crate::db::sums::SumKey;
use crate::db::{self, DbError, Tx};
use crate::friction::{Sums, epoch_h};

/// Uploads that wait for the writer.
pub const UPLOADS_WAITING_MAX: usize = 256;
/// Records of one transaction beyond which no further batch is taken in.
const GROUP_RECORDS_MAX: usize = 2_000;
/// Least time from the begin of one transaction to the begin of the next, while uploads come in
/// faster: a transaction has a price of its own, in processor time as well as on the disk.
const GROUP_INTERVAL: Duration = Duration::from_millis(25);
/// Integers on the wire and in JSON stay exact below this.
const SEQ_MAX: u64 = 1 << 53;
/// Keys kept in memory before they are looked up afresh.
const KEYS_MAX: usize = 100_000;

/// One batch of one robot, and where its answer goes.
#[derive(Debug)]
pub struct Upload {
    /// The site of the key that it came on.
    pub site: SiteId,
    /// The batch; its robot is the one of the key.
    pub batch: Batch,
    /// Where the answer goes.
    pub answer: oneshot::Sender<Result<Receipt, Refusal>>,
}

/// Stores uploads until the stop, then those that already wait.
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
        // Without the stop the queue never closes: its senders live as long as the network.
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

/// Keys of the database that do not change once they are written.
#[derive(Debug, Default)]
struct Keys {
    robots: HashMap<(SiteId, RobotId), (i64, i64)>,
    boots: HashMap<(i64, BootId), i64>,
    configurations: HashMap<ConfigurationId, i64>,
}

impl Keys {
    fn forget(&mut self) {
        *self = Self::default();
    }

    fn bound(&mut self) {
        if self.robots.len() + self.boots.len() + self.configurations.len() > KEYS_MAX {
            self.forget();
        }
    }

    async fn robot(
        &mut self,
        tx: &mut Tx,
        site: &SiteId,
        robot: &RobotId,
    ) -> Result<Option<(i64, i64)>, DbError> {
        let key = (site.clone(), robot.clone());
        if let Some(&found) = self.robots.get(&key) {
            return Ok(Some(found));
        }
        let Some(site_row) = db::sites::find(tx, site).await? else {
            return Ok(None);
        };
        let found = db::robots::find(tx, site_row.pk, robot).await?;
        let found = found.map(|row| (site_row.pk, row.pk));
        if let Some(found) = found {
            self.robots.insert(key, found);
        }
        Ok(found)
    }

    async fn boot(&mut self, tx: &mut Tx, robot_pk: i64, boot: BootId) -> Result<i64, DbError> {
        if let Some(&found) = self.boots.get(&(robot_pk, boot)) {
            return Ok(found);
        }
        let key = db::robots::boot_key(tx, robot_pk, boot).await?;
        self.boots.insert((robot_pk, boot), key);
        Ok(key)
    }

    async fn configuration(&mut self, tx: &mut Tx, id: ConfigurationId) -> Result<i64, DbError> {
        if let Some(&found) = self.configurations.get(&id) {
            return Ok(found);
        }
        let key = db::robots::configuration_key(tx, id).await?;
        self.configurations.insert(id, key);
        Ok(key)
    }
}

/// A segment that is possible, ready to be stored.
struct Candidate<'batch> {
    upload: usize,
    keys: (i64, i64),
    site_pk: i64,
    robot_pk: i64,
    segment: &'batch Segment,
    ended_at: Timestamp,
    sums: Sums,
    measurement: Box<RawValue>,
}

/// What became of one batch.
type Outcome = Result<Receipt, Refusal>;

/// What a transaction did beyond its answers.
#[derive(Debug, Default)]
struct Tally {
    segments: u64,
    reports: u64,
    foreign: u64,
}

impl Writer {
    /// A writer that remembers no keys yet.
    pub fn new(app: App) -> Self {
        Self {
            app,
            keys: Keys::default(),
        }
    }

    /// Stores a group, or, if that fails, each of its batches alone; then answers.
    pub async fn store(&mut self, group: Vec<Upload>) {
        let outcomes = match self.commit(&group).await {
            Ok(outcomes) => outcomes,
            Err(cause) => {
                error!("cannot store a group of {} batches: {cause:?}", group.len());
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
            // Who asked may have gone; the robot will ask again and hear of duplicates.
            let _ = upload.answer.send(outcome);
        }
    }

    async fn commit(&mut self, group: &[Upload]) -> Result<Vec<Outcome>, DbError> {
        self.keys.bound();
        let result = self.commit_once(group).await;
        if result.is_err() {
            // Keys of a transaction that was rolled back name nothing.
            self.keys.forget();
        }
        let (outcomes, tally) = result?;
        let counters = self.app.counters();
        counters.ingest_transactions.one();
        counters.segments_committed.add(tally.segments);
        counters.mission_reports_committed.add(tally.reports);
        counters.reports_foreign.add(tally.foreign);
        if tally.reports > 0 {
            self.app.wake();
        }
        Ok(outcomes)
    }

    async fn commit_once(&mut self, group: &[Upload]) -> Result<(Vec<Outcome>, Tally), DbError> {
        let mut outcomes: Vec<Outcome> = Vec::with_capacity(group.len());
        let mut candidates = Vec::new();
        let mut tally = Tally::default();
        let mut tx = self.app.db().write().await?;
        let now = self.app.clock().now();
        for (index, upload) in group.iter().enumerate() {
            let Upload { site, batch, .. } = upload;
            if batch.records.len() > BATCH_RECORDS_MAX {
                let detail = format!("a batch has at most {BATCH_RECORDS_MAX} records");
                outcomes.push(Err(refusal(RefusalCode::Malformed, &detail)));
                continue;
            }
            let Some((site_pk, robot_pk)) = self.keys.robot(&mut tx, site, &batch.robot).await?
            else {
                let detail = "the robot is not known here: say hello first";
                outcomes.push(Err(refusal(RefusalCode::Busy, detail)));
                continue;
            };
            let boot_pk = self.keys.boot(&mut tx, robot_pk, batch.boot).await?;
            let skew = Skew::of(batch.robot_time, now);
            let put_right = |at| skew.put_right(at, now);
            let mut receipt = Receipt {
                committed: 0,
                duplicates: 0,
                refused: Vec::new(),
            };
            for record in &batch.records {
                let seq = record.seq;
                let mut refuse = |reason| receipt.refused.push(RefusedRecord { seq, reason });
                let Some(seq_key) = i64::try_from(seq).ok().filter(|_| seq < SEQ_MAX) else {
                    refuse("seq is beyond 2^53".to_owned());
                    continue;
                };
                let keys = (boot_pk, seq_key);
                match &record.content {
                    RecordContent::Segment(segment) => match prepared(segment, put_right) {
                        Ok((ended_at, sums, measurement)) => candidates.push(Candidate {
                            upload: index,
                            keys,
                            site_pk,
                            robot_pk,
                            segment,
                            ended_at,
                            sums,
                            measurement,
                        }),
                        Err(reason) => refuse(reason),
                    },
                    RecordContent::Mission(report) => {
                        let of = Reporting {
                            robot_pk,
                            boot: batch.boot,
                            now,
                            at: put_right(report.at),
                        };
                        match take_new_report(&mut tx, of, keys, report).await? {
                            Some(Ok(())) => {
                                receipt.committed += 1;
                                tally.reports += 1;
                            }
                            Some(Err(Foreign(reason))) => {
                                refuse(reason);
                                tally.foreign += 1;
                            }
                            None => receipt.duplicates += 1,
                        }
                    }
                }
            }
            outcomes.push(Ok(receipt));
        }
        self.insert(&mut tx, &candidates, now, &mut outcomes, &mut tally)
            .await?;
        tx.commit().await?;
        Ok((outcomes, tally))
    }

    /// Stores segments and folds those that are new.
    async fn insert(
        &mut self,
        tx: &mut Tx,
        candidates: &[Candidate<'_>],
        now: Timestamp,
        outcomes: &mut [Outcome],
        tally: &mut Tally,
    ) -> Result<(), DbError> {
        let rows: Vec<NewSegment<'_>> = candidates
            .iter()
            .map(|candidate| {
                let terrain = candidate.segment.terrain.as_ref();
                let terrain = terrain.map_or("", |terrain| terrain.id.as_str());
                let Candidate {
                    keys,
                    robot_pk,
                    site_pk,
                    ref measurement,
                    ..
                } = *candidate;
                NewSegment(keys.0, keys.1, robot_pk, site_pk, terrain, measurement)
            })
            .collect();
        let mut new: Option<HashSet<(i64, i64)>> =
            match db::segments::insert_new(tx, &rows, now).await? {
                Inserted::All => None,
                Inserted::Only(keys) => Some(keys.into_iter().collect()),
            };
        let mut sums: HashMap<SumKey, Sums> = HashMap::new();
        for candidate in candidates {
            let Some(Ok(receipt)) = outcomes.get_mut(candidate.upload) else {
                continue;
            };
            // One that stands twice in this very group is new once.
            if new.as_mut().is_some_and(|new| !new.remove(&candidate.keys)) {
                receipt.duplicates += 1;
                continue;
            }
            receipt.committed += 1;
            tally.segments += 1;
            let segment = candidate.segment;
            let key = SumKey {
                site_pk: candidate.site_pk,
                cell: segment.cell,
                grid_revision: segment.grid_revision,
                terrain: segment.terrain.clone(),
                robot_pk: candidate.robot_pk,
                configuration_pk: self.keys.configuration(tx, segment.configuration).await?,
                epoch_h: epoch_h(candidate.ended_at),
            };
            let sum = sums.entry(key);
            sum.and_modify(|sum| sum.add(&candidate.sums))
                .or_insert(candidate.sums);
        }
        // In the order of the table, so that neighbours share their pages.
        let mut sums: Vec<(SumKey, Sums)> = sums.into_iter().collect();
        sums.sort_unstable_by_key(|(key, _)| (key.robot_pk, key.epoch_h, key.cell.iy, key.cell.ix));
        db::sums::add(tx, sums.iter().map(|(key, sums)| (key, sums))).await
    }
}

fn refusal(code: RefusalCode, detail: &str) -> Refusal {
    Refusal {
        code,
        detail: detail.to_owned(),
    }
}

/// How wrong a robot's clock is, from the time that it wrote on what it sent.
///
/// Small differences are the network's and are left alone, so that a segment has the same epoch
/// whenever it arrives. With a clock that is wrong by more, the spans are right and the date is
/// not; the server's date counts then.
#[derive(Debug, Clone, Copy)]
struct Skew(SignedDuration);

/// Differences that count as the network's.
const SKEW_MIN: SignedDuration = SignedDuration::from_secs(30);

impl Skew {
    fn of(robot_time: Option<Timestamp>, now: Timestamp) -> Self {
        let ahead = robot_time.map_or(SignedDuration::ZERO, |said| said.duration_since(now));
        Self(if ahead.abs() > SKEW_MIN {
            ahead
        } else {
            SignedDuration::ZERO
        })
    }

    /// A record from the future all the same is of an earlier run, whose clock was wrong and can no
    /// longer be asked; what has arrived cannot have been measured later than now.
    fn put_right(self, at: Timestamp, now: Timestamp) -> Timestamp {
        let at = at.checked_sub(self.0).unwrap_or(at);
        if at.duration_since(now) > SKEW_MIN {
            now
        } else {
            at
        }
    }
}

/// A segment with its times put right: when it ended, its sums, and its text.
fn prepared(
    segment: &Segment,
    put_right: impl Fn(Timestamp) -> Timestamp,
) -> Result<(Timestamp, Sums, Box<RawValue>), String> {
    segment.validate().map_err(|invalid| invalid.to_string())?;
    let mut segment = segment.clone();
    let span = segment.ended_at.duration_since(segment.started_at);
    segment.ended_at = put_right(segment.ended_at);
    let started_at = segment.ended_at.checked_sub(span);
    segment.started_at = started_at.unwrap_or(segment.ended_at);
    let sums = Sums::of(&segment).ok_or_else(|| "theta is out of range".to_owned())?;
    let measurement = to_raw_value(&segment).map_err(|error| error.to_string())?;
    Ok((segment.ended_at, sums, measurement))
}

/// Takes a report unless it was taken before; `None` says that it was.
async fn take_new_report(
    tx: &mut Tx,
    reporting: Reporting,
    (boot_pk, seq): (i64, i64),
    report: &MissionReport,
) -> Result<Option<Result<(), Foreign>>, DbError> {
    if db::history::has_report(tx, boot_pk, seq).await? {
        return Ok(None);
    }
    let taken = take_report(tx, reporting, report).await?;
    // A report that is refused is refused again, not called a duplicate.
    if taken.is_ok() {
        db::history::note_report(tx, boot_pk, seq).await?;
    }
    Ok(Some(taken))
}
