//! Requests about webhooks.

use reqwest::Method;
use serde_json::json;
use tread_api::ids::WebhookId;
use tread_api::page::Page;
use tread_api::webhook::{CreatedWebhook, Delivery, Webhook, WebhookSettings};

use super::{Client, ClientError};

impl Client {
    /// Lists webhooks, newest first.
    pub(crate) async fn webhooks(&self) -> Result<Vec<Webhook>, ClientError> {
        self.all("/v1/webhooks").await
    }

    /// Creates a webhook.
    pub(crate) async fn create_webhook(
        &self,
        settings: &WebhookSettings,
    ) -> Result<CreatedWebhook, ClientError> {
        self.post("/v1/webhooks", settings).await
    }

    /// Replaces the settings of a webhook.
    pub(crate) async fn replace_webhook(
        &self,
        id: WebhookId,
        settings: &WebhookSettings,
    ) -> Result<Webhook, ClientError> {
        let request = self.request(Method::PUT, &format!("/v1/webhooks/{id}"));
        self.send(request.json(settings)).await
    }

    /// Gives a webhook a new secret.
    pub(crate) async fn rotate_webhook_secret(
        &self,
        id: WebhookId,
    ) -> Result<CreatedWebhook, ClientError> {
        self.post(&format!("/v1/webhooks/{id}/secret"), &json!({}))
            .await
    }

    /// Deletes a webhook.
    pub(crate) async fn delete_webhook(&self, id: WebhookId) -> Result<Webhook, ClientError> {
        self.delete(&format!("/v1/webhooks/{id}")).await
    }

    /// Queues a test of a webhook.
    pub(crate) async fn test_webhook(&self, id: WebhookId) -> Result<Delivery, ClientError> {
        self.post(&format!("/v1/webhooks/{id}/test"), &json!({}))
            .await
    }

    /// Lists the newest deliveries of a webhook, at most `limit`.
    pub(crate) async fn webhook_deliveries(
        &self,
        id: WebhookId,
        limit: u32,
    ) -> Result<Page<Delivery>, ClientError> {
        let query = vec![("limit", limit.to_string())];
        self.get_with(&format!("/v1/webhooks/{id}/deliveries"), &query)
            .await
    }
}
