//! Webhooks and their deliveries.

use jiff::Timestamp;
use tread_api::ids::{AlertCode, AlertId, DeliveryId, WebhookId};
use tread_api::webhook::{DeliveryState, NoticeEvent};

/// A webhook that is to be sent something.
#[derive(Clone, PartialEq, Eq)]
pub struct Receiver {
    /// The webhook.
    pub id: WebhookId,
    /// Its URL.
    pub url: String,
    /// Its secret.
    pub secret: String,
}

/// A delivery to be queued.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NewDelivery {
    /// Its identifier.
    pub id: DeliveryId,
    /// The webhook.
    pub webhook: WebhookId,
    /// The alert; `None` for a test.
    pub alert: Option<AlertId>,
    /// What it tells.
    pub event: NoticeEvent,
    /// Kind of the alert.
    pub kind: AlertCode,
    /// Body, JSON.
    pub body: String,
    /// Time when it is queued.
    pub at: Timestamp,
}

/// A delivery that is to be sent now.
#[derive(Clone, PartialEq, Eq)]
pub struct Due {
    /// The webhook.
    pub webhook: WebhookId,
    /// Its URL.
    pub url: String,
    /// Its secret.
    pub secret: String,
    /// The delivery.
    pub id: DeliveryId,
    /// Body, JSON.
    pub body: String,
    /// Number of attempts so far.
    pub attempts: u32,
    /// Time when it was queued.
    pub created_at: Timestamp,
}

/// Times of a search for deliveries that are due.
#[derive(Debug, Clone, Copy)]
pub struct DueTimes {
    /// Present time.
    pub now: Timestamp,
    /// Latest time to which a delivery can have been put off; a later one shows that the clock was
    /// set back.
    pub latest: Timestamp,
}

/// Limit of the age of waiting deliveries.
#[derive(Debug, Clone, Copy)]
pub struct AgeLimit {
    /// Present time, at which those that are too old end.
    pub now: Timestamp,
    /// Time before which none may have been queued.
    pub oldest: Timestamp,
}

/// What became of a delivery by an attempt.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Outcome {
    /// The webhook.
    pub webhook: WebhookId,
    /// The delivery.
    pub id: DeliveryId,
    /// State after the attempt.
    pub state: DeliveryState,
    /// Time of the attempt.
    pub at: Timestamp,
    /// Time from which it is sent again, if it is pending.
    pub due_at: Timestamp,
    /// Status of the answer, if there was one.
    pub status: Option<u16>,
    /// Why the attempt failed.
    pub detail: Option<String>,
}
