//! The outbox: durable records on the robot's disk until the server has acknowledged them.
//!
//! ```text
//! append → pending → (server's receipt) → settled
//!             │             └─ refused → dead-letter file, settled
//!             └─ store full, or damaged on the disk → dropped, counted
//! ```
//!
//! Records are identified by `(robot, boot, seq)`; the server ignores duplicates, so a record is
//! sent again whenever its receipt was lost. Syncs are batched: a crash loses at most what was
//! appended within [`SYNC_DELAY`]. This module is independent of zenoh.

mod bounded_file;
mod damage;
mod dead_letters;
mod error;
mod files;
mod frame;
mod head_file;
mod recovery;
mod store;

use std::fs::{self, File, TryLockError};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::sync::Notify;
use tokio_util::sync::CancellationToken;
use tracing::{error, warn};
use tread_api::ids::{BootId, RobotId};
use tread_api::robot::OutboxStatus;
use tread_api::wire::ingest::{BATCH_RECORDS_MAX, Batch, Receipt, Record, RecordContent};

use dead_letters::{DeadLetter, DeadLetters};
pub use error::StoreError;
pub use frame::CONTENT_BYTES_MAX;
pub use store::Limits;
use store::{Settled, Store};

/// Longest delay between appending a record and syncing it to disk.
pub const SYNC_DELAY: Duration = Duration::from_millis(100);
/// Largest content of one batch, bytes.
pub const BATCH_BYTES_MAX: u64 = 1024 * 1024;

/// Errors of the outbox.
#[derive(Debug, thiserror::Error)]
pub enum OutboxError {
    /// A file operation failed.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// Another agent uses the same folder.
    #[error("`{}` is in use by another agent", .0.display())]
    InUse(PathBuf),
    /// The lock file cannot be made or locked.
    #[error("`{}` cannot be locked", path.display())]
    Lock {
        /// The lock file.
        path: PathBuf,
        /// Error of the operating system.
        #[source]
        source: std::io::Error,
    },
    /// A record could not be written as JSON.
    #[error("a record cannot be written as JSON")]
    Content(#[source] serde_json::Error),
}

/// The oldest waiting records of one run, ready to be sent.
#[derive(Debug, Clone)]
pub struct PendingBatch {
    /// The message to the server.
    pub batch: Batch,
    through_ordinal: u64,
}

/// Damage of the outbox's files.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct OutboxDamage {
    /// Number of records lost by damage since the store was made.
    pub lost_records: u64,
    /// File of the damaged bytes, until a person has removed it and the agent has restarted.
    pub kept_in: Option<PathBuf>,
}

/// Handle to one robot's outbox; clones share it.
#[derive(Debug, Clone)]
pub struct Outbox {
    shared: Arc<Shared>,
}

#[derive(Debug)]
struct Shared {
    robot: RobotId,
    folder: PathBuf,
    store: Mutex<Store>,
    /// Serialises syncs, so that no older head overwrites a newer one.
    syncing: Mutex<()>,
    dead_letters: Mutex<DeadLetters>,
    /// Number of records that will be appended soon.
    expected: AtomicU64,
    /// Notified when a record is appended, for the uploader.
    arrived: Notify,
    /// Notified when a change must be synced.
    unsynced: Notify,
    /// Lock held while the outbox is open, so that no second agent writes here.
    _lock: File,
}

/// Guard of a record that will be appended soon.
#[derive(Debug)]
pub(crate) struct ExpectedRecord(Arc<Shared>);

impl Drop for ExpectedRecord {
    fn drop(&mut self) {
        self.0.expected.fetch_sub(1, Ordering::Relaxed);
    }
}

fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // Each step of the store leaves it consistent.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Outbox {
    /// Opens the outbox in a folder, creating it if missing; repairs files that a crash left torn.
    ///
    /// # Errors
    /// [`OutboxError`] if the folder cannot be used or another agent uses it.
    pub fn open(
        folder: &Path,
        limits: Limits,
        robot: RobotId,
        boot: BootId,
    ) -> Result<Self, OutboxError> {
        let lock_path = folder.join("lock");
        let lock_failed = |source| OutboxError::Lock {
            path: lock_path.clone(),
            source,
        };
        fs::create_dir_all(folder).map_err(lock_failed)?;
        let lock = File::create(&lock_path).map_err(lock_failed)?;
        match lock.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => return Err(OutboxError::InUse(folder.to_owned())),
            Err(TryLockError::Error(source)) => return Err(lock_failed(source)),
        }
        let (store, recovery) = Store::open(folder, limits, boot)?;
        if recovery.torn_bytes > 0 {
            let torn_bytes = recovery.torn_bytes;
            warn!(torn_bytes, "repaired the outbox after a crash");
        }
        if recovery.damaged_bytes > 0 || recovery.lost_records > 0 {
            let (bytes, lost) = (recovery.damaged_bytes, recovery.lost_records);
            error!(
                damaged_bytes = bytes,
                lost_records = lost,
                "files of the outbox `{}` are damaged: {lost} records are lost",
                folder.display(),
            );
        }
        let dead_letters = DeadLetters::new(folder);
        Ok(Self {
            shared: Arc::new(Shared {
                robot,
                folder: folder.to_owned(),
                store: Mutex::new(store),
                syncing: Mutex::default(),
                dead_letters: Mutex::new(dead_letters),
                expected: AtomicU64::new(0),
                arrived: Notify::new(),
                unsynced: Notify::new(),
                _lock: lock,
            }),
        })
    }

    /// Appends a record and returns its number within this run.
    ///
    /// # Errors
    /// [`OutboxError`] if the record cannot be written or is too large; it is not kept then.
    pub fn append(&self, content: &RecordContent) -> Result<u64, OutboxError> {
        let content = serde_json::to_vec(content).map_err(OutboxError::Content)?;
        let name = locked(&self.shared.store).append(&content)?;
        self.shared.arrived.notify_one();
        self.shared.unsynced.notify_one();
        Ok(name.seq)
    }

    /// Returns the oldest waiting records of one run, at most `records_max`; `None` if none waits.
    ///
    /// # Errors
    /// [`OutboxError`] if the files cannot be read.
    pub fn pending(&self, records_max: usize) -> Result<Option<PendingBatch>, OutboxError> {
        let records_max = records_max.clamp(1, BATCH_RECORDS_MAX);
        loop {
            let raw = locked(&self.shared.store).oldest(records_max, BATCH_BYTES_MAX)?;
            let Some(&(first, _)) = raw.first() else {
                return Ok(None);
            };
            let mut records = Vec::with_capacity(raw.len());
            let mut through_ordinal = first.ordinal;
            let mut unreadable = None;
            for (name, content) in raw {
                match serde_json::from_slice(&content) {
                    Ok(content) => records.push(Record {
                        seq: name.seq,
                        content,
                    }),
                    Err(cause) => {
                        unreadable = Some((name, content, cause.to_string()));
                        break;
                    }
                }
                through_ordinal = name.ordinal;
            }
            if let Some((name, content, cause)) = unreadable.filter(|_| records.is_empty()) {
                // Not readable by this version: moved to the dead letters, so that the records
                // behind it are sent.
                let text = String::from_utf8_lossy(&content);
                self.dead_letter(&DeadLetter {
                    boot: name.boot,
                    seq: name.seq,
                    reason: &cause,
                    content: &text,
                })?;
                locked(&self.shared.store).settle(Settled {
                    through_ordinal: name.ordinal,
                    refused: 1,
                });
                continue;
            }
            let batch = Batch {
                robot: self.shared.robot.clone(),
                boot: first.boot,
                robot_time: None,
                records,
            };
            return Ok(Some(PendingBatch {
                batch,
                through_ordinal,
            }));
        }
    }

    /// Settles a batch by the server's receipt; refused records go to the dead-letter file.
    ///
    /// # Errors
    /// [`OutboxError`] if the dead-letter file cannot be written; nothing is settled then.
    pub fn settle(&self, sent: &PendingBatch, receipt: &Receipt) -> Result<(), OutboxError> {
        let mut refused = 0;
        for refusal in &receipt.refused {
            let Some(record) = sent
                .batch
                .records
                .iter()
                .find(|record| record.seq == refusal.seq)
            else {
                continue;
            };
            let content = serde_json::to_string(&record.content).map_err(OutboxError::Content)?;
            self.dead_letter(&DeadLetter {
                boot: sent.batch.boot,
                seq: record.seq,
                reason: &refusal.reason,
                content: &content,
            })?;
            refused += 1;
        }
        locked(&self.shared.store).settle(Settled {
            through_ordinal: sent.through_ordinal,
            refused,
        });
        self.shared.unsynced.notify_one();
        Ok(())
    }

    fn dead_letter(&self, letter: &DeadLetter<'_>) -> Result<(), OutboxError> {
        let DeadLetter {
            boot, seq, reason, ..
        } = *letter;
        warn!(%boot, seq, reason, "record {seq} was refused and moved to the dead letters");
        locked(&self.shared.dead_letters).write(letter)?;
        Ok(())
    }

    /// Counts a record as pending that will be appended soon, until the guard is dropped.
    pub(crate) fn expect_record(&self) -> ExpectedRecord {
        self.shared.expected.fetch_add(1, Ordering::Relaxed);
        ExpectedRecord(Arc::clone(&self.shared))
    }

    /// Returns the numbers of records that wait, were dropped and were refused.
    pub fn status(&self) -> OutboxStatus {
        let store = locked(&self.shared.store);
        let head = store.head();
        let stored: u64 = store.pending_records().try_into().unwrap_or(u64::MAX);
        OutboxStatus {
            pending: stored.saturating_add(self.shared.expected.load(Ordering::Relaxed)),
            dropped: head.dropped,
            refused: head.refused,
        }
    }

    /// Returns the damage of the files.
    pub fn damage(&self) -> OutboxDamage {
        let store = locked(&self.shared.store);
        OutboxDamage {
            kept_in: store.damage(),
            lost_records: store.head().damaged,
        }
    }

    /// Returns the number of records ever appended in this folder, over all runs.
    pub fn appended(&self) -> u64 {
        locked(&self.shared.store).appended()
    }

    /// Waits until a record has been appended since the last call.
    pub async fn arrived(&self) {
        self.shared.arrived.notified().await;
    }

    /// Syncs all appended and settled records to disk. Blocks.
    ///
    /// # Errors
    /// [`OutboxError`] if the disk fails.
    pub fn sync(&self) -> Result<(), OutboxError> {
        let _syncing = locked(&self.shared.syncing);
        let ticket = locked(&self.shared.store).begin_sync()?;
        // The slow part, without the lock.
        ticket.run()?;
        Ok(locked(&self.shared.store).finish_sync(&ticket)?)
    }

    /// Syncs soon after each change, until requested to stop; then once more.
    pub async fn keep_synced(self, stop: CancellationToken) {
        while !stop.is_cancelled() {
            tokio::select! {
                () = self.shared.unsynced.notified() => {}
                () = stop.cancelled() => {}
            }
            // Collects further changes; this pause and the sync itself bound what a crash can lose.
            tokio::select! {
                () = tokio::time::sleep(SYNC_DELAY / 2) => {}
                () = stop.cancelled() => {}
            }
            let outbox = self.clone();
            match tokio::task::spawn_blocking(move || outbox.sync()).await {
                Ok(Ok(())) => {}
                Ok(Err(cause)) => {
                    let folder = self.shared.folder.display();
                    error!(
                        error = &cause as &dyn std::error::Error,
                        "cannot sync `{folder}`"
                    );
                    self.shared.unsynced.notify_one();
                    // Retry on a failing disk, but not in a busy loop.
                    tokio::time::sleep(SYNC_DELAY).await;
                }
                // Only when the runtime shuts down.
                Err(_) => return,
            }
        }
    }
}

#[cfg(test)]
mod damage_tests;
#[cfg(test)]
mod tests;
