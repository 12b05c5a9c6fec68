//! Webhooks, and their deliveries: outbox and log in one table.

use jiff::Timestamp;
use tread_api::alert_kind;
use tread_api::ids::{AlertCode, DeliveryId, SiteId, WebhookId};
use tread_api::webhook::{Delivery, DeliveryState, NoticeEvent, Webhook, WebhookSettings};
pub use tread_store::webhooks::{AgeLimit, Due, DueTimes, NewDelivery, Outcome, Receiver};

use super::{
    Connection, EngineError, corrupt, from_json, from_us, parse, to_json, to_us, unsigned,
};

struct Raw {
    id: String,
    name: String,
    url: String,
    kinds: Option<String>,
    sites: Option<String>,
    enabled: bool,
    created_at_us: i64,
    created_by: String,
    pending: i64,
}

impl TryFrom<Raw> for Webhook {
    type Error = EngineError;

    fn try_from(raw: Raw) -> Result<Self, EngineError> {
        let kinds = raw.kinds.map(|text| from_json("kinds", &text));
        let sites = raw.sites.map(|text| from_json("sites", &text));
        Ok(Self {
            id: parse("webhook", &raw.id)?,
            name: raw.name,
            url: raw.url,
            kinds: kinds.transpose()?,
            sites: sites.transpose()?,
            enabled: raw.enabled,
            created_at: from_us(raw.created_at_us)?,
            created_by: raw.created_by,
            pending: unsigned("count", raw.pending)?,
        })
    }
}

macro_rules! webhooks {
    ($condition:tt $(, $argument:expr)* $(,)?) => {
        sqlx::query_as!(
            Raw,
            r#"SELECT id, name, url, kinds, sites, enabled AS "enabled: bool", created_at_us,
                   created_by,
                   (SELECT COUNT(*) FROM webhook_deliveries AS waiting
                    WHERE waiting.webhook_id = webhooks.id AND waiting.state = 'pending')
                       AS "pending!: i64"
               FROM webhooks "# + $condition
            $(, $argument)*
        )
    };
}

/// Returns the webhooks that are older than one, newest first.
pub async fn list(
    db: &mut Connection,
    before: Option<WebhookId>,
    limit: u32,
) -> Result<Vec<Webhook>, EngineError> {
    let before = before.map(|id| id.to_string());
    let raw = webhooks!(
        "WHERE (CAST($1 AS TEXT) IS NULL OR id < $1) ORDER BY id DESC LIMIT $2",
        before,
        i64::from(limit),
    )
    .fetch_all(db)
    .await?;
    raw.into_iter().map(Webhook::try_from).collect()
}

/// Returns a webhook by its identifier.
pub async fn find(db: &mut Connection, id: WebhookId) -> Result<Option<Webhook>, EngineError> {
    let id = id.to_string();
    let raw = webhooks!("WHERE id = $1", id).fetch_optional(db).await?;
    raw.map(Webhook::try_from).transpose()
}

/// Returns the number of webhooks.
pub async fn count(db: &mut Connection) -> Result<u32, EngineError> {
    let count = sqlx::query_scalar!(r#"SELECT COUNT(*) AS "count!: i64" FROM webhooks"#);
    unsigned("count", count.fetch_one(db).await?)
}

/// Returns the number of deliveries that wait, of all webhooks.
pub async fn pending_count(db: &mut Connection) -> Result<u64, EngineError> {
    let count = sqlx::query_scalar!(
        r#"SELECT COUNT(*) AS "count!: i64" FROM webhook_deliveries WHERE state = 'pending'"#
    );
    unsigned("count", count.fetch_one(db).await?)
}

/// Columns of a webhook's settings.
struct Columns {
    kinds: Option<String>,
    sites: Option<String>,
}

impl Columns {
    fn of(settings: &WebhookSettings) -> Result<Self, EngineError> {
        let kinds = settings.kinds.as_ref();
        let sites = settings.sites.as_ref();
        Ok(Self {
            kinds: kinds.map(|kinds| to_json("kinds", kinds)).transpose()?,
            sites: sites.map(|sites| to_json("sites", sites)).transpose()?,
        })
    }
}

/// Stores a new webhook. A name that is in use violates a unique constraint.
pub async fn insert(
    db: &mut Connection,
    webhook: &Webhook,
    secret: &str,
) -> Result<(), EngineError> {
    let (id, created_at_us) = (webhook.id.to_string(), to_us(webhook.created_at));
    let Columns { kinds, sites } = Columns::of(&webhook.settings())?;
    sqlx::query!(
        "INSERT INTO webhooks (id, name, url, secret, kinds, sites, enabled, created_at_us,
             created_by)
         VALUES ($1, $2, $3, $4, $5, $6, $7, $8, $9)",
        id,
        webhook.name,
        webhook.url,
        secret,
        kinds,
        sites,
        webhook.enabled,
        created_at_us,
        webhook.created_by,
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Replaces the settings of a webhook; false if it is not known. A name that is in use violates a
/// unique constraint.
pub async fn replace(
    db: &mut Connection,
    id: WebhookId,
    settings: &WebhookSettings,
) -> Result<bool, EngineError> {
    let id = id.to_string();
    let Columns { kinds, sites } = Columns::of(settings)?;
    let done = sqlx::query!(
        "UPDATE webhooks SET name = $1, url = $2, kinds = $3, sites = $4, enabled = $5 WHERE id = $6",
        settings.name,
        settings.url,
        kinds,
        sites,
        settings.enabled,
        id,
    )
    .execute(db)
    .await?;
    Ok(done.rows_affected() == 1)
}

/// Replaces the secret of a webhook; false if it is not known.
pub async fn set_secret(
    db: &mut Connection,
    id: WebhookId,
    secret: &str,
) -> Result<bool, EngineError> {
    let id = id.to_string();
    let done = sqlx::query!("UPDATE webhooks SET secret = $1 WHERE id = $2", secret, id)
        .execute(db)
        .await?;
    Ok(done.rows_affected() == 1)
}

/// Deletes a webhook with its deliveries; false if it is not known.
pub async fn delete(db: &mut Connection, id: WebhookId) -> Result<bool, EngineError> {
    let id = id.to_string();
    let done = sqlx::query!("DELETE FROM webhooks WHERE id = $1", id)
        .execute(db)
        .await?;
    Ok(done.rows_affected() == 1)
}

/// Returns the enabled webhooks that are to be sent alerts of a kind, of a site or, without one,
/// about the server itself.
pub async fn interested(
    db: &mut Connection,
    kind: &AlertCode,
    site: Option<&SiteId>,
) -> Result<Vec<Receiver>, EngineError> {
    let mut receivers = interested_in_code(db, kind, site).await?;
    // The alert or the webhook may be of an earlier version, with the other code of the kind.
    if let Some(other) = alert_kind::other_code(kind) {
        for receiver in interested_in_code(db, &other, site).await? {
            if receivers.iter().all(|known| known.id != receiver.id) {
                receivers.push(receiver);
            }
        }
    }
    Ok(receivers)
}

async fn interested_in_code(
    db: &mut Connection,
    kind: &AlertCode,
    site: Option<&SiteId>,
) -> Result<Vec<Receiver>, EngineError> {
    let (kind, site) = (kind.as_str(), site.map(SiteId::as_str));
    let rows = sqlx::query!(
        "SELECT id, url, secret FROM webhooks
         WHERE enabled = TRUE
           AND (kinds IS NULL OR $1 IN (SELECT value FROM json_each(kinds)))
           AND (sites IS NULL OR CAST($2 AS TEXT) IS NULL OR $2 IN (SELECT value FROM json_each(sites)))
         ORDER BY id",
        kind,
        site,
    );
    let rows = rows.fetch_all(db).await?;
    let receivers = rows.into_iter().map(|row| {
        Ok(Receiver {
            id: parse("webhook", &row.id)?,
            url: row.url,
            secret: row.secret,
        })
    });
    receivers.collect()
}

/// Queues a delivery; has no effect if it is queued already.
pub async fn queue(db: &mut Connection, new: &NewDelivery) -> Result<(), EngineError> {
    let (id, webhook) = (new.id.to_string(), new.webhook.to_string());
    let alert = new.alert.map(|alert| alert.to_string());
    let (event, kind, at_us) = (new.event.as_str(), new.kind.as_str(), to_us(new.at));
    sqlx::query!(
        "INSERT INTO webhook_deliveries (id, webhook_id, alert_id, event, kind, body, state,
             created_at_us, due_at_us)
         VALUES ($1, $2, $3, $4, $5, $6, 'pending', $7, $7) ON CONFLICT DO NOTHING",
        id,
        webhook,
        alert,
        event,
        kind,
        new.body,
        at_us,
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Drops a webhook's oldest waiting deliveries beyond `pending_max`; returns how many.
pub async fn drop_oldest(
    db: &mut Connection,
    webhook: WebhookId,
    pending_max: u32,
    at: Timestamp,
) -> Result<u64, EngineError> {
    let (webhook, at_us) = (webhook.to_string(), to_us(at));
    let done = sqlx::query!(
        "UPDATE webhook_deliveries
         SET state = 'dropped', ended_at_us = $3,
             detail = 'more deliveries were waiting than are kept'
         WHERE webhook_id = $1 AND state = 'pending'
           AND id <= (SELECT more.id FROM webhook_deliveries AS more
               WHERE more.webhook_id = $1 AND more.state = 'pending'
               ORDER BY more.id DESC LIMIT 1 OFFSET $2)",
        webhook,
        i64::from(pending_max),
        at_us,
    )
    .execute(db)
    .await?;
    Ok(done.rows_affected())
}

/// Returns of each webhook the oldest delivery that is due. Of a webhook that is not enabled only
/// tests are sent.
pub async fn due(db: &mut Connection, times: DueTimes) -> Result<Vec<Due>, EngineError> {
    let (now_us, latest_us) = (to_us(times.now), to_us(times.latest));
    let rows = sqlx::query!(
        "SELECT webhooks.id AS webhook, webhooks.url, webhooks.secret, one.id, one.body,
             one.attempts, one.created_at_us
         FROM webhooks
         JOIN webhook_deliveries AS one ON one.id = (
             SELECT first.id FROM webhook_deliveries AS first
             WHERE first.webhook_id = webhooks.id AND first.state = 'pending'
               AND (first.due_at_us <= $1 OR first.due_at_us > $2)
               AND (webhooks.enabled = TRUE OR first.event = 'test')
             ORDER BY first.id LIMIT 1)
         ORDER BY one.id",
        now_us,
        latest_us,
    );
    let rows = rows.fetch_all(db).await?;
    let due = rows.into_iter().map(|row| {
        Ok(Due {
            webhook: parse("webhook", &row.webhook)?,
            url: row.url,
            secret: row.secret,
            id: parse("delivery", &row.id)?,
            body: row.body,
            attempts: unsigned("count", row.attempts)?,
            created_at: from_us(row.created_at_us)?,
        })
    });
    due.collect()
}

/// Stores the outcome of an attempt. A delivery that was dropped meanwhile only counts if it has
/// arrived.
pub async fn record_attempt(db: &mut Connection, outcome: &Outcome) -> Result<(), EngineError> {
    let (id, state) = (outcome.id.to_string(), outcome.state.as_str());
    let (at_us, due_at_us) = (to_us(outcome.at), to_us(outcome.due_at));
    let ended_at_us = (outcome.state != DeliveryState::Pending).then_some(at_us);
    sqlx::query!(
        "UPDATE webhook_deliveries
         SET state = $2, attempts = attempts + 1, last_attempt_at_us = $3, due_at_us = $4,
             status = $5, detail = $6, ended_at_us = $7
         WHERE id = $1 AND (state = 'pending' OR $2 = 'delivered')",
        id,
        state,
        at_us,
        due_at_us,
        outcome.status.map(i64::from),
        outcome.detail,
        ended_at_us,
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Returns whether a waiting delivery was queued before a time.
pub async fn has_older(db: &mut Connection, than: Timestamp) -> Result<bool, EngineError> {
    let than_us = to_us(than);
    let found = sqlx::query_scalar!(
        r#"SELECT EXISTS (SELECT 1 FROM webhook_deliveries
               WHERE state = 'pending' AND created_at_us < $1) AS "found!: bool""#,
        than_us
    );
    Ok(found.fetch_one(db).await?)
}

/// Gives up the waiting deliveries beyond a limit; returns how many.
pub async fn abandon_oldest(db: &mut Connection, limit: AgeLimit) -> Result<u64, EngineError> {
    let (oldest_us, now_us) = (to_us(limit.oldest), to_us(limit.now));
    let done = sqlx::query!(
        "UPDATE webhook_deliveries
         SET state = 'failed', ended_at_us = $2,
             detail = 'given up: it waited too long; ' || COALESCE(detail, 'it was never sent')
         WHERE state = 'pending' AND created_at_us < $1",
        oldest_us,
        now_us,
    )
    .execute(db)
    .await?;
    Ok(done.rows_affected())
}

/// Deletes a webhook's oldest deliveries that do not wait, beyond `kept` of them.
pub async fn prune(db: &mut Connection, webhook: WebhookId, kept: u32) -> Result<(), EngineError> {
    let webhook = webhook.to_string();
    sqlx::query!(
        "DELETE FROM webhook_deliveries
         WHERE webhook_id = $1 AND state <> 'pending'
           AND id <= (SELECT more.id FROM webhook_deliveries AS more
               WHERE more.webhook_id = $1 AND more.state <> 'pending'
               ORDER BY more.id DESC LIMIT 1 OFFSET $2)",
        webhook,
        i64::from(kept),
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Returns a webhook's deliveries that are older than one, newest first.
pub async fn deliveries(
    db: &mut Connection,
    webhook: WebhookId,
    before: Option<DeliveryId>,
    limit: u32,
) -> Result<Vec<Delivery>, EngineError> {
    let (webhook, before) = (webhook.to_string(), before.map(|id| id.to_string()));
    let rows = sqlx::query!(
        "SELECT id, alert_id, event, kind, state, created_at_us, due_at_us, attempts,
             last_attempt_at_us, status, detail, ended_at_us
         FROM webhook_deliveries
         WHERE webhook_id = $1 AND (CAST($2 AS TEXT) IS NULL OR id < $2) ORDER BY id DESC LIMIT $3",
        webhook,
        before,
        i64::from(limit),
    );
    let rows = rows.fetch_all(db).await?;
    let deliveries = rows.into_iter().map(|row| {
        let state = DeliveryState::from_name(&row.state);
        let state = state.ok_or_else(|| corrupt("state of a delivery", &row.state))?;
        let event = NoticeEvent::from_name(&row.event);
        let alert = row.alert_id.map(|alert| parse("alert", &alert));
        let status = row.status.map(|status| unsigned("status", status));
        let is_pending = state == DeliveryState::Pending;
        let next_us = is_pending.then_some(row.due_at_us);
        Ok(Delivery {
            id: parse("delivery", &row.id)?,
            alert: alert.transpose()?,
            event: event.ok_or_else(|| corrupt("event of a delivery", &row.event))?,
            kind: parse("alert code", &row.kind)?,
            state,
            created_at: from_us(row.created_at_us)?,
            attempts: unsigned("count", row.attempts)?,
            last_attempt_at: row.last_attempt_at_us.map(from_us).transpose()?,
            next_attempt_at: next_us.map(from_us).transpose()?,
            status: status.transpose()?,
            detail: row.detail,
            ended_at: row.ended_at_us.map(from_us).transpose()?,
        })
    });
    deliveries.collect()
}
