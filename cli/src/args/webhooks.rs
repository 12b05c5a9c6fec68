//! Arguments of `tread webhooks`.

use clap::{Args, Subcommand};
use tread_api::ids::{AlertCode, SiteId};

use super::Connection;

/// Default number of deliveries in the log that is shown.
const DELIVERIES_DEFAULT: u32 = 20;

#[derive(Debug, Args)]
pub(crate) struct WebhooksArguments {
    #[command(subcommand)]
    pub(crate) action: Option<WebhooksAction>,
    #[command(flatten)]
    pub(crate) connection: Connection,
}

/// A webhook, by its name or identifier.
#[derive(Debug, Args)]
pub(crate) struct NamedWebhook {
    /// Name or identifier of the webhook
    #[arg(value_name = "WEBHOOK")]
    pub(crate) name: String,
}

#[derive(Debug, Subcommand)]
pub(crate) enum WebhooksAction {
    /// List webhooks, newest first
    List,
    /// Add a webhook; its secret is printed only once
    Add {
        /// Name of the webhook, for people
        name: String,
        /// URL to which alerts are sent, https unless the server's configuration allows http
        url: String,
        /// Kinds of alerts to send, separated by commas; all if absent
        #[arg(long, value_name = "KINDS", value_delimiter = ',')]
        kinds: Option<Vec<AlertCode>>,
        /// Sites whose alerts are sent, separated by commas; all if absent
        #[arg(long = "for", value_name = "SITES", value_delimiter = ',')]
        sites: Option<Vec<SiteId>>,
        /// Add it disabled: only tests are sent until it is enabled
        #[arg(long)]
        disabled: bool,
    },
    /// Remove a webhook and its deliveries, including pending ones
    Remove(NamedWebhook),
    /// Send a test to a webhook and wait for its outcome; exits with 1 if it did not arrive
    Test(NamedWebhook),
    /// List the deliveries to a webhook, pending ones included, newest first
    Deliveries {
        #[command(flatten)]
        webhook: NamedWebhook,
        /// Maximum number of deliveries
        #[arg(long, default_value_t = DELIVERIES_DEFAULT,
            value_parser = clap::value_parser!(u32).range(1..=1_000))]
        limit: u32,
    },
    /// Enable a webhook: alerts are sent to it, including pending ones
    Enable(NamedWebhook),
    /// Disable a webhook: no further alerts are queued, and pending ones are kept for a day
    Disable(NamedWebhook),
    /// Rotate the secret of a webhook: deliveries are signed with the new one from now on; it is
    /// printed only once
    Rotate(NamedWebhook),
}
