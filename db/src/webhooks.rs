//! Webhooks, and their deliveries: outbox and log in one table.

use jiff::Timestamp;
use tread_api::ids::{AlertCode, DeliveryId, SiteId, WebhookId};
use tread_api::webhook::{Delivery, Webhook, WebhookSettings};
pub use tread_store::webhooks::{AgeLimit, Due, DueTimes, NewDelivery, Outcome, Receiver};

use super::{DbError, Tx, forward};

forward! {
    webhooks;
    fn list(before: Option<WebhookId>, limit: u32) -> Vec<Webhook>;
    fn find(id: WebhookId) -> Option<Webhook>;
    fn count() -> u32;
    fn pending_count() -> u64;
    fn insert(webhook: &Webhook, secret: &str) -> ();
    fn replace(id: WebhookId, settings: &WebhookSettings) -> bool;
    fn set_secret(id: WebhookId, secret: &str) -> bool;
    fn delete(id: WebhookId) -> bool;
    fn interested(kind: &AlertCode, site: Option<&SiteId>) -> Vec<Receiver>;
    fn queue(new: &NewDelivery) -> ();
    fn drop_oldest(webhook: WebhookId, pending_max: u32, at: Timestamp) -> u64;
    fn due(times: DueTimes) -> Vec<Due>;
    fn record_attempt(outcome: &Outcome) -> ();
    fn has_older(than: Timestamp) -> bool;
    fn abandon_oldest(limit: AgeLimit) -> u64;
    fn prune(webhook: WebhookId, kept: u32) -> ();
    fn deliveries(webhook: WebhookId, before: Option<DeliveryId>, limit: u32) -> Vec<Delivery>;
}
