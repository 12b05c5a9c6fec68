//! Sends what the outbox of webhooks holds, at least once.
//!
//! ```text
//!            attempt succeeds
//!  pending ──────────────────► delivered
//!    │  ▲ │
//!    │  └─┘ attempt fails: again after a back-off that doubles, with jitter
//!    │
//!    ├── the last attempt fails, or it waited too long ──► failed
//!    └── too many others wait ───────────────────────────► dropped
//! ```
//!
//! Each webhook has at most one attempt under way, of its oldest delivery that is due; after one
//! that failed it rests. The outcome is stored before the webhook's next attempt; if the server ends
//! in between, the delivery is sent again with the same identifier.
//!
//! Alerts about the server say among other things that nothing can be stored. While that is so, they
//! are sent without the outbox, and once more from it later, with the same identifier.

use std::collections::{HashMap, HashSet};
use std::sync::Arc;
use std::time::Duration;

use jiff::{SignedDuration, Timestamp};
use sha2::{Digest as _, Sha256};
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;
use tread_api::ids::{DeliveryId, WebhookId};
use tread_api::webhook::DeliveryState;

use super::{LOG_MAX, body};
use crate::app::{App, AppError};
use crate::db;
use crate::db::webhooks::{AgeLimit, Due, DueTimes, Outcome};
use crate::webhooks::{Attempt, OutgoingDelivery, Sender};

/// Interval between looks at the outbox when nothing wakes the task.
pub const POLL_INTERVAL: Duration = Duration::from_secs(1);
/// Time after a failure of the database in which it is left to others.
const REST_AFTER_ERROR: Duration = Duration::from_secs(3);
/// Maximum number of attempts under way at once, at most one per webhook.
const ATTEMPTS_AT_ONCE_MAX: usize = 16;
/// Maximum number of attempts of a delivery.
pub const ATTEMPTS_MAX: u32 = 20;
/// Maximum age of a delivery at which it is still sent.
pub const AGE_MAX: SignedDuration = SignedDuration::from_hours(24);
/// Back-off after the first attempt; it doubles with each further one.
pub const RETRY_MIN: Duration = Duration::from_secs(10);
/// Maximum back-off.
pub const RETRY_MAX: Duration = Duration::from_hours(2);
/// Minimum time between a failed attempt and the next attempt for the same webhook, of any delivery.
pub const REST_AFTER_FAILURE: Duration = Duration::from_secs(5);

/// Origin of a delivery.
#[derive(Debug, Clone, PartialEq, Eq)]
enum DeliverySource {
    /// A row of the outbox: number of attempts before, and the time when it was queued.
    Queued {
        attempts: u32,
        created_at: Timestamp,
    },
    /// An alert about the server that could not be written to the outbox.
    Unwritten,
}

/// A completed attempt.
#[derive(Debug)]
struct CompletedAttempt {
    webhook: WebhookId,
    id: DeliveryId,
    what: DeliverySource,
    at: Timestamp,
    attempt: Attempt,
}

/// Sends deliveries until the stop.
pub async fn run(app: App, sender: Sender, stop: CancellationToken) {
    let mut dispatcher = Dispatcher::new(app.clone(), sender, stop.clone());
    while !stop.is_cancelled() {
        if let Err(error) = db::limited(dispatcher.pass()).await {
            app.log_failure("send alerts to webhooks", &error);
            tokio::select! {
                () = stop.cancelled() => break,
                () = tokio::time::sleep(REST_AFTER_ERROR) => {}
            }
        } else {
            tokio::select! {
                biased;
                () = stop.cancelled() => break,
                Some(done) = dispatcher.finishing.recv() => dispatcher.record(done),
                () = app.webhooks().woken.notified() => {}
                () = tokio::time::sleep(POLL_INTERVAL) => {}
            }
        }
        while let Ok(done) = dispatcher.finishing.try_recv() {
            dispatcher.record(done);
        }
    }
}

/// Starts attempts and stores their outcomes.
#[derive(Debug)]
struct Dispatcher {
    app: App,
    sender: Arc<Sender>,
    stop: CancellationToken,
    finished: mpsc::Sender<CompletedAttempt>,
    finishing: mpsc::Receiver<CompletedAttempt>,
    /// Webhooks with an attempt whose outcome is not stored.
    under_way: HashSet<WebhookId>,
    /// Outcomes that are not stored, at most one per webhook.
    outcomes: Vec<Outcome>,
    /// Time until which a webhook rests.
    resting: HashMap<WebhookId, Duration>,
}

impl Dispatcher {
    fn new(app: App, sender: Sender, stop: CancellationToken) -> Self {
        let (finished, finishing) = mpsc::channel(ATTEMPTS_AT_ONCE_MAX);
        Self {
            app,
            sender: Arc::new(sender),
            stop,
            finished,
            finishing,
            under_way: HashSet::new(),
            outcomes: Vec::new(),
            resting: HashMap::new(),
        }
    }

    /// Stores the outcomes of attempts, abandons deliveries that are too old, and starts those that are
    /// due.
    async fn pass(&mut self) -> Result<(), AppError> {
        let now = self.app.clock().elapsed();
        self.resting.retain(|_, until| *until > now);
        if let Err(error) = self.app.write_server_changes().await {
            self.send_unwritten().await?;
            return Err(error);
        }
        self.store_outcomes().await?;
        let now = self.app.clock().now();
        let oldest = now.checked_sub(AGE_MAX).unwrap_or(Timestamp::MIN);
        let latest = now.checked_add(RETRY_MAX).unwrap_or(Timestamp::MAX);
        let mut tx = self.app.db().read("webhooks").await?;
        let has_older = db::webhooks::has_older(&mut tx, oldest).await?;
        let due = db::webhooks::due(&mut tx, DueTimes { now, latest }).await?;
        drop(tx);
        if has_older {
            let mut tx = self.app.db().write_uncounted("webhooks").await?;
            let count = db::webhooks::abandon_oldest(&mut tx, AgeLimit { now, oldest }).await?;
            tx.commit().await?;
            self.app.counters().webhook_given_up.add(count);
        }
        for due in due {
            // It has just been given up.
            if due.created_at < oldest || !self.may_send(due.webhook) {
                continue;
            }
            let Due {
                webhook,
                url,
                secret,
                id,
                body,
                attempts,
                created_at,
            } = due;
            let outgoing = OutgoingDelivery {
                id,
                url,
                secret,
                body,
                at: now,
            };
            let what = DeliverySource::Queued {
                attempts,
                created_at,
            };
            self.start(webhook, outgoing, what);
        }
        Ok(())
    }

    fn may_send(&self, webhook: WebhookId) -> bool {
        self.under_way.len() < ATTEMPTS_AT_ONCE_MAX
            && !self.under_way.contains(&webhook)
            && !self.resting.contains_key(&webhook)
    }

    fn start(&mut self, webhook: WebhookId, outgoing: OutgoingDelivery, what: DeliverySource) {
        self.under_way.insert(webhook);
        let (sender, finished) = (Arc::clone(&self.sender), self.finished.clone());
        let stop = self.stop.clone();
        let attempt = async move {
            let attempt = tokio::select! {
                // It is sent again after the restart.
                () = stop.cancelled() => return,
                attempt = sender.send(&outgoing) => attempt,
            };
            let done = CompletedAttempt {
                webhook,
                id: outgoing.id,
                what,
                at: outgoing.at,
                attempt,
            };
            // There is room for every attempt that is under way, unless the server stops.
            let _ = finished.try_send(done);
        };
        self.app.spawn_background("webhook", attempt);
    }

    /// Notes how an attempt ended.
    fn record(&mut self, done: CompletedAttempt) {
        let CompletedAttempt {
            webhook,
            id,
            what,
            at,
            attempt,
        } = done;
        let has_arrived = attempt.failure.is_none();
        let counters = self.app.counters();
        if has_arrived {
            counters.webhook_delivered.one();
        } else {
            counters.webhook_attempts_failed.one();
            let until = self.app.clock().elapsed() + REST_AFTER_FAILURE;
            self.resting.insert(webhook, until);
        }
        let DeliverySource::Queued {
            attempts,
            created_at,
        } = what
        else {
            self.under_way.remove(&webhook);
            if has_arrived {
                for change in self.app.webhooks().server_changes().iter_mut() {
                    if change.ids.get(&webhook) == Some(&id) {
                        change.sent.insert(webhook);
                    }
                }
            }
            return;
        };
        let attempts = attempts.saturating_add(1);
        let next = if has_arrived {
            Next::Delivered
        } else {
            next(id, attempts, at, at.duration_since(created_at))
        };
        let (state, due_at) = match next {
            Next::Delivered => (DeliveryState::Delivered, at),
            Next::GivenUp => {
                counters.webhook_given_up.one();
                (DeliveryState::Failed, at)
            }
            Next::Again(due_at) => (DeliveryState::Pending, due_at),
        };
        self.outcomes.push(Outcome {
            webhook,
            id,
            state,
            at,
            due_at,
            status: attempt.status,
            detail: attempt.failure,
        });
    }

    async fn store_outcomes(&mut self) -> Result<(), AppError> {
        if self.outcomes.is_empty() {
            return Ok(());
        }
        let mut tx = self.app.db().write_uncounted("webhooks").await?;
        for outcome in &self.outcomes {
            db::webhooks::record_attempt(&mut tx, outcome).await?;
            if outcome.state != DeliveryState::Pending {
                db::webhooks::prune(&mut tx, outcome.webhook, LOG_MAX).await?;
            }
        }
        tx.commit().await?;
        for outcome in self.outcomes.drain(..) {
            self.under_way.remove(&outcome.webhook);
        }
        Ok(())
    }

    /// Sends alerts about the server that cannot be written to the outbox.
    async fn send_unwritten(&mut self) -> Result<(), AppError> {
        let changes = self.app.webhooks().server_changes().clone();
        let mut tx = self.app.db().read("webhooks").await?;
        for change in changes {
            for receiver in db::webhooks::interested(&mut tx, &change.alert.code, None).await? {
                let webhook = receiver.id;
                if change.sent.contains(&webhook) || !self.may_send(webhook) {
                    continue;
                }
                let known = change.ids.get(&webhook).copied();
                let id = known.unwrap_or_else(|| self.app.clock().new_id());
                self.store_id(&change, webhook, id);
                let notice = self.app.notice(id, change.event, &change.alert);
                let outgoing = OutgoingDelivery {
                    id,
                    url: receiver.url,
                    secret: receiver.secret,
                    body: body(&notice)?,
                    at: self.app.clock().now(),
                };
                self.start(webhook, outgoing, DeliverySource::Unwritten);
            }
        }
        Ok(())
    }

    /// Keeps the identifier of a delivery for its next attempts.
    fn store_id(&self, of: &super::ServerChange, webhook: WebhookId, id: DeliveryId) {
        for change in self.app.webhooks().server_changes().iter_mut() {
            if (change.alert.id, change.event) == (of.alert.id, of.event) {
                change.ids.insert(webhook, id);
            }
        }
    }
}

/// What follows an attempt.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Next {
    Delivered,
    GivenUp,
    Again(Timestamp),
}

/// Decides what follows an attempt that failed, the `attempts`-th of a delivery, which had this age then.
fn next(id: DeliveryId, attempts: u32, at: Timestamp, age: SignedDuration) -> Next {
    let due_at = at.checked_add(backoff(id, attempts));
    let due_at = due_at.unwrap_or(Timestamp::MAX);
    if attempts >= ATTEMPTS_MAX || due_at.duration_since(at) + age > AGE_MAX {
        Next::GivenUp
    } else {
        Next::Again(due_at)
    }
}

/// Returns the back-off after the `attempts`-th attempt: it doubles up to [`RETRY_MAX`], and between
/// half of it and all of it is waited. The part is derived from the delivery's random identifier, so
/// that deliveries that failed together are not repeated together.
fn backoff(id: DeliveryId, attempts: u32) -> Duration {
    let doublings = attempts.saturating_sub(1).min(31);
    let whole = RETRY_MIN.saturating_mul(1 << doublings).min(RETRY_MAX);
    let mut hash = Sha256::new();
    hash.update(id.as_uuid().as_bytes());
    hash.update(attempts.to_le_bytes());
    let [low, high, ..]: [u8; 32] = hash.finalize().into();
    let part = f64::from(u16::from_le_bytes([low, high])) / f64::from(u16::MAX);
    whole.mul_f64(0.5 + 0.5 * part)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use uuid::Uuid;

    use super::*;

    fn delivery(bits: u128) -> DeliveryId {
        DeliveryId::from_uuid(Uuid::from_u128(bits))
    }

    proptest! {
        #[test]
        fn a_backoff_doubles_within_its_bounds_and_differs_between_deliveries(
            bits: u128, attempts in 1..1_000_u32,
        ) {
            let waited = backoff(delivery(bits), attempts);
            prop_assert!(waited >= RETRY_MIN / 2 && waited <= RETRY_MAX);
            let whole = RETRY_MIN.saturating_mul(1 << attempts.min(20).saturating_sub(1));
            let whole = whole.min(RETRY_MAX);
            prop_assert!(waited >= whole / 2 && waited <= whole, "{waited:?} of {whole:?}");
            prop_assert_eq!(waited, backoff(delivery(bits), attempts));
        }

        #[test]
        fn every_delivery_is_given_up_within_its_bounds(bits: u128) {
            let begin: Timestamp = "2026-11-01T00:00:00Z".parse().unwrap();
            let (mut at, mut attempts) = (begin, 0);
            loop {
                attempts += 1;
                match next(delivery(bits), attempts, at, at.duration_since(begin)) {
                    Next::Again(due_at) => {
                        prop_assert!(due_at > at);
                        at = due_at;
                    }
                    Next::GivenUp => break,
                    Next::Delivered => unreachable!("it failed"),
                }
            }
            prop_assert!(attempts <= ATTEMPTS_MAX);
            prop_assert!(at.duration_since(begin) <= AGE_MAX);
            // A receiver that is back after some hours still gets it.
            prop_assert!(at.duration_since(begin) > SignedDuration::from_hours(6));
        }
    }

    #[test]
    fn deliveries_that_failed_together_are_not_repeated_together() {
        let waits: HashSet<Duration> = (0..100).map(|bits| backoff(delivery(bits), 3)).collect();
        assert!(waits.len() > 90, "{}", waits.len());
    }
}
