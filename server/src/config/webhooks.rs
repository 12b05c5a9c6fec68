//! `[webhooks]`: to which addresses alerts may be sent.

use std::path::PathBuf;

use serde::Deserialize;

use super::ConfigError;
use crate::identity::address::Network;
use crate::identity::origin::Origin;

/// Maximum number of networks that are allowed beside public addresses.
pub const NETWORKS_MAX: usize = 100;

/// `[webhooks]`: to which addresses alerts may be sent.
#[derive(Debug, Clone, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct WebhooksConfig {
    /// Whether URLs may be `http`, whose deliveries everybody on the path can read.
    pub allow_http: bool,
    /// Networks whose addresses may be called although they are not public, for instance that of a
    /// receiver in the company's own network.
    pub allowed_networks: Vec<Network>,
    /// File with CA certificates to trust in addition to the machine's, PEM.
    pub ca: Option<PathBuf>,
    /// Origin under which people reach this server, for the links in deliveries.
    pub public_url: Option<Origin>,
}

impl WebhooksConfig {
    pub(super) fn check(&self) -> Result<(), ConfigError> {
        let count = self.allowed_networks.len();
        if count > NETWORKS_MAX {
            return Err(ConfigError::TooMany {
                key: "webhooks.allowed_networks",
                count,
                most: NETWORKS_MAX,
            });
        }
        Ok(())
    }
}
