//! `/v1/webhooks`.

use axum::extract::State;
use axum::http::StatusCode;
use tread_api::ids::WebhookId;
use tread_api::page::Page;
use tread_api::problem::ProblemBody;
use tread_api::webhook::{CreatedWebhook, Delivery, Webhook, WebhookSettings};

use super::extract::{Json, Path, Query, cursor, page_limit};
use super::problem::Problem;
use super::sites::PageQuery;
use super::subject::Subject;
use crate::app::App;

/// List webhooks, newest first.
#[utoipa::path(get, path = "/v1/webhooks", tag = "webhooks", operation_id = "list_webhooks",
    security(("token" = ["administer"])), params(PageQuery),
    responses((status = 200, body = Page<Webhook>), (status = 400, body = ProblemBody)))]
pub(super) async fn list(
    State(app): State<App>,
    Query(query): Query<PageQuery>,
) -> Result<Json<Page<Webhook>>, Problem> {
    let limit = page_limit(query.limit)?;
    let before = cursor(query.cursor.as_deref())?;
    Ok(Json(app.list_webhooks(before, limit).await?))
}

/// Create a webhook, to which alerts are sent.
///
/// Only this response contains its secret.
#[utoipa::path(post, path = "/v1/webhooks", tag = "webhooks", operation_id = "create_webhook",
    security(("token" = ["administer"])), request_body = WebhookSettings,
    responses((status = 201, body = CreatedWebhook), (status = 409, body = ProblemBody),
        (status = 422, body = ProblemBody)))]
pub(super) async fn create(
    State(app): State<App>,
    Subject(subject): Subject,
    Json(settings): Json<WebhookSettings>,
) -> Result<(StatusCode, Json<CreatedWebhook>), Problem> {
    let created = app.create_webhook(settings, &subject.name).await?;
    Ok((StatusCode::CREATED, Json(created)))
}

/// Get a webhook.
#[utoipa::path(get, path = "/v1/webhooks/{webhook}", tag = "webhooks",
    operation_id = "get_webhook", security(("token" = ["administer"])),
    params(("webhook" = WebhookId, Path)),
    responses((status = 200, body = Webhook), (status = 404, body = ProblemBody)))]
pub(super) async fn get(
    State(app): State<App>,
    Path(webhook): Path<WebhookId>,
) -> Result<Json<Webhook>, Problem> {
    Ok(Json(app.webhook(webhook).await?))
}

/// Replace the settings of a webhook; its secret stays.
#[utoipa::path(put, path = "/v1/webhooks/{webhook}", tag = "webhooks",
    operation_id = "replace_webhook", security(("token" = ["administer"])),
    params(("webhook" = WebhookId, Path)), request_body = WebhookSettings,
    responses((status = 200, body = Webhook), (status = 404, body = ProblemBody),
        (status = 409, body = ProblemBody), (status = 422, body = ProblemBody)))]
pub(super) async fn replace(
    State(app): State<App>,
    Path(webhook): Path<WebhookId>,
    Json(settings): Json<WebhookSettings>,
) -> Result<Json<Webhook>, Problem> {
    Ok(Json(app.change_webhook(webhook, settings).await?))
}

/// Delete a webhook and its deliveries, including pending ones.
#[utoipa::path(delete, path = "/v1/webhooks/{webhook}", tag = "webhooks",
    operation_id = "delete_webhook", security(("token" = ["administer"])),
    params(("webhook" = WebhookId, Path)),
    responses((status = 200, body = Webhook), (status = 404, body = ProblemBody)))]
pub(super) async fn delete(
    State(app): State<App>,
    Path(webhook): Path<WebhookId>,
) -> Result<Json<Webhook>, Problem> {
    Ok(Json(app.delete_webhook(webhook).await?))
}

/// Rotate the secret of a webhook.
///
/// From now on deliveries are signed with the new secret. Only this response contains it.
#[utoipa::path(post, path = "/v1/webhooks/{webhook}/secret", tag = "webhooks",
    operation_id = "rotate_webhook_secret", security(("token" = ["administer"])),
    params(("webhook" = WebhookId, Path)),
    responses((status = 200, body = CreatedWebhook), (status = 404, body = ProblemBody)))]
pub(super) async fn rotate(
    State(app): State<App>,
    Path(webhook): Path<WebhookId>,
) -> Result<Json<CreatedWebhook>, Problem> {
    Ok(Json(app.rotate_webhook_secret(webhook).await?))
}

/// Send a test to a webhook, whether or not it is enabled.
///
/// The response is the queued delivery; the log of deliveries shows its result.
#[utoipa::path(post, path = "/v1/webhooks/{webhook}/test", tag = "webhooks",
    operation_id = "test_webhook", security(("token" = ["administer"])),
    params(("webhook" = WebhookId, Path)),
    responses((status = 202, body = Delivery), (status = 404, body = ProblemBody)))]
pub(super) async fn test(
    State(app): State<App>,
    Path(webhook): Path<WebhookId>,
) -> Result<(StatusCode, Json<Delivery>), Problem> {
    let queued = app.test_webhook(webhook).await?;
    Ok((StatusCode::ACCEPTED, Json(queued)))
}

/// List the deliveries of a webhook, newest first: pending ones and the last thousand others.
#[utoipa::path(get, path = "/v1/webhooks/{webhook}/deliveries", tag = "webhooks",
    operation_id = "list_webhook_deliveries", security(("token" = ["administer"])),
    params(("webhook" = WebhookId, Path), PageQuery),
    responses((status = 200, body = Page<Delivery>), (status = 400, body = ProblemBody),
        (status = 404, body = ProblemBody)))]
pub(super) async fn deliveries(
    State(app): State<App>,
    Path(webhook): Path<WebhookId>,
    Query(query): Query<PageQuery>,
) -> Result<Json<Page<Delivery>>, Problem> {
    let limit = page_limit(query.limit)?;
    let before = cursor(query.cursor.as_deref())?;
    Ok(Json(app.webhook_deliveries(webhook, before, limit).await?))
}
