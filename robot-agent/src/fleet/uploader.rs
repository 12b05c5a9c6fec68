//! Uploads the outbox to the server: one batch at a time, oldest first, repeated until answered.

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
/// Longest pause between two attempts.
pub const BACKOFF_MAX: Duration = Duration::from_secs(5);

/// Target duration of one upload including its receipt.
const UPLOAD_AIM: Duration = Duration::from_secs(1);

/// Pauses that double with each consecutive failure, up to [`BACKOFF_MAX`].
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

/// Number of records per upload, adapted so that an upload takes about [`UPLOAD_AIM`]. On a slow
/// link a full batch would exceed the timeout of its receipt every time.
#[derive(Debug, Clone, Copy)]
struct BatchSize {
    records_max: usize,
}

impl BatchSize {
    fn new() -> Self {
        Self {
            records_max: BATCH_RECORDS_MAX,
        }
    }

    /// Adapts the size to a batch that was answered after `took`.
    fn record_success(&mut self, took: Duration) {
        if took > 2 * UPLOAD_AIM {
            self.halve();
        } else if took < UPLOAD_AIM {
            self.records_max = (2 * self.records_max).min(BATCH_RECORDS_MAX);
        }
    }

    /// Adapts the size to a batch that was not answered: an absent server fails at once, a slow
    /// link late.
    fn record_failure(&mut self, took: Duration) {
        if took > UPLOAD_AIM {
            self.halve();
        }
    }

    fn halve(&mut self) {
        self.records_max = (self.records_max / 2).max(1);
    }
}

/// Uploads until requested to stop, once the server has welcomed the robot.
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
        let mut size = BatchSize::new();
        loop {
            let begin = clock.monotonic();
            let next = upload_next(&link, &outbox, &clock, size.records_max).await;
            let took = clock.monotonic().saturating_sub(begin);
            match next {
                Ok(Next::Empty) => outbox.arrived().await,
                Ok(Next::Settled) => {
                    backoff = Backoff::new();
                    size.record_success(took);
                }
                Ok(Next::TryFewer(fewer)) => size.records_max = fewer,
                Ok(Next::TryLater) => {
                    size.record_failure(took);
                    tokio::select! {
                        () = tokio::time::sleep(backoff.grow()) => {}
                        // The server is reachable again: the pause ends.
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
    // The server corrects the records' times by it, should this clock be wrong.
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
        // The server cannot read the batch. Halve it until the unreadable record is alone, and move
        // that to the dead letters.
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
    // An aborted settlement leaves the batch in the outbox.
    settling.await.unwrap_or(Ok(()))
}

fn log_refused(cause: &AskError) {
    match cause {
        // The usual result of an absent server, which the link logs.
        AskError::NoAnswer => {}
        AskError::Refused(refusal) => {
            warn!(code = ?refusal.code, "the server refused an upload: {}", refusal.detail);
        }
        AskError::Unreadable(_) | AskError::Unwritable(_) | AskError::Link(_) => {
            warn!(error = cause as &dyn std::error::Error, "an upload failed");
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::super::UPLOAD_TIMEOUT;
    use super::*;

    proptest! {
        #[test]
        fn on_any_link_batches_soon_fit_their_timeout_and_make_use_of_it(
            records_per_s in 2.0_f64..1e5,
            round_trip_ms in 0_u64..600,
        ) {
            let mut size = BatchSize::new();
            let mut took = Duration::ZERO;
            for upload in 0..40 {
                #[expect(clippy::cast_precision_loss, reason = "a small count")]
                let sending_s = size.records_max as f64 / records_per_s;
                took = Duration::from_millis(round_trip_ms) + Duration::from_secs_f64(sending_s);
                let is_answered = took <= UPLOAD_TIMEOUT;
                prop_assert!(is_answered || upload < 12, "upload {upload} takes {took:?}");
                if is_answered {
                    size.record_success(took);
                } else {
                    size.record_failure(UPLOAD_TIMEOUT);
                }
            }
            prop_assert!(took <= 4 * UPLOAD_AIM || size.records_max == 1);
            let is_busy = 4 * took >= UPLOAD_AIM || size.records_max == BATCH_RECORDS_MAX;
            prop_assert!(is_busy, "{} records take {took:?}", size.records_max);
        }
    }

    #[test]
    fn an_absent_server_makes_batches_no_smaller() {
        let mut size = BatchSize::new();
        for _ in 0..100 {
            size.record_failure(Duration::from_millis(1));
        }
        assert_eq!(size.records_max, BATCH_RECORDS_MAX);
    }
}
