//! Webhooks: their settings, and the outbox of their deliveries.
//!
//! The transaction that raises or ends an alert also queues its deliveries, so both are committed or
//! neither is. [`delivery`] sends the queued deliveries; this module waits for no receiver.

pub mod delivery;

use std::collections::{BTreeSet, HashMap, HashSet, VecDeque};
use std::sync::{Mutex, MutexGuard, PoisonError};

use tokio::sync::Notify;
use tread_api::alert_kind;
use tread_api::ids::{AlertCode, DeliveryId, WebhookId};
use tread_api::page::Page;
use tread_api::robot::Alert;
use tread_api::webhook::{
    AlertNotice, CreatedWebhook, Delivery, NOTICE_VERSION, NoticeEvent, TEST_KIND,
    WEBHOOK_KINDS_MAX, WEBHOOK_NAME_MAX, WEBHOOK_SITES_MAX, WEBHOOKS_MAX, Webhook, WebhookSettings,
};

use super::identity::new_secret;
use super::{App, AppError, PeopleField, page, people_line, site_row};
use crate::config::webhooks::WebhooksConfig;
use crate::db::webhooks::NewDelivery;
use crate::db::{self, DbError, Tx};
use crate::identity::secret::Kind;
use crate::webhooks::Rules;

/// Maximum number of deliveries that wait for one webhook; beyond it the oldest are dropped.
pub const PENDING_MAX: u32 = 1_000;
/// Maximum number of deliveries of a webhook in the log, beside those that wait.
pub const LOG_MAX: u32 = 1_000;
/// Maximum number of changes of alerts about the server that wait for the database; beyond it the
/// oldest are dropped.
const SERVER_CHANGES_MAX: usize = 100;

/// State of webhooks in memory.
#[derive(Debug)]
pub(super) struct Webhooks {
    rules: Rules,
    woken: Notify,
    /// Changes of alerts about the server, which are not written by a transaction.
    server_changes: Mutex<VecDeque<ServerChange>>,
}

/// Change of an alert about the server, which waits for the database.
#[derive(Debug, Clone)]
struct ServerChange {
    alert: Alert,
    event: NoticeEvent,
    /// Identifier of the delivery to each webhook, the same for every attempt.
    ids: HashMap<WebhookId, DeliveryId>,
    /// Webhooks that got it although the database could not be written.
    sent: HashSet<WebhookId>,
}

impl Webhooks {
    pub(super) fn new(config: WebhooksConfig) -> Self {
        Self {
            rules: Rules::new(config),
            woken: Notify::new(),
            server_changes: Mutex::default(),
        }
    }

    fn server_changes(&self) -> MutexGuard<'_, VecDeque<ServerChange>> {
        let changes = self.server_changes.lock();
        changes.unwrap_or_else(PoisonError::into_inner)
    }
}

impl App {
    /// Returns the rules for URLs and addresses of webhooks.
    pub fn webhook_rules(&self) -> &Rules {
        &self.webhooks().rules
    }

    /// Wakes the task that sends deliveries.
    pub(super) fn wake_webhooks(&self) {
        self.webhooks().woken.notify_one();
    }

    /// Returns a page of the webhooks, newest first.
    pub async fn list_webhooks(
        &self,
        before: Option<WebhookId>,
        limit: u32,
    ) -> Result<Page<Webhook>, AppError> {
        let mut tx = self.db().read("webhooks").await?;
        let found = db::webhooks::list(&mut tx, before, limit + 1).await?;
        Ok(page(found, limit, |webhook: &Webhook| {
            webhook.id.to_string()
        }))
    }

    /// Returns a webhook.
    ///
    /// # Errors
    /// [`AppError::UnknownWebhook`].
    pub async fn webhook(&self, id: WebhookId) -> Result<Webhook, AppError> {
        let mut tx = self.db().read("webhooks").await?;
        known(&mut tx, id).await
    }

    /// Creates a webhook.
    ///
    /// # Errors
    /// A setting is impossible, the name is taken, a site is not known, or there are too many.
    pub async fn create_webhook(
        &self,
        settings: WebhookSettings,
        created_by: &str,
    ) -> Result<CreatedWebhook, AppError> {
        let mut tx = self.db().write_uncounted("webhooks").await?;
        let settings = self.checked(&mut tx, settings).await?;
        let count = db::webhooks::count(&mut tx).await?;
        if usize::try_from(count).is_ok_and(|count| count >= WEBHOOKS_MAX) {
            return Err(AppError::TooMany {
                what: "webhooks",
                count: WEBHOOKS_MAX,
            });
        }
        let secret = new_secret(Kind::Webhook)?;
        let webhook = Webhook {
            id: self.clock().new_id::<WebhookId>(),
            name: settings.name,
            url: settings.url,
            kinds: settings.kinds,
            sites: settings.sites,
            enabled: settings.enabled,
            created_at: self.clock().now(),
            created_by: created_by.to_owned(),
            pending: 0,
        };
        let inserted = db::webhooks::insert(&mut tx, &webhook, secret.reveal()).await;
        inserted.map_err(|error| taken(error, &webhook.name))?;
        tx.commit().await?;
        Ok(CreatedWebhook {
            webhook,
            secret: secret.reveal().to_owned(),
        })
    }

    /// Replaces the settings of a webhook. What waits is sent by the new settings.
    ///
    /// # Errors
    /// As [`Self::create_webhook`], or the webhook is not known.
    pub async fn change_webhook(
        &self,
        id: WebhookId,
        settings: WebhookSettings,
    ) -> Result<Webhook, AppError> {
        let mut tx = self.db().write_uncounted("webhooks").await?;
        known(&mut tx, id).await?;
        let settings = self.checked(&mut tx, settings).await?;
        let replaced = db::webhooks::replace(&mut tx, id, &settings).await;
        if !replaced.map_err(|error| taken(error, &settings.name))? {
            return Err(AppError::UnknownWebhook(id));
        }
        let webhook = known(&mut tx, id).await?;
        tx.commit().await?;
        self.wake_webhooks();
        Ok(webhook)
    }

    /// Gives a webhook a new secret, with which everything is signed from now on.
    ///
    /// # Errors
    /// [`AppError::UnknownWebhook`].
    pub async fn rotate_webhook_secret(&self, id: WebhookId) -> Result<CreatedWebhook, AppError> {
        let secret = new_secret(Kind::Webhook)?;
        let mut tx = self.db().write_uncounted("webhooks").await?;
        if !db::webhooks::set_secret(&mut tx, id, secret.reveal()).await? {
            return Err(AppError::UnknownWebhook(id));
        }
        let webhook = known(&mut tx, id).await?;
        tx.commit().await?;
        Ok(CreatedWebhook {
            webhook,
            secret: secret.reveal().to_owned(),
        })
    }

    /// Deletes a webhook with its deliveries, also those that wait.
    ///
    /// # Errors
    /// [`AppError::UnknownWebhook`].
    pub async fn delete_webhook(&self, id: WebhookId) -> Result<Webhook, AppError> {
        let mut tx = self.db().write_uncounted("webhooks").await?;
        let webhook = known(&mut tx, id).await?;
        db::webhooks::delete(&mut tx, id).await?;
        tx.commit().await?;
        Ok(webhook)
    }

    /// Queues a delivery that tests a webhook, whether or not it is enabled.
    ///
    /// # Errors
    /// [`AppError::UnknownWebhook`].
    pub async fn test_webhook(&self, id: WebhookId) -> Result<Delivery, AppError> {
        let mut tx = self.db().write_uncounted("webhooks").await?;
        let webhook = known(&mut tx, id).await?;
        let (delivery, at) = (self.clock().new_id::<DeliveryId>(), self.clock().now());
        let kind: AlertCode = TEST_KIND.parse().expect("the kind of a test is a code");
        let notice = AlertNotice {
            v: NOTICE_VERSION,
            delivery,
            event: NoticeEvent::Test,
            id: None,
            kind: kind.clone(),
            severity: None,
            text: format!("test of the webhook `{}`", webhook.name),
            site: None,
            robot: None,
            mission: None,
            place: None,
            at,
            opened_at: None,
            ended_at: None,
            link: None,
        };
        self.queue_delivery(&mut tx, id, &notice).await?;
        let found = db::webhooks::deliveries(&mut tx, id, None, 1).await?;
        let queued = found.into_iter().next();
        let queued = queued.ok_or(AppError::UnknownWebhook(id))?;
        tx.commit().await?;
        self.wake_webhooks();
        Ok(queued)
    }

    /// Returns a page of the log of a webhook's deliveries, newest first.
    ///
    /// # Errors
    /// [`AppError::UnknownWebhook`].
    pub async fn webhook_deliveries(
        &self,
        id: WebhookId,
        before: Option<DeliveryId>,
        limit: u32,
    ) -> Result<Page<Delivery>, AppError> {
        let mut tx = self.db().read("webhooks").await?;
        known(&mut tx, id).await?;
        let found = db::webhooks::deliveries(&mut tx, id, before, limit + 1).await?;
        Ok(page(found, limit, |delivery: &Delivery| {
            delivery.id.to_string()
        }))
    }

    /// Queues what is to be sent of an alert that this transaction raises or ends.
    pub(super) async fn queue_alert(
        &self,
        tx: &mut Tx,
        event: NoticeEvent,
        alert: &Alert,
    ) -> Result<(), DbError> {
        let site = alert.site.as_ref();
        for webhook in db::webhooks::interested(tx, &alert.code, site).await? {
            let delivery = self.clock().new_id::<DeliveryId>();
            let notice = self.notice(delivery, event, alert);
            self.queue_delivery(tx, webhook.id, &notice).await?;
        }
        Ok(())
    }

    fn notice(&self, delivery: DeliveryId, event: NoticeEvent, alert: &Alert) -> AlertNotice {
        let link = self.webhook_rules().link(&page_of(alert));
        AlertNotice::of_alert(delivery, event, alert, link)
    }

    async fn queue_delivery(
        &self,
        tx: &mut Tx,
        webhook: WebhookId,
        notice: &AlertNotice,
    ) -> Result<(), DbError> {
        let now = self.clock().now();
        let new = NewDelivery {
            id: notice.delivery,
            webhook,
            alert: notice.id,
            event: notice.event,
            kind: notice.kind.clone(),
            body: body(notice)?,
            at: now,
        };
        db::webhooks::queue(tx, &new).await?;
        let dropped = db::webhooks::drop_oldest(tx, webhook, PENDING_MAX, now).await?;
        if dropped > 0 {
            self.counters().webhook_dropped.add(dropped);
            db::webhooks::prune(tx, webhook, LOG_MAX).await?;
        }
        Ok(())
    }

    /// Queues what is to be sent of an alert about the server, as soon as the database can be
    /// written.
    pub(super) fn queue_server_alert(&self, event: NoticeEvent, alert: &Alert) {
        let mut changes = self.webhooks().server_changes();
        if changes.len() >= SERVER_CHANGES_MAX {
            changes.pop_front();
            self.counters().webhook_dropped.one();
        }
        changes.push_back(ServerChange {
            alert: alert.clone(),
            event,
            ids: HashMap::new(),
            sent: HashSet::new(),
        });
        drop(changes);
        self.wake_webhooks();
    }

    /// Writes the changes of alerts about the server to the outbox. Those that come meanwhile stay.
    async fn write_server_changes(&self) -> Result<(), AppError> {
        let changes: Vec<ServerChange> = self.webhooks().server_changes().iter().cloned().collect();
        if changes.is_empty() {
            return Ok(());
        }
        let mut tx = self.db().write_uncounted("webhooks").await?;
        for change in &changes {
            for webhook in db::webhooks::interested(&mut tx, &change.alert.code, None).await? {
                let known = change.ids.get(&webhook.id).copied();
                let delivery = known.unwrap_or_else(|| self.clock().new_id());
                let notice = self.notice(delivery, change.event, &change.alert);
                self.queue_delivery(&mut tx, webhook.id, &notice).await?;
            }
        }
        tx.commit().await?;
        let mut left = self.webhooks().server_changes();
        let is_written = |change: &ServerChange| {
            let mut written = changes.iter();
            written.any(|one| (one.alert.id, one.event) == (change.alert.id, change.event))
        };
        left.retain(|change| !is_written(change));
        Ok(())
    }

    /// Checks the settings of a webhook and brings them to their usual form.
    async fn checked(
        &self,
        tx: &mut Tx,
        settings: WebhookSettings,
    ) -> Result<WebhookSettings, AppError> {
        let url = self.webhook_rules().read(&settings.url);
        let url = url.map_err(|wrong| AppError::Invalid {
            field: "url",
            detail: wrong.to_string(),
        })?;
        let sites = distinct("sites", settings.sites, WEBHOOK_SITES_MAX)?;
        for site in sites.iter().flatten() {
            site_row(tx, site).await?;
        }
        let kinds = distinct("kinds", settings.kinds, WEBHOOK_KINDS_MAX)?;
        for kind in kinds.iter().flatten() {
            check_kind(tx, kind).await?;
        }
        Ok(WebhookSettings {
            name: people_line(PeopleField::Name, &settings.name, WEBHOOK_NAME_MAX)?,
            url: url.to_string(),
            kinds,
            sites,
            enabled: settings.enabled,
        })
    }
}

/// Refuses a kind of which this version raises no alerts and of which none is stored: a mistyped
/// kind would never be sent. Agents of a newer version may raise kinds that are not known here.
async fn check_kind(tx: &mut Tx, kind: &AlertCode) -> Result<(), AppError> {
    if alert_kind::is_known(kind) {
        return Ok(());
    }
    let filter = db::alerts::AlertFilter {
        kind: Some(kind.clone()),
        ..db::alerts::AlertFilter::default()
    };
    if !db::alerts::list(tx, &filter, 1).await?.is_empty() {
        return Ok(());
    }
    let known = alert_kind::ALERT_KINDS.join(", ");
    let detail = format!("`{kind}` is the kind of no alert; kinds are {known}, and `base-…`");
    Err(AppError::Invalid {
        field: "kinds",
        detail,
    })
}

/// Returns where the page shows an alert to people.
fn page_of(alert: &Alert) -> String {
    let site = alert.site.as_ref();
    let site = site.map_or_else(String::new, |site| format!("site={site}&"));
    format!("/#{site}tab=alerts&alert={}", alert.id)
}

/// Returns the entries of a list, each once and in order.
fn distinct<T: Ord>(
    field: &'static str,
    given: Option<Vec<T>>,
    most: usize,
) -> Result<Option<Vec<T>>, AppError> {
    let Some(given) = given else {
        return Ok(None);
    };
    let entries: BTreeSet<T> = given.into_iter().collect();
    if entries.is_empty() || entries.len() > most {
        let detail = format!("name 1 to {most} {field}, or leave `{field}` out for all");
        return Err(AppError::Invalid { field, detail });
    }
    Ok(Some(entries.into_iter().collect()))
}

async fn known(tx: &mut Tx, id: WebhookId) -> Result<Webhook, AppError> {
    let found = db::webhooks::find(tx, id).await?;
    found.ok_or(AppError::UnknownWebhook(id))
}

fn taken(error: DbError, name: &str) -> AppError {
    if error.is_unique_violation() {
        AppError::AlreadyExists {
            what: "webhook",
            id: name.to_owned(),
        }
    } else {
        error.into()
    }
}

fn body(notice: &AlertNotice) -> Result<String, DbError> {
    serde_json::to_string(notice).map_err(|_error| DbError::DoesNotFit("notice"))
}
