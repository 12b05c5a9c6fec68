//! `tread webhooks`: where alerts are sent, and what became of it.

use std::process::ExitCode;
use std::time::Duration;

use anyhow::Context as _;
use tread_api::ids::DeliveryId;
use tread_api::page::PAGE_LIMIT_DEFAULT;
use tread_api::webhook::{CreatedWebhook, Delivery, DeliveryState, Webhook, WebhookSettings};

use crate::args::{NamedWebhook, WebhooksAction, WebhooksArguments};
use crate::client::{Client, ClientError};
use crate::output::{Output, or_dash, print_note, render, table};

/// Interval between looks at a test that is under way.
const POLL_INTERVAL: Duration = Duration::from_millis(250);
/// Number of looks after which a test counts as not arrived: longer than an attempt takes.
const POLLS_MAX: u32 = 80;

pub(super) async fn run(
    arguments: WebhooksArguments,
    client: &Client,
    output: Output,
) -> anyhow::Result<ExitCode> {
    match arguments.action {
        None | Some(WebhooksAction::List) => {
            output.show(&client.webhooks().await?, |webhooks| list(webhooks))?;
        }
        Some(WebhooksAction::Add {
            name,
            url,
            kinds,
            sites,
            disabled,
        }) => {
            let settings = WebhookSettings {
                name,
                url,
                kinds,
                sites,
                enabled: !disabled,
            };
            let created = client.create_webhook(&settings).await?;
            show_secret(&created, output)?;
        }
        Some(WebhooksAction::Remove(named)) => {
            let webhook = find(client, &named).await?;
            let removed = client.delete_webhook(webhook.id).await?;
            output.show(&removed, |webhook| format!("`{}` is removed", webhook.name))?;
        }
        Some(WebhooksAction::Test(named)) => {
            let webhook = find(client, &named).await?;
            let queued = client.test_webhook(webhook.id).await?;
            let tried = await_attempt(client, &webhook, queued.id).await?;
            let has_arrived = tried.state == DeliveryState::Delivered;
            output.show(&tried, outcome)?;
            return Ok(if has_arrived {
                ExitCode::SUCCESS
            } else {
                ExitCode::FAILURE
            });
        }
        Some(WebhooksAction::Deliveries { webhook, limit }) => {
            let webhook = find(client, &webhook).await?;
            let page = client.webhook_deliveries(webhook.id, limit).await?;
            output.show(&page.items, |deliveries| log(deliveries))?;
        }
        Some(WebhooksAction::Enable(named)) => set_enabled(client, &named, true, output).await?,
        Some(WebhooksAction::Disable(named)) => set_enabled(client, &named, false, output).await?,
        Some(WebhooksAction::Rotate(named)) => {
            let webhook = find(client, &named).await?;
            let rotated = client.rotate_webhook_secret(webhook.id).await?;
            show_secret(&rotated, output)?;
        }
    }
    Ok(ExitCode::SUCCESS)
}

async fn find(client: &Client, named: &NamedWebhook) -> anyhow::Result<Webhook> {
    let is_it = |webhook: &Webhook| {
        webhook.name == named.name || webhook.id.to_string() == named.name.to_lowercase()
    };
    let found = client.webhooks().await?.into_iter().find(is_it);
    let unknown = || ClientError::NoSuchWebhook {
        name: named.name.clone(),
    };
    found.ok_or_else(|| unknown().into())
}

fn show_secret(created: &CreatedWebhook, output: Output) -> anyhow::Result<()> {
    if !output.is_json() {
        let Webhook { name, url, .. } = &created.webhook;
        print_note(&format!(
            "webhook `{name}` to {url}; its secret is shown only once:"
        ));
    }
    output.show(created, |created| created.secret.clone())
}

async fn set_enabled(
    client: &Client,
    named: &NamedWebhook,
    enabled: bool,
    output: Output,
) -> anyhow::Result<()> {
    let webhook = find(client, named).await?;
    let settings = WebhookSettings {
        enabled,
        ..webhook.settings()
    };
    let changed = client.replace_webhook(webhook.id, &settings).await?;
    let state = if enabled { "enabled" } else { "disabled" };
    output.show(&changed, |webhook| format!("`{}` is {state}", webhook.name))
}

/// Waits for the first attempt to send a delivery.
async fn await_attempt(
    client: &Client,
    webhook: &Webhook,
    id: DeliveryId,
) -> anyhow::Result<Delivery> {
    let mut last = None;
    for _ in 0..POLLS_MAX {
        let page = client.webhook_deliveries(webhook.id, PAGE_LIMIT_DEFAULT);
        let found = page.await?.items.into_iter().find(|one| one.id == id);
        match found {
            Some(delivery) if delivery.attempts > 0 => return Ok(delivery),
            found => last = found.or(last),
        }
        tokio::time::sleep(POLL_INTERVAL).await;
    }
    last.context("the test is not in the log of deliveries")
}

fn outcome(delivery: &Delivery) -> String {
    let status = delivery.status.map(|status| status.to_string());
    match &delivery.detail {
        None if delivery.state == DeliveryState::Delivered => {
            format!("it arrived; the answer was {}", or_dash(status))
        }
        None => "it waits: another delivery is under way or has just failed".to_owned(),
        Some(detail) => format!("it did not arrive: {detail}"),
    }
}

fn list(webhooks: &[Webhook]) -> String {
    if webhooks.is_empty() {
        return "there are no webhooks".to_owned();
    }
    let mut table = table([
        "WEBHOOK", "NAME", "URL", "KINDS", "SITES", "ENABLED", "WAITING",
    ]);
    for webhook in webhooks {
        table.add_row([
            webhook.id.to_string(),
            webhook.name.clone(),
            webhook.url.clone(),
            names(webhook.kinds.as_deref()),
            names(webhook.sites.as_deref()),
            if webhook.enabled { "yes" } else { "no" }.to_owned(),
            webhook.pending.to_string(),
        ]);
    }
    render(&table)
}

/// Returns the names of a list; `all` if it is absent.
fn names<T: ToString>(listed: Option<&[T]>) -> String {
    let Some(listed) = listed else {
        return "all".to_owned();
    };
    let names: Vec<String> = listed.iter().map(ToString::to_string).collect();
    names.join(", ")
}

fn log(deliveries: &[Delivery]) -> String {
    if deliveries.is_empty() {
        return "nothing was sent".to_owned();
    }
    let mut table = table([
        "DELIVERY", "QUEUED", "KIND", "EVENT", "STATE", "TRIES", "NEXT", "STATUS", "WHY",
    ]);
    for delivery in deliveries {
        table.add_row([
            delivery.id.to_string(),
            format!("{:.0}", delivery.created_at),
            delivery.kind.to_string(),
            delivery.event.as_str().to_owned(),
            delivery.state.as_str().to_owned(),
            delivery.attempts.to_string(),
            or_dash(delivery.next_attempt_at.map(|at| format!("{at:.0}"))),
            or_dash(delivery.status.map(|status| status.to_string())),
            or_dash(delivery.detail.clone()),
        ]);
    }
    render(&table)
}
