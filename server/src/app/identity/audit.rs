//! The audit log: written by one task beside the requests, so that none of them waits for it.
//!
//! Refused attempts are written too, but only so many: a stranger must not be able to push what
//! people did out of the log.

use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use jiff::{SignedDuration, Timestamp};
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;
use tread_api::identity::AuditEntry;
use tread_api::ids::TokenId;
use tread_api::page::Page;

use crate::app::{App, AppError, page};
use crate::db;
use crate::db::audit::AuditFilter;

/// Entries that may wait for the writer.
pub const WAITING_MAX: usize = 2_048;
/// Entries that are written at once.
const BATCH_MAX: usize = 256;
/// How long the writer waits for more before it writes.
const GATHER: Duration = Duration::from_millis(100);
/// Rest after the database failed.
const RETRY_REST: Duration = Duration::from_secs(1);
/// Entries that are kept.
pub const ENTRIES_MAX: u32 = 200_000;
/// How long entries are kept.
pub const KEPT: SignedDuration = SignedDuration::from_hours(400 * 24);
/// Old entries that are forgotten with each batch.
const FORGET_MAX: u32 = 1_000;
/// Refused attempts that are written at once.
const REFUSED_BURST: f64 = 60.0;
/// Refused attempts that are written per second over longer times.
const REFUSED_RATE_HZ: f64 = 1.0;

/// What the writer is told.
#[derive(Debug)]
enum Note {
    Entry(Box<AuditEntry>),
    Used(TokenId, Timestamp),
}

/// How many refused attempts may be written now.
#[derive(Debug)]
struct Allowance {
    left: f64,
    counted_at: Duration,
}

impl Allowance {
    fn take(&mut self, now: Duration) -> bool {
        let passed_s = now.saturating_sub(self.counted_at).as_secs_f64();
        self.left = (self.left + passed_s * REFUSED_RATE_HZ).min(REFUSED_BURST);
        self.counted_at = now;
        let may = self.left >= 1.0;
        if may {
            self.left -= 1.0;
        }
        may
    }
}

/// Where entries wait for the writer.
#[derive(Debug)]
pub(super) struct AuditLog {
    notes: mpsc::Sender<Note>,
    written: Mutex<Option<mpsc::Receiver<Note>>>,
    refused: Mutex<Allowance>,
}

impl Default for AuditLog {
    fn default() -> Self {
        let (notes, written) = mpsc::channel(WAITING_MAX);
        Self {
            notes,
            written: Mutex::new(Some(written)),
            refused: Mutex::new(Allowance {
                left: REFUSED_BURST,
                counted_at: Duration::ZERO,
            }),
        }
    }
}

impl App {
    /// Puts an entry into the audit log, soon and without waiting. A refused attempt
    /// (`is_change` false) may find that there were too many.
    pub fn audit(&self, entry: AuditEntry, is_change: bool) {
        let log = &self.identity().audit;
        if !is_change {
            let mut allowance = log.refused.lock().unwrap_or_else(PoisonError::into_inner);
            if !allowance.take(self.clock().elapsed()) {
                self.counters().audit_refusals_left_out.one();
                return;
            }
        }
        if log.notes.try_send(Note::Entry(Box::new(entry))).is_err() {
            self.counters().audit_dropped.one();
        }
    }

    pub(super) fn note_use(&self, token: TokenId, at: Timestamp) {
        // Only the time of a token's last use is lost; the next use brings it again.
        let _ = self.identity().audit.notes.try_send(Note::Used(token, at));
    }

    /// Entries of the audit log, newest first.
    pub async fn audit_log(
        &self,
        filter: &AuditFilter,
        limit: u32,
    ) -> Result<Page<AuditEntry>, AppError> {
        let mut tx = self.db().read().await?;
        let entries = db::audit::list(&mut tx, filter, limit + 1).await?;
        Ok(page(entries, limit, |entry| entry.id.to_string()))
    }

    async fn write_notes(&self, notes: &[Note]) -> Result<(), AppError> {
        let mut tx = self.db().write().await?;
        for note in notes {
            match note {
                Note::Entry(entry) => db::audit::insert(&mut tx, entry).await?,
                Note::Used(token, at) => db::tokens::touch(&mut tx, *token, *at).await?,
            }
        }
        if let Ok(before) = self.clock().now().checked_sub(KEPT) {
            db::audit::forget(&mut tx, before, ENTRIES_MAX, FORGET_MAX).await?;
        }
        Ok(tx.commit().await?)
    }
}

/// Writes the audit log until the stop, and then what still waits.
pub async fn run(app: App, stop: CancellationToken) {
    let waiting = &app.identity().audit.written;
    let waiting = waiting
        .lock()
        .unwrap_or_else(PoisonError::into_inner)
        .take();
    let Some(mut waiting) = waiting else {
        return;
    };
    let mut notes = Vec::new();
    loop {
        let is_stopping = tokio::select! {
            biased;
            _ = waiting.recv_many(&mut notes, BATCH_MAX) => stop.is_cancelled(),
            () = stop.cancelled() => true,
        };
        if !is_stopping {
            let gathering = async {
                while notes.len() < BATCH_MAX {
                    let room = BATCH_MAX - notes.len();
                    waiting.recv_many(&mut notes, room).await;
                }
            };
            tokio::select! {
                _ = tokio::time::timeout(GATHER, gathering) => {}
                () = stop.cancelled() => {}
            }
        }
        while let Err(error) = db::limited(app.write_notes(&notes)).await {
            app.log_failure("write entries of the audit log", &error);
            if stop.is_cancelled() {
                return;
            }
            tokio::time::sleep(RETRY_REST).await;
        }
        notes.clear();
        if is_stopping && waiting.is_empty() {
            return;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_flood_of_refusals_leaves_room_for_what_people_did() {
        let mut allowance = Allowance {
            left: REFUSED_BURST,
            counted_at: Duration::ZERO,
        };
        let hour_ms = 3_600_000;
        let written = (0..hour_ms)
            .filter(|&ms| allowance.take(Duration::from_millis(ms)))
            .count();
        assert!((3_600..=3_660).contains(&written), "{written}");
    }
}
