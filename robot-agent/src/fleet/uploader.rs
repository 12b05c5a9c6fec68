//! Brings the outbox to the server: one batch at a time, oldest first, again until answered.

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::watch;
use tokio_util::sync::CancellationToken;
use tracing::{error, info, warn};
use tread_api::wire::ingest::{BATCH_RECORDS_MAX, Receipt, RefusedRecord};

use super::{AskError, FleetLink, may_pass_later};
use crate::clock::SharedClock;
use crate::outbox::{Outbox, OutboxError, PendingBatch};

/// First pause after a failure.
pub const BACKOFF_FIRST: Duration = Duration::from_millis(100);
/// Longest pause between two tries.
pub const BACKOFF_MAX: Duration = Duration::from_secs(5);

/// Pauses that grow with each failure in a row.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Backoff {
    next: Duration,
}

impl Backoff {
    pub(crate) fn new() -> Self {
        Self {
            next: BACKOFF_FIRST,
        }
    }

    pub(crate) fn grow(&mut self) -> Duration {
        let pause = self.next;
        self.next = (2 * self.next).min(BACKOFF_MAX);
        pause
    }
}

/// Uploads for ever, once the server has welcomed the robot.
pub async fn run(
    link: Arc<FleetLink>,
    outbox: Outbox,
    clock: SharedClock,
    mut is_welcome: watch::Receiver<bool>,
    stop: CancellationToken,
) {
    let uploading = async {
        if is_welcome.wait_for(|welcome| *welcome).await.is_err() {
            return;
        }
        let mut server_seen = link.server_seen();
        let mut backoff = Backoff::new();
        let mut records_max = BATCH_RECORDS_MAX;
        loop {
            match upload_next(&link, &outbox, &clock, records_max).await {
                Ok(Next::Empty) => outbox.arrived().await,
                Ok(Next::Settled) => {
                    backoff = Backoff::new();
                    records_max = (2 * records_max).min(BATCH_RECORDS_MAX);
                }
                Ok(Next::TryFewer(fewer)) => records_max = fewer,
                Ok(Next::TryLater) => {
                    tokio::select! {
                        () = tokio::time::sleep(backoff.grow()) => {}
                        // The server is back: no need to sit the pause out.
                        changed = server_seen.changed() => if changed.is_err() { return },
                    }
                }
                Err(cause) => {
                    error!(
                        error = &cause as &dyn std::error::Error,
                        "the outbox failed"
                    );
                    tokio::time::sleep(backoff.grow()).await;
                }
            }
        }
    };
    tokio::select! {
        () = uploading => {}
        () = stop.cancelled() => {}
    }
}

enum Next {
    Empty,
    Settled,
    TryFewer(usize),
    TryLater,
}

async fn upload_next(
    link: &Arc<FleetLink>,
    outbox: &Outbox,
    clock: &SharedClock,
    records_max: usize,
) -> Result<Next, OutboxError> {
    let reading = outbox.clone();
    let reading = tokio::task::spawn_blocking(move || reading.pending(records_max));
    let Ok(pending) = reading.await else {
        return Ok(Next::TryLater);
    };
    let Some(mut sent) = pending? else {
        return Ok(Next::Empty);
    };
    // The server puts the records' times right by it, should this clock be wrong.
    sent.batch.robot_time = Some(clock.wall());
    match link.upload(&sent.batch).await {
        Ok(receipt) => {
            let records = sent.batch.records.len();
            if receipt.duplicates > 0 {
                let duplicates = receipt.duplicates;
                info!(
                    records,
                    duplicates, "the server had {duplicates} records before"
                );
            }
            settle(outbox, sent, receipt).await?;
            Ok(Next::Settled)
        }
        Err(cause) if may_pass_later(&cause) => {
            log_refused(&cause);
            Ok(Next::TryLater)
        }
        // The server cannot read the batch. Find the record that it stumbles over, so that the
        // others pass, and set it aside.
        Err(cause) => match sent.batch.records.as_slice() {
            [only] => {
                let refusal = RefusedRecord {
                    seq: only.seq,
                    reason: cause.to_string(),
                };
                let receipt = Receipt {
                    committed: 0,
                    duplicates: 0,
                    refused: vec![refusal],
                };
                settle(outbox, sent, receipt).await?;
                Ok(Next::Settled)
            }
            several => Ok(Next::TryFewer(several.len() / 2)),
        },
    }
}

async fn settle(outbox: &Outbox, sent: PendingBatch, receipt: Receipt) -> Result<(), OutboxError> {
    let outbox = outbox.clone();
    let settling = tokio::task::spawn_blocking(move || outbox.settle(&sent, &receipt));
    // An aborted settlement leaves the batch where it was.
    settling.await.unwrap_or(Ok(()))
}

fn log_refused(cause: &AskError) {
    match cause {
        // What an absent server looks like; the link logs that.
        AskError::NoAnswer => {}
        AskError::Refused(refusal) => {
            warn!(code = ?refusal.code, "the server refused an upload: {}", refusal.detail);
        }
        AskError::Unreadable(_) | AskError::Unwritable(_) | AskError::Link(_) => {
            warn!(error = cause as &dyn std::error::Error, "an upload failed");
        }
    }
}
