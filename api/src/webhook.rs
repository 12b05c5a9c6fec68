//! Webhooks: addresses to which the server sends alerts, and the log of what was sent.

use std::fmt;

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::geometry::Point;
use crate::ids::{AlertCode, AlertId, DeliveryId, MissionId, RobotId, SiteId, WebhookId};
use crate::robot::{Alert, Severity};

/// Maximum number of webhooks of a server.
pub const WEBHOOKS_MAX: usize = 50;
/// Maximum length of a webhook's name, characters.
pub const WEBHOOK_NAME_MAX: usize = 80;
/// Maximum length of a webhook's URL, bytes.
pub const WEBHOOK_URL_MAX: usize = 2_000;
/// Maximum number of kinds to which a webhook is limited.
pub const WEBHOOK_KINDS_MAX: usize = 100;
/// Maximum number of sites to which a webhook is limited.
pub const WEBHOOK_SITES_MAX: usize = 100;
/// Version of the body of a delivery; an incompatible change increases it.
pub const NOTICE_VERSION: u32 = 1;
/// Kind of a delivery that was requested to test a webhook.
pub const TEST_KIND: &str = "test";
/// Header of a delivery with the time of the attempt, seconds since 1970.
pub const TIMESTAMP_HEADER: &str = "tread-timestamp";
/// Header of a delivery with its identifier, the same for every attempt.
pub const DELIVERY_HEADER: &str = "tread-delivery";
/// Header of a delivery with its signature: `v1=` and the HMAC-SHA256 of `timestamp.body` in hex.
pub const SIGNATURE_HEADER: &str = "tread-signature";

/// Settings of a webhook: the body of `POST /v1/webhooks` and `PUT /v1/webhooks/{webhook}`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct WebhookSettings {
    /// Name, for people, unique among webhooks; 1 to 80 characters.
    pub name: String,
    /// URL to which alerts are sent, `https` unless the server's configuration allows `http`.
    pub url: String,
    /// Kinds of alerts that are sent, at most 100; all when absent. An unknown kind is refused.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub kinds: Option<Vec<AlertCode>>,
    /// Sites whose alerts are sent, at most 100; all when absent. Alerts about the server itself
    /// are sent to every webhook of their kind.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sites: Option<Vec<SiteId>>,
    /// Whether alerts are sent; true when absent.
    #[serde(default = "is_enabled")]
    pub enabled: bool,
}

const fn is_enabled() -> bool {
    true
}

/// Webhook without its secret.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Webhook {
    /// Identifier of the webhook.
    pub id: WebhookId,
    /// Name, for people.
    pub name: String,
    /// URL to which alerts are sent.
    pub url: String,
    /// Kinds of alerts that are sent; `null` for all.
    pub kinds: Option<Vec<AlertCode>>,
    /// Sites whose alerts are sent; `null` for all.
    pub sites: Option<Vec<SiteId>>,
    /// Whether alerts are sent.
    pub enabled: bool,
    /// Time when it was created.
    pub created_at: Timestamp,
    /// Name of the token or person that created it.
    pub created_by: String,
    /// Number of deliveries that wait to be sent or to be sent again.
    pub pending: u32,
}

impl Webhook {
    /// Returns the settings, for instance to change one of them.
    pub fn settings(&self) -> WebhookSettings {
        WebhookSettings {
            name: self.name.clone(),
            url: self.url.clone(),
            kinds: self.kinds.clone(),
            sites: self.sites.clone(),
            enabled: self.enabled,
        }
    }
}

/// Webhook with a new secret, which no other response contains.
#[derive(Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct CreatedWebhook {
    /// The webhook.
    pub webhook: Webhook,
    /// Secret with which deliveries are signed, as text: its bytes are the key of the HMAC.
    pub secret: String,
}

impl fmt::Debug for CreatedWebhook {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter
            .debug_struct("CreatedWebhook")
            .field("webhook", &self.webhook)
            .finish_non_exhaustive()
    }
}

/// Event that a delivery reports.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum NoticeEvent {
    /// An alert was raised.
    Opened,
    /// The cause of an alert ended.
    Ended,
    /// No event: a user tests the webhook.
    Test,
}

impl NoticeEvent {
    /// Returns the name on the wire and in the database.
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Opened => "opened",
            Self::Ended => "ended",
            Self::Test => "test",
        }
    }

    /// Returns the event with this name; `None` if there is none.
    pub fn from_name(name: &str) -> Option<Self> {
        [Self::Opened, Self::Ended, Self::Test]
            .into_iter()
            .find(|event| event.as_str() == name)
    }
}

/// State of a delivery.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum DeliveryState {
    /// It waits to be sent, or to be sent again.
    Pending,
    /// The receiver answered with a 2xx status.
    Delivered,
    /// The server gave it up after the last attempt, or because it became too old.
    Failed,
    /// The server discarded it because too many others were waiting.
    Dropped,
}

impl DeliveryState {
    /// Every state.
    pub const ALL: [Self; 4] = [Self::Pending, Self::Delivered, Self::Failed, Self::Dropped];

    /// Returns the name on the wire and in the database.
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Pending => "pending",
            Self::Delivered => "delivered",
            Self::Failed => "failed",
            Self::Dropped => "dropped",
        }
    }

    /// Returns the state with this name; `None` if there is none.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|state| state.as_str() == name)
    }
}

/// Entry of the log of deliveries.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Delivery {
    /// Identifier of the delivery, the same for every attempt.
    pub id: DeliveryId,
    /// Alert that it is about; `null` for a test.
    pub alert: Option<AlertId>,
    /// Event that it reports.
    pub event: NoticeEvent,
    /// Kind of the alert; `test` for a test.
    pub kind: AlertCode,
    /// State of the delivery.
    pub state: DeliveryState,
    /// Time when it was queued.
    pub created_at: Timestamp,
    /// Number of attempts so far.
    pub attempts: u32,
    /// Time of the last attempt; `null` before the first.
    pub last_attempt_at: Option<Timestamp>,
    /// Time from which it is sent next; `null` unless it is pending.
    pub next_attempt_at: Option<Timestamp>,
    /// HTTP status of the last attempt; `null` if there was no answer.
    pub status: Option<u16>,
    /// Why the last attempt failed, for people; `null` if it did not.
    pub detail: Option<String>,
    /// Time when it was delivered, given up or dropped; `null` before that.
    pub ended_at: Option<Timestamp>,
}

/// Body of a delivery, which a webhook's receiver gets.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct AlertNotice {
    /// Version of this format, 1.
    pub v: u32,
    /// Identifier of the delivery. The same delivery may arrive more than once.
    pub delivery: DeliveryId,
    /// Event that it reports.
    pub event: NoticeEvent,
    /// Identifier of the alert; `null` for a test.
    pub id: Option<AlertId>,
    /// Kind of the alert, for programs.
    pub kind: AlertCode,
    /// Severity of the alert; `null` for a test.
    pub severity: Option<Severity>,
    /// Description, for people.
    pub text: String,
    /// Site; `null` for an alert about the server itself.
    pub site: Option<SiteId>,
    /// Robot; `null` for an alert about the server itself.
    pub robot: Option<RobotId>,
    /// Mission that the alert is about, or that the robot drove; `null` without one.
    pub mission: Option<MissionId>,
    /// Position of the robot in the site frame when the alert was raised; `null` if unknown.
    pub place: Option<Point>,
    /// Time of the event.
    pub at: Timestamp,
    /// Time when the alert was raised; `null` for a test.
    pub opened_at: Option<Timestamp>,
    /// Time when its cause ended; `null` before that.
    pub ended_at: Option<Timestamp>,
    /// Address at which the dashboard shows the alert: absolute if the server's configuration has
    /// `webhooks.public_url`, else a path; `null` for a test.
    pub link: Option<String>,
}

impl AlertNotice {
    /// Returns the notice of an alert that was raised or has ended.
    pub fn of_alert(delivery: DeliveryId, event: NoticeEvent, alert: &Alert, link: String) -> Self {
        let ended_at = alert.cleared_at.filter(|_| event == NoticeEvent::Ended);
        Self {
            v: NOTICE_VERSION,
            delivery,
            event,
            id: Some(alert.id),
            kind: alert.code.clone(),
            severity: Some(alert.severity),
            text: alert.text.clone(),
            site: alert.site.clone(),
            robot: alert.robot.clone(),
            mission: alert.mission,
            place: alert.place,
            at: ended_at.unwrap_or(alert.raised_at),
            opened_at: Some(alert.raised_at),
            ended_at,
            link: Some(link),
        }
    }
}
