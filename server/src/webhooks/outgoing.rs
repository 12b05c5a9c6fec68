//! A delivery of an alert to a webhook.

use jiff::Timestamp;
use tread_api::ids::DeliveryId;

/// A delivery to be sent.
#[derive(Clone, PartialEq, Eq)]
pub struct OutgoingDelivery {
    /// Identifier of the delivery.
    pub id: DeliveryId,
    /// URL of the webhook.
    pub url: String,
    /// Secret of the webhook.
    pub secret: String,
    /// Body, JSON.
    pub body: String,
    /// Time of the attempt.
    pub at: Timestamp,
}
